"""Posterior samples in a model's file, for sensors and other systems alike: statistics by parameter, and checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from probewise._arrays import BoolArray, FloatArray, read_only_floats, require_finite
from probewise._display import ShowsItself
from probewise._kinds import checked_texts
from probewise.errors import ParameterError, ShapeError, require

MIN_SAMPLES = 500
"""Least number of posterior samples in a file: fewer do not give 95 % intervals."""


class NamedSamples(ShowsItself):
    """Base of models with posterior `samples`, (n_samples, n_params), and `names`, one per column."""

    names: tuple[str, ...]
    samples: FloatArray

    def mean(self) -> dict[str, float]:
        """Return the posterior mean by name of the parameter."""
        return dict(zip(self.names, self.samples.mean(axis=0).tolist(), strict=True))

    def sd(self) -> dict[str, float]:
        """Return the posterior standard deviation by name of the parameter."""
        return dict(zip(self.names, self.samples.std(axis=0).tolist(), strict=True))

    def median(self) -> dict[str, float]:
        """Return the posterior median by name of the parameter; single outlying samples hardly change it."""
        return dict(zip(self.names, np.median(self.samples, axis=0).tolist(), strict=True))

    def interval(self, mass: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return the central interval (low, high) that holds a share `mass` of the samples, by parameter name."""
        require(0 < mass < 1, "mass", mass, "greater than 0, less than 1")
        low, high = np.quantile(self.samples, [0.5 - mass / 2, 0.5 + mass / 2], axis=0)
        return {name: (float(a), float(b)) for name, a, b in zip(self.names, low, high, strict=True)}


def interval_table_lines(rows: Sequence[tuple[str, float, tuple[float, float]]]) -> list[str]:
    """Return the lines of a text table with a header; `rows` are (name, median, (low, high)), the 95 % interval."""
    width = max(9, *(len(name) for name, _, _ in rows))
    return [
        f"{'parameter':<{width}}  {'median':>11}  95 % interval",
        *(f"{name:<{width}}  {value:>11.5g}  {low:.5g} to {high:.5g}" for name, value, (low, high) in rows),
    ]


def checked_samples(samples: FloatArray, noise_sd: FloatArray, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Return read-only copies of samples (n_samples, n_params) and noise sds (n_samples,); `names` has n_params names.

    ShapeError or ParameterError if the shapes do not fit, a name is no text, there are fewer than 500 samples, a value
    is not finite, or an sd is not positive.
    """
    checked_texts("names", names, "names of the columns of samples")
    samples, noise_sd = read_only_floats(samples), read_only_floats(noise_sd)
    if samples.ndim != 2 or samples.shape[1] != len(names):
        raise ShapeError(f"samples have shape {samples.shape}; allowed: (n_samples, {len(names)})")
    require(len(samples) >= MIN_SAMPLES, "n_samples", len(samples), f"{MIN_SAMPLES} or more posterior samples")
    if noise_sd.shape != (len(samples),):
        raise ShapeError(f"noise_sd has shape {noise_sd.shape}; allowed: ({len(samples)},), one per sample")
    require_finite("samples", samples)
    require_finite("noise_sd", noise_sd)
    require((noise_sd > 0).all(), "noise_sd", float(noise_sd.min()), "greater than 0")
    return samples, noise_sd


def require_masks_of_absent_effects(absent: Mapping[str, BoolArray], effects: tuple[str, ...], n_samples: int) -> None:
    """Raise ParameterError unless `absent` maps names in `effects` to boolean arrays of shape (n_samples,)."""
    for name, without in absent.items():
        if name not in effects or without.shape != (n_samples,):
            raise ParameterError("absent", name, f"effects of the model, each with {n_samples} truth values")
