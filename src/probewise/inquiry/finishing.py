"""Near the end, ask for the reading after which there may be nothing left to ask."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.inquiry.forecast import thinned
from probewise.inquiry.given_reading import GivenReading
from probewise.inquiry.prospect import Goal, Prospect
from probewise.inquiry.utility import InformationGain, Utility

__all__ = ["Finishing"]

_NEAR = 15.0  # times the sd that is asked for: farther off than that no single reading ends a run
_MOST_ASKED = 800  # hypotheses
_MOST_DESIGNS = 250  # the best by the other utility


@dataclass(frozen=True)
class Finishing:
    """Probability that the next reading ends the run, where some reading may well do so; otherwise another utility.

    Information counts every bit alike, also of what is known well enough. Greedy for bits, a robot goes on
    sharpening one length while another is still too wide; this looks at the sds that the run is to end on.

    Parameters
    ----------
    of
        What a reading is worth until then.
    least
        Probability of ending the run from which on it is all that counts.
    """

    of: Utility = field(default_factory=InformationGain)
    least: float = 0.25

    def __post_init__(self) -> None:
        if not 0 < self.least <= 1:
            raise ParameterError("least", self.least, "greater than 0, up to 1")

    @property
    def label(self) -> str:
        """The other's, and what stands in its place near the end."""
        return f"{self.of.label}, or chance to finish"

    def __call__(self, prospect: Prospect) -> FloatArray:
        """Value every design that can be taken, (n,): all by the one measure or all by the other."""
        return self.measure(prospect)[0]

    def measure(self, prospect: Prospect) -> tuple[FloatArray, str]:
        """Value every design that can be taken, (n,), and say by which of the two measures, as a colour bar does."""
        worth = self.of(prospect)
        if prospect.goal is None or not _is_near(prospect, prospect.goal):
            return worth, self.of.label
        best = np.argsort(-worth, kind="stable")[:_MOST_DESIGNS]
        chance = _ends(prospect, prospect.goal, best)
        if chance.max() < self.least:
            return worth, self.of.label
        out = np.zeros(len(worth))
        out[best] = chance
        return out, "probability that a reading there ends the run"


def _is_near(prospect: Prospect, goal: Goal) -> bool:
    """Whether one more reading may end the run, and none has yet."""
    lengths = prospect.theta[:, goal.columns]
    spread = prospect.weight @ (lengths - prospect.weight @ lengths) ** 2
    return bool(goal.sd <= np.sqrt(spread.max()) < _NEAR * goal.sd)


def _ends(prospect: Prospect, goal: Goal, designs: IntArray) -> FloatArray:
    """Probability of a reading after which every length is known well enough, at some designs, (n_designs,)."""
    rows, share = thinned(prospect.weight, _MOST_ASKED)
    away = prospect.theta[rows][:, goal.columns]
    away = away - share @ away / share.sum()
    answers = prospect.forecast.predict(prospect.theta[rows], prospect.plan.take(prospect.rows[designs]))
    given = GivenReading(answers, share, prospect.readout)
    ends = np.ones(given.mass.shape, dtype=np.bool_)
    for length in away.T:
        mean = given.sum(length) / given.mass
        ends &= given.sum(length**2) / given.mass - mean**2 < goal.sd**2
    return np.asarray((given.mass * ends).sum(axis=1) / given.mass.sum(axis=1))
