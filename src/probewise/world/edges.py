"""Edges of a surface: the distance to the nearest edge, and the direction across edges."""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import FloatArray
from probewise.recordings.patterns import Disc, HalfPlane, Image, Polygon, Quadrant, Ramp, Stripes, Uniform
from probewise.world.painting import CoveredSurface, Oval, Surface

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
