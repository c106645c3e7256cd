"""Covariates of a residual: place, time, level, direction, and the recording's own columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.effects import NamedEffect, orientation_deg, sign_of_motion
from probewise.recordings.plan import Plan
from probewise.scene import edge_distance, region_of

_NOT_COLUMNS = frozenset({"time", "level", "edge_distance", "slope", "direction", "orientation", "scan", "place"})
_MOST_SCANS = 24  # number of scans above which residuals are not located in single scans


def slope_along_motion(predict: Callable[[Plan], FloatArray], plan: Plan) -> FloatArray:
    """Differentiate predictions of a plan along each row's direction of motion, in readings per mm, (n_points,)."""
    step = 0.25
    ahead, behind = (
        replace(
            plan,
            x_mm=plan.x_mm + s * plan.direction_of_motion[:, 0],
            y_mm=plan.y_mm + s * plan.direction_of_motion[:, 1],
        )
        for s in (step, -step)
    )
    # All rows are shifted together, so that directions, and hence backlash, do not change.
    return np.asarray((predict(ahead) - predict(behind)) / (2 * step))


def varying_covariates(plan: Plan, usable: IntArray, level: FloatArray, slope: FloatArray) -> list[Covariate]:
    """List the covariates that vary in this recording.

    Parameters
    ----------
    plan
        The plan of all rows.
    usable
        Row numbers of the usable readings, shape (n_usable,).
    level, slope
        Predicted reading and its slope along the motion, both (n_usable,).
    """
    everything = np.arange(len(usable))
    sign = sign_of_motion(plan)[usable]
    moving = np.flatnonzero(sign != 0)
    scan = plan.scan[usable]
    degrees = orientation_deg(plan)[usable]
    pooled: Mapping[str, FloatArray] = {
        "time": plan.time_s[usable],
        "level": level,
        "edge_distance": _edge_distance_mm(plan)[usable],
        **{_covariate_of_column(name): values[usable] for name, values in plan.covariates.items()},
    }
    out: list[Covariate] = []
    for name, values in pooled.items():
        there = np.flatnonzero(np.isfinite(values))
        if there.size and _varies(values[there], 1.0 if name == "edge_distance" else 0.0):
            out.append(Covariate(name, values[there], there))
    # A slope or a distance that is about 0 everywhere is rounding error: of the level over 1 mm, of 1 mm.
    if moving.size and _varies(slope[moving], float(np.abs(level).max(initial=0.0))):
        out.append(Covariate("slope", slope[moving], moving))
    if _varies(sign[moving]):
        out.append(Covariate("direction", sign[moving], moving, groups=True))
    if _varies(degrees):
        out.append(Covariate("orientation", degrees, everything, groups=True))
    if len(np.unique(scan)) > 1:
        out.append(Covariate("scan", scan.astype(np.float64), everything, groups=True))
    return out + _place_covariates_along_scans(plan, usable)


def _covariate_of_column(name: str) -> str:
    """Return the covariate's name for a column of the recording: as it is, or "column NAME" if that is taken."""
    return f"column {name}" if name in _NOT_COLUMNS else name


def _place_covariates_along_scans(plan: Plan, usable: IntArray) -> list[Covariate]:
    """List the places (x or y, mm) along all scans in the longer direction, and along each longer scan alone."""
    x_mm, y_mm, scan = plan.x_mm[usable], plan.y_mm[usable], plan.scan[usable]
    by_scan = [np.flatnonzero(scan == k) for k in range(len(plan.scan_names))]
    along_x = np.ptp(x_mm) >= np.ptp(y_mm)
    alike = [rows for rows in by_scan if rows.size and (np.ptp(x_mm[rows]) >= np.ptp(y_mm[rows])) == along_x]
    rows = np.sort(np.concatenate(alike)) if alike else np.arange(len(usable))
    longest = (x_mm if along_x else y_mm)[rows]
    out = [Covariate("place", longest, rows)] if _varies(longest) else []
    for rows, name in zip(by_scan, plan.scan_names, strict=True):
        if rows.size >= 16 and len(by_scan) <= _MOST_SCANS:
            along = x_mm[rows] if np.ptp(x_mm[rows]) >= np.ptp(y_mm[rows]) else y_mm[rows]
            if _varies(along):
                out.append(Covariate("place", along, rows, scan=name))
    return out


def covariate_of_effect(
    effect: NamedEffect[Any], change: FloatArray, without: FloatArray, plan: Plan, known: Sequence[Covariate]
) -> Covariate | None:
    """Return the first of an effect's covariates that varies here; None if none varies, or `change` is 0 everywhere.

    Parameters
    ----------
    effect
        The effect.
    change
        Its change of the readings, (n_points,).
    without
        Predicted readings without it, (n_points,), the values of the covariate `level`.
    plan
        Plan of the readings; a place is along the scans with the largest change.
    known
        Covariates of the recording.
    """
    pooled = {c.name: c for c in known if c.scan is None}
    sign = sign_of_motion(plan)
    if "direction" not in pooled and np.ptp(sign) > 0:  # a reading at rest has no direction, but serves for comparison
        pooled["direction"] = Covariate("direction", sign, np.arange(len(sign)), groups=True)
    name = next((name for name in effect.covariates if name in pooled), None)
    if name is None or not np.any(change):
        return None
    if name == "level":
        return replace(pooled[name], values=without[pooled[name].rows])
    return (_place_covariate_of_larger_change(change, plan) if name == "place" else None) or pooled[name]


def _place_covariate_of_larger_change(change: FloatArray, plan: Plan) -> Covariate | None:
    """Return the places along X or Y, for readings approached along it, whichever has the larger change."""
    along_x, along_y = (np.flatnonzero(plan.direction_of_motion[:, k] != 0) for k in (0, 1))
    strength = [float(np.abs(change[rows]).max(initial=0.0)) for rows in (along_x, along_y)]
    rows, values = (along_x, plan.x_mm) if strength[0] >= strength[1] else (along_y, plan.y_mm)
    return Covariate("place", values[rows], rows) if rows.size else None


def _edge_distance_mm(plan: Plan) -> FloatArray:
    """Return the distance of each row from the nearest edge of its pattern, mm; infinite without a described edge."""
    out = np.full(len(plan), np.inf)
    for name, rows in plan.rows_by_pattern():
        if name in plan.patterns:
            region = region_of(plan.patterns[name])
            out[rows] = edge_distance(region, plan.x_mm[None, rows], plan.y_mm[None, rows])[0]
    return out


def _varies(values: FloatArray, size: float = 0.0) -> bool:
    """Return whether values differ by more than 1e-9 of the largest, or of `size` if that is larger."""
    return values.size > 1 and float(np.ptp(values)) > 1e-9 * max(size, float(np.abs(values).max()))
