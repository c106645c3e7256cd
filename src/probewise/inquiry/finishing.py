"""A utility for the end of a run: the probability that a reading ends it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.inquiry.forecast import resampled_rows_and_weights
from probewise.inquiry.given_reading import WeightsGivenReading
from probewise.inquiry.utility import InformationGain, Utility
from probewise.inquiry.utility_input import Goal, UtilityInput

_NEAR = 15.0  # times the target sd: beyond it, no single reading ends a run
_MOST_ASKED = 800  # hypotheses
_MOST_DESIGNS = 250  # the best by the other utility


@dataclass(frozen=True)
class Finishing:
    """Utility: the probability that the next reading ends the run, if that may be; until then another utility.

    Information counts bits on every parameter, even one that is known well enough: a greedy robot would refine one
    length while another is still too uncertain. This utility uses the sds of the stopping rule.

    Parameters
    ----------
    of
        The utility until then.
    least
        Probability of ending the run, above 0, at which it replaces the other utility.
    """

    of: Utility = field(default_factory=InformationGain)
    least: float = 0.25

    def __post_init__(self) -> None:
        if not 0 < self.least <= 1:
            raise ParameterError("least", self.least, "greater than 0, 1 or less")

    @property
    def label(self) -> str:
        """Label of the utility until then, and of its replacement near the end."""
        return f"{self.of.label}, or chance to finish"

    def __call__(self, utility_input: UtilityInput) -> FloatArray:
        """Return the utility of every available design, (n,), all by the same one of the two.

        The probability is computed for the 250 designs best by the other utility; it is set to 0 for the rest.
        """
        return self.utility_and_label(utility_input)[0]

    def utility_and_label(self, utility_input: UtilityInput) -> tuple[FloatArray, str]:
        """Return the utility of every available design, (n,), and the label of the one used."""
        plain = self.of(utility_input)
        if utility_input.goal is None or not _may_end_with_one_more(utility_input, utility_input.goal):
            return plain, self.of.label
        best = np.argsort(-plain, kind="stable")[:_MOST_DESIGNS]
        chance = _probability_of_ending(utility_input, utility_input.goal, best)
        if chance.max() < self.least:
            return plain, self.of.label
        out = np.zeros(len(plain))
        out[best] = chance
        return out, "probability that a reading there ends the run"


def _may_end_with_one_more(utility_input: UtilityInput, goal: Goal) -> bool:
    """Return whether one more reading may end the run: the largest sd is 1 to 15 times the goal."""
    lengths = utility_input.theta[:, goal.columns]
    spread = utility_input.weight @ (lengths - utility_input.weight @ lengths) ** 2
    return bool(goal.sd <= np.sqrt(spread.max()) < _NEAR * goal.sd)


def _probability_of_ending(utility_input: UtilityInput, goal: Goal, designs: IntArray) -> FloatArray:
    """Return the probability that a reading, or the mean of a design's repeats, reaches the target precision, (n,).

    `designs` are places in `rows`.
    """
    rows, share = resampled_rows_and_weights(utility_input.weight, _MOST_ASKED)
    away = utility_input.theta[rows][:, goal.columns]
    away = away - share @ away / share.sum()
    answers = utility_input.forecast.predict(
        utility_input.theta[rows], utility_input.plan.take(utility_input.rows[designs])
    )
    n_repeats = utility_input.designs.n_repeats[utility_input.rows[designs]]
    out = np.empty(len(designs))
    for n in np.unique(n_repeats).tolist():
        own = n_repeats == n
        given = WeightsGivenReading(answers[:, own], share, utility_input.readout, repeats=n)
        ends = np.ones(given.weight_by_cell.shape, dtype=np.bool_)
        for length in away.T:
            mean = given.weighted_sum_by_cell(length) / given.weight_by_cell
            ends &= given.weighted_sum_by_cell(length**2) / given.weight_by_cell - mean**2 < goal.sd**2
        out[own] = (given.weight_by_cell * ends).sum(axis=1) / given.weight_by_cell.sum(axis=1)
    return out
