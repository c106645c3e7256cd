"""Utilities (acquisition functions) of readings: information, about all or some parameters, or to end a run.

A `Utility` gives each available design a number from the whole posterior, the designs and the sensor (`UtilityInput`).
`ReadingEntropy` is the paper's, of few hypotheses; `InformationGain` subtracts the entropy of the noise (Lindley 1956).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray, require_finite
from probewise.errors import ParameterError, did_you_mean, require
from probewise.inquiry.entropy import UtilityMap, choose, label_entropy, map_of_rows
from probewise.inquiry.forecast import Forecast, PredictiveDistributions, resampled_rows_and_weights
from probewise.inquiry.grid import Designs
from probewise.inquiry.predictive import WeightsGivenReading
from probewise.inquiry.readout import MOST_LEVELS, Readout, entropy_bits
from probewise.recordings.plan import Plan

_CELL = 0.75  # width of a cell in noise sds, for unrounded readings: loses 2 % of a nat, uniformly
_SETTLED = 1.0 - 1e-7  # weight of one level from which it counts as certain
_BLOCK = 512  # designs per batch, to fit the cache
_NEAR = 15.0  # times the target sd: beyond it, no single reading ends a run
_MOST_PREDICTED = 800  # hypotheses for the probability of reaching the target
_MOST_DESIGNS = 250  # the best by the other utility
_OUTCOMES = 16  # simulated outcomes of the readings of a batch chosen so far
_FEW = 600  # hypotheses used to simulate them


@dataclass(frozen=True)
class Goal:
    """The target sd of a run, a part of its stopping rule: the posterior sds of `columns` of theta are below `sd`."""

    columns: tuple[int, ...]
    sd: float


@dataclass(frozen=True, eq=False)
class UtilityInput:
    """Posterior, designs and sensor, with the quantities that utilities need.

    Attributes
    ----------
    forecast
        Predictions, with the sensor model.
    readout
        Noise, rounding and range of a reading.
    theta, weight
        The whole posterior, (n_samples, n_params), and its weights, (n_samples,), summing to one.
    drawn
        A few equally weighted posterior samples, (n_drawn, n_params); 50 in the paper.
    designs, plan
        The designs, and the same as rows of a plan.
    rows
        Indices of the available designs, (n,); all results are for these, in this order.
    cost_s
        Seconds that each available design takes, (n,).
    goal
        The target sd of the lengths; None for a set of shapes.
    """

    forecast: Forecast
    readout: Readout
    theta: FloatArray
    weight: FloatArray
    drawn: FloatArray
    designs: Designs
    plan: Plan
    rows: IntArray
    cost_s: FloatArray
    goal: Goal | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, one per column of theta."""
        return self.forecast.model.names

    @cached_property
    def predicted(self) -> FloatArray:
        """Noise-free readings of the drawn samples at every available design, (n_drawn, n)."""
        predicted = self.forecast.predict(self.drawn, self.plan.take(self.rows))
        require_finite("predicted", predicted)
        return predicted

    @cached_property
    def predictive(self) -> PredictiveDistributions:
        """Predictive distribution under the whole posterior, as weights of levels."""
        noise_sd = self.readout.noise_sd / np.sqrt(max(self.designs.repeats))
        return self.forecast.predictive(self.theta, self.weight, self.designs, self.plan, self.rows, noise_sd)

    def information(self, weight: FloatArray, *, with_noise: bool = False) -> FloatArray:
        """Return the expected information in bits of a reading at every available design, for weights (n_samples,).

        `with_noise`: the whole entropy of the reading, of which noise, rounding and range are not subtracted. The
        weights need not sum to one, and may be 0 for some hypotheses.
        """
        out = np.empty(len(self.rows))
        for at, mass in self.predictive.level_weights(weight):
            n = int(self.designs.n_repeats[self.rows[at[0]]])  # the same for all of them
            exact = self.readout.cell_probability(self.predictive.levels, repeats=n, fine=_CELL, most=MOST_LEVELS)
            chance: FloatArray = np.asarray(exact.astype(np.float32))
            out[at] = _entropy_of_readings(mass, chance)
            if not with_noise:
                of_noise = mass @ entropy_bits(chance).astype(np.float64) / mass.sum(axis=1)
                out[at] = np.maximum(out[at] - of_noise, 0.0)
        return out


