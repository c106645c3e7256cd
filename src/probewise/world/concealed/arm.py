"""Position and orientation errors of the arm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows


@dataclass(frozen=True)
class Backlash:
    """Backlash: the arm stops `width_mm` / 2, half the play of its gears, short of the commanded place."""

    name: ClassVar[str] = "backlash"
    stage: ClassVar[Stage] = "place"
    width_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values - rows.direction * (self.width_mm / 2)


@dataclass(frozen=True)
class PositionScale:
    """Scale error of the arm: true X is 1 + `x` times the commanded one, true Y 1 + `y` times."""

    name: ClassVar[str] = "position_scale"
    stage: ClassVar[Stage] = "place"
    x: float
    y: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(values * [1 + self.x, 1 + self.y])


@dataclass(frozen=True)
class PeriodicPositionError:
    """Runout of a gear or lead screw: adds `amp_mm` sin(2 pi X / `period_mm` + `phase`) to X."""

    name: ClassVar[str] = "periodic_position_error"
    stage: ClassVar[Stage] = "place"
    amp_mm: float
    period_mm: float
    phase: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        x_mm, y_mm = values.T
        wave = self.amp_mm * np.sin(2 * math.pi * x_mm / self.period_mm + self.phase)
        return np.stack([x_mm + wave, y_mm], axis=-1)


@dataclass(frozen=True)
class ScanAngleError:
    """An error of `deg` degrees in the sensor's orientation, in the scans named in `scans`."""

    name: ClassVar[str] = "scan_angle_error"
    stage: ClassVar[Stage] = "turn"
    deg: float
    scans: tuple[str, ...]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + math.radians(self.deg) * rows.in_scans_mask(self.scans)


@dataclass(frozen=True)
class OrientationError:
    """A constant error of `deg` degrees in the sensor's orientation."""

    name: ClassVar[str] = "orientation_error"
    stage: ClassVar[Stage] = "turn"
    deg: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + math.radians(self.deg)
