"""Posterior samples that a model's file keeps, of a sensor as of any system: statistics by parameter, and checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from probewise._arrays import BoolArray, FloatArray, read_only_floats, require_finite
from probewise._display import ShowsItself
from probewise.errors import ParameterError, ShapeError

MIN_SAMPLES = 500
"""Least number of posterior samples in a file: fewer do not give 95 % intervals."""


class NamedSamples(ShowsItself):
    """Base of models that hold posterior samples, (n_samples, n_params), whose columns have names."""

    names: tuple[str, ...]
    samples: FloatArray

    def mean(self) -> dict[str, float]:
        """Posterior mean by parameter."""
        return dict(zip(self.names, self.samples.mean(axis=0).tolist(), strict=True))

    def sd(self) -> dict[str, float]:
        """Posterior standard deviation by parameter."""
        return dict(zip(self.names, self.samples.std(axis=0).tolist(), strict=True))

    def median(self) -> dict[str, float]:
        """Posterior median by parameter, robust against single outlying samples."""
        return dict(zip(self.names, np.median(self.samples, axis=0).tolist(), strict=True))

    def interval(self, mass: float = 0.95) -> dict[str, tuple[float, float]]:
        """Central interval of each parameter that holds `mass`."""
        if not 0 < mass < 1:
            raise ParameterError("mass", mass, "greater than 0, less than 1")
        low, high = np.quantile(self.samples, [0.5 - mass / 2, 0.5 + mass / 2], axis=0)
        return {name: (float(a), float(b)) for name, a, b in zip(self.names, low, high, strict=True)}


def interval_table_lines(rows: Sequence[tuple[str, float, tuple[float, float]]]) -> list[str]:
    """Return the lines of a text table: name, median and 95 % interval of each quantity."""
    width = max(9, *(len(name) for name, _, _ in rows))
    return [
        f"{'parameter':<{width}}  {'median':>11}  95 % interval",
        *(f"{name:<{width}}  {value:>11.5g}  {low:.5g} to {high:.5g}" for name, value, (low, high) in rows),
    ]


def checked_samples(samples: FloatArray, noise_sd: FloatArray, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Return read-only copies of samples (n_samples, n_params) and noise sds (n_samples,).

    Raises
    ------
    ShapeError, ParameterError
        If the shapes do not fit, there are too few samples, a value is not finite, or an sd is not positive.
    """
    samples, noise_sd = read_only_floats(samples), read_only_floats(noise_sd)
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
