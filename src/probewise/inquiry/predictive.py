"""The noise of a reading, and the weights of hypotheses given each possible reading.

From these follow the expected information of a reading, the probability that it reaches a target sd, and the expected
distance of posterior sds from a goal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self, TypeAlias

import numpy as np
from scipy.special import gammaln, ndtr, stdtr

from probewise._arrays import FloatArray, IntArray
from probewise._kinds import checked_number
from probewise.errors import ParameterError, ShapeError, require
from probewise.inquiry.readout import (
    MOST_LEVELS,
    Readout,
    entropy_bits,
    evenly_spaced_levels,
    nearest_level_index,
    weight_by_level,
)
from probewise.priors import Marginal

AnyNoise: TypeAlias = "float | Callable[[FloatArray], Any] | Marginal | ReadingNoise"
_ALLOWED_SD = (
    "a number greater than 0, a function of the predicted reading, or, where it is unknown, its prior, such as "
    "LogUniform(0.1, 10.0)"
)
_PER_SD = 2.0  # levels of the predicted reading per noise sd, given a reading
_LEAST = 1e-12
_LEAST_SD = 1e-150  # and one over it the greatest: squares of numbers beyond overflow
_N_LEVELS = 256  # of a reading without noise: near a goal they are finer than a sample's error
_N_SDS = 8  # groups of samples where the sd of the noise is unknown
_CELL = 0.4  # sds: wide as a cell of a reading, which loses 1.3 % of a small information
_REACH = 5.0  # sds beyond the levels that the cells cover
_NARROWEST = 1e-6  # sds, for predictions that are all alike
_LEAST_SHARE = 1e-9  # of a goal's variance
_BELOW = 0.01  # weight of nats below a goal
_OUTERMOST = 0.01  # of the outliers' range, at each end: a tail is not smaller


@dataclass(frozen=True)
class ReadingNoise:
    """Noise of independent readings.

    Parameters
    ----------
    sd
        Sd of the noise, in the unit of the reading (of a Student-t distribution: its scale): a number; a function that
        returns the sd for each of an array of predicted readings; or a prior, where it is unknown and inferred.
    dof
        Degrees of freedom of a Student-t distribution; infinity is the Gaussian.
    outliers
        Share of the readings that do not depend on the prediction, 0 or more, below 1.
    between
        Least and greatest outlier; they are uniform in between. Required if there are outliers.

    Raises
    ------
    ParameterError
        If a value is out of range.
    """

    sd: float | Callable[[FloatArray], Any] | Marginal
    dof: float = math.inf
    outliers: float = 0.0
    between: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require(not isinstance(self.sd, type | str | bytes), "noise sd", self.sd, _ALLOWED_SD)
        is_number = not (self.is_sd_inferred or callable(self.sd))
        if is_number and not _LEAST_SD < checked_number("noise sd", self.sd, _ALLOWED_SD) < 1 / _LEAST_SD:
            raise ParameterError("noise sd", self.sd, _ALLOWED_SD)
        if self.is_sd_inferred and not np.min(self.sd.from_unit(np.array([1e-9, 0.5]))) > 0:  # type: ignore[union-attr]
            raise ParameterError("noise sd", self.sd, "a prior of numbers greater than 0, such as LogUniform(0.1, 10)")
        require(checked_number("dof", self.dof) > 0, "dof", self.dof, "greater than 0; infinity is the Gaussian")
        share = "0 or more, below 1: the share of readings that are outliers"
        require(0 <= checked_number("outliers", self.outliers) < 1, "outliers", self.outliers, share)
        allowed = "(low, high), finite, low < high: the least and the greatest outlier"
        require(not self.outliers or _is_range(self.between), "between", self.between, allowed)

    @classmethod
    def of(cls, given: AnyNoise) -> ReadingNoise:
        """Build the noise from a sd, a function of the prediction, the prior of a sd, or a ReadingNoise."""
        return given if isinstance(given, ReadingNoise) else cls(given)

    @cached_property
    def is_sd_inferred(self) -> bool:
        """Whether the sd is unknown: a parameter with a prior."""
        return isinstance(self.sd, Marginal)

    def scale(self, predicted: FloatArray, sd: FloatArray | None) -> FloatArray:
        """Return the sd of each prediction's noise, (n_samples, n_points).

        `sd`, (n_samples,): each sample's, if the sd is inferred; else None. ShapeError or ParameterError if a function
        for the sd returns a wrong shape or a number not above 0.
        """
        if sd is not None:
            return np.asarray(np.broadcast_to(sd[:, None], predicted.shape))
        if not callable(self.sd):
            return np.full(predicted.shape, float(self.sd))  # type: ignore[arg-type]
        sds = np.asarray(self.sd(predicted.ravel()), dtype=np.float64)
        if sds.shape not in ((), (predicted.size,)):
            allowed = f"({predicted.size},), one for each predicted reading"
            raise ShapeError(f"noise sd returns shape {sds.shape}; allowed: {allowed}")
        out = np.array(np.broadcast_to(sds, (predicted.size,))).reshape(predicted.shape)
        bad = ~((out > 0) & np.isfinite(out))
        if bad.any():
            name = f"noise sd of the predicted reading {predicted[bad][0]:g}"
            raise ParameterError(name, float(out[bad][0]), "finite, greater than 0")
        return out

    def log_density(self, readings: FloatArray, predicted: FloatArray, scale: FloatArray) -> FloatArray:
        """Return the log density of readings, given predictions and sds (`scale`); arrays that broadcast."""
        z, nu = (readings - predicted) / scale, self.dof
        if math.isinf(nu):
            standard = -0.5 * (z * z + math.log(2 * math.pi))
        else:
            constant = float(gammaln((nu + 1) / 2) - gammaln(nu / 2)) - 0.5 * math.log(nu * math.pi)
            standard = constant - 0.5 * (nu + 1) * np.log1p(z * z / nu)
        core = standard - np.log(scale)
        if not self.outliers:
            return np.asarray(core)
        low, high = self._outlier_range
        inside = (readings >= low) & (readings <= high)
        outlying = np.where(inside, math.log(self.outliers / (high - low)), -np.inf)
        return np.asarray(np.logaddexp(math.log1p(-self.outliers) + core, outlying))

    def cdf(self, readings: FloatArray, predicted: FloatArray, scale: FloatArray) -> FloatArray:
        """Return the probability of a smaller reading, given prediction and sd (`scale`); arrays that broadcast."""
        z = (readings - predicted) / scale
        core = ndtr(z) if math.isinf(self.dof) else stdtr(self.dof, z)
        if not self.outliers:
            return np.asarray(core)
        low, high = self._outlier_range
        return np.asarray((1 - self.outliers) * core + self.outliers * np.clip((readings - low) / (high - low), 0, 1))

    def smaller_tail(self, readings: FloatArray, predicted: FloatArray, scale: FloatArray) -> FloatArray:
        """Return the probability of a smaller or of a greater reading, whichever is less; arrays that broadcast."""
        # One minus the probability of a smaller reading would be 0 from 8.3 sds above on.
        if not self.outliers:
            return np.minimum(self.cdf(readings, predicted, scale), self.cdf(-readings, -predicted, scale))
        low, high = self._outlier_range
        mirrored = replace(self, between=(-high, -low))
        tail = np.minimum(self.cdf(readings, predicted, scale), mirrored.cdf(-readings, -predicted, scale))
        # An outlier at the very end of its range, such as a reading of 0, is no less probable than others.
        least = np.where((readings >= low) & (readings <= high), _OUTERMOST * self.outliers, 0.0)
        return np.maximum(tail, least)

    def draw(self, predicted: FloatArray, scale: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw a reading for each prediction, with sd `scale`; arrays of one shape."""
        z = rng.standard_normal(predicted.shape) if math.isinf(self.dof) else rng.standard_t(self.dof, predicted.shape)
        core = predicted + scale * z
        if not self.outliers:
            return np.asarray(core)
        is_out = rng.random(predicted.shape) < self.outliers
        return np.where(is_out, rng.uniform(*self._outlier_range, predicted.shape), core)

    @property
    def _outlier_range(self) -> tuple[float, float]:
        assert self.between is not None
        return self.between


