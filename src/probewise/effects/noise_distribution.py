"""The distribution of readings with all effects on the noise: density, variance, ends of a range, prediction."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import log_ndtr, ndtr, softmax

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.recordings.plan import masks_of_readings_at_ends
from probewise.sensor.stages import NoiseParameters

_LEAST_MASS = 1e-290  # below, masses lose digits; above, their difference is as exact as that of logs, in half the time
_NARROW = 1e-3  # of the noise sd: the sd of a lost reading about its value
_FARTHEST = 40.0  # sds from which a normal distribution has no mass in doubles


def log_gaussian_density(readings: FloatArray, mean: FloatArray | float, sd: FloatArray | float) -> FloatArray:
    """Return the natural log of the normal density of readings, per unit of the reading; the arrays broadcast."""
    z = (readings - mean) / sd
    return np.asarray(-0.5 * z * z - np.log(sd) - 0.5 * math.log(2 * math.pi))


def log_rounding_cell_density(
    readings: FloatArray, mean: FloatArray, sd: FloatArray, step: float | FloatArray
) -> FloatArray:
    """Return the natural log of the mean normal density over each reading's rounding cell, reading ± step / 2.

    The two tail masses are subtracted in logs, so the result stays finite however far the reading lies from the mean.
    """
    low, high = (readings - step / 2 - mean) / sd, (readings + step / 2 - mean) / sd
    # Mirror cells above the mean: log_ndtr keeps its precision in the lower tail only.
    above = low + high > 0
    near, far = np.where(above, -low, high), np.where(above, -high, low)
    return log_gaussian_mass_between(far, near) - np.log(step)


def log_gaussian_mass_between(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the natural log of a standard normal's mass from `low` to `high`; inexact if both are far above 0."""
    low, high = np.broadcast_arrays(low, high)
    mass = np.asarray(ndtr(high) - ndtr(low))
    small = mass < _LEAST_MASS
    if not small.any():
        return np.asarray(np.log(mass))
    out = np.log(np.where(small, 1.0, mass))
    log_low, log_high = log_ndtr(low[small]), log_ndtr(high[small])
    out[small] = log_high + np.log(-np.expm1(np.minimum(log_low - log_high, -1e-15)))
    return np.asarray(out)


@dataclass(frozen=True, eq=False)
class FittedReadings:
    """A fit's predicted readings, the number of each one's run (scan), and what was read, (n_points,); the noise sd."""

    predicted: FloatArray
    sd: float
    run: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    readings: FloatArray = field(default_factory=lambda: np.zeros(0))


