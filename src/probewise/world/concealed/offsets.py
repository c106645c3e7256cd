"""Additive offsets of the reading, on black too: stray light, drift, flicker, glint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows


@dataclass(frozen=True)
class AmbientGradient:
    """Room light from one side: adds `per_mm_x` X + `per_mm_y` Y (lab frame, mm) to the reading."""

    name: ClassVar[str] = "ambient_gradient"
    stage: ClassVar[Stage] = "offset"
    per_mm_x: float
    per_mm_y: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.per_mm_x * rows.place_mm[:, 0] + self.per_mm_y * rows.place_mm[:, 1]


@dataclass(frozen=True)
class AmbientStep:
    """A lamp is switched on: adds `amp` to the readings after `at_s`."""

    name: ClassVar[str] = "ambient_step"
    stage: ClassVar[Stage] = "offset"
    amp: float
    at_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.amp * (rows.time_s > self.at_s)


@dataclass(frozen=True)
class OffsetDrift:
    """Linear drift of the dark level, by `per_hour` reading units per hour."""

    name: ClassVar[str] = "offset_drift"
    stage: ClassVar[Stage] = "offset"
    per_hour: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.per_hour * rows.time_s / 3600


@dataclass(frozen=True)
class Flicker:
    """A sinusoidal offset of amplitude `amp` at `alias_hz`: mains flicker, aliased by the sampling, or a slow lamp."""

    name: ClassVar[str] = "flicker"
    stage: ClassVar[Stage] = "offset"
    amp: float
    alias_hz: float
    phase: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.amp * np.sin(2 * math.pi * self.alias_hz * rows.time_s + self.phase)


@dataclass(frozen=True)
class Hysteresis:
    """An offset of +`amp` or -`amp`, by the direction of motion."""

    name: ClassVar[str] = "hysteresis"
    stage: ClassVar[Stage] = "offset"
    amp: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Add `amp` times the sign of the motion along X, or along Y if X does not change."""
        along_x, along_y = np.sign(rows.direction).T
        sign: FloatArray = np.where(along_x != 0, along_x, along_y)
        return values + self.amp * sign


@dataclass(frozen=True)
class Glint:
    """A reflection of a lamp: adds a Gaussian of height `amp` and sd `r` about `x`, `y` (lab frame) to the reading."""

    name: ClassVar[str] = "glint"
    stage: ClassVar[Stage] = "offset"
    amp: float
    x: float
    y: float
    r: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        squared = (rows.place_mm[:, 0] - self.x) ** 2 + (rows.place_mm[:, 1] - self.y) ** 2
        return values + self.amp * np.exp(-squared / (2 * self.r**2))
