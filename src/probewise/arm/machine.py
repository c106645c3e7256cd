"""The interface to the arm's motors and sensor, and a dry run that only prints the moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Protocol, Self

from probewise.arm.basics import Side
from probewise.arm.geometry import JOINTS, Geometry
from probewise.arm.limits import SoftLimits


class Machine(Protocol):
    """Three motors and a light sensor; joints 0 to 2: base, shoulder, elbow. The end of `with` releases the motors."""

    limits: SoftLimits

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        """Turn a joint's motor to a count, approaching with the count rising (side 1) or falling (-1), and hold it."""
        ...

    def move_near(self, joint: int, goal: int) -> None:
        """Turn a joint's motor approximately to a count, and hold it."""
        ...

    def release(self) -> None:
        """Let all motors turn freely."""
        ...

    def find_stop(self, joint: int, side: Side) -> None:
        """Turn a joint gently to its stop, angle rising (side 1) or falling (-1); its count becomes `stop_counts`."""
        ...

    def reset(self, joints: Sequence[int]) -> None:
        """Set the counters of these joints' motors to 0."""
        ...

    def read_percent(self) -> float:
        """Read the light sensor with the LED on: 0 to 100, with fractions."""
        ...

    def battery_mv(self) -> float:
        """Read the battery's voltage, in mV."""
        ...

    def keep_awake(self) -> None:
        """Keep the machine awake; to be called now and then during minutes of inactivity."""
        ...


class DryRun:
    """A dry run: prints every commanded move, and reads nothing.

    Parameters
    ----------
    geometry
        Geometry of the arm.
    say
        Function called with one line per command.
    """

    def __init__(self, geometry: Geometry, say: Callable[[str], None]) -> None:
        self._geometry, self._say = geometry, say
        self.limits = SoftLimits(geometry)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        """Print the move and record its count; ReachError if it would leave the limits."""
        self._check_and_print_move(joint, goal, "up" if side > 0 else "down")

    def move_near(self, joint: int, goal: int) -> None:
        """Print the move and record its count; ReachError if it would leave the limits."""
        self._check_and_print_move(joint, goal, "roughly")

    def release(self) -> None:
        """Print the command."""
        self._say("release all motors")

    def find_stop(self, joint: int, side: Side) -> None:
        """Print the command and record the count of the stop."""
        self.limits.record_present_count(joint, self._geometry.joints[joint].stop_counts)
        self._say(f"{JOINTS[joint]:<8} {'up' if side > 0 else 'down'} to its stop")

    def reset(self, joints: Sequence[int]) -> None:
        """Print that these counters are set to 0, and record it."""
        for joint in joints:
            self.limits.record_present_count(joint, 0)
        self._say(f"set to 0 the counters of {', '.join(JOINTS[joint] for joint in joints)}")

    def read_percent(self) -> float:
        """Print the command and return NaN: nothing is read."""
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
