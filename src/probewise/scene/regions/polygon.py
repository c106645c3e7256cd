"""Polygons: batches of simple ones, or a single one that may cross itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError, ShapeError
from probewise.scene._pixels import share_inside_polygon
from probewise.scene.regions.checks import RegionBatch, broadcast_and_freeze_fields
from probewise.scene.regions.geometry import edge_distance, outlines


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

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over turned square pixels, exact: (n_regions, n_points)."""
        share = share_inside_polygon(self.edges_mm, centers_mm, pixel_mm, turn_rad)
        return self.outside + (self.inside - self.outside) * share


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
    if size == 0:
        raise ParameterError("vertices_mm", edges[:, 0].tolist(), "a polygon whose area is not 0")
    pieces: dict[tuple[tuple[float, float], tuple[float, float]], None] = {}
    for start, end in edges:
        cuts = {0.0, 1.0}
        step = end - start
        length2 = float(step @ step)
        if length2 == 0:
            continue
        for other_start, other_end in edges:
            other = other_end - other_start
            between = other_start - start
            cross = step[0] * other[1] - step[1] * other[0]
            if abs(cross) > 1e-12 * size * size:
                t = (between[0] * other[1] - between[1] * other[0]) / cross
                s = (between[0] * step[1] - between[1] * step[0]) / cross
                if -1e-12 <= s <= 1 + 1e-12:
                    cuts.add(float(t))
            elif abs(step[0] * between[1] - step[1] * between[0]) <= 1e-9 * size * math.sqrt(length2):
                cuts.update((float(between @ step) / length2, float((other_end - start) @ step) / length2))
        ordered = sorted(t for t in cuts if 0 <= t <= 1)
        for a, b in pairwise(ordered):
            if b - a > 1e-9:
                p, q = (tuple(np.round(start + t * step, 9).tolist()) for t in (a, b))
                pieces.setdefault((min(p, q), max(p, q)))
    kept = []
    for p, q in pieces:
        ends = np.array([p, q])
        middle, along = ends.mean(axis=0), ends[1] - ends[0]
        left = np.array([-along[1], along[0]]) / np.hypot(*along) * 1e-7 * size
        sides = _count_ray_crossings(edges[None], np.stack([middle + left, middle - left]))[0] % 2
        if sides[0] != sides[1]:
            kept.append(ends if sides[0] else ends[::-1])
    if not kept:
        raise ParameterError("vertices_mm", edges[:, 0].tolist(), "a polygon whose area is not 0")
    return np.stack(kept)


@outlines.register
def _outlines_of_polygon(region: PolygonRegion, *, n_vertices: int = 96) -> list[FloatArray]:
    return [_outline_of_edges(edges) for edges in region.edges_mm]


def _outline_of_edges(edges: FloatArray) -> FloatArray:
    if np.array_equal(edges[1, 1], edges[0, 0]):  # given clockwise: each edge was turned round in its place
        edges = edges[::-1]
    points = [edges[0, 0]]
    for start, end in edges:
        if not np.array_equal(points[-1], start):
            points += [np.full(2, np.nan), start]
        points.append(end)
    return np.array(points)


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
