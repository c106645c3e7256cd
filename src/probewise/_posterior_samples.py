"""The checks of posterior samples that a model's file keeps, of a sensor as of any system."""

from __future__ import annotations

from collections.abc import Mapping

from probewise._arrays import BoolArray, FloatArray, frozen, require_finite
from probewise.errors import ParameterError, ShapeError

MIN_SAMPLES = 500
"""Least number of posterior samples in a file: fewer do not give 95 % intervals."""


def require_samples(samples: FloatArray, noise_sd: FloatArray, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Return read-only copies of samples (n_samples, n_params) and noise sds (n_samples,).

    Raises
    ------
    ShapeError, ParameterError
        If the shapes do not fit, there are too few samples, a value is not finite, or an sd is not positive.
    """
    samples, noise_sd = frozen(samples), frozen(noise_sd)
    if samples.ndim != 2 or samples.shape[1] != len(names):
        raise ShapeError(f"samples have shape {samples.shape}; allowed: (n_samples, {len(names)})")
    if len(samples) < MIN_SAMPLES:
        raise ParameterError("n_samples", len(samples), f"{MIN_SAMPLES} or more posterior samples")
    if noise_sd.shape != (len(samples),):
        raise ShapeError(f"noise_sd has shape {noise_sd.shape}; allowed: ({len(samples)},), one per sample")
    require_finite("samples", samples)
    require_finite("noise_sd", noise_sd)
    if not (noise_sd > 0).all():
        raise ParameterError("noise_sd", float(noise_sd.min()), "greater than 0")
    return samples, noise_sd


def require_masks_of_absent_effects(absent: Mapping[str, BoolArray], effects: tuple[str, ...], n_samples: int) -> None:
    """Raise ParameterError unless `absent` holds truth values, (n_samples,), by names of the model's effects."""
    for name, without in absent.items():
        if name not in effects or without.shape != (n_samples,):
            raise ParameterError("absent", name, f"effects of the model, each with {n_samples} truth values")
