"""Turn a motor to a count and keep it there, given what the brick's firmware does with a limit.

The firmware counts a limited move from its own running *target*, not from where the motor
stands; at the target it lets go, and the motor runs on, *coasts*, by some counts. So the
target is kept track of here, the coast is learned by direction and power, and every move is
worked out from the count that was read last: a fast move that stops short, slow ones for the
rest, always arriving from the same side, so that the play in the gears always lies on the same flank.

No telegram has a checksum. A state that surprises is therefore asked for again, and believed once two in a
row say the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from probewise.arm.basics import Clock, Side
from probewise.arm.nxt.link import Link, NoAnswerError
from probewise.arm.nxt.status import BrickError
from probewise.arm.nxt.telegram import (
    GetOutputState,
    OutputMode,
    OutputState,
    Regulation,
    ResetMotorPosition,
    RunState,
    SetOutputState,
)
from probewise.arm.nxt.wire import TelegramError
from probewise.errors import LinkError, ParameterError

__all__ = ["Drive", "Guard", "Motor", "MotorError"]

Guard: TypeAlias = Callable[[int, int], None]
"""Raises ReachError where the motor may not go from one rotation count to another."""

COUNTS_S = 10.0  # that one unit of power stands for
STUCK, BEYOND = "is stuck at", "runs on beyond its goal, to"
FAINT_POWER = 1  # a motor needs some 8 to overcome its own friction
BRAKED = OutputMode.ON | OutputMode.BRAKE
DRIVEN = BRAKED | OutputMode.REGULATED
N_ASKED = 6  # so often at most, until two states in a row say the same
N_UNTAKEN = 3  # so many moves in a row that the brick does not take end it


class MotorError(LinkError):
    """Report a motor that does not get where it is sent: stuck, slipping, or not plugged in."""


@dataclass(frozen=True)
class Drive:
    """How a motor is driven; counts are degrees of its shaft.

    Parameters
    ----------
    fast_power, slow_power
        Power of the way, and of the last counts, 1 to 100: about 10 counts/s each.
    seek_power
        Power, unregulated, with which it turns towards a mechanical stop: no more than that presses on it.
    coast_counts
        First guess of how far it runs on after a fast move; slow ones in proportion.
    tolerance_counts
        A count so near to the goal is there.
    lead_counts
        How far to go back, at least, to arrive from the right side: more than the play.
    runaway_counts
        A motor that goes so much farther than it should is stopped.
    settle_s
        Wait before a count is taken for that of a motor at rest.
    stuck_s
        A running motor whose count does not change for so long is stuck.
    n_moves
        So many moves must do for one goal.
    """

    fast_power: int = 60
    slow_power: int = 15
    seek_power: int = 30
    coast_counts: int = 60
    tolerance_counts: int = 1
    lead_counts: int = 30
    runaway_counts: int = 100
    settle_s: float = 0.2
    stuck_s: float = 1.5
    n_moves: int = 12

    def __post_init__(self) -> None:
        if not 1 <= self.slow_power <= self.fast_power <= 100:
            raise ParameterError(
                "slow_power, fast_power",
                (self.slow_power, self.fast_power),
                "1 to 100, the fast one not below the slow",
            )
        if not FAINT_POWER < self.seek_power <= 100:
            raise ParameterError("seek_power", self.seek_power, f"{FAINT_POWER + 1} to 100, enough to turn the motor")
        for name in ("coast_counts", "tolerance_counts", "lead_counts", "runaway_counts", "settle_s"):
            if not getattr(self, name) >= 0:
                raise ParameterError(name, getattr(self, name), "0 or more")
        for name in ("stuck_s", "n_moves"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "greater than 0")


class Motor:
    """One motor of a brick.

    Parameters
    ----------
    link
        The line to the brick.
    port
        0 to 2, for A to C.
    guard
        Asked before every move that a command could cause; None: anything goes.
    drive
        How it is driven; None: as a motor under a light load is.
    clock
        What is waited with.

    Attributes
    ----------
    last_counts
        The rotation counter as it was last read.
    """

    def __init__(
        self, link: Link, port: int, *, guard: Guard | None = None, drive: Drive | None = None, clock: Clock = time
    ) -> None:
        self._link, self.port, self._guard, self._clock = link, port, guard, clock
        self.drive = Drive() if drive is None else drive
        self.last_counts = 0
        self._target: int | None = None  # the firmware's, in rotation counts; None: not known
        self._datum: tuple[int, int] | None = None  # tacho counter minus rotation and minus block counter
        self._n_untaken = 0  # moves in a row
        self._arrived: Side | None = None  # from which side it came to where it stands
        self._coast: dict[tuple[int, Side], float] = {}

    @property
    def letter(self) -> str:
        """The port as it is written on the brick."""
        return "ABC"[self.port]

    def counts(self) -> int:
        """Read the rotation counter."""
        return self._state().rotation_counts

    def reset(self) -> None:
        """Take where it stands for 0."""
        state = self._state()
        self._link.ask(ResetMotorPosition(self.port, 0))
        if self._target is not None:
            self._target -= state.rotation_counts
        self._datum = state.tacho_counts, state.tacho_counts - state.block_counts

    def hold(self) -> None:
        """Keep it where it is, against a load."""
        self._link.ask(self._command(0, 0))

    def rest(self) -> int:
        """Stop and hold it, and read the count once it has settled."""
        self.hold()
        self._clock.sleep(self.drive.settle_s)
        return self.counts()

    def release(self) -> None:
        """Let it turn freely."""
        self._link.ask(SetOutputState(self.port, 0, OutputMode.IDLE, Regulation.IDLE, 0, RunState.IDLE, 0))
        self._arrived = None

    def move_to(self, goal: int, side: Side) -> int:
        """Turn to a count, arriving in direction `side`, and hold it there.

        Returns
        -------
        The count at rest, within the tolerance of the goal.

        Raises
        ------
        ReachError
            If the guard refuses a move; nothing moves then.
        MotorError
            If it does not get there.
        """
        here = self.counts()
        for _ in range(self.drive.n_moves):
            if self._target is None:
                here = self._synchronise()
            ahead = side * (goal - here)
            if abs(ahead) <= self.drive.tolerance_counts and self._arrived == side:
                return here
            here = (
                self._approach(goal, side, here)
                if ahead >= self.drive.lead_counts
                else self._back_off(goal, side, here)
            )
        raise MotorError(
            f"motor {self.letter} stands at {here} counts, not within {self.drive.tolerance_counts} of {goal}, after "
            f"{self.drive.n_moves} moves; is something in its way, or a gear slipping?"
        )

    def move_near(self, goal: int) -> int:
        """Turn to the neighbourhood of a count, by one fast move if it is not there, and hold; see `move_to`."""
        here = self.counts()
        side: Side = 1 if goal >= here else -1
        if self._target is None:
            here = self._synchronise()
        target = goal - side * self._coasts(self.drive.fast_power, side)
        if min(side * (target - here), side * (target - self._known_target)) > 0:
            here = self._go(target, side, self.drive.fast_power, here)
        return here

    def find_stop(self, side: Side, farthest: int) -> int:
        """Turn in a direction until something stops it, gently, and hold it there; no guard is asked.

        Parameters
        ----------
        side
            The direction.
        farthest
            It must be stopped within so many counts.

        Returns
        -------
        The count at the stop.

        Raises
        ------
        MotorError
            If nothing stops it.
        """
        start = self._synchronise()
        power = side * self.drive.seek_power
        gently = SetOutputState(self.port, power, BRAKED, Regulation.IDLE, 0, RunState.RUNNING, farthest)
        while not self._start(start + side * farthest, side, gently):
            start = self._synchronise()
        trouble = self._await_idle(start, side * (farthest + self.drive.runaway_counts), start + side * farthest)
        here = self.rest()
        self._target = None  # it lies behind the stop
        if trouble != STUCK:
            raise MotorError(
                f"motor {self.letter} met no stop within {farthest} counts; is it plugged in, its gear whole?"
            )
        return here

    @property
    def _known_target(self) -> int:
        if self._target is None:
            raise MotorError(f"motor {self.letter}: its counters jumped; did a program start on the brick?")
        return self._target

    def _approach(self, goal: int, side: Side, here: int) -> int:
        """Go on towards the goal: fast to a place well short of it, or slowly all the way."""
        fast, slow = self.drive.fast_power, self.drive.slow_power
        target = goal - side * self._coasts(slow, side)
        if side * self._known_target >= side * target:
            here = self._synchronise()  # left there by a move the other way, it would lead beyond the goal
        least = max(side * here, side * self._known_target) + 1  # a target behind this moves nothing
        short = goal - side * (2 * self.drive.lead_counts + self._coasts(fast, side))
        if side * short > least + self.drive.lead_counts:
            return self._go(short, side, fast, here)
        return self._go(side * max(side * target, least), side, slow, here)

    def _back_off(self, goal: int, side: Side, here: int) -> int:
        """Go back behind the goal, far enough for a slow move to get going and take up the play."""
        back: Side = 1 if side == -1 else -1
        fast, slow = self.drive.fast_power, self.drive.slow_power
        behind = goal - side * (self._coasts(slow, side) + 2 * self.drive.lead_counts)
        least = max(back * here, back * self._known_target) + 1
        short = behind + side * self._coasts(fast, back)
        if back * short > least + self.drive.lead_counts:
            return self._go(short, back, fast, here)
        return self._go(back * max(back * behind, least), back, slow, here)

    def _coasts(self, power: int, side: Side) -> int:
        share = power / self.drive.fast_power
        return round(self._coast.get((power, side), share * self.drive.coast_counts))

    def _go(self, target: int, side: Side, power: int, here: int) -> int:
        """Make one limited move to a target of the firmware's, and read where it led."""
        stop = target + side * self._coasts(power, side)
        if self._guard is not None:
            self._guard(here, stop)
        if not self._start(target, side, self._command(side * power, side * (target - self._known_target))):
            return self.rest()
        self._clock.sleep(max(side * (target - here), 0) / (COUNTS_S * power))
        trouble = self._await_idle(here, stop + side * self.drive.runaway_counts - here, target)
        here = self.rest()
        if trouble:
            self._target = None
            raise MotorError(
                f"motor {self.letter} {trouble} {here} counts at power {power}; is it plugged in, and its way free?"
            )
        ran_on = side * (here - target)
        if ran_on < -self.drive.tolerance_counts:
            self._target = None  # it stopped short of the target, which must lie elsewhere
            return here
        learned = self._coast.get((power, side), ran_on)
        self._coast[power, side] = (learned + ran_on) / 2
        return here

    def _start(self, target: int, side: Side, command: SetOutputState) -> bool:
        """Order a limited move, once and no more; tell whether the brick took it.

        Raises
        ------
        LinkError
            If it took none of several in a row.
        """
        try:
            self._link.ask(command)
        except (NoAnswerError, TelegramError, BrickError) as error:
            # Holding sets the limit to 0 after every move: this one's is the brick's own word that it took it.
            took = self._state(lambda state: False).limit_counts == command.limit_counts
            if not took or self._target is None:
                self._n_untaken += 1
                if self._n_untaken >= N_UNTAKEN:
                    raise error
                return False
        self._n_untaken = 0
        self._target = target
        self._arrived = side
        return True

    def _synchronise(self) -> int:
        """Stop the motor and learn the firmware's target, which follows a motor that is driven without a limit.

        It is driven with a power that does not turn it, so that nothing happens if the line dies here, and
        that sending it twice does no harm.
        """

        def is_faint(state: OutputState) -> bool:
            return (state.power, state.run_state, state.limit_counts) == (FAINT_POWER, RunState.RUNNING, 0)

        faint = SetOutputState(self.port, FAINT_POWER, BRAKED, Regulation.IDLE, 0, RunState.RUNNING, 0)
        self._link.ask(faint)
        self._clock.sleep(self.drive.settle_s)
        state = self._state(is_faint)
        if not is_faint(state):
            raise MotorError(f"motor {self.letter} is not driven as it was told; does a program run on the brick?")
        self._target = state.rotation_counts
        return self.rest()

    def _await_idle(self, start: int, farthest: int, target: int) -> str:
        """Wait for a limited move to end; say what is wrong where it sticks, or goes farther than it may."""
        side = 1 if farthest > 0 else -1

        def is_likely(state: OutputState) -> bool:
            # The firmware lets go of a motor at its target and not before.
            return state.run_state == RunState.RUNNING or side * (state.rotation_counts - target) >= 0

        here, changed_at = start, self._clock.monotonic()
        while (state := self._state(is_likely)).run_state != RunState.IDLE:
            now = self._clock.monotonic()
            if state.rotation_counts != here:
                here, changed_at = state.rotation_counts, now
            if abs(here - start) > abs(farthest):
                return BEYOND
            if now - changed_at > self.drive.stuck_s:
                return STUCK
        return ""

    def _state(self, is_likely: Callable[[OutputState], bool] = lambda state: True) -> OutputState:
        """Ask what the motor is doing; where that is not likely, or a counter jumped, until two in a row agree.

        A byte that was changed on its way shifts one of the three counters against the others.
        """
        state, before = self._asked(), None
        n_asked = 1
        while (_datum_of(state) != self._datum or not is_likely(state)) and _essence(state) != before:
            if n_asked == N_ASKED:
                raise MotorError(
                    f"motor {self.letter} is told of differently each of {N_ASKED} times; is the brick near?"
                )
            before, state = _essence(state), self._asked()
            n_asked += 1
        self.last_counts = state.rotation_counts
        if _datum_of(state) != self._datum:
            # Somebody else set a counter back: what was known of the target is void.
            self._target, self._datum = None, _datum_of(state)
        return state

    def _asked(self) -> OutputState:
        return self._link.ask(GetOutputState(self.port))

    def _command(self, power: int, limit: int) -> SetOutputState:
        return SetOutputState(self.port, power, DRIVEN, Regulation.SPEED, 0, RunState.RUNNING, limit)


def _datum_of(state: OutputState) -> tuple[int, int]:
    """Return how far the counters are apart, which no turning changes."""
    return state.tacho_counts - state.rotation_counts, state.tacho_counts - state.block_counts


def _essence(state: OutputState) -> tuple[object, ...]:
    """Return all that two states of a motor that turns have in common."""
    return _datum_of(state), state.power, state.mode, state.regulation, state.run_state, state.limit_counts
