"""Noise that is not white, not Gaussian or not everywhere the same."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.special import ndtr, stdtrit

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows

__all__ = ["CorrelatedNoise", "DriftingNoise", "Dropouts", "HeavyTails", "Outliers", "SignalDependentNoise"]


@dataclass(frozen=True)
class CorrelatedNoise:
    """Noise remembers: AR(1) within a scan with the sd unchanged."""

    name: ClassVar[str] = "correlated_noise"
    stage: ClassVar[Stage] = "noise"
    rho: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Mix each draw with the one before it in the scan."""
        fresh = math.sqrt(1 - self.rho**2)
        out = values.copy()
        for k in np.flatnonzero(~rows.starts_scan()):
            out[k] = self.rho * out[k - 1] + fresh * values[k]
        return out


@dataclass(frozen=True)
class SignalDependentNoise:
    """Bright readings are noisier: the variance grows by `ratio` from black to white."""

    name: ClassVar[str] = "signal_dependent_noise"
    stage: ClassVar[Stage] = "noise"
    ratio: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Multiply the variance by 1 + ratio u."""
        return values * np.sqrt(1 + self.ratio * seen)


@dataclass(frozen=True)
class DriftingNoise:
    """Noise grows in time: its sd rises to `factor` within `over_s`, and stays there."""

    name: ClassVar[str] = "drifting_noise"
    stage: ClassVar[Stage] = "noise"
    factor: float
    over_s: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Multiply the sd by 1 at the start to `factor`."""
        return values * (1 + (self.factor - 1) * np.clip(rows.time_s / self.over_s, 0.0, 1.0))


@dataclass(frozen=True)
class HeavyTails:
    """Noise is Student-t of `dof` degrees of freedom, 3 or more, with the sd unchanged."""

    name: ClassVar[str] = "heavy_tails"
    stage: ClassVar[Stage] = "noise"
    dof: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Take each draw to the same quantile of the other distribution."""
        return np.asarray(stdtrit(self.dof, ndtr(values)) * math.sqrt((self.dof - 2) / self.dof))


@dataclass(frozen=True)
class Outliers:
    """A share of the readings carries a second noise, `size` times the sd of the first."""

    name: ClassVar[str] = "outliers"
    stage: ClassVar[Stage] = "noise"
    share: float
    size: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Add the second noise where the dice say so."""
        hit = rng.random(len(values)) < self.share
        return values + hit * self.size * rng.standard_normal(len(values))


@dataclass(frozen=True)
class Dropouts:
    """A share of the readings is lost to one value."""

    name: ClassVar[str] = "dropouts"
    stage: ClassVar[Stage] = "loss"
    share: float
    value: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Replace readings where the dice say so."""
        return np.where(rng.random(len(values)) < self.share, self.value, values)
