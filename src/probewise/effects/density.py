"""The normal density of a reading, and its mean over the rounding cell of a reading rounded to a step."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import log_ndtr, ndtr

from probewise._arrays import FloatArray

_LEAST_MASS = 1e-290  # below, masses lose digits; above, their difference is as exact as that of logs, in half the time


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
    low = (readings - step / 2 - mean) / sd
    high = (readings + step / 2 - mean) / sd
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
