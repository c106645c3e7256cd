"""The arm does not stand where, or as, it was sent."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows

__all__ = ["Backlash", "OrientationError", "PeriodicPositionError", "PositionScale", "ScanAngleError"]


@dataclass(frozen=True)
class Backlash:
    """The arm stands behind by half the play of its gears, whichever way it came."""

    name: ClassVar[str] = "backlash"
    stage: ClassVar[Stage] = "place"
    width_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Move places against the direction of the move by width/2."""
        return values - rows.direction * (self.width_mm / 2)


@dataclass(frozen=True)
class PositionScale:
    """The arm's millimetre is not one: too long by a share `x` along X and `y` along Y."""

    name: ClassVar[str] = "position_scale"
    stage: ClassVar[Stage] = "place"
    x: float
    y: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Stretch places about the origin."""
        return np.asarray(values * [1 + self.x, 1 + self.y])


@dataclass(frozen=True)
class PeriodicPositionError:
    """A gear or a lead screw runs out of true: X errs by a sine of X."""

    name: ClassVar[str] = "periodic_position_error"
    stage: ClassVar[Stage] = "place"
    amp_mm: float
    period_mm: float
    phase: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Add amp sin(2 pi x / period + phase) to X."""
        x_mm, y_mm = values.T
        wave = self.amp_mm * np.sin(2 * math.pi * x_mm / self.period_mm + self.phase)
        return np.stack([x_mm + wave, y_mm], axis=-1)


@dataclass(frozen=True)
class ScanAngleError:
    """The sensor was mounted askew for some scans, by their names."""

    name: ClassVar[str] = "scan_angle_error"
    stage: ClassVar[Stage] = "turn"
    deg: float
    scans: tuple[str, ...]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Turn the sensor on by `deg` in these scans."""
        return values + math.radians(self.deg) * rows.in_scans(self.scans)


@dataclass(frozen=True)
class OrientationError:
    """The sensor sits askew on its axis, always."""

    name: ClassVar[str] = "orientation_error"
    stage: ClassVar[Stage] = "turn"
    deg: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Turn the sensor on by `deg`."""
        return values + math.radians(self.deg)
