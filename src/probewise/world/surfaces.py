"""The albedo of a surface at a point, the distance to its nearest edge, and the direction across its edges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import ParameterError
from probewise.recordings.patterns import Disc, HalfPlane, Image, Pattern, Polygon, Quadrant, Ramp, Stripes, Uniform


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
            return surface.per_mm * (x_mm * math.cos(surface.normal_rad) + y_mm * math.sin(surface.normal_rad))
        case Image():
            return _albedo_in_image(surface, x_mm, y_mm)
        case HalfPlane():
            within = x_mm * math.cos(surface.normal_rad) + y_mm * math.sin(surface.normal_rad) > surface.offset_mm
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
            along = x_mm * math.cos(surface.normal_rad) + y_mm * math.sin(surface.normal_rad) - surface.phase_mm
            turns = along / surface.period_mm
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
            return np.abs(_coordinate_along_normal(surface.normal_rad, x_mm, y_mm) - surface.offset_mm)
        case Stripes():
            since = np.mod(
                _coordinate_along_normal(surface.normal_rad, x_mm, y_mm) - surface.phase_mm, surface.period_mm
            )
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


def _coordinate_along_normal(normal_rad: float, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    return np.asarray(x_mm * math.cos(normal_rad) + y_mm * math.sin(normal_rad))


def _distance_to_outline(corners: FloatArray, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return each point's distance in mm, (n_points,), to the nearest side of a polygon, corners (n, 2) in order."""
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(*sides.T)
    from_start = np.stack([x_mm, y_mm], axis=-1)[:, None, :] - corners
    share = np.clip((from_start * sides).sum(axis=-1) / np.maximum(lengths**2, 1e-300), 0.0, 1.0)
    apart = from_start - share[..., None] * sides
    return np.asarray(np.hypot(apart[..., 0], apart[..., 1]).min(axis=1))
