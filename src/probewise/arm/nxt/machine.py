"""The machine interface on a brick: the arm's three motors with their soft limits, and its light sensor."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import partial
from types import TracebackType
from typing import Self

from probewise.arm.basics import Side
from probewise.arm.geometry import ROOM_COUNTS, Geometry
from probewise.arm.limits import SoftLimits
from probewise.arm.nxt.brick import Brick
from probewise.arm.nxt.motor import Motor


class BrickMachine:
    """A brick wired as in the arm's geometry.

    Parameters
    ----------
    brick
        The brick.
    geometry
        Ports of motors and sensor, and the limits.
    """

    def __init__(self, brick: Brick, geometry: Geometry) -> None:
        self.brick = brick
        self.limits = SoftLimits(geometry)
        self._joints = geometry.joints
        self._zeros = [0] * 3  # counts at home; not 0 between finding a stop and the next reset
        self._motors = [
            brick.motor(joint.port, guard=partial(self._require_allowed_move, k))
            for k, joint in enumerate(self._joints)
        ]
        self._light = brick.light_sensor(geometry.sensor_port)

    def __enter__(self) -> Self:
        self.brick.__enter__()
        try:
            for joint, motor in enumerate(self._motors):
                # An earlier session that lost its connection may have left a motor turning.
                self.limits.record_present_count(joint, motor.stop_and_settle())
        except BaseException as error:
            self.brick.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop and release the motors."""
        self.brick.__exit__(kind, error, trace)

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        """Turn a joint's motor to a count from home, approaching with the count rising (side 1) or falling (-1)."""
        with self._recording_counts(joint) as motor:
            motor.move_to(goal + self._zeros[joint], side)

    def move_near(self, joint: int, goal: int) -> None:
        """Turn a joint's motor approximately to a count from home, and hold it; see `Motor.move_near`."""
        with self._recording_counts(joint) as motor:
            motor.move_near(goal + self._zeros[joint])

    def release(self) -> None:
        """Let all motors turn freely; turns by hand are noticed at the next move."""
        for motor in self._motors:
            motor.release()

    def find_stop(self, joint: int, side: Side) -> None:
        """Turn a joint gently to its stop, angle rising (side 1) or falling (-1); its count becomes `stop_counts`."""
        mechanics = self._joints[joint]
        motor = self._motors[joint]
        with_gears: Side = side if mechanics.gear_ratio > 0 else -side
        at_stop = mechanics.stop_counts
        far_limit_rad = mechanics.low_rad if side > 0 else mechanics.high_rad
        range_counts = (mechanics.high_rad - mechanics.low_rad) * abs(mechanics.counts_per_rad)
        way_counts = abs(at_stop - mechanics.counts_at(far_limit_rad))  # more, if the stop is well beyond its limit
        found = motor.find_stop(with_gears, max(round(range_counts) + 2 * ROOM_COUNTS, way_counts + ROOM_COUNTS))
        self._zeros[joint] = found - at_stop
        self.limits.record_present_count(joint, at_stop)

    def reset(self, joints: Sequence[int]) -> None:
        """Set the counters of these joints' motors to 0."""
        for joint in joints:
            self._motors[joint].reset_counter()
            self._zeros[joint] = 0
            self.limits.record_present_count(joint, 0)

    def read_percent(self) -> float:
        """Flash the light sensor's LED and read: 0 to 100, with fractions."""
        return self._light.flash().fine_percent

    def battery_mv(self) -> float:
        """Read the battery's voltage, in mV."""
        return self.brick.battery_mv()

    def keep_awake(self) -> None:
        """Keep the brick from falling asleep."""
        self.brick.link.keep_awake()

    @contextlib.contextmanager
    def _recording_counts(self, joint: int) -> Iterator[Motor]:
        """Yield a joint's motor, then record its last count in `limits`, also after a failed move."""
        motor = self._motors[joint]
        try:
            yield motor
        finally:
            self.limits.record_present_count(joint, motor.last_counts - self._zeros[joint])

    def _require_allowed_move(self, joint: int, here: int, to: int) -> None:
        """Raise ReachError if the limits, in counts from home, refuse a move between values of a motor's counter."""
        self.limits.require_allowed_move(joint, here - self._zeros[joint], to - self._zeros[joint])
