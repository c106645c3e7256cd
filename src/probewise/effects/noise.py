"""Effects on the noise, single faulty readings and undeclared rounding among them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.effect import NoiseEffect, in_words
from probewise.effects.noise_distribution import FittedReadings
from probewise.effects.reference import Extent
from probewise.priors import LogHeavyTailedPrior, LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import NoiseParameters

_SPREADS = (0.1, 0.2, 0.4, 0.8, 1.6)  # hyperprior, equal weights: sds between runs of the logarithm of a run's sd
_NEWTON_STEPS = 40
_FAR = 4.0  # noise sds beyond which a reading may be lost rather than noisy
_NEAR_END = 1e-4  # of the range of a lost reading's value: distance of the bank's values from its ends
_TELLING = 15.0  # least ratio of a lattice's step to the rounding of the printed values
_DIGITS = 1e-6  # of a step: below this a difference is rounding


class CorrelatedNoise(NoiseEffect):
    """Correlated noise, AR(1) within a scan: e_k = rho e_(k-1) + new noise."""

    name, words, covariates = "correlated_noise", "correlated noise", ("scan",)
    units = ("1",)
    prior = Product({"rho": Uniform(-0.5, 0.95)})
    n_nodes = 28  # dense enough to integrate the posterior of a thousand readings
    says = in_words(
        "the noise of successive readings has correlation {0}: part of each error returns in the next reading"
    )

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, rho=theta[:, :1])


class SignalDependentNoise(NoiseEffect):
    """Noise that grows with the light: variance x (1 + ratio u), u the seen white fraction."""

    name, words, covariates = "signal_dependent_noise", "noise that grows with the signal", ("level",)
    units = ("1",)
    prior = Product({"ratio": LogUniform(0.05, 50.0)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, sd=value.sd * np.sqrt(1 + theta[:, :1] * np.clip(value.seen, 0.0, 1.0)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        times = f"{value_with_sd(1 + mean[0], sd[0])} times that at the lowest"
        return f"the noise grows with the reading: its variance at the highest level is {times}"


class DriftingNoise(NoiseEffect):
    """Noise whose sd grows or shrinks exponentially in time: sd x growth^(time / duration - 1/2).

    The effect is outside the vocabulary: a nuisance that keeps the tests of the mean valid. Time counts from the first
    reading to the last of the plan; no repaired model holds it, so that it never acts on another plan than the
    recording's.
    """

    name, words, covariates = "drifting_noise", "noise that changes in time", ("time",)
    units = ("1",)
    prior = Product({"growth": LogUniform(0.2, 5.0)})
    says = in_words("the sd of the noise at the end is {0} times that at the start")

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        elapsed = (plan.time_s - plan.time_s.min()) / (float(np.ptp(plan.time_s)) or 1.0)
        return replace(value, sd=value.sd * theta[:, :1] ** (elapsed - 0.5))


@dataclass(frozen=True)
class RandomWalk(NoiseEffect):
    """A random walk of the offset: a normal step from each row to the next, across runs too.

    `n_before` is the number of steps taken before the first row of the plan: the rows of the training data.
    """

    n_before: int = 0

    name, words, covariates = "random_walk", "a random walk of the zero", ("time", "row", "run")
    units = ("noise sd",)
    prior = Product({"sd_per_row": LogUniform(5e-3, 3.0)})
    n_nodes = 16
    says = in_words("the offset is a random walk with steps of sd {0} noise sds from row to row")

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, walk=theta[:, :1], walked=self.n_before + 1.0 + np.arange(float(len(plan))))


@dataclass(frozen=True)
class NoisePerRun(NoiseEffect):
    """Noise that differs between runs: sd x the run's value, whose logarithm has a heavy-tailed prior.

    `runs`: names of the runs; `n_rows`: number of readings from which each run's value was estimated; () where it is
    not needed.
    """

    runs: tuple[str, ...] = ()
    n_rows: tuple[int, ...] = ()

    name, words, covariates = "noise_per_run", "noise that differs from run to run", ("run",)
    amplitudes = ()
    nodes_per_parameter = ()  # they are most probable values about a fit

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        plan = extent.plan
        names = tuple(plan.scan_names)
        return cls(names, tuple(np.bincount(plan.scan, minlength=len(names)).tolist())) if len(names) > 1 else None

    @property
    def units(self) -> tuple[str, ...]:
        return ("1",) * len(self.runs)

    @property
    def nothing(self) -> dict[int, float]:
        return dict.fromkeys(range(len(self.runs)), 1.0)

    @cached_property
    def prior(self) -> Product:
        return Product({f"values[{run}]": LogHeavyTailedPrior(0.3) for run in self.runs})

    def bank(self) -> FloatArray:
        return np.ones((1, 1, len(self.runs)))

    def weighed_nodes(self, residuals: FloatArray, rows: FittedReadings) -> tuple[FloatArray, FloatArray]:
        """Return the runs' most probable values, (n_nodes, n_runs), and log Laplace weights, (n_nodes,).

        There is one node for each of five assumed sds, between runs, of the values' logs; none for a single run.
        """
        n_runs = len(self.runs)
        counts = np.bincount(rows.run, minlength=n_runs).astype(np.float64)
        squares: FloatArray = np.bincount(rows.run, residuals**2, minlength=n_runs).astype(np.float64)
        if n_runs < 2 or not (squares > 0).any():
            return np.zeros((0, n_runs)), np.zeros(0)
        values, log_weights = [], []
        for spread in _SPREADS:
            logs = _most_probable_log_sd_ratios(counts, squares, spread)
            curvature = 2 * counts + spread**-2
            # The overall sd is integrated elsewhere, at fixed values: `beside` corrects for its coupling to them.
            beside = float(np.sum(2 * counts * spread**-2 / curvature)) / float(2 * counts.sum())
            log_prior = -0.5 * float(np.sum((logs / spread) ** 2)) - n_runs * np.log(spread)
            log_weights.append(log_prior - 0.5 * float(np.log(curvature).sum() + np.log(beside)))
            values.append(np.exp(logs))
        return np.array(values), np.array(log_weights) - np.log(len(_SPREADS))

    def draws_about(self, nodes: FloatArray, *, rng: np.random.Generator) -> FloatArray | None:
        """Draw each run's value about its node, with relative sd 1 / sqrt(2 n_rows)."""
        widths = 1 / np.sqrt(2 * np.maximum(np.array(self.n_rows or (1,) * len(self.runs)), 1))
        return np.asarray(nodes * np.exp(widths * rng.standard_normal(nodes.shape)))

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        known = {name: k for k, name in enumerate(self.runs)}
        at = np.array([known.get(name, len(self.runs)) for name in plan.scan_names])
        values = np.concatenate([theta, np.ones((len(theta), 1))], axis=1)
        return replace(value, sd=value.sd * values[:, at[plan.scan]])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        low, high = int(np.argmin(mean)), int(np.argmax(mean))
        return (
            f"the noise differs from run to run: its sd is {value_with_sd(mean[high], sd[high])} times the typical one "
            f"in run {self.runs[high]} and {value_with_sd(mean[low], sd[low])} times in run {self.runs[low]}"
        )


