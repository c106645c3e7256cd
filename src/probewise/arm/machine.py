"""What moves the arm's joints and reads its sensor: a seam, and a rehearsal that only says what it would do."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Protocol, Self

from probewise.arm.basics import Side
from probewise.arm.geometry import JOINTS, Geometry
from probewise.arm.limits import SoftLimits

__all__ = ["Machine", "Rehearsal"]


class Machine(Protocol):
    """Three motors and a light sensor; joints are 0 to 2, base, shoulder, elbow. Leaving the block releases them."""

    limits: SoftLimits

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        """Turn a joint's motor to a count, arriving in direction `side`, and hold it."""
        ...

    def move_near(self, joint: int, goal: int) -> None:
        """Turn a joint's motor to about a count, and hold it."""
        ...

    def release(self) -> None:
        """Let all motors turn freely."""
        ...

    def find_stop(self, joint: int, side: Side) -> None:
        """Turn a joint gently in direction `side` until it meets its stop, and take its counts from there."""
        ...

    def reset(self, joints: Sequence[int]) -> None:
        """Take where these joints' motors stand for 0."""
        ...

    def read_percent(self) -> float:
        """Read the light sensor, LED on: 0 to 100 in all steps that it has."""
        ...

    def battery_mv(self) -> float:
        """Read the battery's voltage."""
        ...

    def keep_awake(self) -> None:
        """Be called now and then while nothing else happens for minutes."""
        ...


class Rehearsal:
    """A machine of words: says every move that it is asked for, and reads nothing.

    Parameters
    ----------
    geometry
        The arm's.
    say
        Gets a line a move.
    """

    def __init__(self, geometry: Geometry, say: Callable[[str], None]) -> None:
        self._geometry, self._say = geometry, say
        self.limits = SoftLimits(geometry)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        """Say it."""
        self._move(joint, goal, "up" if side > 0 else "down")

    def move_near(self, joint: int, goal: int) -> None:
        """Say it."""
        self._move(joint, goal, "roughly")

    def release(self) -> None:
        """Say it."""
        self._say("release all motors")

    def find_stop(self, joint: int, side: Side) -> None:
        """Say it."""
        self.limits.stands(joint, self._geometry.joints[joint].stop_counts)
        self._say(f"{JOINTS[joint]:<8} {'up' if side > 0 else 'down'} to its stop")

    def reset(self, joints: Sequence[int]) -> None:
        """Take where these stand for 0."""
        for joint in joints:
            self.limits.stands(joint, 0)
        self._say(f"set to 0 the counters of {', '.join(JOINTS[joint] for joint in joints)}")

    def read_percent(self) -> float:
        """Say it; nothing is read."""
        self._say("read the light sensor")
        return math.nan

    def battery_mv(self) -> float:
        """No battery."""
        return math.nan

    def keep_awake(self) -> None:
        """Nobody falls asleep."""

    def _move(self, joint: int, goal: int, how: str) -> None:
        here = self.limits.counts[joint]
        self.limits.check(joint, here, goal)
        self.limits.stands(joint, goal)
        if goal != here:
            angle = math.degrees(self._geometry.joints[joint].angle_at(goal))
            self._say(f"{JOINTS[joint]:<8} to {angle:7.1f} degrees, motor from {here} to {goal} counts, {how}")