def _is_range(value: Any) -> bool:
    try:
        low, high = value
        return bool(np.isfinite([low, high]).all() and low < high)
    except (TypeError, ValueError):
        return False


@dataclass(frozen=True, eq=False)
class WeightsGivenReading:
    """Weights of hypotheses times the probability of each cell of a reading, and sums over hypotheses.

    A cell is a range of readings recorded as one. Hypotheses with nearly equal predictions are summed first, so that
    the noise is applied to some hundred levels instead of every hypothesis: `index` is the level that each predicts,
    (n, n_designs), `weight` its weight, (n,), `chance` the probability of each cell given each level, (n_levels,
    n_cells).
    """

    index: IntArray
    weight: FloatArray
    chance: FloatArray

    @classmethod
    def of(
        cls, predicted: FloatArray, weight: FloatArray, readout: Readout, *, fine: float = 1.0, repeats: int = 1
    ) -> Self:
        """Build from predicted readings, (n, n_designs), and the weights of the hypotheses, (n,).

        `fine`: width of a cell in noise sds, if readings are not rounded; `repeats`: number of readings at each design,
        of which the mean counts.
        """
        sd = readout.noise_sd / math.sqrt(repeats)
        levels = evenly_spaced_levels(float(predicted.min()), float(predicted.max()), sd / _PER_SD, most=MOST_LEVELS)
        chance = readout.cell_probability(levels, repeats=repeats, fine=fine, most=MOST_LEVELS)
        return cls(nearest_level_index(predicted, levels), weight, chance)

    @cached_property
    def weight_by_cell(self) -> FloatArray:
        """Total weight in each cell, (n_designs, n_cells); never 0."""
        return np.maximum(self._weight_by_level @ self.chance, _LEAST)

    @cached_property
    def information_bits(self) -> FloatArray:
        """Expected information about the hypotheses, whose weights sum to one, in bits, (n_designs,)."""
        of_noise = self._weight_by_level @ entropy_bits(self.chance)
        return np.asarray(np.maximum(entropy_bits(self.weight_by_cell) - of_noise, 0.0))

    @cached_property
    def _weight_by_level(self) -> FloatArray:
        return weight_by_level(self.index, self.weight, len(self.chance))

    def weighted_sum_by_cell(self, values: FloatArray) -> FloatArray:
        """Sum over hypotheses of weight times value times cell probability: values (n,) -> (n_designs, n_cells)."""
        return np.asarray(weight_by_level(self.index, self.weight * values, len(self.chance)) @ self.chance)

    def probability_of_reaching_target(
        self, lengths: FloatArray, sd: float, *, off: float = math.inf, most_off: float = 1.0
    ) -> FloatArray:
        """Return the probability, (n_designs,), that a reading brings all sds of lengths, (n, n_lengths), below `sd`.

        And that a length is more than `off` from its mean with a probability below `most_off`. The lengths are of each
        hypothesis, best less their means, so that no digits are lost.
        """
        weight, means = self.weight_by_cell, []
        ends = np.ones(weight.shape, dtype=np.bool_)
        for length in lengths.T:
            means.append(self.weighted_sum_by_cell(length) / weight)
            ends &= self.weighted_sum_by_cell(length**2) / weight - means[-1] ** 2 < sd**2
        for design in np.flatnonzero(ends.any(axis=1)) if math.isfinite(off) else ():
            apart = np.abs(lengths[:, :, None] - np.array(means)[:, design]) > off
            joint = self.weight[:, None] * self.chance[self.index[:, design]]
            ends[design] &= np.where(apart.any(axis=1), joint, 0.0).sum(axis=0) < most_off * weight[design]
        return np.asarray((weight * ends).sum(axis=1) / weight.sum(axis=1))


