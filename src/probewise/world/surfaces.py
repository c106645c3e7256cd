"""The albedo of a surface, its edges, and the integral over a footprint: by pixels, by rays in pixels with an edge."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import ParameterError
from probewise.recordings.patterns import Disc, HalfPlane, Image, Pattern, Polygon, Quadrant, Ramp, Stripes, Uniform
from probewise.world.spots import Spot


@dataclass(frozen=True)
class Oval:
    """An ellipse, not in the file format: half axes in mm, the first at `angle_rad` to X; albedo inside and outside."""

    center_mm: tuple[float, float]
    half_axes_mm: tuple[float, float]
    angle_rad: float = 0.0
    inside: float = 1.0
    outside: float = 0.0


@dataclass(frozen=True)
class CoveredSurface:
    """A surface with cards lying on it, each a polygon of albedo `inside`; the last card is on top."""

    below: Pattern | Oval
    cards: tuple[Polygon, ...]


Surface: TypeAlias = Pattern | Oval | CoveredSurface


def albedo_at(surface: Surface, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return the albedo at points in mm; `x_mm`, `y_mm` and the result have one shape.

    Raises ParameterError if the type of surface is unknown.
    """
    match surface:
        case CoveredSurface():
            seen = albedo_at(surface.below, x_mm, y_mm)
            for card in surface.cards:
                seen = np.where(_inside_polygon_mask(card, x_mm, y_mm), card.inside, seen)
            return seen
        case Uniform():
            return np.full(x_mm.shape, surface.albedo)
        case Ramp():
            return surface.per_mm * _along(surface.normal_rad, x_mm, y_mm)
        case Image():
            return _albedo_in_image(surface, x_mm, y_mm)
        case HalfPlane():
            within = _along(surface.normal_rad, x_mm, y_mm) > surface.offset_mm
        case Quadrant():
            (cx, cy), (dx, dy) = surface.corner_mm, surface.direction
            within = ((x_mm - cx) * dx > 0) & ((y_mm - cy) * dy > 0)
        case Disc():
            (cx, cy), r = surface.center_mm, surface.radius_mm
            within = (x_mm - cx) ** 2 + (y_mm - cy) ** 2 < r * r
        case Oval():
            cos, sin = math.cos(surface.angle_rad), math.sin(surface.angle_rad)
            dx_mm, dy_mm = x_mm - surface.center_mm[0], y_mm - surface.center_mm[1]
            along = (dx_mm * cos + dy_mm * sin) / surface.half_axes_mm[0]
            across = (dy_mm * cos - dx_mm * sin) / surface.half_axes_mm[1]
            within = along**2 + across**2 < 1
        case Polygon():
            within = _inside_polygon_mask(surface, x_mm, y_mm)
        case Stripes():
            turns = (_along(surface.normal_rad, x_mm, y_mm) - surface.phase_mm) / surface.period_mm
            within = turns - np.floor(turns) < surface.duty
        case _:
            raise ParameterError("surface", type(surface).__name__, "a pattern of the recording format, or Oval")
    return np.where(within, surface.inside, surface.outside)


