"""Known straight edges and corners under many readings: laid out once, seen by every hypothesis in one product.

Calibration lives on them: the same few hundred readings, a million hypotheses. What depends on
the readings alone (angles, distances, which of them are alike) is worked out when the layout is made.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.scene.regions import HalfPlaneRegion, QuadrantRegion
from probewise.sensor._normal import CENTRE, PER_SD, replace_by_cumulative
from probewise.sensor.gaussian import Spot, mass_in_quadrant, turned
from probewise.sensor.stages import Footprint, Poses

__all__ = ["StraightCorners", "StraightEdges", "columns_of"]

_BLOCK = 2**14  # elements at a time: stays in the cache
_FEW_ANGLES = 16  # up to so many the product with zeros is cheaper than picking columns


@dataclass(frozen=True, eq=False)
class StraightEdges:
    """Half-planes under the readings `rows`, each field (n_rows,) unless said.

    Parameters
    ----------
    rows
        Numbers of the readings.
    turn_rad
        The edge's normal as the sensor sees it: the normal's angle less the sensor's orientation.
    distance_mm
        How far inside the edge the sensor stands, (1 or n_samples, n_rows).
    inside, outside
        Albedo on either side.
    """

    rows: IntArray
    turn_rad: FloatArray
    distance_mm: FloatArray
    inside: FloatArray
    outside: FloatArray

    @classmethod
    def of(cls, parts: list[tuple[IntArray, HalfPlaneRegion]], poses: Poses) -> StraightEdges:
        """Lay out regions of one hypothesis each, under sensors whose orientation no hypothesis changes."""
        rows = np.concatenate([r for r, _ in parts])

        def each(values: list[float]) -> FloatArray:
            return np.concatenate([np.full(len(r), value) for (r, _), value in zip(parts, values, strict=True)])

        normal = each([float(region.normal_rad[0]) for _, region in parts])
        offset = each([float(region.offset_mm[0]) for _, region in parts])
        x, y, orientation = (columns_of(a, rows) for a in (poses.x_mm, poses.y_mm, poses.orientation_rad))
        return cls(
            rows,
            np.broadcast_to(normal - orientation[0], rows.shape),
            np.cos(normal) * x + np.sin(normal) * y - offset,
            each([region.inside for _, region in parts]),
            each([region.outside for _, region in parts]),
        )

    @cached_property
    def _angles(self) -> tuple[FloatArray, IntArray]:
        """Distinct angles, and which of them is each reading's."""
        distinct, which = np.unique(self.turn_rad, return_inverse=True)
        return distinct, which.reshape(-1)

    @cached_property
    def _hand_out(self) -> FloatArray:
        """Matrix that gives each reading its angle's (1/sd, shift/sd), in cells of the table, (2 n_angles, n_rows)."""
        distinct, which = self._angles
        own = np.eye(len(distinct))[:, which]
        return np.concatenate([own * self.distance_mm, own])

    @cached_property
    def _plain(self) -> bool:
        """Whether all is white inside and black outside."""
        return bool((self.inside == 1.0).all() and (self.outside == 0.0).all())

    @cached_property
    def _place(self) -> slice | None:
        """The rows as a slice, where they are neighbours: a view of the result then takes the place of a copy."""
        together = bool((np.diff(self.rows) == 1).all())
        return slice(int(self.rows[0]), int(self.rows[-1]) + 1) if together else None

    def see(self, footprint: Footprint, out: FloatArray) -> None:
        """Write what each hypothesis' footprint sees into the columns `rows` of `out`, (n_samples, n_points)."""
        share = np.empty((len(out), len(self.rows))) if self._place is None else out[:, self._place]
        if len(self.distance_mm) == 1 and footprint.weight.shape[1] == 1 and not _varies(footprint):
            self._see_by_product(footprint, share)
        else:
            self._see_each(footprint, share)
        if not self._plain:
            share *= self.inside - self.outside
            share += self.outside
        if self._place is None:
            out[:, self.rows] = share

    def _see_by_product(self, footprint: Footprint, share: FloatArray) -> None:
        """See with a footprint that no reading changes: Gaussians projected once an angle, handed out in a product."""
        distinct, which = self._angles
        per_sd, shift = (np.moveaxis(a, 2, 1) for a in _projected(footprint, distinct))
        both = np.concatenate([per_sd * PER_SD, shift * per_sd * PER_SD + CENTRE], axis=2)
        n_gaussians, n_angles = per_sd.shape[1:]
        step = max(1, _BLOCK // (n_gaussians * len(self.rows)))
        for start in range(0, len(share), step):
            block = slice(start, start + step)
            here = _rows_of(both, block)
            if n_angles <= _FEW_ANGLES:
                cells = (here.reshape(-1, 2 * n_angles) @ self._hand_out).reshape(len(here), n_gaussians, -1)
            else:
                cells = here[..., which] * self.distance_mm
                cells += here[..., n_angles + which]
            replace_by_cumulative(cells)
            np.matmul(_rows_of(footprint.weight, block), cells, out=share[block, None])

    def _see_each(self, footprint: Footprint, share: FloatArray) -> None:
        """See from places that change with the hypothesis, or with a footprint that changes with the reading."""
        angles, which = (self.turn_rad, np.arange(len(self.rows))) if _varies(footprint) else self._angles
        here = Footprint(*(columns_of(getattr(footprint, f.name), self.rows) for f in fields(footprint)))
        per_sd, shift = _projected(here, angles)
        share[:] = 0.0
        step = max(1, _BLOCK // len(self.rows))
        for start in range(0, len(share), step):
            block = slice(start, start + step)
            for g in range(footprint.weight.shape[2]):
                cells = _rows_of(shift, block)[:, which, g] + _rows_of(self.distance_mm, block)
                cells = cells * (_rows_of(per_sd, block)[:, which, g] * PER_SD)
                cells += CENTRE
                replace_by_cumulative(cells)
                share[block] += cells * _rows_of(here.weight, block)[:, :, g]


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
    def of(cls, parts: list[tuple[IntArray, QuadrantRegion]], poses: Poses) -> StraightCorners:
        """Lay out regions of one hypothesis each."""
        rows = np.concatenate([r for r, _ in parts])
        of = np.repeat(np.arange(len(parts)), [len(r) for r, _ in parts])
        return cls(
            rows,
            np.concatenate([region.corner_mm for _, region in parts])[of],
            np.concatenate([region.direction for _, region in parts])[of],
            np.array([region.inside for _, region in parts])[of],
            np.array([region.outside for _, region in parts])[of],
            Poses(*(columns_of(a, rows) for a in (poses.x_mm, poses.y_mm, poses.orientation_rad))),
        )

    def see(self, footprint: Footprint, out: FloatArray) -> None:
        """Write what each hypothesis' footprint sees into the columns `rows` of `out`, (n_samples, n_points)."""
        poses = self.poses
        turn = poses.orientation_rad[..., None]
        moments = (footprint.u_mm, footprint.v_mm, footprint.var_u, footprint.var_v, footprint.cov_uv)
        moved = turned(turn, *(columns_of(a, self.rows) for a in moments))
        spots = Spot(poses.x_mm[..., None], poses.y_mm[..., None], *moved)  # (n_samples, n_rows, n_gaussians)
        (corner_x, corner_y), (to_x, to_y) = self.corner_mm.T[..., None], self.direction.T[..., None]
        found = mass_in_quadrant(corner_x, corner_y, to_x, to_y, spots)
        share = (found * columns_of(footprint.weight, self.rows)).sum(axis=2)
        out[:, self.rows] = self.outside + (self.inside - self.outside) * share


def _varies(footprint: Footprint) -> bool:
    """Whether its Gaussians change with the reading."""
    moments = (footprint.u_mm, footprint.v_mm, footprint.var_u, footprint.var_v, footprint.cov_uv)
    return any(a.shape[1] > 1 for a in moments)


def _projected(footprint: Footprint, angle_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Project the Gaussians on axes at these angles: 1/sd and mean, (n_samples, n_angles, n_gaussians) both."""
    c, s = np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]
    variance = c * c * footprint.var_u + s * s * footprint.var_v + 2 * c * s * footprint.cov_uv
    per_sd, mean = np.broadcast_arrays(1 / np.sqrt(variance), c * footprint.u_mm + s * footprint.v_mm)
    return per_sd, mean


def _rows_of(array: FloatArray, block: slice) -> FloatArray:
    """Take a block of the hypotheses, of an array whose sample axis may be 1."""
    return array if array.shape[0] == 1 else array[block]


def columns_of(array: FloatArray, rows: IntArray) -> FloatArray:
    """Take the columns of the readings `rows`, of an array whose point axis may be 1."""
    return array if array.shape[1] == 1 else array[:, rows]
