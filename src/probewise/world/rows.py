"""The simulator's table of readings: pose, motion, time, scan and covariates of each, and the nearest edge."""

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
        Position (x, y) of the sensor, shape (n_points, 2): commanded, or true once the arm's errors are applied.
    direction
        Unit vector of the last motion, 0 where there was none, shape (n_points, 2).
    orientation_rad
        Orientation, commanded or true, shape (n_points,).
    time_s
        Time, shape (n_points,).
    scan
        Number of the scan, an index of `scan_names`, shape (n_points,).
    scan_names
        Name of each scan.
    covariates
        Other logged columns by name, arrays of shape (n_points,).
    across
        Unit vector across the straight edges of the pattern below, (1, 0) for others (`common_edge_normal`), shape
        (n_points, 2).
    edge_mm
        Distance from the sensor's position to the pattern's nearest edge, infinite where there is none, (n_points,).
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
        """Build from a plan's commanded poses, with `across` and `edge_mm` of the surfaces below."""
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
        """Return the covariate `name`, shape (n_points,), with `otherwise` in place of NaN or of an absent column."""
        column = self.covariates.get(name, np.full(len(self.time_s), np.nan))
        return np.where(np.isfinite(column), column, otherwise)

    def in_scans_mask(self, names: tuple[str, ...]) -> BoolArray:
        """Return a mask of the rows that belong to a scan in `names`, shape (n_points,)."""
        chosen = [k for k, name in enumerate(self.scan_names) if name in names]
        return np.isin(self.scan, chosen)

    def scan_start_mask(self) -> BoolArray:
        """Return a mask, shape (n_points,), of the rows that start a scan or resume it after another scan."""
        return np.concatenate([[True], self.scan[1:] != self.scan[:-1]])
