"""What a residual may depend on: place, time, level, direction, and whatever else the recording holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.fit import Model
from probewise.recordings.plan import Plan

__all__ = ["Covariate", "covariates_of", "slope_along_the_move"]


@dataclass(frozen=True, eq=False)
class Covariate:
    """One covariate of the usable rows.

    `values` (n_usable,) in its unit; `rows` those usable rows it is defined for; `groups` says that
    only whole groups of equal values make sense (an orientation, a scan). `scan` is the scan's name
    where it is meant within one scan.
    """

    name: str
    values: FloatArray
    rows: IntArray
    groups: bool = False
    scan: str | None = None


def slope_along_the_move(model: Model, z: FloatArray) -> FloatArray:
    """Differentiate the prediction along each row's direction of motion, per mm, shape (n_points,)."""
    plan = model.plan
    step = 0.25
    ahead, behind = (
        replace(plan, x_mm=plan.x_mm + s * plan.direction[:, 0], y_mm=plan.y_mm + s * plan.direction[:, 1])
        for s in (step, -step)
    )
    # The moved plans move the whole row, so the directions, and with them backlash, stay as they are.
    return np.asarray((model.predict(z[None, :], ahead)[0] - model.predict(z[None, :], behind)[0]) / (2 * step))


def covariates_of(plan: Plan, usable: IntArray, level: FloatArray, slope: FloatArray) -> list[Covariate]:
    """List the covariates that vary in this recording.

    Parameters
    ----------
    plan
        The plan of all rows.
    usable
        Row numbers of the usable readings, shape (n_usable,).
    level, slope
        Predicted reading and its slope along the move, both (n_usable,).
    """
    everything = np.arange(len(usable))
    direction = plan.direction[usable]
    sign: FloatArray = np.where(direction[:, 0] != 0, np.sign(direction[:, 0]), np.sign(direction[:, 1]))
    moving = np.flatnonzero(sign != 0)
    scan = plan.scan[usable]
    degrees = np.asarray(np.round(np.degrees(plan.orientation_rad[usable]), 6), dtype=np.float64)
    pooled: Mapping[str, FloatArray] = {
        "time": plan.time_s[usable],
        "level": level,
        **{name: values[usable] for name, values in plan.covariates.items()},
    }
    out: list[Covariate] = []
    for name, values in pooled.items():
        there = np.flatnonzero(np.isfinite(values))
        if there.size and _varies(values[there]):
            out.append(Covariate(name, values[there], there))
    if moving.size and _varies(slope[moving]):
        out.append(Covariate("slope", slope[moving], moving))
    if _varies(sign[moving]):
        out.append(Covariate("direction", sign[moving], moving, groups=True))
    if _varies(degrees):
        out.append(Covariate("orientation", degrees, everything, groups=True))
    if len(np.unique(scan)) > 1:
        out.append(Covariate("scan", scan.astype(np.float64), everything, groups=True))
    longest = _along(plan.x_mm[usable], plan.y_mm[usable])
    if _varies(longest):
        out.append(Covariate("place", longest, everything))
    for k, name in enumerate(plan.scan_names):
        rows = np.flatnonzero(scan == k)
        if rows.size >= 16:
            along = _along(plan.x_mm[usable][rows], plan.y_mm[usable][rows])
            if _varies(along):
                out.append(Covariate("place", along, rows, scan=name))
    return out


def _along(x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Take the coordinate along the longer side of a scan."""
    return x_mm if np.ptp(x_mm) >= np.ptp(y_mm) else y_mm


def _varies(values: FloatArray) -> bool:
    return values.size > 1 and float(np.ptp(values)) > 1e-9 * max(1.0, float(np.abs(values).max()))
