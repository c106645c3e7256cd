"""The interface to the arm's motors and sensor, its soft limits, and a dry run that only prints the moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Protocol, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import JOINTS, Geometry
from probewise.arm.instrument import Side
from probewise.errors import ReachError

N_CHECKED = 33  # points checked along a move


class SoftLimits:
    """Allowed range of each joint and of the sensor's height; moves are checked from the motors' last counts."""

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
        """Return the sensor's height at 33 points along a move of one joint to the count `to`, shape (33,).

        `counts` are those of all motors at the start, but for the moving joint's where `here` is given.
        """
        joints = self._geometry.joints
        way = np.empty((N_CHECKED, 3))
        way[:] = [mechanics.angle_at(count) for mechanics, count in zip(joints, counts, strict=True)]
        start = joints[joint].angle_at(counts[joint] if here is None else here)
        way[:, joint] = np.linspace(start, joints[joint].angle_at(to), N_CHECKED)
        return np.asarray(self._geometry.position_mm(way)[:, 2])

    def require_allowed_move(self, joint: int, here: int, to: int) -> None:
        """Raise ReachError if a move of one joint from count `here` to `to` leaves the allowed range.

        The others are at rest. A joint beyond its limits may move back, and a sensor below the lowest height may rise.
        """
        geometry, mechanics = self._geometry, self._geometry.joints[joint]
        angle, start = mechanics.angle_at(to), mechanics.angle_at(here)
        low, high = min(mechanics.low_rad, start), max(mechanics.high_rad, start)
        if not low <= angle <= high:
            allowed = f"{math.degrees(mechanics.low_rad):g} to {math.degrees(mechanics.high_rad):g} degrees"
            raise ReachError(JOINTS[joint], f"{math.degrees(angle):.1f} degrees", allowed)
        heights = self.heights_along_move_mm(self.last_counts, joint, to, here)
        if heights.min() < min(geometry.lowest_mm, float(heights[0])):
            moving = f"the sensor's height while the {JOINTS[joint]} moves"
            allowed = f"{geometry.lowest_mm:g} mm or more; is the arm where its counters say? home it"
            raise ReachError(moving, f"{heights.min():.0f} mm", allowed)


class Machine(Protocol):
    """Three motors and a light sensor; joints 0 to 2: base, shoulder, elbow. The end of `with` releases the motors."""

    limits: SoftLimits

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        """Turn a joint's motor to a count, approaching with the count rising (side 1) or falling (-1), and hold it."""

    def move_near(self, joint: int, goal: int) -> None:
        """Turn a joint's motor approximately to a count, and hold it."""

    def release(self) -> None:
        """Let all motors turn freely."""

    def find_stop(self, joint: int, side: Side) -> None:
        """Turn a joint gently to its stop, angle rising (side 1) or falling (-1); its count becomes `stop_counts`."""

    def reset(self, joints: Sequence[int]) -> None:
        """Set the counters of these joints' motors to 0."""

    def read_percent(self) -> float:
        """Read the light sensor with the LED on: 0 to 100, with fractions."""

    def battery_mv(self) -> float:
        """Read the battery's voltage, in mV."""

    def keep_awake(self) -> None:
        """Keep the machine awake; to be called now and then during minutes of inactivity."""


class DryRun:
    """A dry run: `say` is called with a line per commanded move, and nothing is read."""

    def __init__(self, geometry: Geometry, say: Callable[[str], None]) -> None:
        self._geometry, self._say = geometry, say
        self.limits = SoftLimits(geometry)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        self._check_and_print_move(joint, goal, "up" if side > 0 else "down")

    def move_near(self, joint: int, goal: int) -> None:
        self._check_and_print_move(joint, goal, "roughly")

    def release(self) -> None:
        self._say("release all motors")

    def find_stop(self, joint: int, side: Side) -> None:
        self.limits.record_present_count(joint, self._geometry.joints[joint].stop_counts)
        self._say(f"{JOINTS[joint]:<8} {'up' if side > 0 else 'down'} to its stop")

    def reset(self, joints: Sequence[int]) -> None:
        for joint in joints:
            self.limits.record_present_count(joint, 0)
        self._say(f"set to 0 the counters of {', '.join(JOINTS[joint] for joint in joints)}")

    def read_percent(self) -> float:
        self._say("read the light sensor")
        return math.nan

    def battery_mv(self) -> float:
        """Return NaN: there is no battery."""
        return math.nan

    def keep_awake(self) -> None:
        """Do nothing."""

    def _check_and_print_move(self, joint: int, goal: int, how: str) -> None:
        here = self.limits.last_counts[joint]
        self.limits.require_allowed_move(joint, here, goal)
        self.limits.record_present_count(joint, goal)
        if goal != here:
            angle = math.degrees(self._geometry.joints[joint].angle_at(goal))
            self._say(f"{JOINTS[joint]:<8} to {angle:7.1f} degrees, motor from {here} to {goal} counts, {how}")
