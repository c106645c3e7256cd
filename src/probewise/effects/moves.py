"""Which way each reading was approached, and in which scans: what several effects ask of a plan."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.recordings.plan import Plan

__all__ = ["in_scans", "mountings", "moves_in_more_than_one_way", "sign_of_move"]


def sign_of_move(plan: Plan) -> FloatArray:
    """Give the sign of the last move along X, or along Y where X stands still, 0 where nothing moved, (n_points,)."""
    along_x, along_y = np.sign(plan.direction).T
    return np.asarray(np.where(along_x != 0, along_x, along_y))


def moves_in_more_than_one_way(plan: Plan) -> bool:
    """Tell whether moves differ in their sign: forth and back, or forth and not at all."""
    return bool(np.ptp(sign_of_move(plan)) > 0)


def in_scans(plan: Plan, names: tuple[str, ...]) -> FloatArray:
    """Give 1 for the readings of these scans, 0 for the others, (n_points,)."""
    member = np.array([name in names for name in plan.scan_names], dtype=np.float64)
    return np.asarray(member[plan.scan])


def mountings(plan: Plan) -> tuple[tuple[str, ...], ...]:
    """Names of the scans of each mounting (those that share an orientation), and of each scan by itself.

    A mounting that holds all scans is none: nothing is left to compare it with. A scan in which the
    sensor turns belongs to no mounting.
    """
    by_angle: dict[float, list[str]] = {}
    for name, rows in zip(plan.scan_names, plan.rows_by_scan(), strict=True):
        angles = np.unique(np.round(plan.orientation_rad[rows], 9))
        if len(angles) == 1:
            by_angle.setdefault(float(angles[0]), []).append(name)
    groups = [tuple(dict.fromkeys(names)) for names in by_angle.values()]
    singles = [(name,) for name in dict.fromkeys(plan.scan_names)]
    every = set(plan.scan_names)
    return tuple(group for group in dict.fromkeys([*groups, *singles]) if set(group) != every)
