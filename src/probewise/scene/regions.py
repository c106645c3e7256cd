"""Areas of albedo, one for each hypothesis: small frozen values of batched geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from probewise._arrays import FloatArray, IntArray, frozen, frozen_int, require_finite
from probewise.errors import ParameterError, ShapeError
from probewise.scene._pixels import share_behind_edge, share_in_edges
from probewise.scene.albedo import Region

__all__ = [
    "EllipseRegion",
    "HalfPlaneRegion",
    "ImageRegion",
    "MixtureOfRegions",
    "PolygonRegion",
    "QuadrantRegion",
    "RampRegion",
    "StripesRegion",
    "UniformRegion",
    "disc_region",
    "outlines",
]


def _batch(region: object, **shapes: tuple[int, ...]) -> None:
    """Freeze the named fields to (n_regions, *shape), one n_regions for all."""
    arrays = {name: np.asarray(getattr(region, name), dtype=np.float64) for name in shapes}
    lengths = set()
    for name, shape in shapes.items():
        array = arrays[name] = arrays[name][None] if arrays[name].ndim == len(shape) else arrays[name]
        if array.ndim != len(shape) + 1 or any(
            want not in (-1, got) for want, got in zip(shape, array.shape[1:], strict=True)
        ):
            raise ShapeError(f"{name} has shape {array.shape}; allowed: (n_regions, {', '.join(map(str, shape))})")
        lengths.add(len(array))
    n_regions = max(lengths, default=1)
    for name, array in arrays.items():
        if len(array) not in (1, n_regions):
            raise ShapeError(f"{name} has {len(array)} rows; allowed: {n_regions}, as the other fields, or 1")
        require_finite(name, array)
        object.__setattr__(region, name, frozen(np.broadcast_to(array, (n_regions, *array.shape[1:]))))


def _require_positive(name: str, values: FloatArray) -> None:
    bad = values <= 0
    if bad.any():
        raise ParameterError(name, float(values[bad][0]), "greater than 0")


@dataclass(frozen=True, eq=False)
class UniformRegion:
    """The same albedo everywhere: `level`, shape (n_regions,)."""

    level: FloatArray

    def __post_init__(self) -> None:
        _batch(self, level=())

    @property
    def n_regions(self) -> int:
        """How many hypotheses it holds, or 1."""
        return len(self.level)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        return np.repeat(self.level[:, None], len(points_mm), axis=1)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over pixels: the level."""
        return self.albedo(centers_mm)


