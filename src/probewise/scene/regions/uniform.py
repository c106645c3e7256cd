"""Uniform albedo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.scene.regions.checks import batch

__all__ = ["UniformRegion"]


@dataclass(frozen=True, eq=False)
class UniformRegion:
    """A uniform albedo `level`, shape (n_regions,)."""

    level: FloatArray

    def __post_init__(self) -> None:
        batch(self, level=())

    @property
    def n_regions(self) -> int:
        """Number of hypotheses, or 1 where all share one region."""
        return len(self.level)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        return np.repeat(self.level[:, None], len(points_mm), axis=1)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over pixels: the level."""
        return self.albedo(centers_mm)