def log_density(noise: NoiseParameters, readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the natural log of the density of each reading alone, (n_samples, n_points), per unit of the reading.

    `readings`: measured readings, (n_points,); `predicted`: noise-free readings, (n_samples, n_points).
    """
    return _log_of_mixture(
        noise,
        lambda sd: _log_density_rounded(readings, predicted, sd, noise.step),
        lambda: _log_density_rounded(readings, noise.lost_value, noise.sd * _NARROW, noise.step),
    )


def _log_of_mixture(
    noise: NoiseParameters, of_sd: Callable[[FloatArray], FloatArray], of_lost: Callable[[], FloatArray]
) -> FloatArray:
    """Return the log of the sum over narrow, wide and lost readings, each with its share; `of_sd` is log density."""
    out = of_sd(np.hypot(noise.sd, noise.offset_sd))
    with np.errstate(divide="ignore"):  # a share of 0 has the log -inf
        if np.any(noise.wide_share):
            wide = of_sd(np.hypot(noise.sd * noise.wide_times, noise.offset_sd))
            out = np.logaddexp(np.log1p(-noise.wide_share) + out, np.log(noise.wide_share) + wide)
        if np.any(noise.lost_share):
            out = np.logaddexp(np.log1p(-noise.lost_share) + out, np.log(noise.lost_share) + of_lost())
    return np.asarray(out)


@dataclass(frozen=True, eq=False)
class RecordedBefore:
    """What was recorded before some rows that are to be predicted, by which noise with a memory is known in part.

    `rows`: number of each recorded row, in order, (n_recorded,); `usable`: mask of those with a reading, (n_recorded,);
    `later`: number of each row to be predicted, (n_later,); `last`: place in `rows` of the last usable one of its run,
    -1 if there is none, (n_later,); `n_since`: rows of the run since then, (n_later,).
    """

    rows: IntArray
    usable: BoolArray
    later: IntArray
    last: IntArray
    n_since: IntArray

    def condition(
        self, noise: NoiseParameters, sigma: FloatArray, residuals: FloatArray
    ) -> tuple[FloatArray, NoiseParameters]:
        """Return the expected noise of each later row, (n_samples, n_later), and the noise about it.

        `noise` is that of all rows, the recorded ones first; `sigma` (n_samples, 1) is the sd in which the steps of a
        walk are told; `residuals` are those of the recorded rows, (n_samples, n_recorded). AR(1) noise of correlation
        rho is expected to be rho^k of the last one after k rows, with 1 - rho^(2 k) of its variance. A walk is filtered
        (Kalman); from its state at the last recorded row its variance grows by a step a row. A row without recorded
        ones in its run has the marginal distribution, a walk that of one that begins at the first row.
        """
        n, follows = len(self.rows), self.last >= 0
        sd = np.broadcast_to(noise.sd, (len(residuals), n + len(self.later)))
        expected, own, offset = np.zeros((len(sd), len(self.later))), sd[:, n:], np.zeros((1, 1))
        if np.any(noise.rho) and follows.any():
            kept = np.where(follows, noise.rho**self.n_since, 0.0)
            expected = kept * own * (residuals / sd[:, :n])[:, self.last]
            own = own * np.sqrt(1 - kept**2)
        if np.any(noise.walk):
            step = (noise.walk * sigma) ** 2
            variance = step * (self.later + 1)
            if follows.any():
                known = np.flatnonzero(self.usable)
                state, unsure = _filtered_walk(noise, step, sd[:, known], residuals[:, known], self.rows[known])
                n_steps = np.maximum(self.later - self.rows[known[-1]], self.n_since)
                expected = expected + np.where(follows, state, 0.0)
                variance = np.where(follows, unsure + step * n_steps, variance)
            offset = np.sqrt(variance)
        return expected, replace(noise, sd=own, offset_sd=offset)


def _filtered_walk(
    noise: NoiseParameters, step: FloatArray, sd: FloatArray, residuals: FloatArray, rows: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance, (n_samples, 1) both, of a random walk at the last of some rows, given their residuals.

    `step` (n_samples, 1) is the variance of its steps; `sd` and `residuals` are (n_samples, n_rows). A reading may be
    wide: two normal distributions, which are merged after each row.
    """
    times = np.concatenate(np.broadcast_arrays(1.0, noise.wide_times), axis=1)
    with np.errstate(divide="ignore"):  # a share of 0 has the log -inf
        log_share = np.log(np.concatenate([1 - noise.wide_share, noise.wide_share], axis=1))
    mean, variance = np.zeros((len(sd), 1)), np.zeros((len(sd), 1))
    for k, n_steps in enumerate(np.diff(rows, prepend=-1)):
        variance = variance + step * n_steps
        total = variance + (sd[:, k, None] * times) ** 2
        missed = residuals[:, k, None] - mean
        weight = softmax(log_share - 0.5 * np.log(total) - 0.5 * missed**2 / total, axis=1)
        moved = variance / total * missed
        change = np.sum(weight * moved, axis=1, keepdims=True)
        mean = mean + change
        variance = np.sum(weight * (variance * (1 - variance / total) + (moved - change) ** 2), axis=1, keepdims=True)
    return mean, variance


def _log_density_rounded(readings: FloatArray, mean: FloatArray, sd: FloatArray, step: FloatArray) -> FloatArray:
    """Return the log of the normal density or, where readings are rounded, of its mean over the rounding cell."""
    if not np.any(step):
        return log_gaussian_density(readings, mean, sd)
    width = np.where(step > 0, step, 1.0)
    in_cell = log_rounding_cell_density(readings, mean, sd, width)
    return in_cell if np.all(step) else np.where(step > 0, in_cell, log_gaussian_density(readings, mean, sd))


def log_probability_at_end(
    noise: NoiseParameters, readings: FloatArray, predicted: FloatArray, *, is_high: bool
) -> FloatArray:
    """Return the log probability of each reading at an end: of noise that reaches it, (n_samples, n_points).

    `readings`: readings at an end of the range, (n_points,); `predicted`: noise-free readings of an unlimited
    instrument, (n_samples, n_points); `is_high`: whether that is the high end.
    """
    sign = 1.0 if is_high else -1.0
    beyond = sign * (predicted - readings) + 0.5 * noise.step
    lost_beyond = sign * (noise.lost_value - readings) + 0.5 * noise.step
    return _log_of_mixture(
        noise, lambda sd: np.asarray(log_ndtr(beyond / sd)), lambda: np.where(lost_beyond >= 0, 0.0, -np.inf)
    )


def limited_mean(noise: NoiseParameters, predicted: FloatArray, low: float, high: float) -> FloatArray:
    """Return the mean of a reading that is not lost, limited to a range, about `predicted`, (n_samples, n_points)."""
    beside = np.hypot(noise.offset_sd, noise.step / np.sqrt(12))
    sds = (np.hypot(sd, beside) for sd in (noise.sd, noise.sd * noise.wide_times))
    own, wide = (_mean_of_limited_normal(predicted, sd, low, high) for sd in sds)
    return np.asarray((1 - noise.wide_share) * own + noise.wide_share * wide)


def _mean_of_limited_normal(mean: FloatArray, sd: FloatArray, low: float, high: float) -> FloatArray:
    """Return the mean of a normal variable that is limited to a range; arrays broadcast."""
    a, b = (np.clip((end - mean) / sd, -_FARTHEST, _FARTHEST) for end in (low, high))
    at_a, at_b = (np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) for z in (a, b))
    z = a * ndtr(a) + b * ndtr(-b) + at_a - at_b
    return np.asarray(np.clip(mean + sd * z, low, high))


