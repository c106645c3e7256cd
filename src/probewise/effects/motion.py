"""Positions, direction of motion, scans and mountings of a plan, for the effects that depend on them."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray, distinct_values
from probewise.recordings.plan import Plan

_SAME_PLACE_MM = 1e-6


def distinct_positions_mm(axis_mm: FloatArray) -> FloatArray:
    """Return the distinct positions along one axis, sorted, (n_distinct,); of those within 1e-6 mm, the least."""
    return distinct_values(axis_mm, within=_SAME_PLACE_MM)


def sign_of_motion(plan: Plan) -> FloatArray:
    """Return the sign of each reading's last motion, (n_points,): along X, or Y where X stays; 0 without motion."""
    along_x, along_y = np.sign(plan.direction_of_motion).T
    return np.asarray(np.where(along_x != 0, along_x, along_y))


def scan_indicator(plan: Plan, names: tuple[str, ...]) -> FloatArray:
    """Return 1.0 for the readings of these scans, 0.0 for the others, (n_points,)."""
    member = np.array([name in names for name in plan.scan_names], dtype=np.float64)
    return np.asarray(member[plan.scan])


def orientation_deg(plan: Plan) -> FloatArray:
    """Return the orientation of each reading, rounded to 1e-6 degrees, (n_points,).

    Orientations of the plan that differ by whole turns become the least of them: 0 and 360 degrees are both 0.
    """
    turned = np.degrees(plan.orientation_rad)
    # Rounded after the turns are taken off, since most decimals have another last digit a turn on; 359.9999999 is 0.
    _, which = np.unique(np.round(turned % 360.0, 6) % 360.0, return_inverse=True)
    recorded = np.round(turned, 6)
    least = np.full(which.max(initial=-1) + 1, np.inf)
    np.minimum.at(least, which, recorded)
    return np.asarray(least[which], dtype=np.float64)


def candidate_scan_groups(plan: Plan) -> tuple[tuple[str, ...], ...]:
    """List groups of scan names as candidates: each mounting (all scans of one orientation) and each single scan.

    Of several recordings that were joined, each mounting of each recording and each whole recording are candidates too:
    the sensor may have been mounted anew in between, or not. A group of all scans is left out, since nothing remains
    for comparison. A scan in which the sensor turns belongs to no mounting.
    """
    turned_deg = orientation_deg(plan)
    sessions = plan.sessions or (0,) * len(plan.scan_names)
    mountings: dict[float, list[str]] = {}
    mountings_of_session: dict[tuple[int, float], list[str]] = {}
    recordings: dict[int, list[str]] = {}
    for name, rows, session in zip(plan.scan_names, plan.rows_by_scan(), sessions, strict=True):
        recordings.setdefault(session, []).append(name)
        angles = np.unique(turned_deg[rows]).tolist()
        if len(angles) == 1:
            mountings.setdefault(angles[0], []).append(name)
            mountings_of_session.setdefault((session, angles[0]), []).append(name)
    singles = [[name] for name in plan.scan_names]
    groups = (*mountings.values(), *singles, *mountings_of_session.values(), *recordings.values())
    found = dict.fromkeys(tuple(dict.fromkeys(names)) for names in groups)
    every = set(plan.scan_names)
    return tuple(group for group in found if set(group) != every)
