"""Posterior samples in a model's file, for sensors and other systems alike: statistics by parameter, and checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from probewise._arrays import BoolArray, FloatArray, data_frame, read_only_floats, require_finite
from probewise._display import ShowsItself
from probewise._kinds import checked_texts
from probewise.errors import ShapeError, require

MIN_SAMPLES = 500
"""Least number of posterior samples in a file: fewer do not give 95 % intervals."""


class NamedSamples(ShowsItself):
    """Base of models with posterior `samples`, (n_samples, n_params), and `names`, one per column.

    `noise_sd` (n_samples,) is that of a reading; `absent`, by name of an effect, is the mask of the samples without it.
    """

    names: tuple[str, ...]
    samples: FloatArray
    noise_sd: FloatArray
    effects: tuple[str, ...]
    absent: Mapping[str, BoolArray]

    def rows_by_parameter(self, *statistics: str) -> list[dict[str, Any]]:
        """Return a JSON object for each parameter: its name, and these of mean, sd, median and interval95, in order."""
        ends = {name: list(own) for name, own in self.interval().items()}
        known: dict[str, Mapping[str, Any]] = {"mean": self.mean(), "sd": self.sd(), "median": self.median()}
        known["interval95"] = ends
        return [{"name": name, **{each: known[each][name] for each in statistics}} for name in self.names]

    def require_sound_samples(self) -> None:
        """Make samples and noise sds read-only copies; raise an error if they do not fit the names and effects.

        A ShapeError or ParameterError if the shapes do not fit, a name is no text, there are fewer than 500 samples, a
        value is not finite, an sd is not positive, or an effect's mask is that of no effect or of other samples.
        """
        checked_texts("names", self.names, "names of the columns of samples")
        samples, noise_sd = read_only_floats(self.samples), read_only_floats(self.noise_sd)
        n, n_params = len(samples), len(self.names)
        if samples.ndim != 2 or samples.shape[1] != n_params:
            raise ShapeError(f"samples have shape {samples.shape}; allowed: (n_samples, {n_params})")
        require(n >= MIN_SAMPLES, "n_samples", n, f"{MIN_SAMPLES} or more posterior samples")
        if noise_sd.shape != (n,):
            raise ShapeError(f"noise_sd has shape {noise_sd.shape}; allowed: ({n},), one per sample")
        require_finite("samples", samples)
        require_finite("noise_sd", noise_sd)
        require((noise_sd > 0).all(), "noise_sd", float(noise_sd.min()), "greater than 0")
        for name, without in self.absent.items():
            fits = name in self.effects and without.shape == (n,)
            require(fits, "absent", name, f"effects of the model, each with {n} truth values")
        object.__setattr__(self, "samples", samples)
        object.__setattr__(self, "noise_sd", noise_sd)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: a row per sample, a column per parameter, then `noise_sd`."""
        columns = {name: self.samples[:, k] for k, name in enumerate(self.names)}
        return data_frame({**columns, "noise_sd": self.noise_sd})

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
