"""How far a place lies from the nearest edge of a pattern."""

from __future__ import annotations

from functools import singledispatch

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.albedo import GradedRegion, PatchedRegion
from probewise.scene.albedo import Region
from probewise.scene.regions import (
    EllipseRegion,
    HalfPlaneRegion,
    MixtureOfRegions,
    PolygonRegion,
    QuadrantRegion,
    StripesRegion,
)

__all__ = ["edge_distance"]


@singledispatch
def edge_distance(region: Region, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Distance of places from the nearest edge of a region, mm.

    Parameters
    ----------
    region
        Of n_regions hypotheses; infinitely far where its kind has no edge (uniform, a ramp, an image).
    x_mm, y_mm
        Places, (n_samples or 1, n_points).

    Returns
    -------
    Distances, (n_samples or n_regions or 1, n_points). Of an ellipse to first order in the distance; of
    a disc exactly.
    """
    return np.full(np.broadcast_shapes(x_mm.shape, y_mm.shape, (region.n_regions, 1)), np.inf)


@edge_distance.register
def _(region: HalfPlaneRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    normal = region.normal_rad[:, None]
    return np.abs(np.cos(normal) * x_mm + np.sin(normal) * y_mm - region.offset_mm[:, None])


@edge_distance.register
def _(region: StripesRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    normal, period = region.normal_rad[:, None], region.period_mm[:, None]
    along = np.cos(normal) * x_mm + np.sin(normal) * y_mm - region.phase_mm[:, None]
    edges = (along, along - region.duty[:, None] * period)
    from_rise, from_fall = (np.abs(edge - period * np.round(edge / period)) for edge in edges)
    return np.asarray(np.minimum(from_rise, from_fall))


@edge_distance.register
def _(region: QuadrantRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    right = (x_mm - region.corner_mm[:, :1]) * region.direction[:, :1]
    above = (y_mm - region.corner_mm[:, 1:]) * region.direction[:, 1:]
    # Two rays from the corner: to the right, and up.
    return np.minimum(np.hypot(np.minimum(right, 0), above), np.hypot(right, np.minimum(above, 0)))


@edge_distance.register
def _(region: EllipseRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    cosine, sine = np.cos(region.angle_rad)[:, None], np.sin(region.angle_rad)[:, None]
    a, b = region.semi_axes_mm[:, :1], region.semi_axes_mm[:, 1:]
    dx, dy = x_mm - region.center_mm[:, :1], y_mm - region.center_mm[:, 1:]
    p, q = (cosine * dx + sine * dy) / a, (cosine * dy - sine * dx) / b
    level = np.hypot(p, q)
    steepness = np.where(level > 1e-12, np.hypot(p / a, q / b) / np.maximum(level, 1e-12), 1 / np.minimum(a, b))
    return np.asarray(np.abs(level - 1) / steepness)


@edge_distance.register
def _(region: PolygonRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    nearest = np.full(np.broadcast_shapes(x_mm.shape, y_mm.shape, (region.n_regions, 1)), np.inf)
    for k in range(region.edges_mm.shape[1]):
        (x1, y1), (x2, y2) = (region.edges_mm[:, k, end, :, None].transpose(1, 0, 2) for end in (0, 1))
        length2 = np.maximum((x2 - x1) ** 2 + (y2 - y1) ** 2, 1e-300)
        share = np.clip(((x_mm - x1) * (x2 - x1) + (y_mm - y1) * (y2 - y1)) / length2, 0, 1)
        foot_x, foot_y = x1 + share * (x2 - x1), y1 + share * (y2 - y1)
        nearest = np.minimum(nearest, np.hypot(x_mm - foot_x, y_mm - foot_y))
    return nearest


@edge_distance.register
def _(region: MixtureOfRegions, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    shape = (region.n_regions, max(x_mm.shape[1], y_mm.shape[1]))
    x_mm, y_mm = np.broadcast_to(x_mm, shape), np.broadcast_to(y_mm, shape)
    out = np.empty(shape)
    for rows, part in region.rows():
        out[rows] = edge_distance(part, x_mm[rows], y_mm[rows])
    return out


@edge_distance.register
def _(region: GradedRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    return edge_distance(region.region, x_mm, y_mm)


@edge_distance.register
def _(region: PatchedRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    return edge_distance(region.region, x_mm, y_mm)
