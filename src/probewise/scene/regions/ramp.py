"""A linear gradient of albedo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.scene.regions.checks import batch

__all__ = ["RampRegion"]


@dataclass(frozen=True, eq=False)
class RampRegion:
    """Albedo per_mm (x . n), unbounded; fields (n_regions,)."""

    normal_rad: FloatArray
    per_mm: FloatArray

    def __post_init__(self) -> None:
        batch(self, normal_rad=(), per_mm=())

    @property
    def n_regions(self) -> int:
        """Number of hypotheses, or 1 where all share one region."""
        return len(self.per_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        normal = self.normal_rad[:, None]
        return self.per_mm[:, None] * (points_mm[:, 0] * np.cos(normal) + points_mm[:, 1] * np.sin(normal))

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels: exactly the value at their centres."""
        return self.albedo(centers_mm)
