"""Soft limits: they refuse every motor command that would take a joint or the sensor out of its allowed range."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import JOINTS, Geometry
from probewise.errors import ReachError

N_CHECKED = 33  # points checked along a move


class SoftLimits:
    """Allowed range of each joint and of the sensor's height; moves are checked from the motors' last counts.

    Parameters
    ----------
    geometry
        Limits of the joints, and the lowest height of the sensor.
    """

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._counts = [0, 0, 0]

    def record_present_count(self, joint: int, count: int) -> None:
        """Record the present count of one joint's motor."""
        self._counts[joint] = count

    @property
    def last_counts(self) -> tuple[int, int, int]:
        """Last recorded counts of the motors: base, shoulder, elbow; 0 at the start."""
        base, shoulder, elbow = self._counts
        return base, shoulder, elbow

    def heights_along_move_mm(self, counts: Sequence[int], joint: int, to: int, here: int | None = None) -> FloatArray:
        """Return the sensor's height at 33 points along a move of one joint, shape (33,).

        Parameters
        ----------
        counts
            Counts of all motors at the start.
        joint, to
            The joint that moves, and its target count.
        here
            Starting count of that joint; None: as in `counts`.
        """
        joints = self._geometry.joints
        way = np.empty((N_CHECKED, 3))
        way[:] = [mechanics.angle_at(count) for mechanics, count in zip(joints, counts, strict=True)]
        start = joints[joint].angle_at(counts[joint] if here is None else here)
        way[:, joint] = np.linspace(start, joints[joint].angle_at(to), N_CHECKED)
        return np.asarray(self._geometry.position_mm(way)[:, 2])

    def require_allowed_move(self, joint: int, here: int, to: int) -> None:
        """Raise ReachError if a move of one joint, the others at rest, leaves the allowed range.

        `here` and `to` are the counts of the joint's motor at start and end. A joint beyond its limits may move back,
        and a sensor below the lowest height may rise.

        Raises
        ------
        ReachError
            If the move is refused.
        """
        geometry, mechanics = self._geometry, self._geometry.joints[joint]
        angle, start = mechanics.angle_at(to), mechanics.angle_at(here)
        low, high = min(mechanics.low_rad, start), max(mechanics.high_rad, start)
        if not low <= angle <= high:
            raise ReachError(
                JOINTS[joint],
                f"{math.degrees(angle):.1f} degrees",
                f"{math.degrees(mechanics.low_rad):g} to {math.degrees(mechanics.high_rad):g} degrees",
            )
        heights = self.heights_along_move_mm(self.last_counts, joint, to, here)
        floor = min(geometry.lowest_mm, float(heights[0]))
        if heights.min() < floor:
            raise ReachError(
                f"the sensor's height while the {JOINTS[joint]} moves",
                f"{heights.min():.0f} mm",
                f"{geometry.lowest_mm:g} mm or more; is the arm where its counters say? home it",
            )