def _most_probable_log_sd_ratios(counts: FloatArray, squares: FloatArray, spread: float) -> FloatArray:
    """Return the most probable logs of each run's noise sd over the overall sd, (n_runs,); the latter is profiled out.

    `counts` and `squares` are the number of readings and the sum of squared residuals of each run, (n_runs,); `spread`
    is the prior sd of the logs.
    """
    logs = np.zeros(len(counts))
    for _ in range(_NEWTON_STEPS):
        weighed = squares * np.exp(-2 * logs)
        share = weighed * counts.sum() / weighed.sum()  # sums of squares in units of the best overall variance
        slope = share - counts - logs / spread**2
        curvature = 2 * share + spread**-2
        # Profiling out the overall sd takes a rank-one term from the Hessian: Sherman-Morrison inverts it.
        along, turned = 2 * share / curvature, slope / curvature
        step = turned - along * float(np.sum(2 * share * turned)) / (-float(2 * share.sum()) + float(2 * share @ along))
        logs = logs + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-9:
            break
    return np.asarray(logs)


LARGEST_SIZE = 40.0
"""Largest sd of outlying readings, in noise sds; readings too far out for it are lost ones (`diagnosis.outlying`)."""


MOST_OUTLYING = 0.2
"""Largest share of outlying or of lost readings."""


_SHARES = LogUniform(2e-3, MOST_OUTLYING)


