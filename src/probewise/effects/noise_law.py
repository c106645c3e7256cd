"""The law of one reading's noise: its density, and draws from it, with all that effects on the noise may do to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray
from probewise.sensor.stages import NoiseLevel

__all__ = ["NoiseRows", "draw_readings", "log_density"]

_NARROW = 1e-3  # of the noise sd: how exactly a lost reading holds its value where nothing is rounded


@dataclass(frozen=True, eq=False)
class NoiseRows:
    """What statistics of the noise ask of the rows, each (n_points,).

    `predicted` readings and `seen` white fraction of the fit, the noise `sd`, and `steps`: rows back to
    the previous reading of the same scan, 0 for none.
    """

    predicted: FloatArray
    seen: FloatArray
    sd: float
    steps: IntArray


def log_density(level: NoiseLevel, readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Log density of each reading by itself, (n_samples, n_points), per unit of the reading.

    Parameters
    ----------
    level
        The noise.
    readings
        What was read, (n_points,).
    predicted
        Noise-free readings, (n_samples, n_points).
    """

    def normal(mean: FloatArray, sd: FloatArray) -> FloatArray:
        z = (readings - mean) / sd
        smooth = np.exp(-0.5 * z * z) / (sd * np.sqrt(2 * np.pi))
        # Rounded readings hold the mass of a cell.
        step = np.where(level.step > 0, level.step, 1.0)
        half = step / 2 / sd
        in_cell = np.where(z > 0, ndtr(half - z) - ndtr(-half - z), ndtr(z + half) - ndtr(z - half)) / step
        return np.where(level.step > 0, in_cell, smooth)

    kept = (1 - level.wide_share) * normal(predicted, level.sd)
    kept = kept + level.wide_share * normal(predicted, level.sd * level.wide_times)
    lost = normal(level.lost_value, level.sd * _NARROW)
    with np.errstate(divide="ignore"):
        return np.log((1 - level.lost_share) * kept + level.lost_share * lost)


def draw_readings(level: NoiseLevel, predicted: FloatArray, scan: IntArray, *, rng: np.random.Generator) -> FloatArray:
    """Draw readings, (n_samples, n_points): noise with its memory, wide ones, lost ones, then rounding.

    Parameters
    ----------
    level
        The noise.
    predicted
        Noise-free readings, (n_samples, n_points).
    scan
        Scan of each reading, in order of taking, (n_points,).
    rng
        Source of randomness.
    """
    noise = rng.standard_normal(predicted.shape)
    fresh = np.sqrt(1 - level.rho[:, 0] ** 2)
    for k in range(1, len(scan)):
        if scan[k] == scan[k - 1]:
            noise[:, k] = level.rho[:, 0] * noise[:, k - 1] + fresh * noise[:, k]
    noise = noise * np.where(rng.random(predicted.shape) < level.wide_share, level.wide_times, 1.0)
    readings = predicted + level.sd * noise
    readings = np.where(rng.random(predicted.shape) < level.lost_share, level.lost_value, readings)
    step = np.where(level.step > 0, level.step, 1.0)
    return np.where(level.step > 0, step * np.round(readings / step), readings)
