"""Half-planes: black and white on either side of a straight edge (paper, S_BW)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.scene._pixels import share_inside_half_plane
from probewise.scene.regions.checks import RegionBatch, broadcast_and_freeze_fields
from probewise.scene.regions.geometry import edge_distance


@dataclass(frozen=True, eq=False)
class HalfPlaneRegion(RegionBatch):
    """Half-planes x cos(normal) + y sin(normal) > offset, albedo `inside`; `outside` elsewhere. Fields (n_regions,)."""

    normal_rad: FloatArray
    offset_mm: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        broadcast_and_freeze_fields(self, normal_rad=(), offset_mm=())

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        return np.where(self._signed_distance(points_mm) > 0, self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over turned square pixels, exact: (n_regions, n_points)."""
        share = share_inside_half_plane(
            self._signed_distance(centers_mm), self.normal_rad[:, None] - turn_rad, pixel_mm
        )
        return self.outside + (self.inside - self.outside) * share

    def _signed_distance(self, points_mm: FloatArray) -> FloatArray:
        normal = self.normal_rad[:, None]
        return points_mm[:, 0] * np.cos(normal) + points_mm[:, 1] * np.sin(normal) - self.offset_mm[:, None]


@edge_distance.register
def _edge_distance_of_half_plane(region: HalfPlaneRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    normal = region.normal_rad[:, None]
    return np.abs(np.cos(normal) * x_mm + np.sin(normal) * y_mm - region.offset_mm[:, None])