class Outliers(NoiseEffect):
    """A heavy tail: with probability `share`, a reading's noise is `size` times as wide (sd)."""

    name, words, covariates = "outliers", "outlying readings", ("level", "time")
    units = ("1", "noise sd")
    prior = Product({"share": _SHARES, "size": LogUniform(2.5, LARGEST_SIZE)})
    nodes_per_parameter = (4, 4)
    says = in_words("outliers: {0} % of the readings scatter {1} times as widely as the others", factors=(100,))

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, wide_share=theta[:, :1], wide_times=theta[:, 1:2])


@dataclass(frozen=True)
class Dropouts(NoiseEffect):
    """Lost readings: with probability `share` a reading is `value`, whatever lies under the sensor.

    `lowest` and `highest` bound that value; `ends` are those of the instrument's declared range, its likeliest values.
    `lost`: what the readings read that are lost beyond doubt, of `n_readings` in all, and `distance`, the norm of their
    residuals in noise sds. They are left out of the recording, so that the noise of the others does not change; where
    they differ, `value` is any of theirs.
    """

    lowest: float = -50.0
    highest: float = 150.0
    ends: tuple[float, ...] = ()
    unit: str = field(default="", kw_only=True)
    lost: tuple[float, ...] = field(default=(), kw_only=True)
    n_readings: int = field(default=0, kw_only=True)
    distance: float = field(default=0.0, kw_only=True)

    name, words, covariates = "dropouts", "lost readings", ("level", "time")
    units = ("1", "reading")
    nodes_per_parameter = ()  # they depend on the readings, and the share's lie close

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        low, high = extent.low - 0.01 * extent.span, extent.high + 0.01 * extent.span
        return cls(low, high, extent.plan.instrumentation.declared_ends, unit=extent.reading_unit)

    @classmethod
    def of_lost_readings(cls, lost: FloatArray, n_readings: int, distance: float, unit: str) -> Self:
        """Return the effect that lost these of `n_readings` readings; `distance` as above."""
        wide = 0.01 * max(float(np.ptp(lost)), float(np.abs(lost).max()), 1e-300)
        low, high = float(lost.min()) - wide, float(lost.max()) + wide
        return cls(low, high, unit=unit, lost=tuple(lost.tolist()), n_readings=n_readings, distance=distance)

    @property
    def parameters_known_before_fit(self) -> FloatArray | None:
        """The share of the readings that are `lost`, and the commonest value; None without them."""
        if not self.lost:
            return None
        return np.array([len(self.lost) / self.n_readings, max(self.lost, key=self.lost.count)])

    def draws_about(self, nodes: FloatArray, *, rng: np.random.Generator) -> FloatArray | None:
        """Draw the share that the number of `lost` readings tells (Jeffreys prior), and one of their values."""
        if not self.lost:
            return None
        n, n_lost = len(nodes), len(self.lost)
        share = rng.beta(n_lost + 0.5, self.n_readings - n_lost + 0.5, n)
        return np.stack([share, rng.choice(self.lost, n)], axis=1)

    @cached_property
    def prior(self) -> Product:
        return Product({"share": _SHARES, "value": Uniform(self.lowest, self.highest)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, lost_share=theta[:, :1], lost_value=theta[:, 1:2])

    def bank(self) -> FloatArray:
        near = _NEAR_END * (self.highest - self.lowest)
        ends = (self.lowest + near, self.highest - near)
        return np.array([[[share, end]] for share in (0.01, 0.05) for end in ends])

    def nodes(self, residuals: FloatArray, rows: FittedReadings) -> FloatArray:
        """Return twelve pairs (share, value), (12, 2), with the commonest value of readings beyond four noise sds.

        There is no node, (0, 2), unless an outlying value occurs twice or is an end of the declared range.
        """
        far = rows.readings[np.abs(residuals) > _FAR]
        # Floats differ in their last digits, so the value is one of the readings, not their mean.
        n_alike = (np.abs(far[:, None] - far) <= 1e-6 * rows.sd).sum(axis=0)
        at_end = (np.abs(far[:, None] - np.array(self.ends)) <= 1e-6 * rows.sd).any(axis=1)
        if not (at_end | (n_alike > 1)).any():
            return np.zeros((0, 2))
        value = far[int(np.argmax(n_alike + 0.5 * at_end))]
        shares = _SHARES.from_unit((np.arange(12) + 0.5) / 12)
        return np.stack([shares, np.full(12, value)], axis=1)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        exact = f"{mean[1]:z.12g} {self.unit}".rstrip()  # lost readings have one value, to the last digit
        value = value_with_sd(mean[1], sd[1], self.unit) if sd[1] > 0 else exact
        share = value_with_sd(mean[0], sd[0], factor=100)
        if len({*self.lost}) > 1:
            values = [f"{each:.12g}" for each in sorted({*self.lost})]
            value = f"{', '.join(values[:-1])} or {values[-1]} {self.unit}".rstrip()
        return f"readings are lost: {share} % of them read {value}, whatever the true value"


@dataclass(frozen=True)
class Quantisation(NoiseEffect):
    """Readings rounded to a step that was not declared: step round(reading / step), after the noise."""

    smallest: float = 0.05
    largest: float = 20.0
    unit: str = field(default="", kw_only=True)

    name, words, covariates = "quantisation", "rounded readings", ("lattice",)
    units = ("reading",)
    n_nodes = 16
    nodes_per_parameter = ()  # one node, from the readings
    seen_above: ClassVar[float] = 0.3
    """Smallest step, in noise sds, that counts: a finer lattice is only the printing of digits."""

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        if extent.plan.instrumentation.step is not None:
            return None
        return cls(1e-3 * extent.span, 0.2 * extent.span, unit=extent.reading_unit)

    @cached_property
    def prior(self) -> Product:
        return Product({"step": LogUniform(self.smallest, self.largest)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, step=theta[:, :1])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return in_words("the readings are rounded to steps of {0}, which were not declared", self.unit)(mean, sd)


def lattice_step(readings: FloatArray) -> float:
    """Find the step of a lattice that holds all readings; 0 where there is none.

    The result is 0 also for a step below 1e-5 of the range, and for fewer than three distinct readings. Readings
    printed to some digits lie on a lattice too; a coarser lattice is found through it, since printing moves each value
    by at most half a digit.
    """
    values = np.unique(readings[np.isfinite(readings)])
    if len(values) < 3:
        return 0.0
    least = 1e-6 * float(values[-1] - values[0])
    exact = _greatest_common_step(values, least)
    return _step_of_rounded_lattice(values, exact or 10 * least) or exact


def sd_of_estimated_lattice_step(readings: FloatArray, step: float) -> float:
    """Estimate the sd of a lattice's step, as fitted to distinct readings that were printed to some digits.

    The result is the printing's rounding error (sd) over the norm of the readings' centred lattice numbers; at least a
    millionth of the step.
    """
    values = np.unique(readings[np.isfinite(readings)])
    first = max(math.floor(-math.log10(step)), 0)  # the digits are no coarser than the step, which may be tiny
    digits = (
        10.0**-n
        for n in range(first, first + 10)
        if np.allclose(values, np.round(values, n), rtol=0, atol=1e-6 * 10.0**-n)
    )
    reach = float(np.linalg.norm(values - values.mean())) / step
    return max(next(digits, 0.0) / math.sqrt(12) / reach, _DIGITS * step)


def _step_of_rounded_lattice(values: FloatArray, rounding: float) -> float:
    """Fit the step of a lattice to rounded values, from the two closest outwards; 0 if one of them is off the lattice.

    `rounding` is the full width of the rounding error of each value.
    """
    gaps = np.diff(values)
    step, start = float(gaps.min()), float(values[np.argmin(gaps)])
    if step <= _TELLING * rounding:
        return 0.0
    reach, known = 0.0, 1.0  # distance up to which values are numbered, and how many steps the last fit spanned
    while reach < values[-1] - values[0]:
        further = 0.2 * step / rounding * known * step  # up to here every value's number is certain
        near = values[np.abs(values - start) <= further]
        if further <= reach or len(near) < 2:
            return 0.0
        number = np.round((near - start) / step)
        reach, known = further, max(float(np.ptp(number)), 1.0)
        step, start = np.polyfit(number, near, 1).tolist()
    off = np.abs(values - start - step * np.round((values - start) / step))
    return step if float(off.max()) <= 0.75 * rounding else 0.0


def _greatest_common_step(values: FloatArray, tolerance: float) -> float:
    """Find the greatest step of which all gaps of sorted values are multiples; 0 if at most ten times the tolerance.

    Euclid's algorithm on their differences; a remainder below the tolerance counts as rounding.
    """
    step = 0.0
    for gap in np.diff(values):
        larger, smaller = max(step, float(gap)), min(step, float(gap))
        while smaller > tolerance:
            rest = larger - smaller * round(larger / smaller)
            larger, smaller = smaller, abs(rest)
        step = larger
        if step <= 10 * tolerance:
            return 0.0
    return step