def _entropy_of_readings(mass: FloatArray, chance: FloatArray) -> FloatArray:
    """Return the entropy in bits of the reading's cell, for unnormalised weights of levels (n, n_levels): (n,)."""
    level = mass.argmax(axis=1)
    settled = mass[np.arange(len(mass)), level] >= _SETTLED * mass.sum(axis=1)
    out = np.asarray(entropy_bits(chance)[level], dtype=np.float64)
    rest = np.flatnonzero(~settled)
    for start in range(0, len(rest), _BLOCK):
        block = rest[start : start + _BLOCK]
        part = mass[block].astype(np.float32)
        part /= part.sum(axis=1, keepdims=True)
        out[block] = entropy_bits(part @ chance)
    return out


class Utility(Protocol):
    """Utility of a reading at each design; larger is better. A frozen dataclass, so that a journal can record it."""

    @property
    def label(self) -> str:
        """Label with unit, for a colour bar."""
        ...

    def __call__(self, inputs: UtilityInput) -> FloatArray:
        """Return the utility of every available design, (n,)."""
        ...


@dataclass(frozen=True)
class ReadingEntropy:
    """Shannon entropy, in bits, of the readings that a few hypotheses predict (paper, section 2.3).

    The predictions are noise-free and fall into fixed bins, `bin_width` wide and centred on its multiples: one LEGO
    unit rounds as the sensor does. For the naive model there are two readings, so the map is the paper's partition: at
    most one bit, where half of the circles contain the place.
    """

    bin_width: float = 1.0

    label: ClassVar[str] = "entropy (bits)"

    def __post_init__(self) -> None:
        require(0 < self.bin_width < np.inf, "bin_width", self.bin_width, "finite, greater than 0")

    def __call__(self, inputs: UtilityInput) -> FloatArray:
        """Return the entropy in bits at every available design, (n,)."""
        return label_entropy(np.rint(inputs.predicted / self.bin_width))


@dataclass(frozen=True)
class InformationGain:
    """Expected information, in bits, about all parameters together (Lindley 1956).

    The entropy of the predictive distribution (parameters, noise, rounding and range) minus the expected entropy given
    the parameters, which is due to noise.
    """

    label: ClassVar[str] = "expected information (bits)"

    def __call__(self, inputs: UtilityInput) -> FloatArray:
        """Return the bits at every available design, (n,)."""
        return inputs.information(inputs.weight)


@dataclass(frozen=True)
class InformationAbout:
    """Expected information, in bits, about a partition of the hypotheses: by a parameter, or by the kind of shape.

    The entropy of the predictive distribution minus its expected entropy given the part: differences among hypotheses
    of one part do not count.
    """

    of: Partition

    @property
    def label(self) -> str:
        """Label that names the partition."""
        return f"information about {self.of} (bits)"

    def __call__(self, inputs: UtilityInput) -> FloatArray:
        """Return the bits at every available design, (n,)."""
        parts = self.of(inputs.names, inputs.theta, inputs.weight)
        bits = inputs.information(inputs.weight, with_noise=True)
        for part in np.unique(parts):
            weight = np.where(parts == part, inputs.weight, 0.0)
            if weight.sum() > 0:
                bits -= weight.sum() * inputs.information(weight, with_noise=True)
        return np.maximum(bits, 0.0)


@dataclass(frozen=True)
class PerSecond:
    """The utility `of` a reading per second, including travel; ParameterError if a cost is not above 0."""

    of: Utility = field(default_factory=InformationGain)

    @property
    def label(self) -> str:
        """Label of the other utility, per second."""
        return f"{self.of.label} per second"

    def __call__(self, inputs: UtilityInput) -> FloatArray:
        """Return the utility per second at every design, (n,)."""
        if not (inputs.cost_s > 0).all():
            allowed = "greater than 0: a reading takes time where the arm stands, too"
            raise ParameterError("cost_s", float(inputs.cost_s.min()), allowed)
        return self.of(inputs) / inputs.cost_s


