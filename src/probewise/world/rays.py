"""Integrate albedo over the footprint: by pixels on uniform surface, by many rays in pixels with an edge."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray, IntArray
from probewise.recordings.patterns import Image, Ramp
from probewise.world.spots import Spot
from probewise.world.surfaces import Surface, albedo_at, distance_to_nearest_edge

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
            first_u, first_v = _sequence_offset_of_pixels(row, column)
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


def _sequence_offset_of_pixels(row: IntArray, column: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return each pixel's shift (u, v) of the ray sequence, 0 to 1 pixel, spread evenly along rows and columns."""
    golden = 0.6180339887498949
    return np.mod(row * golden + column * _STEP_V, 1.0), np.mod(column * golden + row * _STEP_U, 1.0)
