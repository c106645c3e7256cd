"""What a world may do that a plain sensor model leaves out: one small value an effect, formulas of its own.

A concealed effect changes one step of the way from pose to reading. To add one, write a frozen
dataclass with `name`, `step` and `change`; `World` applies it at that step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray

__all__ = [
    "STEPS",
    "AmbientGradient",
    "Backlash",
    "Concealed",
    "CorrelatedNoise",
    "GainDrift",
    "Nonlinearity",
    "Rows",
    "Saturation",
    "Step",
]

Step: TypeAlias = Literal["place", "response", "gain", "offset", "saturation", "noise"]
STEPS: tuple[Step, ...] = ("place", "response", "gain", "offset", "saturation", "noise")


@dataclass(frozen=True, eq=False)
class Rows:
    """What the world knows of the readings it takes, one row each: where, which way, when, in which scan."""

    place_mm: FloatArray  # (n_points, 2), where the sensor really stands
    direction: FloatArray  # (n_points, 2), unit vector of the last move, 0 where there was none
    time_s: FloatArray
    scan: IntArray


class Concealed(Protocol):
    """One change at one step.

    `change` takes and returns, by `step`: "place", (n_points, 2) in mm; "response", the seen white
    fraction; "gain", the signal without I_min; "offset" and "saturation", the reading; "noise",
    independent standard normal draws to be turned into the noise in units of its sd; all (n_points,).
    """

    name: ClassVar[str]
    step: ClassVar[Step]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Apply the effect."""
        ...


@dataclass(frozen=True)
class Backlash:
    """The arm stands behind by half the play of its gears, whichever way it came."""

    name: ClassVar[str] = "backlash"
    step: ClassVar[Step] = "place"
    width_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Move places against the direction of the move by width/2."""
        return values - rows.direction * (self.width_mm / 2)


@dataclass(frozen=True)
class Nonlinearity:
    """The photodiode's answer is a power of the light."""

    name: ClassVar[str] = "nonlinearity"
    step: ClassVar[Step] = "response"
    gamma: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Raise the seen fraction to gamma."""
        return np.asarray(np.power(np.maximum(values, 0.0), self.gamma), dtype=np.float64)


@dataclass(frozen=True)
class GainDrift:
    """The LED warms up: the signal starts off by `frac` and settles with `tau_s`."""

    name: ClassVar[str] = "gain_drift"
    step: ClassVar[Step] = "gain"
    frac: float
    tau_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Multiply the signal by 1 + frac exp(-t/tau)."""
        return values * (1 + self.frac * np.exp(-rows.time_s / self.tau_s))


@dataclass(frozen=True)
class AmbientGradient:
    """Room light falls in from one side."""

    name: ClassVar[str] = "ambient_gradient"
    step: ClassVar[Step] = "offset"
    per_mm_x: float
    per_mm_y: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Add a plane over the lab frame."""
        return values + self.per_mm_x * rows.place_mm[:, 0] + self.per_mm_y * rows.place_mm[:, 1]


@dataclass(frozen=True)
class Saturation:
    """The converter ends at a level; `softness` (reading units, 0 = a sharp corner) rounds the corner."""

    name: ClassVar[str] = "saturation"
    step: ClassVar[Step] = "saturation"
    level: float
    softness: float = 0.0

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Let no reading pass the level."""
        if self.softness == 0:
            return np.minimum(values, self.level)
        return self.level - self.softness * np.logaddexp(0.0, (self.level - values) / self.softness)


@dataclass(frozen=True)
class CorrelatedNoise:
    """Noise remembers: AR(1) within a scan with the sd unchanged."""

    name: ClassVar[str] = "correlated_noise"
    step: ClassVar[Step] = "noise"
    rho: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Mix each draw with the one before it in the scan."""
        out = values.copy()
        fresh = np.sqrt(1 - self.rho**2)
        for k in range(1, len(out)):
            if rows.scan[k] == rows.scan[k - 1]:
                out[k] = self.rho * out[k - 1] + fresh * values[k]
        return out
