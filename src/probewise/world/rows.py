"""What the world knows of the readings it takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.recordings.plan import Plan

__all__ = ["Rows"]


@dataclass(frozen=True, eq=False)
class Rows:
    """One row per reading, in the order they were taken.

    Parameters
    ----------
    place_mm
        Where the sensor stands, shape (n_points, 2): as commanded, and once the arm has erred, where it really is.
    direction
        Unit vector of the last move, 0 where there was none, shape (n_points, 2).
    orientation_rad
        How it is turned, commanded and then real, shape (n_points,).
    time_s
        When, shape (n_points,).
    scan
        Number of the scan, shape (n_points,).
    scan_names
        Name of each scan.
    covariates
        Anything else that was noted down, arrays of shape (n_points,).
    across
        Unit vector across the edge of the pattern underneath, (1, 0) where it has no one such, (n_points, 2).
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
    def of(cls, plan: Plan, across: FloatArray, edge_mm: FloatArray) -> Rows:
        """Take over a plan as commanded."""
        return cls(
            place_mm=np.stack([plan.x_mm, plan.y_mm], axis=-1),
            direction=plan.direction,
            orientation_rad=plan.orientation_rad,
            time_s=plan.time_s,
            scan=plan.scan,
            scan_names=plan.scan_names,
            covariates=plan.covariates,
            across=across,
            edge_mm=edge_mm,
        )

    def in_scans(self, names: tuple[str, ...]) -> BoolArray:
        """Tell which rows belong to the scans of these names, shape (n_points,)."""
        chosen = [k for k, name in enumerate(self.scan_names) if name in names]
        return np.isin(self.scan, chosen)

    def starts_scan(self) -> BoolArray:
        """Tell which rows are the first of their scan, shape (n_points,)."""
        return np.concatenate([[True], self.scan[1:] != self.scan[:-1]])