def _inside_polygon_mask(polygon: Polygon, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
    """Return a mask of the points inside: those from which a ray towards +x crosses an odd number of sides."""
    odd = np.zeros(x_mm.shape, dtype=np.bool_)
    corners = polygon.vertices_mm
    for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
        if y0 == y1:
            continue
        spans = (y_mm < y0) != (y_mm < y1)
        odd ^= spans & (x_mm < x0 + (y_mm - y0) * ((x1 - x0) / (y1 - y0)))
    return odd


def _albedo_in_image(image: Image, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    n_rows, n_columns = image.albedo.shape
    column = np.floor((x_mm - image.origin_mm[0]) / image.pixel_mm)
    row = n_rows - 1 - np.floor((y_mm - image.origin_mm[1]) / image.pixel_mm)
    on = (column >= 0) & (column < n_columns) & (row >= 0) & (row < n_rows)
    found = image.albedo[np.where(on, row, 0).astype(np.int64), np.where(on, column, 0).astype(np.int64)]
    return np.where(on, found, 0.0)


_N_RIM = 720  # points on an oval's outline among which the nearest is searched


def distance_to_nearest_edge(surface: Surface, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return the distance in mm to the nearest printed edge, (n_points,); infinite where there is none.

    Ramps and images count as having none: a ramp is smooth, and an image's edges are not described.
    """
    match surface:
        case CoveredSurface():
            below = [distance_to_nearest_edge(part, x_mm, y_mm) for part in (surface.below, *surface.cards)]
            return np.asarray(np.min(below, axis=0))
        case Uniform() | Ramp() | Image():
            return np.full(x_mm.shape, np.inf)
        case HalfPlane():
            return np.abs(_along(surface.normal_rad, x_mm, y_mm) - surface.offset_mm)
        case Stripes():
            since = np.mod(_along(surface.normal_rad, x_mm, y_mm) - surface.phase_mm, surface.period_mm)
            edges = surface.period_mm * np.array([0.0, surface.duty, 1.0])
            return np.asarray(np.abs(since[:, None] - edges).min(axis=1))
        case Quadrant():
            (cx, cy), (dx, dy) = surface.corner_mm, surface.direction
            right, up = (x_mm - cx) * dx, (y_mm - cy) * dy
            # Two half-lines leave the corner; behind it, the corner itself is nearest.
            return np.minimum(np.hypot(up, np.minimum(right, 0.0)), np.hypot(right, np.minimum(up, 0.0)))
        case Disc():
            (cx, cy), r = surface.center_mm, surface.radius_mm
            return np.abs(np.hypot(x_mm - cx, y_mm - cy) - r)
        case Oval():
            turn = np.arange(_N_RIM) * (2 * math.pi / _N_RIM)
            p, q = surface.half_axes_mm[0] * np.cos(turn), surface.half_axes_mm[1] * np.sin(turn)
            cos, sin = math.cos(surface.angle_rad), math.sin(surface.angle_rad)
            corners = np.stack([p * cos - q * sin, p * sin + q * cos], axis=-1) + surface.center_mm
            return _distance_to_outline(corners, x_mm, y_mm)
        case Polygon():
            return _distance_to_outline(np.array(surface.vertices_mm), x_mm, y_mm)


def common_edge_normal(surface: Surface) -> tuple[float, float]:
    """Return the unit vector (x, y) across the edges of a half-plane or stripes, or up a ramp; (1, 0) for others."""
    match surface:
        case HalfPlane() | Stripes() | Ramp():
            return math.cos(surface.normal_rad), math.sin(surface.normal_rad)
        case _:
            return 1.0, 0.0


def _along(normal_rad: float, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    return np.asarray(x_mm * math.cos(normal_rad) + y_mm * math.sin(normal_rad))


def _distance_to_outline(corners: FloatArray, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return each point's distance in mm, (n_points,), to the nearest side of a polygon, corners (n, 2) in order."""
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(*sides.T)
    from_start = np.stack([x_mm, y_mm], axis=-1)[:, None, :] - corners
    share = np.clip((from_start * sides).sum(axis=-1) / np.maximum(lengths**2, 1e-300), 0.0, 1.0)
    apart = from_start - share[..., None] * sides
    return np.asarray(np.hypot(apart[..., 0], apart[..., 1]).min(axis=1))


Retouch: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""(albedo, x_mm, y_mm), places in the lab frame, to changed albedo; arrays of one shape."""

_BLOCK = 50_000  # pixels or rays at a time, to fit a processor's cache
# Additive steps of a two-dimensional Kronecker sequence: 1/g and 1/g^2, g the root of g^3 = g + 1.
_STEP_U, _STEP_V = 0.7548776662466927, 0.5698402909980532


def seen_white_fraction(
    surface: Surface,
    spot: Spot,
    x_mm: FloatArray,
    y_mm: FloatArray,
    orientation_rad: FloatArray,
    *,
    scale: ArrayLike = 1.0,
    pattern_mm: ArrayLike = (0.0, 0.0),
    retouch: Retouch | None = None,
    n_rays: int = 64,
) -> FloatArray:
    """Return the seen white fraction at each pose, (n_points,): the sum of weight times albedo over the footprint.

    A pixel whose four corners have the same albedo counts as uniform; every other one is sampled by `n_rays` rays of a
    low-discrepancy sequence, shifted from pixel to pixel so that errors of neighbours along an edge do not add up.
    Features finer than a pixel need a footprint with smaller pixels. With 0.25 mm pixels and 64 rays the error is below
    1e-3.

    `surface`, `spot`: the surface, and the footprint; `x_mm`, `y_mm`, `orientation_rad`: pose of the sensor frame in
    the lab frame, (n_points,); `scale`: factor by which the footprint is enlarged about the sensor frame's origin,
    (n_points,) or scalar; `pattern_mm`: displacement of the surface from its description, (n_points, 2) or (2,);
    `retouch`: function (albedo, x_mm, y_mm) -> changed albedo, applied pixel by pixel; must be smooth over a pixel;
    `n_rays`: rays per pixel that contains an edge.
    """
    n_points = len(x_mm)
    moved = np.broadcast_to(np.asarray(pattern_mm, dtype=np.float64), (n_points, 2)).T
    # A scan out and back visits each place twice.
    stands = np.stack([x_mm, y_mm, orientation_rad, np.broadcast_to(scale, n_points), *moved])
    poses, again = np.unique(stands, axis=1, return_inverse=True)
    seen = albedo_at(surface, poses[0] - poses[4], poses[1] - poses[5])
    rest = np.arange(len(seen))
    if retouch is None and not isinstance(surface, Ramp | Image):
        # No edge within the footprint: the albedo at its origin applies to all of it.
        u, v = spot.edges_mm()
        reach = np.hypot(np.abs(u).max(), np.abs(v).max()) * poses[3]
        rest = np.flatnonzero(distance_to_nearest_edge(surface, poses[0] - poses[4], poses[1] - poses[5]) <= reach)
    per_block = max(1, _BLOCK // spot.weights.size)
    for start in range(0, len(rest), per_block):
        part = rest[start : start + per_block]
        seen[part] = _seen_white_fraction_of_block(surface, spot, poses[:, part], retouch, n_rays)
    return seen[again.ravel()]


def _seen_white_fraction_of_block(
    surface: Surface, spot: Spot, poses: FloatArray, retouch: Retouch | None, n_rays: int
) -> FloatArray:
    x_mm, y_mm, turn, scale, pattern_x, pattern_y = poses[:, :, None, None]
    cos, sin = scale * np.cos(turn), scale * np.sin(turn)
    u, v = spot.edges_mm()
    # A displaced surface is equivalent to a sensor displaced the other way.
    origin_x, origin_y = x_mm - pattern_x, y_mm - pattern_y
    # Corners of all pixels, (n_points, n_v + 1, n_u + 1).
    corners_x, corners_y = cos * u - sin * v[:, None], sin * u + cos * v[:, None]
    found = albedo_at(surface, origin_x + corners_x, origin_y + corners_y)
    around = (found[:, :-1, :-1], found[:, :-1, 1:], found[:, 1:, :-1], found[:, 1:, 1:])
    albedo: FloatArray = (around[0] + around[1] + around[2] + around[3]) / 4
    # The mean of the corners is exact where albedo is linear.
    if not isinstance(surface, Ramp):
        mixed = (around[1] != around[0]) | (around[2] != around[0]) | (around[3] != around[0])
        mixed_at = np.nonzero(mixed & (spot.weights > 0))
        per_block = max(1, _BLOCK // n_rays)
        for start in range(0, mixed_at[0].size, per_block):
            at = pose, row, column = tuple(index[start : start + per_block] for index in mixed_at)
            golden = 0.6180339887498949  # shifts each pixel's sequence by 0 to 1 pixel, evenly along rows and columns
            first_u = np.mod(row * golden + column * _STEP_V, 1.0)
            first_v = np.mod(column * golden + row * _STEP_U, 1.0)
            ray_u = u[column][:, None] + spot.pixel_mm * np.mod(first_u[:, None] + np.arange(n_rays) * _STEP_U, 1.0)
            ray_v = v[row][:, None] + spot.pixel_mm * np.mod(first_v[:, None] + np.arange(n_rays) * _STEP_V, 1.0)
            c, s = cos[pose, 0], sin[pose, 0]
            landed_x = origin_x[pose, 0] + c * ray_u - s * ray_v
            landed_y = origin_y[pose, 0] + s * ray_u + c * ray_v
            albedo[at] = albedo_at(surface, landed_x, landed_y).mean(axis=1)
    if retouch is not None:
        mid_u, mid_v = u[:-1] + spot.pixel_mm / 2, (v[:-1] + spot.pixel_mm / 2)[:, None]
        albedo = retouch(albedo, x_mm + cos * mid_u - sin * mid_v, y_mm + sin * mid_u + cos * mid_v)
    return np.asarray(np.einsum("kvu,vu->k", albedo, spot.weights))
