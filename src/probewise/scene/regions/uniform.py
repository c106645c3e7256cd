"""Uniform albedo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.scene.regions.checks import RegionBatch, broadcast_and_freeze_fields


@dataclass(frozen=True, eq=False)
class UniformRegion(RegionBatch):
    """A uniform albedo `level`, shape (n_regions,)."""

    level: FloatArray

    def __post_init__(self) -> None:
        broadcast_and_freeze_fields(self, level=())

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        return np.repeat(self.level[:, None], len(points_mm), axis=1)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over pixels, the level: (n_regions, n_points)."""
        return self.albedo(centers_mm)