@dataclass(frozen=True)
class Finishing:
    """Utility: the probability that the next reading reaches the target sd, if it may; until then another utility.

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
        require(0 < self.least <= 1, "least", self.least, "greater than 0, 1 or less")

    @property
    def label(self) -> str:
        """Label of the utility until then, and of its replacement near the end."""
        return f"{self.of.label}, or chance to finish"

    def __call__(self, inputs: UtilityInput) -> FloatArray:
        """Return the utility of every available design, (n,), all by the same one of the two.

        The probability is computed for the 250 designs best by the other utility; it is set to 0 for the rest.
        """
        return self.utility_and_label(inputs)[0]

    def utility_and_label(self, inputs: UtilityInput) -> tuple[FloatArray, str]:
        """Return the utility of every available design, (n,), and the label of the one used."""
        plain = self.of(inputs)
        if inputs.goal is None or not _may_end_with_one_more(inputs, inputs.goal):
            return plain, self.of.label
        best = np.argsort(-plain, kind="stable")[:_MOST_DESIGNS]
        chance = _probability_of_reaching_target(inputs, inputs.goal, best)
        if chance.max() < self.least:
            return plain, self.of.label
        out = np.zeros(len(plain))
        out[best] = chance
        return out, "probability that a reading there ends the run"


def _may_end_with_one_more(inputs: UtilityInput, goal: Goal) -> bool:
    """Return whether one more reading may end the run: the largest sd is 1 to 15 times the goal."""
    lengths = inputs.theta[:, goal.columns]
    spread = inputs.weight @ (lengths - inputs.weight @ lengths) ** 2
    return bool(goal.sd <= np.sqrt(spread.max()) < _NEAR * goal.sd)


def _probability_of_reaching_target(inputs: UtilityInput, goal: Goal, designs: IntArray) -> FloatArray:
    """Return the probability that a reading, or the mean of a design's repeats, reaches the target sd, (n,).

    `designs` are places in `rows`.
    """
    rows, share = resampled_rows_and_weights(inputs.weight, _MOST_PREDICTED)
    away = inputs.theta[rows][:, goal.columns]
    away = away - share @ away / share.sum()
    predicted = inputs.forecast.predict(inputs.theta[rows], inputs.plan.take(inputs.rows[designs]))
    n_repeats = inputs.designs.n_repeats[inputs.rows[designs]]

    def chance(predicted: FloatArray, n: int) -> FloatArray:
        weights = WeightsGivenReading.of(predicted, share, inputs.readout, repeats=n)
        return weights.probability_of_reaching_target(away, goal.sd)

    return by_repeats(chance, predicted, n_repeats)


def by_repeats(
    utility: Callable[[FloatArray, int], FloatArray], predicted: FloatArray, n_repeats: IntArray
) -> FloatArray:
    """Return the utility of each design, (n_designs,), from predictions, (n, n_designs), by its number of repeats.

    `utility` takes the predictions of designs with the same number of repeats, of which the mean counts.
    """
    out = np.empty(predicted.shape[1])
    for n in np.unique(n_repeats).tolist():
        same = np.flatnonzero(n_repeats == n)
        out[same] = utility(predicted[:, same], n)
    return out


class Partition(Protocol):
    """A partition of hypotheses; those of one part need not be distinguished."""

    def __call__(self, names: tuple[str, ...], theta: FloatArray, weight: FloatArray) -> IntArray:
        """Return each hypothesis's part, a whole number: (n_samples, n_params), (n_samples,) -> (n_samples,)."""
        ...


@dataclass(frozen=True)
class ParameterValue:
    """Partition by the value of the parameter `name`, in `n_bins` bins of equal posterior probability."""

    name: str
    n_bins: int = 16

    def __post_init__(self) -> None:
        require(self.n_bins >= 2, "n_bins", self.n_bins, "2 or more")

    def __str__(self) -> str:
        return self.name

    def __call__(self, names: tuple[str, ...], theta: FloatArray, weight: FloatArray) -> IntArray:
        """Return the bin of each hypothesis's parameter: (n_samples, n_params), (n_samples,) -> (n_samples,)."""
        require(self.name in names, "parameter", self.name, f"one of {', '.join(names)}")
        order = np.argsort(theta[:, names.index(self.name)], kind="stable")
        before = np.cumsum(weight[order]) - 0.5 * weight[order]
        out = np.empty(len(theta), dtype=np.int64)
        out[order] = np.minimum(self.n_bins * before / weight.sum(), self.n_bins - 1).astype(np.int64)
        return out


