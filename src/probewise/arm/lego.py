"""The LEGO arm as an instrument: it moves at travel height, lowers to read, and rises again (paper, test bed)."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise._kinds import checked_finite_number
from probewise._signals import defer_signals
from probewise.arm.geometry import JOINTS, ROOM_COUNTS, Geometry, SoftLimits, wrapped_to_pi
from probewise.arm.instrument import Clock, Pose, Reading, ReadingScale, Side, require_within_reach
from probewise.errors import LinkError, ReachError

if TYPE_CHECKING:
    from probewise.arm.nxt.brick import BrickMachine

BASE, SHOULDER, ELBOW = range(3)
N_RISES = 3  # coarse moves, of which the first one or two may stop short
NEAR_TRAVEL_MM = 10.0  # depth below travel height up to which the sensor counts as raised
CLEAR_MM = 1.0  # depth below its end that a path may reach
N_STEPS_DOWN = 5  # steps of the first lowering
N_TRIED = 361  # angles tried for the path up
SAME_TURN_RAD = math.radians(1.0)
# Duration of a measurement, measured on the emulator: joints move one after another, and each takes time to stop.
COUNTS_S, STOP_S, READ_S = 500.0, 0.9, 4.7


@dataclass(frozen=True)
class JointTarget:
    """Target of a joint: the count of its motor, and the approach (1: with the joint's angle rising, -1: falling)."""

    counts: int
    side: Side


def percent_to_lego_units(percent: float, geometry: Geometry) -> float:
    """Convert the light sensor's percent, 0 to 100, to LEGO units, 1 to 100, as in recordings; NaN stays NaN."""
    if geometry.whole_percent and math.isfinite(percent):
        percent = math.floor(percent)  # the brick truncates fractions
    return ReadingScale(step=1.0 if geometry.whole_percent else None).clip_and_round(percent)


class LegoArm:
    """An instrument: an arm of two links on a turning base, with its sensor looking straight down.

    `machine` moves it, entered and exited with the arm; `clock` gives the times of readings, from `start_s` of an
    earlier run on. `mounted_rad` is the angle, relative to the geometry's, to which a person was last asked to turn the
    sensor on its mount, see `carry_out`; NaN: not known, and taken for 0. `first_down` is called with the height, in
    mm, after each step of the first lowering, and returns when a person has confirmed that height; None: the first
    lowering is one move, like all later ones.
    """

    # A person turns the sensor, and it reads at one height.
    turns = lifts = False

    def __init__(
        self, machine: BrickMachine | DryRun, geometry: Geometry, *, clock: Clock = time, start_s: float = 0.0
    ) -> None:
        self.machine, self.geometry, self._clock = machine, geometry, clock
        self.reach, self.read_height_mm = geometry, geometry.read_height_mm
        self._zero_s = clock.monotonic() - start_s
        self._is_down = False
        self._arrived: list[int] = [0, 0, 0]  # the direction from which each joint reached its position
        self.mounted_rad = 0.0
        self.first_down: Callable[[float], None] | None = None
        self._stop: KeyboardInterrupt | None = None  # held back until a finished reading has been handed over

    def __enter__(self) -> Self:
        self._stop = None
        self.machine.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Raise the sensor if it is down, then release the motors; after an exception, only release them."""
        try:
            if error is None:
                self._raise_held_stop()
            if error is None and self._is_down:
                self.raise_sensor()
        except BaseException as failure:
            self.machine.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self.machine.__exit__(kind, error, trace)

    @property
    def angles_rad(self) -> FloatArray:
        """Joint angles by the motors' counters, shape (3,)."""
        joints, counts = self.geometry.joints, self.machine.limits.last_counts
        return np.array([joints[k].angle_at(counts[k], self._arrived[k]) for k in (BASE, SHOULDER, ELBOW)])

    @property
    def position_mm(self) -> FloatArray:
        """Place and height (x, y, height) of the sensor's face by the motors' counters, lab frame, shape (3,)."""
        return np.asarray(self.geometry.position_mm(self.angles_rad[None, :])[0])

    def orientation_rad(self, places_mm: FloatArray) -> FloatArray:
        """Return the sensor's orientation at places, (n_places, 2), its turn by hand included: shape (n_places,)."""
        return wrapped_to_pi(self.geometry.orientation_rad(places_mm) + np.nan_to_num(self.mounted_rad))

    def reachable(self, places_mm: FloatArray) -> BoolArray:
        return self.geometry.contains(places_mm)

    def travel_s(self, start: Pose, places_mm: FloatArray) -> FloatArray:
        """Estimate the seconds to move from `start` to each place and read, shape (n_places,); NaN out of reach."""
        there = self.geometry.angles_rad(places_mm, self.geometry.travel_height_mm)
        here = self.geometry.angles_rad(np.array([[start.x_mm, start.y_mm]]), self.geometry.travel_height_mm)
        counts = np.abs(there - here) * [abs(joint.counts_per_rad) for joint in self.geometry.joints]
        return np.asarray(np.where(counts < 1, 0.0, counts / COUNTS_S + STOP_S).sum(axis=-1) + READ_S)

    def measure(self, pose: Pose) -> Reading:
        """Move to a pose, lower the sensor, read it, and raise it.

        Returns the reading, with the actual pose by the motors' counters, and the covariates `battery_mv` and
        `height_mm`: the geometry's `read_height_mm`, as in files of recordings, from which that by the counters,
        `position_mm[2]`, differs by some tenths of a millimetre. A KeyboardInterrupt while the sensor rises releases
        the motors at once, but the reading is returned: the next `measure`, or the end of `with`, raises it.

        Raises ReachError if the arm cannot reach the place, or has another orientation or height there (nothing moves),
        or if the sensor cannot rise from where it is; LinkError if the brick does not answer, or a motor does not move,
        before the reading is taken.
        """
        self._raise_held_stop()
        place = np.array([[pose.x_mm, pose.y_mm]])
        require_within_reach(self.geometry, place, "pose")
        if pose.height_mm not in (None, self.geometry.read_height_mm):
            allowed = f"{self.geometry.read_height_mm:g}, at which this arm reads, or None"
            raise ReachError("height_mm", pose.height_mm, allowed)
        stands = float(self.orientation_rad(place)[0])
        if not abs(float(wrapped_to_pi(np.array(pose.orientation_rad - stands)))) <= SAME_TURN_RAD:
            allowed = f"{stands:.4f} at this place: this arm has no wrist, its sensor turns with the base"
            raise ReachError("orientation_rad", pose.orientation_rad, allowed)
        self.go_down(pose.x_mm, pose.y_mm)
        battery_mv = self.machine.battery_mv()  # first, so that no failure loses the reading
        value = self.read_here()
        time_s = self._clock.monotonic() - self._zero_s
        covariates = {"height_mm": self.geometry.read_height_mm, "battery_mv": battery_mv}
        angles = self.angles_rad
        x_mm, y_mm, _ = self.geometry.position_mm(angles[None, :])[0].tolist()
        turned_rad = wrapped_to_pi(
            self.geometry.mounting_rad + angles[BASE] - math.pi / 2 + np.nan_to_num(self.mounted_rad)
        )
        reading = Reading(value, Pose(x_mm, y_mm, float(turned_rad)), time_s, covariates)
        try:
            # A connection lost now is noticed at the next move, which starts with raising.
            with contextlib.suppress(LinkError):
                self.raise_sensor()
        except KeyboardInterrupt as stop:
            try:
                with defer_signals():
                    self.release()
            except LinkError:
                raise stop from None  # a motor may turn: the end of `with` stops it by other means
            self._stop = stop
        return reading

    def _raise_held_stop(self) -> None:
        stop, self._stop = self._stop, None
        if stop is not None:
            raise stop

    def go_over(self, x_mm: float, y_mm: float) -> None:
        """Move the sensor over a place, at about travel height; ReachError if the place is out of reach."""
        goals = self._goals_at_place(x_mm, y_mm, self.geometry.travel_height_mm)
        self.raise_sensor()
        self._turn_joint_to(BASE, goals[BASE])
        for joint in self._choose_link_order(goals):
            self._move_joint_near(joint, goals[joint].counts)

    def go_down(self, x_mm: float, y_mm: float, height_mm: float | None = None) -> None:
        """Move the sensor over a place and lower it, by default to reading height; ReachError if out of reach.

        If `first_down` is set, the first lowering is in steps, and `first_down` is called after each.
        """
        travel_mm = self.geometry.travel_height_mm
        end_mm = self.geometry.read_height_mm if height_mm is None else height_mm
        if self.first_down is not None and end_mm < travel_mm:
            ask, self.first_down = self.first_down, None
            for step_mm in np.linspace(travel_mm, end_mm, N_STEPS_DOWN + 1)[:-1].tolist():
                self._lower_to(x_mm, y_mm, step_mm)
                ask(step_mm)
        self._lower_to(x_mm, y_mm, end_mm)

    def _lower_to(self, x_mm: float, y_mm: float, height_mm: float) -> None:
        goals = self._goals_at_place(x_mm, y_mm, height_mm)
        self.raise_sensor()
        self._turn_all_to(goals, lowers=True)

    def raise_sensor(self) -> None:
        """Raise the sensor, if lower, to about travel height by the link that needs less turn; else ReachError."""
        for _ in range(N_RISES):
            if self.position_mm[2] >= self.geometry.travel_height_mm - NEAR_TRAVEL_MM:
                break
            ways = [way for joint in (SHOULDER, ELBOW) if (way := self._plan_raise_by_one_link(joint)) is not None]
            if not ways:
                stand = np.degrees(self.angles_rad).round(1).tolist()
                raise ReachError("joints", stand, "angles from which the sensor can rise; bring the arm home by hand")
            _, joint, goal = min(ways)
            self._move_joint_near(joint, goal)
        self._is_down = False

    def home(self) -> None:
        """Move all joints home (counter 0); joints with a stop first turn to the stop, which sets their counters.

        The links find their stops before the base, so that the sensor is up when the base turns. Raises LinkError if a
        joint meets no stop, or the brick does not answer; ReachError if the sensor cannot rise from where the links
        are.
        """
        stopped = []
        for joint in (ELBOW, SHOULDER, BASE):
            side = self.geometry.joints[joint].stop_side
            if side is not None:
                self.machine.find_stop(joint, side)
                self._arrived[joint] = side
                stopped.append(joint)
        self.raise_sensor()
        homes = np.array([joint.home_rad for joint in self.geometry.joints])
        goals = [JointTarget(0, side) for side in self._approach_sides_of(homes)]
        self._turn_all_to(goals)
        if stopped:
            self.machine.reset(stopped)

    def set_home(self) -> None:
        """Define the current position, set by hand, as home: set all counters to 0."""
        self.machine.reset((BASE, SHOULDER, ELBOW))
        self._arrived = [0, 0, 0]

    def release(self) -> None:
        """Let all joints move freely."""
        self.machine.release()
        self._arrived = [0, 0, 0]

    def read_here(self) -> float:
        """Read the sensor at its current place, in LEGO units, as in recordings."""
        return percent_to_lego_units(self.machine.read_percent(), self.geometry)

    def keep_awake(self) -> None:
        """Keep the brick from falling asleep; call it now and then during minutes of inactivity."""
        self.machine.keep_awake()

    def turn_joint(self, joint: int, by_rad: float) -> None:
        """Turn one joint (0 to 2: base, shoulder, elbow) by a finite angle; ReachError if it would leave its limits."""
        angles = self.angles_rad
        angles[joint] += checked_finite_number("by_rad", by_rad)
        self._turn_joint_to(joint, self._goals_at_angles(angles)[joint])

    def _goals_at_place(self, x_mm: float, y_mm: float, height_mm: float) -> list[JointTarget]:
        angles = self.geometry.angles_rad(np.array([[x_mm, y_mm]]), height_mm)[0]
        if not np.isfinite(angles).all():
            raise ReachError("the place (mm)", (round(x_mm, 1), round(y_mm, 1)), self.geometry.sentence())
        return self._goals_at_angles(angles)

    def _goals_at_angles(self, angles_rad: FloatArray) -> list[JointTarget]:
        sides = self._approach_sides_of(angles_rad)
        rows = zip(self.geometry.joints, angles_rad, sides, strict=True)
        return [JointTarget(joint.counts_at(float(angle), side), side) for joint, angle, side in rows]

    def _approach_sides_of(self, angles_rad: FloatArray) -> tuple[Side, Side, Side]:
        """Return for each joint whether it approaches these angles, (3,), with its angle rising (1) or falling (-1).

        The links approach a place from above, so that their weight and their motors take up the play in the same
        direction; the base always approaches with its angle rising.
        """
        _, shoulder, elbow = self.geometry.height_slopes_mm_rad(angles_rad[None, :])[0]
        return 1, (-1 if shoulder > 0 else 1), (-1 if elbow > 0 else 1)

    def _choose_link_order(self, goals: Sequence[JointTarget]) -> tuple[int, int]:
        """Return the two links (joint numbers) in the order of moving in which the sensor stays higher on the way.

        If it would go below its target height in either order, the upper link is first moved to the vertical.
        """
        orders = [(SHOULDER, ELBOW), (ELBOW, SHOULDER)]
        ways = [[(joint, goals[joint].counts) for joint in order] for order in orders]
        lowest_mm = [self._heights_along_mm(way).min() for way in ways]
        if max(lowest_mm) > self._heights_along_mm(ways[0])[-1] - CLEAR_MM:
            return orders[int(np.argmax(lowest_mm))]
        self._move_joint_near(SHOULDER, self.geometry.shoulder.counts_at(math.pi / 2))
        return ELBOW, SHOULDER

    def _heights_along_mm(self, way: Sequence[tuple[int, int]]) -> FloatArray:
        """Return the sensor's heights, (n,), along successive moves (joint, target count) from the current counts."""
        counts = list(self.machine.limits.last_counts)
        heights = []
        for joint, goal in way:
            heights.append(self.machine.limits.heights_along_move_mm(counts, joint, goal))
            counts[joint] = goal
        return np.concatenate(heights)

    def _plan_raise_by_one_link(self, joint: int) -> tuple[int, int, int] | None:
        """Return how one link alone can raise the sensor: counts to turn, joint, target count; None if it cannot."""
        mechanics, stand = self.geometry.joints[joint], self.angles_rad
        up = mechanics.low_rad if self._approach_sides_of(stand)[joint] > 0 else mechanics.high_rad
        angles = np.tile(stand, (N_TRIED, 1))
        angles[:, joint] = np.linspace(stand[joint], up, N_TRIED)
        high_enough = np.flatnonzero(self.geometry.position_mm(angles)[:, 2] >= self.geometry.travel_height_mm)
        if not high_enough.size:
            return None
        here = self.machine.limits.last_counts[joint]
        way = mechanics.counts_at(float(angles[high_enough[0], joint]), self._arrived[joint]) - here
        # A coarse move shorter than the motor's overrun would not be made.
        far = int(math.copysign(max(abs(way), ROOM_COUNTS), way))
        end = sorted(mechanics.counts_at(angle) - here for angle in (mechanics.low_rad, mechanics.high_rad))
        return abs(way), joint, here + min(max(far, end[0]), end[1])

    def _turn_all_to(self, goals: Sequence[JointTarget], *, lowers: bool = False) -> None:
        self._turn_joint_to(BASE, goals[BASE])
        self._is_down = self._is_down or lowers
        for joint in self._choose_link_order(goals):
            self._turn_joint_to(joint, goals[joint])

    def _turn_joint_to(self, joint: int, goal: JointTarget) -> None:
        side: Side = 1 if (goal.side > 0) == (self.geometry.joints[joint].gear_ratio > 0) else -1
        self.machine.move_to(joint, goal.counts, side)
        self._arrived[joint] = goal.side

    def _move_joint_near(self, joint: int, counts: int) -> None:
        self.machine.move_near(joint, counts)
        self._arrived[joint] = 0


class DryRun:
    """A machine of which nothing moves: `say` is called with a line per commanded move, and nothing is read."""

    def __init__(self, geometry: Geometry, say: Callable[[str], None]) -> None:
        self._geometry, self._say = geometry, say
        self.limits = SoftLimits(geometry)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        self._check_and_print_move(joint, goal, f"exact, from {'below' if side > 0 else 'above'}")

    def move_near(self, joint: int, goal: int) -> None:
        self._check_and_print_move(joint, goal, "to within some counts")

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