def readings_given_noise(
    predicted: FloatArray, scale: FloatArray, weight: FloatArray, noise: ReadingNoise, *, n_levels: int = _N_LEVELS
) -> WeightsGivenReading:
    """Return the weights of samples given each possible reading at each setting.

    `predicted`, `scale`: predicted readings and sds of their noise, (n_samples, n_settings). Predictions count for the
    nearest of `n_levels` levels, which are as far apart in sds of the noise everywhere. Where the sd is unknown,
    samples of similar sds have levels of their own, half as many.
    """
    low, high = float(predicted.min()), float(predicted.max())
    high = max(high, low + _NARROWEST * float(scale.min()), float(np.nextafter(low, np.inf)))
    if noise.is_sd_inferred:
        order, n = np.argsort(scale[:, 0], kind="stable"), len(scale)
        group = np.empty(n, dtype=np.int64)
        group[order] = np.arange(n) * _N_SDS // n
        sds = np.array([math.sqrt(float((scale[group == k, 0] ** 2).mean())) for k in np.unique(group)])
        levels = np.linspace(low, high, n_levels // 2)
        index = np.rint((predicted - low) * ((len(levels) - 1) / (high - low))).astype(np.int64)
        index += group[:, None] * len(levels)
        level, sd = np.tile(levels, len(sds)), np.repeat(sds, len(levels))
        inner = np.linspace(low, high, _n_cells((high - low) / sds[0], n_levels) + 1)
        ends = np.sort(sds), np.sort(sds)
    else:
        at = np.linspace(low, high, n_levels if callable(noise.sd) else 2)
        per_sd = 1.0 / noise.scale(at[None], None)[0]
        sds_below = np.concatenate([[0.0], np.cumsum(0.5 * (per_sd[1:] + per_sd[:-1]) * np.diff(at))])
        sds = np.interp(predicted, at, sds_below) if callable(noise.sd) else (predicted - low) * per_sd[0]
        index = np.rint(sds * ((n_levels - 1) / sds_below[-1])).astype(np.int64)
        level = np.interp(np.linspace(0.0, sds_below[-1], n_levels), sds_below, at)
        sd = noise.scale(level[None], None)[0]
        inner = np.interp(np.linspace(0.0, sds_below[-1], _n_cells(sds_below[-1], n_levels) + 1), sds_below, at)
        ends = sd[:1], sd[-1:]
    below, above = low, high
    lower, upper = list[FloatArray](), list[FloatArray]()
    for far_low, far_high in zip(*ends, strict=True):  # wider cells farther out, where only wider noise leads
        lower.append(np.arange(below - _CELL * far_low, low - _REACH * far_low, -_CELL * far_low))
        upper.append(np.arange(above + _CELL * far_high, high + _REACH * far_high, _CELL * far_high))
        below, above = min(below, low - _REACH * far_low), max(above, high + _REACH * far_high)
    edges = np.unique(np.concatenate([*lower, inner, *upper]))
    chance = np.diff(noise.cdf(edges, level[:, None], sd[:, None]), axis=1, prepend=0.0, append=1.0)
    return WeightsGivenReading(index, weight, np.maximum(chance, 0.0))


def _n_cells(width_sds: float, most: int) -> int:
    return int(min(max(math.ceil(width_sds / _CELL), 1), most))


def expected_nats_above_goal(given: WeightsGivenReading, values: FloatArray, goal: FloatArray) -> FloatArray:
    """Return the expected distance from the goal after a reading, nats, (n_settings,).

    The distance is the sum over quantities of ln(sd / goal), 0 where an sd is below its goal. `values`: posterior
    samples of the quantities, (n_samples, n_values); `goal`: target sd of each, (n_values,).
    """
    weight = given.weight_by_cell
    far = np.zeros(weight.shape)
    for value, sd in zip((values - values.mean(axis=0)).T, goal, strict=True):
        mean = given.weighted_sum_by_cell(value) / weight
        variance = given.weighted_sum_by_cell(value**2) / weight - mean**2
        far += np.maximum(0.5 * np.log(np.maximum(variance, _LEAST_SHARE * sd**2)) - math.log(sd), 0.0)
    return np.asarray((weight * far).sum(axis=1) / weight.sum(axis=1))


def gaussian_nats_above_goal(
    predicted: FloatArray, scale: FloatArray, values: FloatArray, goal: FloatArray
) -> FloatArray:
    """Return `expected_nats_above_goal`, (n_settings,), as if predictions and values were jointly Gaussian.

    `predicted`, `scale`: predictions and sds of their noise, (n_samples, n_settings), of equally weighted samples. An
    sd below its goal counts a hundredth, which ranks settings that all reach it.
    """
    values, away = values - values.mean(axis=0), predicted - predicted.mean(axis=0)
    total = (away**2).mean(axis=0) + (scale**2).mean(axis=0)
    fallen = (values.T @ away / len(away)) ** 2 / total
    left = (values**2).mean(axis=0)[:, None] - fallen
    least = _LEAST_SHARE * goal[:, None] ** 2
    far = 0.5 * np.log(np.maximum(left, least) / goal[:, None] ** 2)
    return np.asarray(np.where(far > 0.0, far, _BELOW * far).sum(axis=0))
