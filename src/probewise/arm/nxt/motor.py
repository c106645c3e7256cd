"""A motor that turns to a count and holds it, although the brick's firmware only limits the turn and cuts the power.

The firmware counts a limited move from its own running *target*, not from the motor's position; at the target it cuts
the power, and the motor *coasts* by some counts. So the target is tracked here, the coast is learned by direction and
power, and every move is computed from the last count: a fast move that stops short, then slow ones in the direction of
approach, which take up the play of the gears. Telegrams have no checksum: an unexpected state is read again, and
accepted once two successive answers agree.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from probewise.arm.instrument import Clock, Side
from probewise.arm.nxt import telegram as nxt
from probewise.arm.nxt.link import Link, NoAnswerError
from probewise.errors import LinkError

Guard: TypeAlias = Callable[[int, int], None]
"""Function that raises ReachError if the motor must not go from one rotation count to another."""

COUNTS_S = 10.0  # counts per second and unit of power
STUCK, BEYOND = "is stuck at", "runs on beyond its goal, to"
FAINT_POWER = 1  # a motor needs about 8 to overcome its own friction
BRAKED = nxt.MOTOR_ON | nxt.BRAKE
DRIVEN = BRAKED | nxt.REGULATED
N_ASKED = 6  # largest number of queries until two successive states agree
N_UNTAKEN = 3  # successive commands ignored by the brick after which a move fails


class MotorError(LinkError):
    """Raised for a motor that is stuck, slipping or not plugged in, or whose reported states contradict each other."""


@dataclass(frozen=True)
class DriveParameters:
    """Parameters of driving a motor; counts are degrees of its shaft, a unit of power is about 10 counts/s."""

    fast_power: int = 60
    slow_power: int = 15  # of the final approach
    seek_power: int = 30  # towards a mechanical stop, unregulated: low enough to limit the force on it
    coast_counts: int = 60  # first estimate after a fast move; for slow moves in proportion to the power
    tolerance_counts: int = 1  # largest distance from the goal that counts as reached
    lead_counts: int = 30  # least distance to back off, to approach from the right side; more than the play
    runaway_counts: int = 100  # overrun at which a motor is stopped
    settle_s: float = 0.2  # from stopping until the count is read
    stuck_s: float = 1.5  # without a change of count after which a running motor is stuck
    n_moves: int = 12  # for one goal


class Motor:
    """One motor of a brick, at port 0 to 2 for A to C.

    `guard` refuses moves by raising ReachError; None: no limits. `drive` None is for a lightly loaded motor.
    `last_counts` is the last value read of the rotation counter; 0 at first.
    """

    def __init__(
        self,
        link: Link,
        port: int,
        *,
        guard: Guard | None = None,
        drive: DriveParameters | None = None,
        clock: Clock = time,
    ) -> None:
        self._link, self.port, self._guard, self._clock = link, port, guard, clock
        self.drive = DriveParameters() if drive is None else drive
        self.last_counts = 0
        self._target: int | None = None  # the firmware's target, in rotation counts; None: unknown
        self._offsets: tuple[int, int] | None = None  # tacho counter minus rotation and minus block counter
        self._n_untaken = 0  # moves in a row
        self._arrived: Side | None = None  # the direction of its last approach
        self._coast: dict[tuple[int, Side], float] = {}

    @property
    def letter(self) -> str:
        """The port's letter on the brick."""
        return "ABC"[self.port]

    def counts(self) -> int:
        """Read the rotation counter."""
        return self._read_confirmed_state().rotation_counts

    def reset_counter(self) -> None:
        """Set the rotation counter to 0."""
        state = self._read_confirmed_state()
        self._link.ask(nxt.reset_rotation_counter(self.port))
        if self._target is not None:
            self._target -= state.rotation_counts
        self._offsets = state.tacho_counts, state.tacho_counts - state.block_counts

    def hold(self) -> None:
        """Stop the motor and hold its position against a load."""
        self._link.ask(nxt.set_output_state(self.port, 0, DRIVEN, nxt.BY_SPEED, run_state=nxt.RUNNING))

    def stop_and_settle(self) -> int:
        """Stop and hold the motor; return its count once it has settled."""
        self.hold()
        self._clock.sleep(self.drive.settle_s)
        return self.counts()

    def release(self) -> None:
        """Let the motor turn freely."""
        self._link.ask(nxt.set_output_state(self.port))
        self._arrived = None

    def move_to(self, goal: int, side: Side) -> int:
        """Turn to a count, approaching with the count rising (side 1) or falling (-1), and hold the motor there.

        Return the count at rest, within the tolerance of the goal. ReachError if the guard refuses a move, which is
        then not made; MotorError if the motor does not reach the goal.
        """
        here = self.counts()
        for _ in range(self.drive.n_moves):
            if self._target is None:
                here = self._find_firmware_target()
            ahead = side * (goal - here)
            if abs(ahead) <= self.drive.tolerance_counts and self._arrived == side:
                return here
            move = self._approach_goal if ahead >= self.drive.lead_counts else self._back_off_behind_goal
            here = move(goal, side, here)
        missed = f"stands at {here} counts, not within {self.drive.tolerance_counts} of {goal}"
        raise self._error(f"{missed}, after {self.drive.n_moves} moves; is something in its way, or a gear slipping?")

    def move_near(self, goal: int) -> int:
        """Turn near a count by one fast move (none if it would overrun); return the count at rest."""
        here = self.counts()
        side: Side = 1 if goal >= here else -1
        if self._target is None:
            here = self._find_firmware_target()
        target = goal - side * self._coast_counts(self.drive.fast_power, side)
        if min(side * (target - here), side * (target - self._checked_target)) > 0:
            here = self._make_limited_move(target, side, self.drive.fast_power, here)
        return here

    def find_stop(self, side: Side, farthest: int) -> int:
        """Turn gently, count rising (side 1) or falling (-1), until a stop is met, and hold; return the count there.

        Limits are not checked. MotorError if the motor meets no stop within `farthest` counts.
        """
        start = self._find_firmware_target()
        power = side * self.drive.seek_power
        while not self._try_to_start_limited_move(start + side * farthest, side, power, farthest, gently=True):
            start = self._find_firmware_target()
        target, far = start + side * farthest, side * (farthest + self.drive.runaway_counts)
        trouble = self._await_idle_or_trouble(start, far, target)
        here = self.stop_and_settle()
        self._target = None  # it lies behind the stop
        if trouble != STUCK:
            raise self._error(f"met no stop within {farthest} counts; is it plugged in, its gear whole?")
        return here

    @property
    def _checked_target(self) -> int:
        if self._target is None:
            raise MotorError(f"motor {self.letter}: its counters jumped; did a program start on the brick?")
        return self._target

    def _error(self, text: str) -> MotorError:
        return MotorError(f"motor {self.letter} {text}")

    def _approach_goal(self, goal: int, side: Side, here: int) -> int:
        """Move towards the goal, fast to well short of it or slowly all the way; return the count."""
        fast, slow = self.drive.fast_power, self.drive.slow_power
        target = goal - side * self._coast_counts(slow, side)
        if side * self._checked_target >= side * target:
            # A target left by a move in the other direction would lead beyond the goal.
            here = self._find_firmware_target()
        short = goal - side * (2 * self.drive.lead_counts + self._coast_counts(fast, side))
        return self._move(side, here, short, target)

    def _back_off_behind_goal(self, goal: int, side: Side, here: int) -> int:
        """Back off behind the goal, far enough for a slow move to start and take up the play; return the count."""
        back: Side = 1 if side == -1 else -1
        behind = goal - side * (self._coast_counts(self.drive.slow_power, side) + 2 * self.drive.lead_counts)
        return self._move(back, here, behind + side * self._coast_counts(self.drive.fast_power, back), behind)

    def _move(self, side: Side, here: int, fast_target: int, slow_target: int) -> int:
        least = max(side * here, side * self._checked_target) + 1  # a target behind this position causes no motion
        if side * fast_target > least + self.drive.lead_counts:
            return self._make_limited_move(fast_target, side, self.drive.fast_power, here)
        return self._make_limited_move(side * max(side * slow_target, least), side, self.drive.slow_power, here)

    def _coast_counts(self, power: int, side: Side) -> int:
        return round(self._coast.get((power, side), (power / self.drive.fast_power) * self.drive.coast_counts))

    def _make_limited_move(self, target: int, side: Side, power: int, here: int) -> int:
        """Make one limited move to a firmware target; return the count at rest. MotorError if stuck or overrunning."""
        stop = target + side * self._coast_counts(power, side)
        if self._guard is not None:
            self._guard(here, stop)
        limit = side * (target - self._checked_target)
        if not self._try_to_start_limited_move(target, side, side * power, limit):
            return self.stop_and_settle()
        self._clock.sleep(max(side * (target - here), 0) / (COUNTS_S * power))
        trouble = self._await_idle_or_trouble(here, stop + side * self.drive.runaway_counts - here, target)
        here = self.stop_and_settle()
        if trouble:
            self._target = None
            raise self._error(f"{trouble} {here} counts at power {power}; is it plugged in, and its way free?")
        ran_on = side * (here - target)
        if ran_on < -self.drive.tolerance_counts:
            self._target = None  # it stopped short of the target, which must be elsewhere
            return here
        self._coast[power, side] = (self._coast.get((power, side), ran_on) + ran_on) / 2
        return here

    def _try_to_start_limited_move(
        self, target: int, side: Side, power: int, limit: int, *, gently: bool = False
    ) -> bool:
        """Command a limited move, exactly once; return whether the brick accepted it; at the third refusal raise."""
        mode, regulation = (BRAKED, 0) if gently else (DRIVEN, nxt.BY_SPEED)
        try:
            self._link.ask(
                nxt.set_output_state(self.port, power, mode, regulation, run_state=nxt.RUNNING, limit_counts=limit)
            )
        except (NoAnswerError, nxt.TelegramError, nxt.BrickError) as error:
            # Holding sets the limit to 0 after every move, so this limit confirms that the brick accepted the command.
            took = self._read_confirmed_state(lambda state: False).limit_counts == limit
            if not took or self._target is None:
                self._n_untaken += 1
                if self._n_untaken >= N_UNTAKEN:
                    raise error
                return False
        self._n_untaken = 0
        self._target = target
        self._arrived = side
        return True

    def _find_firmware_target(self) -> int:
        """Drive the motor without a limit, so that the firmware's target becomes its count; stop, return the count.

        The power is too little to turn the motor, so that a lost connection or a repeated command does no harm.
        """

        def has_faint_power(state: nxt.OutputState) -> bool:
            return (state.power, state.run_state, state.limit_counts) == (FAINT_POWER, nxt.RUNNING, 0)

        self._link.ask(nxt.set_output_state(self.port, FAINT_POWER, BRAKED, run_state=nxt.RUNNING))
        self._clock.sleep(self.drive.settle_s)
        state = self._read_confirmed_state(has_faint_power)
        if not has_faint_power(state):
            raise self._error("does not keep the power it was set to; does a program run on the brick?")
        self._target = state.rotation_counts
        return self.stop_and_settle()

    def _await_idle_or_trouble(self, start: int, farthest: int, target: int) -> str:
        """Wait for a limited move to end; return `STUCK` or `BEYOND` if the motor sticks or overruns, otherwise ""."""
        side = 1 if farthest > 0 else -1

        def is_plausible(state: nxt.OutputState) -> bool:
            # The firmware releases a motor at its target, not before.
            return state.run_state == nxt.RUNNING or side * (state.rotation_counts - target) >= 0

        here, changed_at = start, self._clock.monotonic()
        while (state := self._read_confirmed_state(is_plausible)).run_state != nxt.IDLE:
            now = self._clock.monotonic()
            if state.rotation_counts != here:
                here, changed_at = state.rotation_counts, now
            if abs(here - start) > abs(farthest):
                return BEYOND
            if now - changed_at > self.drive.stuck_s:
                return STUCK
        return ""

    def _read_confirmed_state(
        self, is_plausible: Callable[[nxt.OutputState], bool] = lambda state: True
    ) -> nxt.OutputState:
        """Read the motor's state; if it is implausible or one counter jumped, read until two successive states agree.

        A corrupted byte changes one of the three counters but not the others.
        """
        state, before = self._read_state(), None
        n_asked = 1
        while (_counter_offsets(state) != self._offsets or not is_plausible(state)) and _constant_fields(
            state
        ) != before:
            if n_asked == N_ASKED:
                raise self._error(f"reports another state each of {N_ASKED} times; is the brick near?")
            before, state = _constant_fields(state), self._read_state()
            n_asked += 1
        self.last_counts = state.rotation_counts
        if _counter_offsets(state) != self._offsets:
            # Another program reset a counter: the known target is void.
            self._target, self._offsets = None, _counter_offsets(state)
        return state

    def _read_state(self) -> nxt.OutputState:
        return self._link.ask(nxt.get_output_state(self.port))


def _counter_offsets(state: nxt.OutputState) -> tuple[int, int]:
    """Return the tacho counter minus the rotation and minus the block counter; motion does not change either."""
    return state.tacho_counts - state.rotation_counts, state.tacho_counts - state.block_counts


def _constant_fields(state: nxt.OutputState) -> tuple[object, ...]:
    """Return the fields, and differences of counters, that do not change while a motor turns."""
    return _counter_offsets(state), state.power, state.mode, state.regulation, state.run_state, state.limit_counts
