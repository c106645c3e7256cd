"""The albedo of a surface at a point."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import ParameterError
from probewise.recordings.patterns import (
    Disc,
    HalfPlane,
    Image,
    Pattern,
    Polygon,
    Quadrant,
    Ramp,
    Stripes,
    Uniform,
)


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

    Raises
    ------
    ParameterError
        If the type of surface is unknown.
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
