"""Ellipses and discs (paper, eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.scene._pixels import share_inside_half_plane
from probewise.scene.regions.checks import RegionBatch, broadcast_and_freeze_fields, require_positive
from probewise.scene.regions.geometry import edge_distance, outlines


@dataclass(frozen=True, eq=False)
class EllipseRegion(RegionBatch):
    """Ellipses, albedo `inside` and `outside` them; a disc has equal semi-axes (paper, eq. 1).

    `center_mm` and `semi_axes_mm` have shape (n_regions, 2), `angle_rad` (of the first semi-axis, anticlockwise from X)
    (n_regions,).
    """

    center_mm: FloatArray
    semi_axes_mm: FloatArray
    angle_rad: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        broadcast_and_freeze_fields(self, center_mm=(2,), semi_axes_mm=(2,), angle_rad=())
        require_positive("semi_axes_mm", self.semi_axes_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Return the albedo at points, the edge inside: (n_points, 2) -> (n_regions, n_points)."""
        p, q = self._unit_circle_coordinates(points_mm)
        return np.where(p * p + q * q <= 1, self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over turned square pixels, the edge taken as straight: (n_regions, n_points)."""
        p, q = self._unit_circle_coordinates(centers_mm)
        a, b = self.semi_axes_mm[:, :1], self.semi_axes_mm[:, 1:]
        level = np.hypot(p, q)
        # Gradient of the level sqrt(p^2 + q^2); it is zero only at the centre, far from the edge.
        along, across = p / a, q / b
        steepness = np.hypot(along, across) / np.maximum(level, 1e-12)
        distance = (1 - level) / np.maximum(steepness, 1e-12)
        angle = np.arctan2(across, along) + self.angle_rad[:, None]
        share = share_inside_half_plane(distance, angle - turn_rad, pixel_mm)
        return self.outside + (self.inside - self.outside) * share

    def _unit_circle_coordinates(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return coordinates in which the edge is the unit circle, each (n_regions, n_points)."""
        cosine, sine = np.cos(self.angle_rad)[:, None], np.sin(self.angle_rad)[:, None]
        dx = points_mm[:, 0] - self.center_mm[:, :1]
        dy = points_mm[:, 1] - self.center_mm[:, 1:]
        a, b = self.semi_axes_mm[:, :1], self.semi_axes_mm[:, 1:]
        return (cosine * dx + sine * dy) / a, (cosine * dy - sine * dx) / b


def disc_region(
    center_mm: FloatArray, radius_mm: FloatArray, *, inside: float = 1.0, outside: float = 0.0
) -> EllipseRegion:
    """Build discs, `center_mm` (n_regions, 2), `radius_mm` (n_regions,)."""
    radius = np.atleast_1d(np.asarray(radius_mm, dtype=np.float64))
    return EllipseRegion(center_mm, np.stack([radius, radius], axis=-1), np.zeros(len(radius)), inside, outside)


@outlines.register
def _outlines_of_ellipse(region: EllipseRegion, *, n_vertices: int = 96) -> list[FloatArray]:
    t = np.linspace(0, 2 * np.pi, n_vertices + 1)
    p = region.semi_axes_mm[:, :1] * np.cos(t)
    q = region.semi_axes_mm[:, 1:] * np.sin(t)
    cosine, sine = np.cos(region.angle_rad)[:, None], np.sin(region.angle_rad)[:, None]
    x = region.center_mm[:, :1] + cosine * p - sine * q
    y = region.center_mm[:, 1:] + sine * p + cosine * q
    return list(np.stack([x, y], axis=-1))


@edge_distance.register
def _edge_distance_of_ellipse(region: EllipseRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    cosine, sine = np.cos(region.angle_rad)[:, None], np.sin(region.angle_rad)[:, None]
    a, b = region.semi_axes_mm[:, :1], region.semi_axes_mm[:, 1:]
    dx, dy = x_mm - region.center_mm[:, :1], y_mm - region.center_mm[:, 1:]
    p, q = (cosine * dx + sine * dy) / a, (cosine * dy - sine * dx) / b
    level = np.hypot(p, q)
    steepness = np.where(level > 1e-12, np.hypot(p / a, q / b) / np.maximum(level, 1e-12), 1 / np.minimum(a, b))
    return np.asarray(np.abs(level - 1) / steepness)
