"""Readings of an instrument of limited range, which reads an end where signal and noise are beyond it."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr, ndtr

from probewise._arrays import FloatArray
from probewise.effects.noise_distribution import noise_with_walk_variance
from probewise.sensor.stages import NoiseParameters

_FARTHEST = 40.0  # sds from which a normal distribution has no mass in doubles


def log_probability_at_end(
    noise: NoiseParameters, readings: FloatArray, predicted: FloatArray, *, is_high: bool
) -> FloatArray:
    """Return the log probability of each reading at an end: of noise that reaches it, (n_samples, n_points).

    Parameters
    ----------
    noise
        The noise.
    readings
        Readings at an end of the range, (n_points,).
    predicted
        Noise-free readings of an unlimited instrument, (n_samples, n_points).
    is_high
        Whether that is the high end.
    """
    noise = noise_with_walk_variance(noise)
    sign = 1.0 if is_high else -1.0
    beyond = sign * (predicted - readings) + 0.5 * noise.step
    out = log_ndtr(beyond / noise.sd)
    with np.errstate(divide="ignore"):  # a share of 0 has the log -inf
        if np.any(noise.wide_share):
            wide = log_ndtr(beyond / (noise.sd * noise.wide_times))
            out = np.logaddexp(np.log1p(-noise.wide_share) + out, np.log(noise.wide_share) + wide)
        if np.any(noise.lost_share):
            lost = np.where(sign * (noise.lost_value - readings) + 0.5 * noise.step >= 0, 0.0, -np.inf)
            out = np.logaddexp(np.log1p(-noise.lost_share) + out, np.log(noise.lost_share) + lost)
    return np.asarray(out)


def limited_mean(noise: NoiseParameters, predicted: FloatArray, low: float, high: float) -> FloatArray:
    """Return the mean of a reading that is not lost, limited to a range, (n_samples, n_points).

    `predicted` are noise-free readings of an unlimited instrument, of that shape.
    """
    noise = noise_with_walk_variance(noise)
    own, wide = (
        _mean_of_limited_normal(predicted, np.hypot(sd, noise.step / np.sqrt(12)), low, high)
        for sd in (noise.sd, noise.sd * noise.wide_times)
    )
    return np.asarray((1 - noise.wide_share) * own + noise.wide_share * wide)


def _mean_of_limited_normal(mean: FloatArray, sd: FloatArray, low: float, high: float) -> FloatArray:
    """Return the mean of a normal variable that is limited to a range; arrays broadcast."""
    a, b = (np.clip((end - mean) / sd, -_FARTHEST, _FARTHEST) for end in (low, high))
    z = a * ndtr(a) + b * ndtr(-b) + _density(a) - _density(b)
    return np.asarray(np.clip(mean + sd * z, low, high))


def _density(z: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi))
