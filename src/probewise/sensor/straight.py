"""Fast responses to known straight edges and corners, for many hypotheses over the same readings.

This is the case of calibration: a few hundred readings, a million hypotheses. Readings of scans out and back, or from
both sides, share a view. Everything that depends only on the readings is computed once per layout.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.scene.regions import HalfPlaneRegion, QuadrantRegion
from probewise.sensor.gaussian import (
    CENTRE,
    PER_SD,
    moments_in_lab_frame,
    normal_cdf_of_cells_in_place,
    probabilities_beyond_corner_and_sides,
)
from probewise.sensor.stages import Footprint, Poses

_BLOCK = 2**14  # elements at a time: they fit the cache
_FEW_ANGLES = 16  # up to so many, a product with a mostly zero matrix is cheaper than indexing columns
_SAME_ANGLE, _SAME_MM = 1e-12, 1e-10  # smaller differences of angles (radians) and places are rounding


@dataclass(frozen=True, eq=False)
class StraightEdges:
    """The distinct views of half-planes under the readings `rows`, (n_rows,).

    An edge seen from its other side is the same view with black and white exchanged. `angle_rad` (n_angles,) of the
    edge's normal in the sensor frame runs from 0 to pi; each view has an angle, by index `which`, and a `distance_mm`,
    (n_views,). Each reading has a `view`, by index, and reads low + gain times the view's mass, `low` and `gain`
    (n_rows,).
    """

    rows: IntArray
    angle_rad: FloatArray
    which: IntArray
    distance_mm: FloatArray
    view: IntArray
    low: FloatArray
    gain: FloatArray

    @classmethod
    def from_regions(cls, parts: list[tuple[IntArray, HalfPlaneRegion]], poses: Poses) -> StraightEdges:
        """Batch half-planes of one hypothesis each with the rows of their readings; the poses are the same for all."""
        rows, x, y, orientation, of = _joined_rows(parts, poses)
        normal, offset, inside, outside = (
            np.array([float(np.ravel(getattr(region, name))[0]) for _, region in parts])[of]
            for name in ("normal_rad", "offset_mm", "inside", "outside")
        )
        turn = normal - orientation
        n_half_turns = np.floor(turn / np.pi + _SAME_ANGLE)
        behind = n_half_turns % 2 == 1
        angle = np.round((turn - n_half_turns * np.pi) / _SAME_ANGLE) * _SAME_ANGLE
        distance = np.cos(normal) * x + np.sin(normal) * y - offset
        distance = np.round(np.where(behind, -1.0, 1.0) * distance / _SAME_MM) * _SAME_MM
        views, view = np.unique(np.stack([angle, distance]), axis=1, return_inverse=True)
        angles, which = np.unique(views[0], return_inverse=True)
        low, high = np.where(behind, inside, outside), np.where(behind, outside, inside)
        return cls(rows, angles, which, views[1], view.reshape(-1), low, high - low)

    @cached_property
    def _matrix_from_angles_to_views(self) -> FloatArray:
        """Matrix from the angles' (1/sd, mean/sd) to the views' positions in the table, (2 n_angles, n_views)."""
        own = np.eye(len(self.angle_rad))[:, self.which]
        return np.concatenate([own * self.distance_mm, own])

    def response(self, footprint: Footprint) -> FloatArray:
        """Compute the responses to a footprint that is the same at all readings, (n_samples or 1, n_rows).

        Gaussians are projected once per angle and mapped to the views by a matrix product, block by block.
        """
        weight, u, v, var_u, var_v, cov_uv = _weight_and_moments_samples_last(footprint)
        c, s = np.cos(self.angle_rad[:, None, None]), np.sin(self.angle_rad[:, None, None])
        per_sd = 1 / np.sqrt(c * c * var_u + s * s * var_v + 2 * c * s * cov_uv)
        shift = c * u + s * v
        n_angles, n_gaussians, n_samples = np.broadcast(per_sd, shift, weight).shape
        both = np.empty((2 * n_angles, n_gaussians, n_samples))
        both[:n_angles] = per_sd * PER_SD
        np.multiply(shift, both[:n_angles], out=both[n_angles:])
        both[n_angles:] += CENTRE
        both = both.transpose(1, 2, 0)
        weight = np.broadcast_to(weight, (n_gaussians, n_samples))[..., None]
        out, step = np.empty((n_samples, len(self.rows))), max(1, _BLOCK // (n_gaussians * len(self.distance_mm)))
        for start in range(0, n_samples, step):
            here = both[:, start : start + step]
            if n_angles <= _FEW_ANGLES:
                cells = here @ self._matrix_from_angles_to_views
            else:
                cells = here[..., self.which] * self.distance_mm
                cells += here[..., n_angles + self.which]
            normal_cdf_of_cells_in_place(cells)
            cells *= weight[:, start : start + step]
            seen = cells.sum(axis=0).take(self.view, axis=1, mode="clip")  # "clip" spares the check of bounds
            seen *= self.gain
            np.add(seen, self.low, out=out[start : start + step])
        return out


@dataclass(frozen=True, eq=False)
class StraightCorners:
    """The distinct views of quadrants under the readings `rows`; one view serves all four quadrants about the corner.

    Three masses determine every quadrant: beyond the corner along both axes, along x, and along y. `turn_rad` is the
    sensor's orientation, (n_views,) or (1,); `x_mm`, `y_mm` the corner relative to the sensor, lab frame, (n_views,).
    The masses times `readings_from_masses`, (3 n_views, n_rows), plus `low`, (n_rows,), are the responses.
    """

    rows: IntArray
    turn_rad: FloatArray
    x_mm: FloatArray
    y_mm: FloatArray
    readings_from_masses: FloatArray
    low: FloatArray

    @classmethod
    def from_regions(cls, parts: list[tuple[IntArray, QuadrantRegion]], poses: Poses) -> StraightCorners:
        """Batch quadrants of one hypothesis each with the rows of their readings; the poses are the same for all."""
        rows, x, y, turn, of = _joined_rows(parts, poses)
        corner, direction = (
            np.concatenate([getattr(region, name) for _, region in parts])[of].T for name in ("corner_mm", "direction")
        )
        inside, outside = (np.array([getattr(r, name) for _, r in parts])[of] for name in ("inside", "outside"))
        same = ((turn, _SAME_ANGLE), (corner[0] - x, _SAME_MM), (corner[1] - y, _SAME_MM))
        places = np.stack([np.round(a / least) * least for a, least in same])
        views, view = np.unique(places, axis=1, return_inverse=True)
        (to_x, to_y), gain = direction, inside - outside
        # With mass q beyond along both, p along x and s along y, a quadrant is q, s - q, p - q or 1 - p - s + q.
        shares = (to_x * to_y, np.where(to_y < 0, to_x, 0.0), np.where(to_x < 0, to_y, 0.0))
        own = np.eye(views.shape[1])[:, view.reshape(-1)] * gain
        low = outside + np.where((to_x < 0) & (to_y < 0), gain, 0.0)
        turns = views[0] if np.ptp(views[0]) > 0 else views[0, :1]
        return cls(rows, turns, views[1], views[2], np.concatenate([own * share for share in shares]), low)

    def response(self, footprint: Footprint) -> FloatArray:
        """Compute the responses to a footprint that is the same at all readings, (n_samples or 1, n_rows)."""
        weight, *moments = _weight_and_moments_samples_last(footprint)
        turn, x, y = (a[:, None, None] for a in (self.turn_rad, self.x_mm, self.y_mm))
        dx, dy, var_x, var_y, cov_xy = moments_in_lab_frame(turn, *moments)
        sd_x, sd_y = np.sqrt(var_x), np.sqrt(var_y)
        shares = probabilities_beyond_corner_and_sides((x - dx) / sd_x, (y - dy) / sd_y, cov_xy / (sd_x * sd_y))
        # Sum over the Gaussians: (n_views, n_gaussians, n_samples) each -> (3 n_views, n_samples).
        beyond = np.concatenate([(share * weight).sum(axis=1) for share in shares])
        return np.asarray(beyond.T @ self.readings_from_masses + self.low)


def _joined_rows(
    parts: list[tuple[IntArray, HalfPlaneRegion]] | list[tuple[IntArray, QuadrantRegion]], poses: Poses
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """Return the rows of all parts, x, y and orientation of the sensor there, and each row's part, (n_rows,) each."""
    rows = np.concatenate([rows for rows, _ in parts])
    places = (np.broadcast_to(select_reading_columns(a, rows)[0], rows.shape) for a in poses.arrays)
    return (rows, *places, np.repeat(np.arange(len(parts)), [len(rows) for rows, _ in parts]))  # type: ignore[return-value]


def _weight_and_moments_samples_last(footprint: Footprint) -> tuple[FloatArray, ...]:
    """Return weight and moments of a footprint that is the same at all readings, (n_gaussians, n_samples or 1) each."""
    return tuple(a[:, 0].T for a in (footprint.weight, *footprint.moments))


def select_reading_columns(array: FloatArray, rows: IntArray) -> FloatArray:
    """Select the columns of the readings `rows` from an array whose point axis may be 1."""
    return array if array.shape[1] == 1 else array[:, rows]
