"""The world's table of readings: where, when, and over what."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.recordings.plan import Plan


@dataclass(frozen=True, eq=False)
class Rows:
    """One row per reading, in order of time.

    Parameters
    ----------
    place_mm
        Place of the sensor, shape (n_points, 2): commanded, or true once the arm's errors are applied.
    direction
        Unit vector of the last motion, 0 where there was none, shape (n_points, 2).
    orientation_rad
        Orientation, commanded or true, shape (n_points,).
    time_s
        Time, shape (n_points,).
    scan
        Number of the scan, shape (n_points,).
    scan_names
        Name of each scan.
    covariates
        Other logged columns, arrays of shape (n_points,).
    across
        Unit vector across the straight edges of the pattern below, (1, 0) for others (`common_edge_normal`), shape
        (n_points, 2).
    edge_mm
        Distance from the place to the nearest edge of the pattern, infinite where it has none, (n_points,).
    """

    place_mm: FloatArray
    direction: FloatArray
    orientation_rad: FloatArray
    time_s: FloatArray
    scan: IntArray
    scan_names: tuple[str, ...]
    covariates: Mapping[str, FloatArray]
    across: FloatArray
    edge_mm: FloatArray

    @classmethod
    def from_plan(cls, plan: Plan, across: FloatArray, edge_mm: FloatArray) -> Rows:
        """Build from a plan, as commanded."""
        return cls(
            place_mm=np.stack([plan.x_mm, plan.y_mm], axis=-1),
            direction=plan.direction_of_motion,
            orientation_rad=plan.orientation_rad,
            time_s=plan.time_s,
            scan=plan.scan,
            scan_names=plan.scan_names,
            covariates=plan.covariates,
            across=across,
            edge_mm=edge_mm,
        )

    def commanded_column(self, name: str, *, otherwise: float) -> FloatArray:
        """Return a commanded column, `otherwise` where it is NaN or there is none, shape (n_points,)."""
        column = self.covariates.get(name, np.full(len(self.time_s), np.nan))
        return np.where(np.isfinite(column), column, otherwise)

    def in_scans_mask(self, names: tuple[str, ...]) -> BoolArray:
        """Return whether each row belongs to one of these scans, shape (n_points,)."""
        chosen = [k for k, name in enumerate(self.scan_names) if name in names]
        return np.isin(self.scan, chosen)

    def scan_start_mask(self) -> BoolArray:
        """Return whether each row is the first, or comes after one of another scan, shape (n_points,)."""
        return np.concatenate([[True], self.scan[1:] != self.scan[:-1]])

    of, commanded, in_scans, starts_scan = (
        from_plan,
        commanded_column,
        in_scans_mask,
        scan_start_mask,
    )  # their old names
