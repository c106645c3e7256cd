"""The noise distribution of a reading, with all effects on the noise: its density and its variance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.effects.density import log_cell_density, log_gaussian_density
from probewise.sensor.stages import NoiseLevel

_NARROW = 1e-3  # of the noise sd: the sd of a lost reading about its value


@dataclass(frozen=True, eq=False)
class FittedReadings:
    """A fit's predicted readings and the number of each one's run (scan), (n_points,), and the noise sd."""

    predicted: FloatArray
    sd: float
    run: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def log_density(level: NoiseLevel, readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the natural log of the density of each reading alone, (n_samples, n_points), per unit of the reading.

    Parameters
    ----------
    level
        The noise.
    readings
        Measured readings, (n_points,).
    predicted
        Noise-free readings, (n_samples, n_points).
    """
    level = _with_walk_variance(level)
    of_kept = _log_density_rounded(readings, predicted, level.sd, level.step)
    with np.errstate(divide="ignore"):  # a share of 0 has the log -inf
        if np.any(level.wide_share):
            wide = _log_density_rounded(readings, predicted, level.sd * level.wide_times, level.step)
            of_kept = np.logaddexp(np.log1p(-level.wide_share) + of_kept, np.log(level.wide_share) + wide)
        if np.any(level.lost_share):
            lost = _log_density_rounded(readings, level.lost_value, level.sd * _NARROW, level.step)
            of_kept = np.logaddexp(np.log1p(-level.lost_share) + of_kept, np.log(level.lost_share) + lost)
    return of_kept


def variance(level: NoiseLevel) -> FloatArray:
    """Return the variance of a reading that is not lost, with outliers, random walk and rounding; it broadcasts."""
    level = _with_walk_variance(level)
    wide = 1 + level.wide_share * (level.wide_times**2 - 1)
    return np.asarray(level.sd**2 * wide + level.step**2 / 12)


def _with_walk_variance(level: NoiseLevel) -> NoiseLevel:
    """Return the noise with the random walk's marginal variance at each row included in its sd."""
    if not np.any(level.walk):
        return level
    return replace(level, sd=level.sd * np.sqrt(1 + level.walk**2 * level.walked), walk=np.zeros((1, 1)))


def _log_density_rounded(readings: FloatArray, mean: FloatArray, sd: FloatArray, step: FloatArray) -> FloatArray:
    """Return the log of the normal density or, where readings are rounded, of its mean over the rounding cell."""
    if not np.any(step):
        return log_gaussian_density(readings, mean, sd)
    width = np.where(step > 0, step, 1.0)
    in_cell = log_cell_density(readings, mean, sd, width)
    return in_cell if np.all(step) else np.where(step > 0, in_cell, log_gaussian_density(readings, mean, sd))