@dataclass(frozen=True)
class WhichShape:
    """Partition by the number of the shape, for hypotheses of a set of shapes (parameter "shape")."""

    def __str__(self) -> str:
        return "the shape"

    def __call__(self, names: tuple[str, ...], theta: FloatArray, weight: FloatArray) -> IntArray:
        """Return the number of each hypothesis's shape in the set, (n_samples,)."""
        require("shape" in names, "names", names, "shape among them: the hypotheses of two shapes or more")
        return np.floor(theta[:, names.index("shape")]).astype(np.int64)


UTILITY_NAMES = ("finishing", "information", "entropy", "per-second", "about:PARAMETER", "which-shape")


def utility_named(text: str, *, bin_width: float = 1.0) -> Utility:
    """Build a utility from its name, one of `UTILITY_NAMES`, such as "entropy" or "about:radius_mm".

    "finishing": `Finishing`; "information": `InformationGain`; "entropy": `ReadingEntropy`; "per-second": `PerSecond`
    of the information; "about:PARAMETER": `InformationAbout` that parameter; "which-shape": `InformationAbout` the
    shape.

    `bin_width` is the width of the bins of "entropy", in the unit of readings: the step of the instrument.
    ParameterError if no utility has the name, or `bin_width` is not above 0.
    """
    name, _, parameter = text.partition(":")
    if name == "about" and parameter:
        return InformationAbout(ParameterValue(parameter))
    plain: dict[str, Utility] = {
        "finishing": Finishing(),
        "information": InformationGain(),
        "entropy": ReadingEntropy(bin_width),
        "per-second": PerSecond(),
        "which-shape": InformationAbout(WhichShape()),
    }
    if text not in plain:
        raise ParameterError("utility", text, ", ".join(UTILITY_NAMES) + did_you_mean(name, UTILITY_NAMES))
    return plain[text]


def utility_map(inputs: UtilityInput, utility: Utility) -> UtilityMap:
    """Compute the utility of every available design (paper, section 2.3).

    ShapeError if the utility returns a wrong number of values, ParameterError if one of them is not finite, ReachError
    if no design is available.
    """
    if isinstance(utility, Finishing):  # the utility with two measures reports which one these values are
        values, label = utility.utility_and_label(inputs)
    else:
        values, label = utility(inputs), utility.label
    return map_of_rows(inputs.designs, inputs.rows, np.asarray(values, dtype=np.float64), label)


def choose_several(
    inputs: UtilityInput, n: int, *, rng: np.random.Generator, chance: FloatArray | None = None
) -> tuple[int, ...]:
    """Choose readings with large joint information, greedily one after another.

    Greedy on the joint information I(y_1 ... y_n) = I(y_1) + I(y_2 | y_1) + .... With exact terms it reaches at least
    1 - 1/e (63 %) of the information of the best set (Nemhauser, Wolsey & Fisher 1978). Here each conditional
    information is averaged over simulated outcomes: each is a draw from the predictive distribution, with its own
    posterior.

    Return indices of designs, from `inputs.rows`, in the order in which they were chosen; two may be the same.
    `chance` is the probability that a reading at each of these returns a value, (n,), by which its information counts.
    """
    everywhere = np.ones(len(inputs.rows), dtype=np.bool_)
    weighing = np.ones(1) if chance is None else chance
    chosen = [choose(inputs.information(inputs.weight) * weighing, everywhere, rng=rng)]
    rows, share = resampled_rows_and_weights(inputs.weight, _FEW)
    few = replace(inputs, theta=inputs.theta[rows], weight=share / share.sum())
    weights = [few.weight] * _OUTCOMES
    for _ in range(n - 1):
        # Each posterior after one reading that it simulates at the last design.
        level = few.forecast.predict(few.theta, few.plan.take(few.rows[[chosen[-1]]]))[:, 0]
        sd = few.readout.noise_sd / np.sqrt(few.designs.n_repeats[few.rows[chosen[-1]]])
        for k, weight in enumerate(weights):
            truth = rng.choice(len(weight), p=weight)
            after = weight * np.exp(-0.5 * ((level[truth] + sd * rng.standard_normal() - level) / sd) ** 2)
            weights[k] = after / after.sum()
        gain = np.mean([few.information(weight) for weight in weights], axis=0)
        chosen.append(choose(gain * weighing, everywhere, rng=rng))
    return tuple(int(inputs.rows[row]) for row in chosen)