@dataclass(frozen=True, eq=False)
class PredictiveMixture:
    """The predictive distribution of readings: the mixture of posterior samples' predictions, added block by block.

    `readings`: measured readings, (n_points,); `scored`: mask of the readings that get a log density, (n_points,);
    `step`: the declared rounding step, if any; `ends`: smallest and largest reading of the instrument; infinite for an
    open end. At an end the "density" is a probability: that the noise reaches the end.
    """

    readings: FloatArray
    scored: BoolArray
    step: float | None = None
    ends: tuple[float, float] = (-math.inf, math.inf)
    _blocks: list[tuple[int, *tuple[FloatArray, ...]]] = field(default_factory=list, init=False)

    def add(self, mean: FloatArray, noise: NoiseParameters, between: FloatArray | None = None) -> None:
        """Add noise-free predictions, (n_samples, n_points), and the noise about them.

        `between` (n_points,) is an additional smoothing sd of the density, for samples whose predictions lie farther
        apart than the noise; mean and sd are unaffected.
        """
        limited = limited_mean(noise, mean, *self.ends) if np.isfinite(self.ends).any() else mean
        wide = 1 + noise.wide_share * (noise.wide_times**2 - 1)
        own = np.asarray(noise.sd**2 * wide + noise.offset_sd**2 + noise.step**2 / 12)  # of a reading that is not lost
        variance = mean.var(axis=0) + np.broadcast_to(own, mean.shape).mean(axis=0)
        if self.step is not None:  # not in the variance: the pooled sd includes a declared rounding
            noise = replace(noise, step=np.full((1, 1), self.step))
        if between is not None:
            noise = replace(noise, offset_sd=np.hypot(np.broadcast_to(noise.offset_sd, mean.shape), between))
        sd, offset_sd = (each if each.shape[-1] == 1 else each[:, self.scored] for each in (noise.sd, noise.offset_sd))
        given = replace(noise, sd=sd, offset_sd=offset_sd), self.readings[self.scored], mean[:, self.scored]
        density = log_density(*given)  # (n_samples, n_scored)
        for at_end, is_high in zip(self._at_ends, (False, True), strict=True):
            if at_end[self.scored].any():
                density = np.where(at_end[self.scored], log_probability_at_end(*given, is_high=is_high), density)
        log_sum = np.logaddexp.reduce(density, axis=0)
        self._blocks.append((len(mean), mean.mean(axis=0), variance, limited.mean(axis=0), log_sum))

    @property
    def _at_ends(self) -> tuple[BoolArray, BoolArray]:
        return masks_of_readings_at_ends(self.readings, *self.ends, self.step)

    def mean_sd_and_log_density(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return mean and sd of a new reading at each row, and log density of the measured one: (n_points,) each.

        The density is NaN where a reading is not scored. The mean is within the range of the instrument; the sd is
        that of a reading which no end limits.
        """
        counts, means, variances, limited, log_sums = map(np.array, zip(*self._blocks, strict=True))
        share = counts / counts.sum()
        mean = share @ means
        sd = np.sqrt(share @ (variances + (means - mean) ** 2))
        scores = np.full(len(self.readings), np.nan)
        scores[self.scored] = np.logaddexp.reduce(log_sums, axis=0) - math.log(counts.sum())
        scores = np.where(np.any(self._at_ends, axis=0), np.minimum(scores, 0.0), scores)
        return np.clip(share @ limited, *self.ends), sd, scores