@dataclass(frozen=True, eq=False)
class HalfPlaneRegion:
    """Inside where x cos(normal) + y sin(normal) > offset (paper, S_BW); fields (n_regions,)."""

    normal_rad: FloatArray
    offset_mm: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        _batch(self, normal_rad=(), offset_mm=())

    @property
    def n_regions(self) -> int:
        """How many hypotheses it holds, or 1."""
        return len(self.offset_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        return np.where(self._distance(points_mm) > 0, self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels, exact: (n_regions, n_points)."""
        share = share_behind_edge(self._distance(centers_mm), self.normal_rad[:, None] - turn_rad, pixel_mm)
        return self.outside + (self.inside - self.outside) * share

    def _distance(self, points_mm: FloatArray) -> FloatArray:
        normal = self.normal_rad[:, None]
        return points_mm[:, 0] * np.cos(normal) + points_mm[:, 1] * np.sin(normal) - self.offset_mm[:, None]


@dataclass(frozen=True, eq=False)
class QuadrantRegion:
    """Inside where (x - cx) dx > 0 and (y - cy) dy > 0 (paper, S_a to S_d).

    `corner_mm` and `direction` (entries +1 or -1) have shape (n_regions, 2).
    """

    corner_mm: FloatArray
    direction: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        _batch(self, corner_mm=(2,), direction=(2,))
        if not np.isin(self.direction, (-1.0, 1.0)).all():
            raise ParameterError("direction", self.direction.tolist(), "+1 or -1")

    @property
    def n_regions(self) -> int:
        """How many hypotheses it holds, or 1."""
        return len(self.corner_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        beyond = (points_mm[None] - self.corner_mm[:, None]) * self.direction[:, None] > 0
        return np.where(beyond.all(axis=-1), self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels, exact: (n_regions, n_points)."""
        reach = pixel_mm + max(1.0, float(np.abs(centers_mm[None] - self.corner_mm[:, None]).max(initial=0.0)))
        x, y = self.corner_mm[:, 0], self.corner_mm[:, 1]
        far_x, far_y = x + 2 * reach * self.direction[:, 0], y + 2 * reach * self.direction[:, 1]
        square = np.stack([np.stack(p, axis=-1) for p in ((x, y), (far_x, y), (far_x, far_y), (x, far_y))], axis=1)
        return PolygonRegion.simple(square, inside=self.inside, outside=self.outside).coverage(
            centers_mm, pixel_mm, turn_rad
        )


@dataclass(frozen=True, eq=False)
class EllipseRegion:
    """Inside an ellipse; a disc has equal semi-axes (paper, eq. 1).

    `center_mm` and `semi_axes_mm` have shape (n_regions, 2), `angle_rad` (of the first semi-axis)
    (n_regions,).
    """

    center_mm: FloatArray
    semi_axes_mm: FloatArray
    angle_rad: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        _batch(self, center_mm=(2,), semi_axes_mm=(2,), angle_rad=())
        _require_positive("semi_axes_mm", self.semi_axes_mm)

    @property
    def n_regions(self) -> int:
        """How many hypotheses it holds, or 1."""
        return len(self.angle_rad)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, the edge inside: (n_points, 2) -> (n_regions, n_points)."""
        p, q = self._unit(points_mm)
        return np.where(p * p + q * q <= 1, self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels, the edge taken as its tangent: (n_regions, n_points)."""
        p, q = self._unit(centers_mm)
        a, b = self.semi_axes_mm[:, :1], self.semi_axes_mm[:, 1:]
        level = np.hypot(p, q)
        # Gradient of the level sqrt(p^2 + q^2), zero only at the centre where no pixel sees the edge.
        along, across = p / a, q / b
        steepness = np.hypot(along, across) / np.maximum(level, 1e-12)
        distance = (1 - level) / np.maximum(steepness, 1e-12)
        angle = np.arctan2(across, along) + self.angle_rad[:, None]
        share = share_behind_edge(distance, angle - turn_rad, pixel_mm)
        return self.outside + (self.inside - self.outside) * share

    def _unit(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coordinates in which the edge is the unit circle, each (n_regions, n_points)."""
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


@dataclass(frozen=True, eq=False)
class PolygonRegion:
    """Inside a polygon given by its directed edges, the inside on their left.

    `edges_mm` has shape (n_regions, n_edges, 2 ends, 2). Build it by `simple` from vertices of
    polygons that do not cross themselves, or by `even_odd` from one polygon that may.
    """

    edges_mm: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        _batch(self, edges_mm=(-1, 2, 2))

    @classmethod
    def simple(cls, vertices_mm: FloatArray, *, inside: float = 1.0, outside: float = 0.0) -> PolygonRegion:
        """Build from vertices (n_regions, n_vertices, 2), in either sense; edges must not cross."""
        vertices = np.asarray(vertices_mm, dtype=np.float64)
        if vertices.ndim != 3 or vertices.shape[1] < 3 or vertices.shape[2] != 2:
            raise ShapeError(f"vertices_mm has shape {vertices.shape}; allowed: (n_regions, 3 or more, 2)")
        following = np.roll(vertices, -1, axis=1)
        area = np.sum(vertices[..., 0] * following[..., 1] - vertices[..., 1] * following[..., 0], axis=1)
        edges = np.stack([vertices, following], axis=2)
        edges = np.where((area < 0)[:, None, None, None], edges[:, :, ::-1], edges)
        return cls(edges, inside, outside)

    @classmethod
    def even_odd(cls, vertices_mm: FloatArray, *, inside: float = 1.0, outside: float = 0.0) -> PolygonRegion:
        """Build one region from vertices (n_vertices, 2) that may cross themselves.

        Edges are split where they meet; each piece that has the inside (even-odd rule) on one
        side only is kept, and directed so that it lies on its left.
        """
        vertices = np.asarray(vertices_mm, dtype=np.float64)
        if vertices.ndim != 2 or len(vertices) < 3 or vertices.shape[1] != 2:
            raise ShapeError(f"vertices_mm has shape {vertices.shape}; allowed: (3 or more, 2)")
        edges = np.stack([vertices, np.roll(vertices, -1, axis=0)], axis=1)
        return cls(_directed_pieces(edges)[None], inside, outside)

    @property
    def n_regions(self) -> int:
        """How many hypotheses it holds, or 1."""
        return len(self.edges_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        return np.where(_crossings(self.edges_mm, points_mm) % 2 == 1, self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels, exact: (n_regions, n_points)."""
        share = share_in_edges(self.edges_mm, centers_mm, pixel_mm, turn_rad)
        return self.outside + (self.inside - self.outside) * share


def _crossings(edges_mm: FloatArray, points_mm: FloatArray) -> IntArray:
    """How many edges a ray to the right of each point crosses, (n_regions, n_points)."""
    x, y = points_mm[:, 0], points_mm[:, 1]
    count = np.zeros((len(edges_mm), len(points_mm)), dtype=np.int64)
    for k in range(edges_mm.shape[1]):
        x1, y1 = edges_mm[:, k, 0, :1], edges_mm[:, k, 0, 1:]
        x2, y2 = edges_mm[:, k, 1, :1], edges_mm[:, k, 1, 1:]
        spans = (y1 > y) != (y2 > y)
        rise = np.where(y2 == y1, 1.0, y2 - y1)
        count += spans & (x < x1 + (y - y1) / rise * (x2 - x1))
    return count


def _directed_pieces(edges: FloatArray) -> FloatArray:
    """Split edges (n_edges, 2, 2) where they meet and keep the boundary of the even-odd inside."""
    size = float(np.ptp(edges.reshape(-1, 2), axis=0).max())
    if size == 0:
        raise ParameterError("vertices_mm", edges[:, 0].tolist(), "a polygon with an area")
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
        sides = _crossings(edges[None], np.stack([middle + left, middle - left]))[0] % 2
        if sides[0] != sides[1]:
            kept.append(ends if sides[0] else ends[::-1])
    if not kept:
        raise ParameterError("vertices_mm", edges[:, 0].tolist(), "a polygon with an area")
    return np.stack(kept)


@dataclass(frozen=True, eq=False)
class StripesRegion:
    """Inside where frac((x . n - phase) / period) < duty; fields (n_regions,)."""

    normal_rad: FloatArray
    period_mm: FloatArray
    duty: FloatArray
    phase_mm: FloatArray
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        _batch(self, normal_rad=(), period_mm=(), duty=(), phase_mm=())
        _require_positive("period_mm", self.period_mm)
        if ((self.duty < 0) | (self.duty > 1)).any():
            raise ParameterError("duty", self.duty.tolist(), "0 to 1")

    @property
    def n_regions(self) -> int:
        """How many hypotheses it holds, or 1."""
        return len(self.period_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        share = self._along(points_mm) / self.period_mm[:, None]
        return np.where(share - np.floor(share) < self.duty[:, None], self.inside, self.outside)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels, exact: (n_regions, n_points)."""
        period = self.period_mm[:, None]
        along = self._along(centers_mm)
        along = along - period * np.floor(along / period)
        angle = self.normal_rad[:, None] - turn_rad
        share = np.zeros_like(along)
        # Half a pixel's diagonal is 0.71 pixels: periods further away are seen whole or not at all.
        reach = 1 + math.ceil(0.75 * pixel_mm / float(self.period_mm.min()))
        for k in range(-reach, reach + 1):
            start = k * period
            share += share_behind_edge(along - start, angle, pixel_mm)
            share -= share_behind_edge(along - start - self.duty[:, None] * period, angle, pixel_mm)
        return self.outside + (self.inside - self.outside) * share

    def _along(self, points_mm: FloatArray) -> FloatArray:
        normal = self.normal_rad[:, None]
        return points_mm[:, 0] * np.cos(normal) + points_mm[:, 1] * np.sin(normal) - self.phase_mm[:, None]


@dataclass(frozen=True, eq=False)
class RampRegion:
    """Albedo per_mm (x . n), not bounded; fields (n_regions,)."""

    normal_rad: FloatArray
    per_mm: FloatArray

    def __post_init__(self) -> None:
        _batch(self, normal_rad=(), per_mm=())

    @property
    def n_regions(self) -> int:
        """How many hypotheses it holds, or 1."""
        return len(self.per_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        normal = self.normal_rad[:, None]
        return self.per_mm[:, None] * (points_mm[:, 0] * np.cos(normal) + points_mm[:, 1] * np.sin(normal))

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels: that of their centres, exactly."""
        return self.albedo(centers_mm)


@dataclass(frozen=True, eq=False)
class ImageRegion:
    """One image of albedos: `values` (n_rows, n_columns), first row on top, 0 outside it.

    `origin_mm` is the lower left corner; hypotheses share it (n_regions is 1).
    """

    values: FloatArray
    pixel_mm: float
    origin_mm: tuple[float, float]

    def __post_init__(self) -> None:
        values = frozen(self.values)
        if values.ndim != 2 or values.size == 0:
            raise ShapeError(f"image has shape {values.shape}; allowed: (n_rows, n_columns), not empty")
        require_finite("image", values)
        if not (0 < self.pixel_mm < math.inf):
            raise ParameterError("pixel_mm", self.pixel_mm, "greater than 0")
        object.__setattr__(self, "values", values)

    @property
    def n_regions(self) -> int:
        """One image for all hypotheses."""
        return 1

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (1, n_points)."""
        return self._at(points_mm[:, 0], points_mm[:, 1])[None]

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels, in strips along x: exact where they are not turned."""
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        steep, flat = np.maximum(np.abs(cosine), 1e-9), np.maximum(np.abs(sine), 1e-9)
        half = 0.5 * pixel_mm
        height = half * (np.abs(cosine) + np.abs(sine))
        total, area = np.zeros(len(centers_mm)), np.zeros(len(centers_mm))
        n_strips = 8
        for k in range(n_strips):
            low, high = (2 * k / n_strips - 1) * height, (2 * (k + 1) / n_strips - 1) * height
            y = 0.5 * (low + high)
            # The square is where |c x + s y| and |c y - s x| are at most half a side.
            middle_1, middle_2 = -sine * y * cosine / steep**2, cosine * y * sine / flat**2
            left = np.maximum(middle_1 - half / steep, middle_2 - half / flat)
            right = np.maximum(left, np.minimum(middle_1 + half / steep, middle_2 + half / flat))
            bottom, top = centers_mm[:, 1] + low, centers_mm[:, 1] + high
            near, far = centers_mm[:, 0] + left, centers_mm[:, 0] + right
            total += self._summed(far, top) - self._summed(near, top)
            total -= self._summed(far, bottom) - self._summed(near, bottom)
            area += (right - left) * (high - low)
        return (total / area)[None]

    @cached_property
    def _cumulative(self) -> FloatArray:
        """Sums of all pixels to the lower left of each corner, (n_rows + 1, n_columns + 1), from below."""
        padded = np.zeros((self.values.shape[0] + 1, self.values.shape[1] + 1))
        padded[1:, 1:] = self.values[::-1].cumsum(axis=0).cumsum(axis=1)
        return padded

    def _summed(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Integral of the albedo over all that lies to the lower left, mm^2."""
        n_rows, n_columns = self.values.shape
        u = np.clip((x_mm - self.origin_mm[0]) / self.pixel_mm, 0, n_columns)
        v = np.clip((y_mm - self.origin_mm[1]) / self.pixel_mm, 0, n_rows)
        i, j = np.minimum(v.astype(np.int64), n_rows - 1), np.minimum(u.astype(np.int64), n_columns - 1)
        u, v, table = u - j, v - i, self._cumulative
        lower = (1 - u) * table[i, j] + u * table[i, j + 1]
        upper = (1 - u) * table[i + 1, j] + u * table[i + 1, j + 1]
        return np.asarray(((1 - v) * lower + v * upper) * self.pixel_mm**2)

    def _at(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        n_rows, n_columns = self.values.shape
        column = np.floor((x_mm - self.origin_mm[0]) / self.pixel_mm).astype(np.int64)
        row = n_rows - 1 - np.floor((y_mm - self.origin_mm[1]) / self.pixel_mm).astype(np.int64)
        within = (column >= 0) & (column < n_columns) & (row >= 0) & (row < n_rows)
        found = self.values[np.where(within, row, 0), np.where(within, column, 0)]
        return np.where(within, found, 0.0)


@dataclass(frozen=True, eq=False)
class MixtureOfRegions:
    """A region of another kind for each hypothesis: a set of shapes.

    `which`, shape (n_regions,), names the part that each hypothesis takes; part k holds, in
    order, the regions of the hypotheses with which == k (its own n_regions of them).
    """

    which: IntArray
    parts: tuple[Region, ...]

    def __post_init__(self) -> None:
        which = frozen_int(self.which)
        object.__setattr__(self, "which", which)
        for k, part in enumerate(self.parts):
            wanted = int(np.sum(which == k))
            if wanted and part.n_regions != wanted:
                raise ShapeError(f"part {k} holds {part.n_regions} regions; allowed: {wanted}, as which == {k}")
        if which.ndim != 1 or (which.size and (which.min() < 0 or which.max() >= len(self.parts))):
            raise ParameterError("which", which.tolist(), f"0 to {len(self.parts) - 1}, one a hypothesis")

    @property
    def n_regions(self) -> int:
        """How many hypotheses it holds."""
        return len(self.which)

    def rows(self) -> list[tuple[IntArray, Region]]:
        """Rows of the hypotheses of each kind that occurs, with their regions."""
        pairs = [(np.flatnonzero(self.which == k), part) for k, part in enumerate(self.parts)]
        return [(rows, part) for rows, part in pairs if rows.size]

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        out = np.empty((self.n_regions, len(points_mm)))
        for rows, part in self.rows():
            out[rows] = part.albedo(points_mm)
        return out

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Mean albedo over turned square pixels, (n_regions, n_points)."""
        out = np.empty((self.n_regions, len(centers_mm)))
        for rows, part in self.rows():
            out[rows] = part.coverage(centers_mm, pixel_mm, turn_rad)
        return out


def outlines(region: Region, *, n_vertices: int = 96) -> list[FloatArray]:
    """Trace the closed edge of each hypothesis, for drawing.

    Parameters
    ----------
    region
        Ellipses, polygons, or a set of these.
    n_vertices
        Vertices of an ellipse's trace.

    Returns
    -------
    One array (n, 2) a hypothesis, mm, the first vertex repeated at the end; pieces of a
    polygon that crosses itself are separated by NaN.

    Raises
    ------
    ParameterError
        If the region has no closed edge.
    """
    if isinstance(region, EllipseRegion):
        t = np.linspace(0, 2 * np.pi, n_vertices + 1)
        p = region.semi_axes_mm[:, :1] * np.cos(t)
        q = region.semi_axes_mm[:, 1:] * np.sin(t)
        cosine, sine = np.cos(region.angle_rad)[:, None], np.sin(region.angle_rad)[:, None]
        x = region.center_mm[:, :1] + cosine * p - sine * q
        y = region.center_mm[:, 1:] + sine * p + cosine * q
        return list(np.stack([x, y], axis=-1))
    if isinstance(region, PolygonRegion):
        return [_joined(edges) for edges in region.edges_mm]
    if isinstance(region, MixtureOfRegions):
        traces: list[FloatArray] = [np.empty((0, 2))] * region.n_regions
        for rows, part in region.rows():
            for row, trace in zip(rows, outlines(part, n_vertices=n_vertices), strict=True):
                traces[int(row)] = trace
        return traces
    raise ParameterError("region", type(region).__name__, "EllipseRegion, PolygonRegion or a mixture of them")


def _joined(edges: FloatArray) -> FloatArray:
    points = [edges[0, 0]]
    for start, end in edges:
        if not np.array_equal(points[-1], start):
            points += [np.full(2, np.nan), start]
        points.append(end)
    return np.array(points)
