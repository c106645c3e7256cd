"""The noise distribution of a reading, with all effects on the noise: its density and its variance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.effects.density import log_gaussian_density, log_rounding_cell_density
from probewise.sensor.stages import NoiseParameters

_NARROW = 1e-3  # of the noise sd: the sd of a lost reading about its value


@dataclass(frozen=True, eq=False)
class FittedReadings:
    """A fit's predicted readings, the number of each one's run (scan), and what was read, (n_points,); the noise sd."""

    predicted: FloatArray
    sd: float
    run: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    readings: FloatArray = field(default_factory=lambda: np.zeros(0))


def log_density(noise: NoiseParameters, readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the natural log of the density of each reading alone, (n_samples, n_points), per unit of the reading.

    Parameters
    ----------
    noise
        The noise.
    readings
        Measured readings, (n_points,).
    predicted
        Noise-free readings, (n_samples, n_points).
    """
    noise = noise_with_walk_variance(noise)
    of_kept = _log_density_rounded(readings, predicted, noise.sd, noise.step)
    with np.errstate(divide="ignore"):  # a share of 0 has the log -inf
        if np.any(noise.wide_share):
            wide = _log_density_rounded(readings, predicted, noise.sd * noise.wide_times, noise.step)
            of_kept = np.logaddexp(np.log1p(-noise.wide_share) + of_kept, np.log(noise.wide_share) + wide)
        if np.any(noise.lost_share):
            lost = _log_density_rounded(readings, noise.lost_value, noise.sd * _NARROW, noise.step)
            of_kept = np.logaddexp(np.log1p(-noise.lost_share) + of_kept, np.log(noise.lost_share) + lost)
    return of_kept


def reading_variance(noise: NoiseParameters) -> FloatArray:
    """Return the variance of a reading that is not lost, with outliers, random walk and rounding; arrays broadcast."""
    noise = noise_with_walk_variance(noise)
    wide = 1 + noise.wide_share * (noise.wide_times**2 - 1)
    return np.asarray(noise.sd**2 * wide + noise.step**2 / 12)


def noise_with_walk_variance(noise: NoiseParameters) -> NoiseParameters:
    """Return the noise with the random walk's marginal variance at each row included in its sd."""
    if not np.any(noise.walk):
        return noise
    return replace(noise, sd=noise.sd * np.sqrt(1 + noise.walk**2 * noise.walked), walk=np.zeros((1, 1)))


def _log_density_rounded(readings: FloatArray, mean: FloatArray, sd: FloatArray, step: FloatArray) -> FloatArray:
    """Return the log of the normal density or, where readings are rounded, of its mean over the rounding cell."""
    if not np.any(step):
        return log_gaussian_density(readings, mean, sd)
    width = np.where(step > 0, step, 1.0)
    in_cell = log_rounding_cell_density(readings, mean, sd, width)
    return in_cell if np.all(step) else np.where(step > 0, in_cell, log_gaussian_density(readings, mean, sd))
