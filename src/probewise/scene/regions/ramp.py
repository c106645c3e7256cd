"""A linear gradient of albedo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.scene.regions.checks import RegionBatch, broadcast_and_freeze_fields


@dataclass(frozen=True, eq=False)
class RampRegion(RegionBatch):
    """Albedo per_mm (x . n), n the unit normal at `normal_rad`, not limited to 0 to 1; fields (n_regions,)."""

    normal_rad: FloatArray
    per_mm: FloatArray

    def __post_init__(self) -> None:
        broadcast_and_freeze_fields(self, normal_rad=(), per_mm=())

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        normal = self.normal_rad[:, None]
        return self.per_mm[:, None] * (points_mm[:, 0] * np.cos(normal) + points_mm[:, 1] * np.sin(normal))

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over turned square pixels: exactly the value at their centres."""
        return self.albedo(centers_mm)
