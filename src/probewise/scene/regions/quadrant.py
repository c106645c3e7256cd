"""Quadrants: a corner between two axis-parallel edges (paper, S_a to S_d)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.scene.regions.checks import RegionBatch, broadcast_and_freeze_fields
from probewise.scene.regions.geometry import edge_distance
from probewise.scene.regions.polygon import PolygonRegion


@dataclass(frozen=True, eq=False)
class QuadrantRegion(RegionBatch):
    """Quadrants (x - cx) dx > 0 and (y - cy) dy > 0 (paper, S_a to S_d).

    `corner_mm` and `direction` (entries +1 or -1) have shape (n_regions, 2). The albedo is `inside` there, `outside`
    elsewhere.
    """

    corner_mm: FloatArray
    direction: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        broadcast_and_freeze_fields(self, corner_mm=(2,), direction=(2,))
        if not np.isin(self.direction, (-1.0, 1.0)).all():
            raise ParameterError("direction", self.direction.tolist(), "+1 or -1")

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        beyond = (points_mm[None] - self.corner_mm[:, None]) * self.direction[:, None] > 0
        return np.where(beyond.all(axis=-1), self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over turned square pixels, exact: (n_regions, n_points)."""
        reach = pixel_mm + max(1.0, float(np.abs(centers_mm[None] - self.corner_mm[:, None]).max(initial=0.0)))
        x, y = self.corner_mm[:, 0], self.corner_mm[:, 1]
        far_x, far_y = x + 2 * reach * self.direction[:, 0], y + 2 * reach * self.direction[:, 1]
        square = np.stack([np.stack(p, axis=-1) for p in ((x, y), (far_x, y), (far_x, far_y), (x, far_y))], axis=1)
        return PolygonRegion.from_vertices(square, inside=self.inside, outside=self.outside).coverage(
            centers_mm, pixel_mm, turn_rad
        )


@edge_distance.register
def _edge_distance_of_quadrant(region: QuadrantRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    right = (x_mm - region.corner_mm[:, :1]) * region.direction[:, :1]
    above = (y_mm - region.corner_mm[:, 1:]) * region.direction[:, 1:]
    # The edges are two rays from the corner: to the right, and up.
    return np.minimum(np.hypot(np.minimum(right, 0), above), np.hypot(right, np.minimum(above, 0)))
