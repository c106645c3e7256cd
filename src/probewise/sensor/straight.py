"""Fast responses to known straight edges and corners, for many hypotheses over the same readings.

This is the case of calibration: a few hundred readings, a million hypotheses. Everything that depends
only on the readings (angles, distances, duplicates) is computed once per layout.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.scene.regions import HalfPlaneRegion, QuadrantRegion
from probewise.sensor._normal import CENTRE, PER_SD, normal_cdf_of_cells_in_place
from probewise.sensor.gaussian import (
    LabGaussian,
    mass_in_quadrant,
    moments_in_lab_frame,
    probabilities_beyond_corner_and_sides,
)
from probewise.sensor.stages import Footprint, Poses

_BLOCK = 2**14  # elements at a time: they fit the cache
_FEW_ANGLES = 16  # up to so many, a product with a mostly zero matrix is cheaper than indexing columns
_SAME_ANGLE, _SAME_MM = 1e-12, 1e-10  # smaller differences of angles (radians) and places are rounding


@dataclass(frozen=True, eq=False)
class StraightEdges:
    """Half-planes under the readings `rows`; each field is (n_rows,) unless stated otherwise.

    `rows`: row indices of the readings; `turn_rad`: angle of the edge's normal in the sensor frame; `distance_mm`:
    signed distance of the sensor from the edge, positive inside, (1 or n_samples, n_rows); `inside`, `outside`: albedo
    on either side.
    """

    rows: IntArray
    turn_rad: FloatArray
    distance_mm: FloatArray
    inside: FloatArray
    outside: FloatArray

    @classmethod
    def from_regions(cls, parts: list[tuple[IntArray, HalfPlaneRegion]], poses: Poses) -> StraightEdges:
        """Batch half-planes of one hypothesis each; orientations must be the same for all hypotheses."""
        rows = np.concatenate([r for r, _ in parts])
        of = np.repeat(np.arange(len(parts)), [len(r) for r, _ in parts])
        normal = np.array([region.normal_rad[0] for _, region in parts])[of]
        offset = np.array([region.offset_mm[0] for _, region in parts])[of]
        x, y, orientation = (select_reading_columns(a, rows) for a in (poses.x_mm, poses.y_mm, poses.orientation_rad))
        return cls(
            rows,
            np.broadcast_to(normal - orientation[0], rows.shape),
            np.cos(normal) * x + np.sin(normal) * y - offset,
            np.array([region.inside for _, region in parts])[of],
            np.array([region.outside for _, region in parts])[of],
        )

    @cached_property
    def _distinct_views(self) -> _DistinctEdgeViews:
        return _DistinctEdgeViews.from_edges(self)

    @cached_property
    def _rows_as_slice(self) -> slice | None:
        """The rows as a slice, which gives views instead of copies; None if they are not contiguous."""
        together = bool((np.diff(self.rows) == 1).all())
        return slice(int(self.rows[0]), int(self.rows[-1]) + 1) if together else None

    def write_response(self, footprint: Footprint, out: FloatArray) -> None:
        """Write each hypothesis' response into the columns `rows` of `out`, (n_samples, n_points)."""
        seen = np.empty((len(out), len(self.rows))) if self._rows_as_slice is None else out[:, self._rows_as_slice]
        if len(self.distance_mm) == 1 and not _varies_with_reading(footprint):
            self._distinct_views.write_response(footprint, seen)
        else:
            self._write_mass_inside_by_hypothesis(footprint, seen)
            seen *= self.inside - self.outside
            seen += self.outside
        if self._rows_as_slice is None:
            out[:, self.rows] = seen

    def _write_mass_inside_by_hypothesis(self, footprint: Footprint, share: FloatArray) -> None:
        """Write the mass inside to `share`, where positions vary by hypothesis or footprints by reading."""
        weight, *moments = (self._own_reading_columns(a) for a in (footprint.weight, *footprint.moments))
        varies = _varies_with_reading(footprint)
        angles, which = (self.turn_rad, None) if varies else np.unique(self.turn_rad, return_inverse=True)
        per_sd, shift = np.broadcast_arrays(*_inverse_sd_and_mean_on_axes(angles[:, None], *moments))
        share[:] = 0.0
        step = max(1, _BLOCK // len(self.rows))
        for start in range(0, len(share), step):
            block = slice(start, start + step)
            distance = _select_hypotheses(self.distance_mm, block)
            for g in range(footprint.weight.shape[2]):
                own_shift, own_per_sd = (
                    _select_hypotheses(shift, block)[:, :, g],
                    _select_hypotheses(per_sd, block)[:, :, g],
                )
                if which is not None:
                    own_shift, own_per_sd = own_shift[:, which], own_per_sd[:, which]
                cells = own_shift + distance
                cells = cells * (own_per_sd * PER_SD)
                cells += CENTRE
                normal_cdf_of_cells_in_place(cells)
                share[block] += cells * _select_hypotheses(weight, block)[:, :, g]

    def _own_reading_columns(self, array: FloatArray) -> FloatArray:
        """Select the columns of the readings `rows`, as a view if they are contiguous."""
        if self._rows_as_slice is None or array.shape[1] == 1:
            return select_reading_columns(array, self.rows)
        return array[:, self._rows_as_slice]


@dataclass(frozen=True, eq=False)
class _DistinctEdgeViews:
    """The distinct views of straight edges: readings of scans out and back, or from both sides, share a view.

    An edge seen from its other side is the same view with black and white exchanged. `angle_rad` (n_angles,) runs from
    0 to pi; each view has an angle, by index `which`, and a `distance_mm`, (n_views,). Each reading has a `view`, by
    index, and reads low + gain times the view's mass, `low` and `gain` (n_rows,).
    """

    angle_rad: FloatArray
    which: IntArray
    distance_mm: FloatArray
    view: IntArray
    low: FloatArray
    gain: FloatArray

    @classmethod
    def from_edges(cls, edges: StraightEdges) -> _DistinctEdgeViews:
        """Find the distinct views of edges whose distance is the same for all hypotheses."""
        n_half_turns = np.floor(edges.turn_rad / np.pi + _SAME_ANGLE)
        behind = n_half_turns % 2 == 1
        angle = np.round((edges.turn_rad - n_half_turns * np.pi) / _SAME_ANGLE) * _SAME_ANGLE
        distance = np.round(np.where(behind, -1.0, 1.0) * edges.distance_mm[0] / _SAME_MM) * _SAME_MM
        views, view = np.unique(np.stack([angle, distance]), axis=1, return_inverse=True)
        angles, which = np.unique(views[0], return_inverse=True)
        low, high = np.where(behind, edges.inside, edges.outside), np.where(behind, edges.outside, edges.inside)
        return cls(angles, which, views[1], view.reshape(-1), low, high - low)

    @cached_property
    def _matrix_from_angles_to_views(self) -> FloatArray:
        """Matrix from the angles' (1/sd, mean/sd) to the views' positions in the table, (2 n_angles, n_views)."""
        own = np.eye(len(self.angle_rad))[:, self.which]
        return np.concatenate([own * self.distance_mm, own])

    def write_response(self, footprint: Footprint, out: FloatArray) -> None:
        """Write the responses to a footprint that is the same at all readings, (n_samples, n_rows).

        Gaussians are projected once per angle and mapped to the views by a matrix product, block by block.
        """
        weight, *moments = _weight_and_moments_samples_last(footprint)
        per_sd, shift = _inverse_sd_and_mean_on_axes(self.angle_rad[:, None, None], *moments)
        n_angles, n_gaussians, n_samples = np.broadcast(per_sd, shift, weight).shape
        both = np.empty((2 * n_angles, n_gaussians, n_samples))
        both[:n_angles] = per_sd * PER_SD
        np.multiply(shift, both[:n_angles], out=both[n_angles:])
        both[n_angles:] += CENTRE
        both = both.transpose(1, 2, 0)
        weight = np.broadcast_to(weight, (n_gaussians, n_samples))[..., None]
        step = max(1, _BLOCK // (n_gaussians * len(self.distance_mm)))
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
            np.add(seen, self.low, out=out[start : start + step] if n_samples > 1 else out)


@dataclass(frozen=True, eq=False)
class StraightCorners:
    """Quadrants under the readings `rows`; corner and direction (n_rows, 2), albedos (n_rows,)."""

    rows: IntArray
    corner_mm: FloatArray
    direction: FloatArray
    inside: FloatArray
    outside: FloatArray
    poses: Poses

    @classmethod
    def from_regions(cls, parts: list[tuple[IntArray, QuadrantRegion]], poses: Poses) -> StraightCorners:
        """Batch quadrants of one hypothesis each with the rows of their readings."""
        rows = np.concatenate([r for r, _ in parts])
        of = np.repeat(np.arange(len(parts)), [len(r) for r, _ in parts])
        return cls(
            rows,
            np.concatenate([region.corner_mm for _, region in parts])[of],
            np.concatenate([region.direction for _, region in parts])[of],
            np.array([region.inside for _, region in parts])[of],
            np.array([region.outside for _, region in parts])[of],
            Poses(*(select_reading_columns(a, rows) for a in (poses.x_mm, poses.y_mm, poses.orientation_rad))),
        )

    @cached_property
    def _distinct_views(self) -> _DistinctCornerViews:
        return _DistinctCornerViews.from_corners(self)

    def write_response(self, footprint: Footprint, out: FloatArray) -> None:
        """Write each hypothesis' response into the columns `rows` of `out`, (n_samples, n_points)."""
        poses = self.poses
        still = len(poses.x_mm) == len(poses.y_mm) == len(poses.orientation_rad) == 1
        if still and not _varies_with_reading(footprint):
            out[:, self.rows] = self._distinct_views.response(footprint)
            return
        moved = moments_in_lab_frame(
            poses.orientation_rad[..., None], *(select_reading_columns(a, self.rows) for a in footprint.moments)
        )
        gaussians = LabGaussian(
            poses.x_mm[..., None], poses.y_mm[..., None], *moved
        )  # (n_samples, n_rows, n_gaussians)
        (corner_x, corner_y), (to_x, to_y) = self.corner_mm.T[..., None], self.direction.T[..., None]
        found = mass_in_quadrant(corner_x, corner_y, to_x, to_y, gaussians)
        share = (found * select_reading_columns(footprint.weight, self.rows)).sum(axis=2)
        out[:, self.rows] = self.outside + (self.inside - self.outside) * share


@dataclass(frozen=True, eq=False)
class _DistinctCornerViews:
    """The distinct views of corners; one view serves all four quadrants about the corner.

    Three masses determine every quadrant: beyond the corner along both axes, along x, and along y. `turn_rad` is the
    sensor's orientation, (n_views,) or (1,); `x_mm`, `y_mm` the corner relative to the sensor, lab frame, (n_views,).
    The masses times `readings_from_masses`, (3 n_views, n_rows), plus `low`, (n_rows,), are the responses.
    """

    turn_rad: FloatArray
    x_mm: FloatArray
    y_mm: FloatArray
    readings_from_masses: FloatArray
    low: FloatArray

    @classmethod
    def from_corners(cls, corners: StraightCorners) -> _DistinctCornerViews:
        """Find the distinct views of corners where the position is the same for all hypotheses."""
        poses = corners.poses
        x, y = corners.corner_mm[:, 0] - poses.x_mm[0], corners.corner_mm[:, 1] - poses.y_mm[0]
        turn = np.broadcast_to(poses.orientation_rad[0], x.shape)
        places = [np.round(a / same) * same for a, same in ((turn, _SAME_ANGLE), (x, _SAME_MM), (y, _SAME_MM))]
        views, view = np.unique(np.stack(places), axis=1, return_inverse=True)
        (to_x, to_y), gain = corners.direction.T, corners.inside - corners.outside
        # With mass q beyond along both, p along x and s along y, a quadrant is q, s - q, p - q or 1 - p - s + q.
        parts = (to_x * to_y, np.where(to_y < 0, to_x, 0.0), np.where(to_x < 0, to_y, 0.0))
        own = np.eye(views.shape[1])[:, view.reshape(-1)] * gain
        low = corners.outside + np.where((to_x < 0) & (to_y < 0), gain, 0.0)
        turns = views[0] if np.ptp(views[0]) > 0 else views[0, :1]
        return cls(turns, views[1], views[2], np.concatenate([own * part for part in parts]), low)

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


def _varies_with_reading(footprint: Footprint) -> bool:
    """Return whether the Gaussians or their weights differ between readings."""
    return any(a.shape[1] > 1 for a in (footprint.weight, *footprint.moments))


def _weight_and_moments_samples_last(footprint: Footprint) -> tuple[FloatArray, ...]:
    """Return weight and moments of a footprint that is the same at all readings, (n_gaussians, n_samples or 1) each."""
    return tuple(a[:, 0].T for a in (footprint.weight, *footprint.moments))


def _inverse_sd_and_mean_on_axes(
    angle_rad: FloatArray, u_mm: FloatArray, v_mm: FloatArray, var_u: FloatArray, var_v: FloatArray, cov_uv: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return 1/sd and mean of Gaussians projected on axes at these angles; the arrays broadcast."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    variance = c * c * var_u + s * s * var_v + 2 * c * s * cov_uv
    return np.asarray(1 / np.sqrt(variance)), c * u_mm + s * v_mm


def _select_hypotheses(array: FloatArray, block: slice) -> FloatArray:
    """Select a block of hypotheses from an array whose sample axis may be 1."""
    return array if array.shape[0] == 1 else array[block]


def select_reading_columns(array: FloatArray, rows: IntArray) -> FloatArray:
    """Select the columns of the readings `rows` from an array whose point axis may be 1."""
    return array if array.shape[1] == 1 else array[:, rows]
