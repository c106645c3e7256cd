"""Effects by which a surface differs from its description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows


@dataclass(frozen=True)
class EdgeMisplacement:
    """A displacement of every pattern by `offset_mm` across its edges (along X if they have no common direction)."""

    name: ClassVar[str] = "edge_misplacement"
    stage: ClassVar[Stage] = "pattern"
    offset_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.offset_mm * rows.across


@dataclass(frozen=True)
class ScanMisplacement:
    """A displacement of the pattern by `offset_mm` across its edges (else along X), in the one scan named `scan`."""

    name: ClassVar[str] = "scan_misplacement"
    stage: ClassVar[Stage] = "pattern"
    offset_mm: float
    scan: str

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.offset_mm * rows.across * rows.in_scans_mask((self.scan,))[:, None]


@dataclass(frozen=True)
class AlbedoGradient:
    """A print that is whiter on one side: albedo times 1 + `per_mm_x` X + `per_mm_y` Y (lab frame, mm)."""

    name: ClassVar[str] = "albedo_gradient"
    stage: ClassVar[Stage] = "albedo"
    per_mm_x: float
    per_mm_y: float

    def retouch(self, albedo: FloatArray, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        return albedo * (1 + self.per_mm_x * x_mm + self.per_mm_y * y_mm)


@dataclass(frozen=True)
class AlbedoPatch:
    """A stain on every pattern, at `x`, `y` of the lab frame: adds a Gaussian of height `albedo`, sd `r` (mm)."""

    name: ClassVar[str] = "albedo_patch"
    stage: ClassVar[Stage] = "albedo"
    albedo: float
    x: float
    y: float
    r: float

    def retouch(self, albedo: FloatArray, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        squared = (x_mm - self.x) ** 2 + (y_mm - self.y) ** 2
        return albedo + self.albedo * np.exp(-squared / (2 * self.r**2))
