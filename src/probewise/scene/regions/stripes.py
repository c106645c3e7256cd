"""Parallel stripes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.scene._pixels import share_inside_half_plane
from probewise.scene.regions.checks import RegionBatch, broadcast_and_freeze_fields, require_positive
from probewise.scene.regions.geometry import edge_distance


@dataclass(frozen=True, eq=False)
class StripesRegion(RegionBatch):
    """Stripes where frac((x . n - phase) / period) < duty, n the unit normal; fields (n_regions,).

    The albedo is `inside` there, `outside` elsewhere.
    """

    normal_rad: FloatArray
    period_mm: FloatArray
    duty: FloatArray
    phase_mm: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        broadcast_and_freeze_fields(self, normal_rad=(), period_mm=(), duty=(), phase_mm=())
        require_positive("period_mm", self.period_mm)
        if ((self.duty < 0) | (self.duty > 1)).any():
            raise ParameterError("duty", self.duty.tolist(), "0 to 1")

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        share = self._position_along_normal(points_mm) / self.period_mm[:, None]
        return np.where(share - np.floor(share) < self.duty[:, None], self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over turned square pixels, exact: (n_regions, n_points)."""
        period = self.period_mm[:, None]
        along = self._position_along_normal(centers_mm)
        along = along - period * np.floor(along / period)
        angle = self.normal_rad[:, None] - turn_rad
        share = np.zeros_like(along)
        # Half a pixel's diagonal is 0.71 pixels: edges further away do not cut the pixel.
        reach = 1 + math.ceil(0.75 * pixel_mm / float(self.period_mm.min()))
        for k in range(-reach, reach + 1):
            start = k * period
            share += share_inside_half_plane(along - start, angle, pixel_mm)
            share -= share_inside_half_plane(along - start - self.duty[:, None] * period, angle, pixel_mm)
        return self.outside + (self.inside - self.outside) * share

    def _position_along_normal(self, points_mm: FloatArray) -> FloatArray:
        normal = self.normal_rad[:, None]
        return points_mm[:, 0] * np.cos(normal) + points_mm[:, 1] * np.sin(normal) - self.phase_mm[:, None]


@edge_distance.register
def _edge_distance_of_stripes(region: StripesRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    normal, period = region.normal_rad[:, None], region.period_mm[:, None]
    along = np.cos(normal) * x_mm + np.sin(normal) * y_mm - region.phase_mm[:, None]
    edges = (along, along - region.duty[:, None] * period)
    from_rise, from_fall = (np.abs(edge - period * np.round(edge / period)) for edge in edges)
    has_edges = (region.duty > 0) & (region.duty < 1)
    return np.where(has_edges[:, None], np.minimum(from_rise, from_fall), np.inf)
