"""Albedo regions, one per hypothesis: frozen values of batched geometry (paper, eq. 2 and 3; patterns: eq. 12 to 16).

A new kind is a frozen dataclass with `n_regions` and `albedo`. It may register the distance to its edge
(`edge_distance`) and, where that is closed, its outline (`outlines`); a closed form registered with
`sensor.gaussian.mean_albedo_under_one_gaussian` makes a footprint over it cost microseconds, not milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import singledispatch
from itertools import pairwise
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray, frozen_int, read_only_floats, require_finite
from probewise.errors import ParameterError, ShapeError, require
from probewise.recordings import patterns as kinds
from probewise.recordings.patterns import Pattern


class Region(Protocol):
    """An albedo field for each hypothesis: `n_regions` of them, 1 where all share one.

    Regions are small frozen values of batched geometry (scene/regions.py). The sensor integrates
    a region in closed form where its kind has one (sensor/gaussian.py), or pixel by pixel
    (sensor/ssf.py).
    """

    @property
    def n_regions(self) -> int:
        """Number of hypotheses, or 1 where all share one region."""
        ...

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Return the albedo at points, (n_points, 2) lab frame -> (n_regions, n_points)."""
        ...


class RegionBatch(Region, Protocol):
    """Base of regions whose first field has a row for each hypothesis, after `broadcast_and_freeze_fields`."""

    @property
    def n_regions(self) -> int:
        """Number of hypotheses, or 1 where all share one region."""
        first = next(iter(self.__dataclass_fields__))  # type: ignore[attr-defined]
        return len(getattr(self, first))


def broadcast_and_freeze_fields(region: object, **shapes: tuple[int, ...]) -> None:
    """Broadcast the named arrays of a region to (n_regions, *shape), -1 for any length, in place; freeze them.

    ShapeError for a shape that does not fit, ParameterError for NaN or infinity.
    """
    arrays: dict[str, FloatArray] = {}
    for name, shape in shapes.items():
        array = np.asarray(getattr(region, name), dtype=np.float64)
        array = arrays[name] = array[None] if array.ndim == len(shape) else array
        wants = zip(shape, array.shape[1:], strict=False)
        if array.ndim != len(shape) + 1 or any(want not in (-1, got) for want, got in wants):
            raise ShapeError(f"{name} has shape {array.shape}; allowed: (n_regions, {', '.join(map(str, shape))})")
        require_finite(name, array)
    n_regions = max(map(len, arrays.values()))
    for name, array in arrays.items():
        if len(array) not in (1, n_regions):
            raise ShapeError(f"{name} has {len(array)} rows; allowed: {n_regions}, as the other arrays, or 1")
        object.__setattr__(region, name, read_only_floats(np.broadcast_to(array, (n_regions, *array.shape[1:]))))


@singledispatch
def outlines(region: Region, *, n_vertices: int = 96) -> list[FloatArray]:
    """Trace the closed edge of each hypothesis, for drawing, rasterising and culling.

    `region`: ellipses, polygons, a mixture of these, or any kind that registers its outline (`outlines.register`);
    `n_vertices`: of a curved edge. Returns one array (n, 2) per hypothesis, mm, the first vertex repeated at the end.
    ParameterError if the region has no closed edge.
    """
    raise ParameterError("region", type(region).__name__, "EllipseRegion, PolygonRegion or a mixture of them")


