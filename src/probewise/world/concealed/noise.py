"""Noise that is correlated, non-Gaussian or of changing variance; lost readings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.special import ndtr, stdtrit

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows


@dataclass(frozen=True)
class CorrelatedNoise:
    """AR(1) noise within each scan: correlation `rho` between successive readings, with unchanged sd."""

    name: ClassVar[str] = "correlated_noise"
    stage: ClassVar[Stage] = "noise"
    rho: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        fresh = math.sqrt(1 - self.rho**2)
        out = values.copy()
        for k in np.flatnonzero(~rows.scan_start_mask()):
            out[k] = self.rho * out[k - 1] + fresh * values[k]
        return out


@dataclass(frozen=True)
class SignalDependentNoise:
    """Noise variance that grows linearly from its value on black to 1 + `ratio` times that on white."""

    name: ClassVar[str] = "signal_dependent_noise"
    stage: ClassVar[Stage] = "noise"
    ratio: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        return values * np.sqrt(1 + self.ratio * seen)


@dataclass(frozen=True)
class RisingNoiseSd:
    """Noise sd that rises linearly to `factor` times its first value from time 0 to `over_s`, then stays constant."""

    name: ClassVar[str] = "drifting_noise"
    stage: ClassVar[Stage] = "noise"
    factor: float
    over_s: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        return values * (1 + (self.factor - 1) * np.clip(rows.time_s / self.over_s, 0.0, 1.0))


@dataclass(frozen=True)
class HeavyTails:
    """Student-t noise of `dof` degrees of freedom, 3 or more, with unchanged sd."""

    name: ClassVar[str] = "heavy_tails"
    stage: ClassVar[Stage] = "noise"
    dof: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Map each draw to the same quantile of the Student-t distribution."""
        return np.asarray(stdtrit(self.dof, ndtr(values)) * math.sqrt((self.dof - 2) / self.dof))


@dataclass(frozen=True)
class Outliers:
    """Outliers: a random `share` of the readings has additional Gaussian noise, of sd `size` times the noise sd."""

    name: ClassVar[str] = "outliers"
    stage: ClassVar[Stage] = "noise"
    share: float
    size: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        hit = rng.random(len(values)) < self.share
        return values + hit * self.size * rng.standard_normal(len(values))


@dataclass(frozen=True)
class Dropouts:
    """Dropouts: a random `share` of the readings is replaced by `value`."""

    name: ClassVar[str] = "dropouts"
    stage: ClassVar[Stage] = "loss"
    share: float
    value: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        return np.where(rng.random(len(values)) < self.share, self.value, values)