@singledispatch
def edge_distance(region: Region, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return the distance of places from the nearest edge of a region, mm; infinite for kinds without edges.

    `x_mm`, `y_mm`: places, (n_samples or 1, n_points). Returns (n_samples or n_regions or 1, n_points): exact, but to
    first order in the distance for an ellipse that is no disc.
    """
    return np.full(np.broadcast_shapes(x_mm.shape, y_mm.shape, (region.n_regions, 1)), np.inf)


@dataclass(frozen=True, eq=False)
class UniformRegion(RegionBatch):
    """A uniform albedo `level`, shape (n_regions,)."""

    level: FloatArray

    def __post_init__(self) -> None:
        broadcast_and_freeze_fields(self, level=())

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        return np.repeat(self.level[:, None], len(points_mm), axis=1)


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
        return np.where(self.signed_distance_mm(*points_mm.T) > 0, self.inside, self.outside)

    def signed_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return the distance from the edge, positive inside; places broadcast with (n_regions, 1)."""
        normal = self.normal_rad[:, None]
        return x_mm * np.cos(normal) + y_mm * np.sin(normal) - self.offset_mm[:, None]


@edge_distance.register
def _edge_distance_of_half_plane(region: HalfPlaneRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    return np.abs(region.signed_distance_mm(x_mm, y_mm))


@dataclass(frozen=True, eq=False)
class PolygonRegion(RegionBatch):
    """Polygons, albedo `inside` and `outside` them, given by directed edges with the inside on their left.

    `edges_mm` has shape (n_regions, n_edges, 2 ends, 2). Build it with `from_vertices` from the vertices of
    polygons that do not cross themselves, or with `from_even_odd_vertices` from one polygon that may.
    """

    edges_mm: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        broadcast_and_freeze_fields(self, edges_mm=(-1, 2, 2))

    @classmethod
    def from_vertices(cls, vertices_mm: FloatArray, *, inside: float = 1.0, outside: float = 0.0) -> PolygonRegion:
        """Build from vertices (n_regions, n_vertices, 2), clockwise or anticlockwise; edges must not cross."""
        vertices = np.asarray(vertices_mm, dtype=np.float64)
        if vertices.ndim != 3 or vertices.shape[1] < 3 or vertices.shape[2] != 2:
            raise ShapeError(f"vertices_mm has shape {vertices.shape}; allowed: (n_regions, 3 or more, 2)")
        following = np.roll(vertices, -1, axis=1)
        area = np.sum(vertices[..., 0] * following[..., 1] - vertices[..., 1] * following[..., 0], axis=1)
        edges = np.stack([vertices, following], axis=2)
        edges = np.where((area < 0)[:, None, None, None], edges[:, :, ::-1], edges)
        return cls(edges, inside, outside)

    @classmethod
    def from_even_odd_vertices(
        cls, vertices_mm: FloatArray, *, inside: float = 1.0, outside: float = 0.0
    ) -> PolygonRegion:
        """Build one region from the vertices (n_vertices, 2) of a polygon that may cross itself.

        Edges are split where they meet; pieces with the inside (even-odd rule) on exactly one
        side are kept, directed so that the inside is on their left. ParameterError if the area is 0.
        """
        vertices = np.asarray(vertices_mm, dtype=np.float64)
        if vertices.ndim != 2 or len(vertices) < 3 or vertices.shape[1] != 2:
            raise ShapeError(f"vertices_mm has shape {vertices.shape}; allowed: (3 or more, 2)")
        edges = np.stack([vertices, np.roll(vertices, -1, axis=0)], axis=1)
        return cls(_even_odd_boundary_edges(edges)[None], inside, outside)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        return np.where(_count_ray_crossings(self.edges_mm, points_mm) % 2 == 1, self.inside, self.outside)


def _count_ray_crossings(edges_mm: FloatArray, points_mm: FloatArray) -> IntArray:
    """Count the edges that a ray to the right of each point crosses, (n_regions, n_points)."""
    x, y = points_mm[:, 0], points_mm[:, 1]
    count = np.zeros((len(edges_mm), len(points_mm)), dtype=np.int64)
    for k in range(edges_mm.shape[1]):
        x1, y1 = edges_mm[:, k, 0, :1], edges_mm[:, k, 0, 1:]
        x2, y2 = edges_mm[:, k, 1, :1], edges_mm[:, k, 1, 1:]
        spans = (y1 > y) != (y2 > y)
        rise = np.where(y2 == y1, 1.0, y2 - y1)
        count += spans & (x < x1 + (y - y1) / rise * (x2 - x1))
    return count


def _even_odd_boundary_edges(edges: FloatArray) -> FloatArray:
    """Return the even-odd inside's boundary, (n_pieces, 2, 2), from edges (n_edges, 2, 2), split where they meet."""
    size = float(np.ptp(edges.reshape(-1, 2), axis=0).max())
    require(size != 0, "vertices_mm", edges[:, 0].tolist(), "a polygon whose area is not 0")
    pieces: dict[tuple[tuple[float, float], tuple[float, float]], None] = {}
    other = edges[:, 1] - edges[:, 0]
    for start, end in edges:
        cuts = {0.0, 1.0}
        step = end - start
        length2 = float(step @ step)
        if length2 == 0:
            continue
        cross = step[0] * other[:, 1] - step[1] * other[:, 0]
        between, is_parallel = edges[:, 0] - start, np.abs(cross) <= 1e-12 * size * size
        with np.errstate(all="ignore"):  # of parallel ones
            t = (between[:, 0] * other[:, 1] - between[:, 1] * other[:, 0]) / cross
            s = (between[:, 0] * step[1] - between[:, 1] * step[0]) / cross
        cuts.update(t[~is_parallel & (s >= -1e-12) & (s <= 1 + 1e-12)].tolist())
        is_near = np.abs(step[0] * between[:, 1] - step[1] * between[:, 0]) <= 1e-9 * size * math.sqrt(length2)
        for k in np.flatnonzero(is_parallel & is_near):  # on one line
            cuts.update((float(between[k] @ step) / length2, float((edges[k, 1] - start) @ step) / length2))
        ordered = sorted(t for t in cuts if 0 <= t <= 1)
        for a, b in pairwise(ordered):
            if b - a > 1e-9:
                p, q = (tuple(np.round(start + t * step, 9).tolist()) for t in (a, b))
                pieces.setdefault((min(p, q), max(p, q)))
    ends = np.array([*pieces]).reshape(-1, 2, 2)
    middle, along = ends.mean(axis=1), ends[:, 1] - ends[:, 0]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None] * 1e-7 * size
    is_in = _count_ray_crossings(edges[None], np.concatenate([middle + left, middle - left])).reshape(2, -1) % 2 == 1
    kept: FloatArray = np.where(is_in[0, :, None, None], ends, ends[:, ::-1])[is_in[0] != is_in[1]]
    require(len(kept), "vertices_mm", edges[:, 0].tolist(), "a polygon whose area is not 0")
    return np.asarray(kept)


@outlines.register
def _outlines_of_polygon(region: PolygonRegion, *, n_vertices: int = 96) -> list[FloatArray]:
    return [np.concatenate([edges[:, 0], edges[:1, 0]]) for edges in region.edges_mm]


@edge_distance.register
def _edge_distance_of_polygon(region: PolygonRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    nearest = np.full(np.broadcast_shapes(x_mm.shape, y_mm.shape, (region.n_regions, 1)), np.inf)
    for k in range(region.edges_mm.shape[1]):
        (x1, y1), (x2, y2) = (region.edges_mm[:, k, end, :, None].transpose(1, 0, 2) for end in (0, 1))
        length2 = np.maximum((x2 - x1) ** 2 + (y2 - y1) ** 2, 1e-300)
        share = np.clip(((x_mm - x1) * (x2 - x1) + (y_mm - y1) * (y2 - y1)) / length2, 0, 1)
        foot_x, foot_y = x1 + share * (x2 - x1), y1 + share * (y2 - y1)
        nearest = np.minimum(nearest, np.hypot(x_mm - foot_x, y_mm - foot_y))
    return nearest


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

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        beyond = (points_mm[None] - self.corner_mm[:, None]) * self.direction[:, None] > 0
        return np.where(beyond.all(axis=-1), self.inside, self.outside)


@edge_distance.register
def _edge_distance_of_quadrant(region: QuadrantRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    right = (x_mm - region.corner_mm[:, :1]) * region.direction[:, :1]
    above = (y_mm - region.corner_mm[:, 1:]) * region.direction[:, 1:]
    # The edges are two rays from the corner: to the right, and up.
    return np.minimum(np.hypot(np.minimum(right, 0), above), np.hypot(right, np.minimum(above, 0)))


@dataclass(frozen=True, eq=False)
class EllipseRegion(RegionBatch):
    """Ellipses, albedo `inside` and `outside` them; a disc has equal semi-axes (paper, eq. 2 and 3).

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

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Return the albedo at points, the edge inside: (n_points, 2) -> (n_regions, n_points)."""
        p, q = self.unit_circle_coordinates(*points_mm.T)
        return np.where(p * p + q * q <= 1, self.inside, self.outside)

    def unit_circle_coordinates(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return coordinates in which the edge is the unit circle; places broadcast with (n_regions, 1)."""
        cosine, sine = np.cos(self.angle_rad)[:, None], np.sin(self.angle_rad)[:, None]
        dx, dy = x_mm - self.center_mm[:, :1], y_mm - self.center_mm[:, 1:]
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
    a, b = region.semi_axes_mm[:, :1], region.semi_axes_mm[:, 1:]
    p, q = region.unit_circle_coordinates(x_mm, y_mm)
    level = np.hypot(p, q)
    steepness = np.where(level > 1e-12, np.hypot(p / a, q / b) / np.maximum(level, 1e-12), 1 / np.minimum(a, b))
    return np.asarray(np.abs(level - 1) / steepness)


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

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        share = self.position_along_normal_mm(*points_mm.T) / self.period_mm[:, None]
        return np.where(share - np.floor(share) < self.duty[:, None], self.inside, self.outside)

    def position_along_normal_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return how far places are from the first stripe's edge; they broadcast with (n_regions, 1)."""
        normal = self.normal_rad[:, None]
        return x_mm * np.cos(normal) + y_mm * np.sin(normal) - self.phase_mm[:, None]


@edge_distance.register
def _edge_distance_of_stripes(region: StripesRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    period, along = region.period_mm[:, None], region.position_along_normal_mm(x_mm, y_mm)
    edges = (along, along - region.duty[:, None] * period)
    from_rise, from_fall = (np.abs(edge - period * np.round(edge / period)) for edge in edges)
    has_edges = (region.duty > 0) & (region.duty < 1)
    return np.where(has_edges[:, None], np.minimum(from_rise, from_fall), np.inf)


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


@dataclass(frozen=True, eq=False)
class ImageRegion:
    """One image of albedos: `values` (n_rows, n_columns), first row on top, 0 outside it.

    `pixel_mm` is a pixel's side, `origin_mm` the lower left corner; hypotheses share the image (n_regions is 1).
    """

    values: FloatArray
    pixel_mm: float
    origin_mm: tuple[float, float]

    def __post_init__(self) -> None:
        values = read_only_floats(self.values)
        if values.ndim != 2 or values.size == 0:
            raise ShapeError(f"image has shape {values.shape}; allowed: (n_rows, n_columns), not empty")
        require_finite("image", values)
        object.__setattr__(self, "values", values)

    @property
    def n_regions(self) -> int:
        """1: all hypotheses share the image."""
        return 1

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        n_rows, n_columns = self.values.shape
        column, up = (np.floor((points_mm - self.origin_mm) / self.pixel_mm).astype(np.int64)).T
        row = n_rows - 1 - up
        within = (column >= 0) & (column < n_columns) & (row >= 0) & (row < n_rows)
        return np.where(within, self.values[np.where(within, row, 0), np.where(within, column, 0)], 0.0)[None]


@dataclass(frozen=True, eq=False)
class RegionsOfMixedKinds(RegionBatch):
    """Regions whose kind may differ between hypotheses, as for a set of shapes.

    `which`, shape (n_regions,), is the index of each hypothesis' part; part k holds, in
    order, the regions of the hypotheses with which == k.
    """

    which: IntArray
    parts: tuple[Region, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "which", frozen_int(self.which))

    def rows_and_regions(self) -> list[tuple[IntArray, Region]]:
        """List, for each part that occurs, the row numbers of its hypotheses in `which`, and their region."""
        pairs = [(np.flatnonzero(self.which == k), part) for k, part in enumerate(self.parts)]
        return [(rows, part) for rows, part in pairs if rows.size]

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        out = np.empty((self.n_regions, len(points_mm)))
        for rows, part in self.rows_and_regions():
            out[rows] = part.albedo(points_mm)
        return out


@outlines.register
def _outlines_of_mixed_kinds(region: RegionsOfMixedKinds, *, n_vertices: int = 96) -> list[FloatArray]:
    traces: list[FloatArray] = [np.empty((0, 2))] * region.n_regions
    for rows, part in region.rows_and_regions():
        for row, trace in zip(rows, outlines(part, n_vertices=n_vertices), strict=True):
            traces[int(row)] = trace
    return traces


@edge_distance.register
def _edge_distance_of_mixed_kinds(region: RegionsOfMixedKinds, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    shape = (region.n_regions, max(x_mm.shape[1], y_mm.shape[1]))
    x_mm, y_mm = np.broadcast_to(x_mm, shape), np.broadcast_to(y_mm, shape)
    out = np.empty(shape)
    for rows, part in region.rows_and_regions():
        out[rows] = edge_distance(part, x_mm[rows], y_mm[rows])
    return out


def region_of(pattern: Pattern) -> Region:
    """Build the region that a pattern of a recording describes (n_regions is 1).

    Raises ParameterError if the pattern is of no known kind, or its numbers describe no area.
    """
    if isinstance(pattern, kinds.Uniform):
        return UniformRegion(np.array([pattern.albedo]))
    if isinstance(pattern, kinds.Image):
        return ImageRegion(pattern.albedo, pattern.pixel_mm, pattern.origin_mm)
    require(type(pattern) in _REGIONS, "pattern", pattern, "a pattern of probewise.recordings.patterns")
    return _REGIONS[type(pattern)](**vars(pattern))


# Regions, or what builds them, with the fields of a pattern as arguments.
_REGIONS: Mapping[type[Pattern], Callable[..., Region]] = {
    kinds.HalfPlane: HalfPlaneRegion,
    kinds.Quadrant: QuadrantRegion,
    kinds.Disc: disc_region,
    kinds.Polygon: PolygonRegion.from_even_odd_vertices,
    kinds.Stripes: StripesRegion,
    kinds.Ramp: RampRegion,
}
