"""Motors and the firmware's output ports, simulated in steps of a millisecond: limits, ramps, regulation, counters.

The behaviour is that of LEGO's firmware 1.28 to 1.31. Important for a host:

- The tacho limit is added to a running *goal*, where the last limited run should have ended, not where that run did
  end. So the overshoot of one run is subtracted from the next. In a run without a limit, the goal follows the motor.
- At the limit the port becomes idle: power decreases by 1 per millisecond and the motor coasts past the limit.
- Speed regulation acts every 101 ms; one unit of power is one count per 100 ms, 10 degrees per second.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from probewise.emulator.protocol import FieldValue, RefusedError, Status


@dataclass(frozen=True)
class MotorParameters:
    """Parameters of a motor under its load, as measured on the NXT motor.

    That runs at 170 revolutions per minute at full power and 9 V without load, in proportion to power and voltage, does
    not start below about 8 % of power, and overshoots by about 60 degrees after an unregulated limited run at power 75.
    """

    full_speed_deg_s: float = 1020.0  # without load, at power 100 and a battery of `rated_mv`
    rated_mv: float = 9000.0
    driven_s: float = 0.06  # time constant of the approach to the commanded speed, and of the electric brake
    coasting_s: float = 0.4  # time constant of slowing down without current
    friction_deg_s2: float = 1200.0  # dry friction, which also keeps a weakly driven motor from starting
    stops_deg: tuple[float, float] = (-math.inf, math.inf)  # of the shaft
    play_deg: float = 0.0  # backlash: what the shaft turns after a reversal before its load follows


@dataclass
class Motor:
    """State of a motor: angle and speed of the shaft, and angle of its load."""

    parameters: MotorParameters = field(default_factory=MotorParameters)
    angle_deg: float = 0.0
    speed_deg_s: float = 0.0
    driven_deg: float = 0.0

    def step(self, seconds: float, power: float, *, brake: bool, battery_mv: float) -> None:
        """Simulate a time step, much shorter than the time constants, at a power of -100 to 100.

        At power 0 the motor brakes (shorted) if `brake`, and coasts without current otherwise.
        """
        parameters = self.parameters
        if power or brake:
            asked = parameters.full_speed_deg_s * (power / 100) * (battery_mv / parameters.rated_mv)
            speed = self.speed_deg_s + (asked - self.speed_deg_s) * seconds / parameters.driven_s
        else:
            speed = self.speed_deg_s * (1 - seconds / parameters.coasting_s)
        # Dry friction reduces the speed towards zero and never reverses it.
        lost = parameters.friction_deg_s2 * seconds
        self.speed_deg_s = speed - lost if speed > lost else speed + lost if speed < -lost else 0.0
        low, high = parameters.stops_deg
        angle = self.angle_deg + self.speed_deg_s * seconds
        if not low <= angle <= high:
            angle, self.speed_deg_s = min(max(angle, low), high), 0.0
        self.angle_deg = angle
        slack = parameters.play_deg / 2
        self.driven_deg = min(max(self.driven_deg, angle - slack), angle + slack)


_ON, _BRAKE, _REGULATED = 0x01, 0x02, 0x04  # bits of the mode byte
_SPEED, _SYNC = 0x01, 0x02  # bits of the regulation byte
_REGULATION_MS = 100
_LEAST_RAMP_POWER = 10
_GAIN_P, _GAIN_I, _GAIN_D = 3, 1, 1


class RunState(IntEnum):
    """Run state of a port."""

    IDLE = 0x00
    RAMP_UP = 0x10
    RUNNING = 0x20
    RAMP_DOWN = 0x40


@dataclass(frozen=True)
class OutputSetting:
    """The fields of SETOUTPUTSTATE, in byte order; a GETOUTPUTSTATE reply begins with them."""

    power: int = 0
    mode: int = 0
    regulation: int = 0
    turn_ratio: int = 0
    run_state: int = 0
    tacho_limit: int = 0


@dataclass
class OutputPort:
    """One output port: its motor and the firmware's state, stepped by the millisecond."""

    motor: Motor = field(default_factory=Motor)
    setting: OutputSetting = field(default_factory=OutputSetting)
    run_state: int = RunState.IDLE
    tacho_count: int = 0
    block_count: int = 0
    rotation_count: int = 0

    set_power: int = 0  # commanded power, the end of a ramp
    target_power: int = 0  # current point of a ramp, the set point of the speed regulation
    power: int = 0  # power applied to the motor
    _brake: bool = False
    _regulation: int = 0
    _goal: int = 0
    _endless: bool = True
    _clock_ms: int = 0
    _moved: int = 0  # counts since the last regulation
    _error: int = 0
    _error_sum: int = 0
    _ramp_counts: int = 0  # counts between two steps of a ramp; 0: not computed yet
    _ramp_from: int = 0
    _ramp_last: int = 0
    _seen_deg: int = 0
    _settled: bool = False

    def __post_init__(self) -> None:
        self._seen_deg = self._encoder_deg

    def apply_setting(self, setting: OutputSetting) -> None:
        """Apply a command in the firmware's sequence: speed, then regulation, then limit."""
        self.setting, self._settled = setting, False
        self._brake = bool(setting.mode & _BRAKE)
        if setting.mode & _ON:
            self._change_run_state(setting.run_state, setting.power)
            self._regulation = setting.regulation if setting.mode & _REGULATED else 0
            if self._regulation & _SPEED and not self.set_power and self.run_state != RunState.RAMP_DOWN:
                self._error = self._error_sum = 0
        else:
            self._change_run_state(RunState.IDLE, 0)
            self._regulation = 0
        self._endless = not setting.tacho_limit
        forward = (self.set_power or self.target_power) > 0
        self._goal += setting.tacho_limit if forward else -setting.tacho_limit

    def reply_fields(self) -> tuple[FieldValue, ...]:
        """Return the fields of a GETOUTPUTSTATE reply after the port's number."""
        s = self.setting
        asked = (s.power, s.mode, s.regulation, s.turn_ratio, self.run_state, s.tacho_limit)
        return (*asked, self.tacho_count, self.block_count, self.rotation_count)

    def simulate_millisecond(self, battery_mv: float) -> None:
        """Simulate a millisecond of motor and firmware, without regulation and synchronisation."""
        self.motor.step(1e-3, self.power, brake=self._brake, battery_mv=battery_mv)
        seen = self._encoder_deg
        turned, self._seen_deg = seen - self._seen_deg, seen
        self.tacho_count += turned
        self.block_count += turned
        self.rotation_count += turned
        self._moved += turned
        self._clock_ms += 1
        if self.run_state == RunState.RAMP_UP:
            self._ramp_up()
        if self.run_state == RunState.RAMP_DOWN:
            self._ramp_down()
        if self.run_state == RunState.RUNNING:
            self._stop_at_limit()
        if self.run_state == RunState.IDLE:
            self._fade_power()

    def regulate_if_due(self) -> bool:
        """Regulate the speed if that is due, every 101 ms; return whether it was due."""
        if self._clock_ms <= _REGULATION_MS:
            return False
        if self._regulation & _SPEED:
            before = (self.power, self._error, self._error_sum)
            self.power = self._regulated_power(self._error - self._moved + self.target_power)
            # A remaining error too small to overcome friction: the motor stays.
            self._settled = not self._moved and before == (self.power, self._error, self._error_sum)
        self._clock_ms = self._moved = 0
        return True

    @property
    def is_at_rest(self) -> bool:
        """Whether nothing will change without a command or a hand that turns the motor."""
        if self.motor.speed_deg_s or self.target_power or self.set_power or self._seen_deg != self._encoder_deg:
            return False
        return self._settled and not self._moved if self._regulation else not self.power

    @property
    def is_at_limit(self) -> bool:
        """Whether a limited run has reached its limit."""
        return not self._endless and self.set_power != 0 and (self.tacho_count - self._goal) * self.set_power >= 0

    @property
    def is_synchronised(self) -> bool:
        """Whether the port is set to be synchronised with another one."""
        return self._regulation & (_SYNC | _SPEED) == _SYNC

    @property
    def _encoder_deg(self) -> int:
        """Angle that the motor's encoder shows: the nearest whole degree, so that home is in the middle of count 0."""
        # A real encoder's count may change at any angle. If it changed at home, a count would mean an angle half a
        # degree larger on average, and every place would be off accordingly.
        return math.floor(self.motor.angle_deg + 0.5)

    def _change_run_state(self, run_state: int, power: int) -> None:
        """Enter a run state with a power; a run that already has both goes on unchanged."""
        if run_state == self.run_state != RunState.IDLE and power == self.set_power:
            return
        if not self.target_power:
            self._error = self._error_sum = self._clock_ms = self._moved = 0
        if run_state == RunState.IDLE:
            self._regulation = 0
        elif run_state == RunState.RUNNING:
            self.set_power = self.target_power = power
            if not power:  # hold the present position
                self.power = self._clock_ms = self._moved = 0
        elif self._is_ramp_complete(run_state, power):
            run_state = RunState.RUNNING
        else:
            self.set_power, self._ramp_counts, self._ramp_from = power, 0, self.tacho_count
        self.run_state = run_state

    def _is_ramp_complete(self, ramp: int, power: int) -> bool:
        """Return whether the port has already reached the power at the end of this ramp, up or down."""
        if ramp == RunState.RAMP_UP:
            return self.set_power != 0 and (self.set_power >= power if power > 0 else self.set_power <= power)
        return self.set_power <= power if self.target_power >= 0 else self.set_power >= power

    def _ramp_up(self) -> None:
        """Raise the power in steps of 1 so that the set power is reached at the limit."""
        sign = 1 if self.set_power > 0 else -1
        if not self.target_power:
            self.target_power = sign * _LEAST_RAMP_POWER
        elif self.target_power != self.set_power:
            if not self._ramp_counts:
                to_go = sign * (self._goal - self._ramp_from)
                self._ramp_counts = max(to_go // abs(self.set_power - self.target_power), 1)
                self._ramp_last = self.tacho_count
            if sign * (self.tacho_count - self._ramp_last) > self._ramp_counts:
                self.target_power += sign
                self._ramp_last = self.tacho_count
        if sign * (self.tacho_count - self._goal) >= 0:
            self.target_power = self.set_power
            self.run_state = RunState.IDLE
        self._set_unregulated_power()

    def _ramp_down(self) -> None:
        """Lower the power in steps of 1, not below 10, until the limit."""
        sign = 1 if self.target_power > 0 else -1
        if not self._ramp_counts:
            steps = abs(self.target_power - self.set_power) - (0 if self.set_power else _LEAST_RAMP_POWER)
            self._ramp_counts = max(sign * (self._goal - self.tacho_count) // max(steps, 1), 1)
            self._ramp_last = self.tacho_count
        if sign * (self.tacho_count - self._ramp_last) > self._ramp_counts:
            self.target_power = sign * max(abs(self.target_power) - 1, _LEAST_RAMP_POWER)
            self._ramp_last = self.tacho_count
        if sign * (self.tacho_count - self._goal) >= 0:
            if not self.set_power:
                self.target_power = self.power = 0
            self.run_state, self._regulation = RunState.IDLE, 0
        self._set_unregulated_power()

    def _stop_at_limit(self) -> None:
        """Become idle at the limit; without a limit, let the goal follow the motor."""
        if self._endless:
            if self.target_power:
                self._goal = self.tacho_count
        elif self.is_at_limit and not self.is_synchronised:
            self.run_state, self._regulation = RunState.IDLE, 0
        self._set_unregulated_power()

    def _set_unregulated_power(self) -> None:
        if not self._regulation:
            self.power = clipped(self.target_power, 100)

    def _fade_power(self) -> None:
        """Reduce the power by 1 per millisecond after a limit: a host sees IDLE well before the motor rests."""
        self._brake = False
        self.power -= _sign(self.power)
        self.target_power -= _sign(self.target_power)
        self.set_power -= _sign(self.set_power)

    def _regulated_power(self, error: int) -> int:
        """Return the power of the firmware's PID regulator for a position error in counts."""
        steepness, self._error = error - self._error, error
        self._error_sum = clipped(quotient_towards_zero(3 * self._error_sum + error, 4), 800)
        wanted = clipped(_GAIN_P * error, 100) + clipped(_GAIN_I * self._error_sum, 100) + _GAIN_D * steepness
        return clipped(quotient_towards_zero(wanted, 2), 100)


def clipped(value: int, limit: int) -> int:
    """Clip a value to +-limit."""
    return min(max(value, -limit), limit)


def quotient_towards_zero(value: int, by: int) -> int:
    """Divide integers and round towards 0, as C does."""
    return value // by if value >= 0 else -(-value // by)


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)


_ALL = 0xFF
_TICK_S = 1e-3
_WATCHED_TICKS = 10


@dataclass
class _Synchronisation:
    """The firmware's state of a synchronised pair of motors."""

    lead: int = 0  # counts by which the first is ahead of the position given by the turn ratio
    lead_sum: int = 0
    turn: int = 0  # difference in counts demanded by the turn ratio so far

    def correct_powers(self, one: OutputPort, two: OutputPort) -> None:
        """Slow the motor that leads and speed up the one that lags (PID gains 3, 1, 1, over 4)."""
        inner = two if (one.setting.turn_ratio > 0) == (one.target_power >= 0) else one
        self.turn += 2 * quotient_towards_zero(inner.setting.turn_ratio * abs(inner.target_power), 100)
        lead = clipped(one.block_count - two.block_count + self.turn, 500)
        self.lead_sum = clipped(self.lead_sum + lead, 900)
        wanted = quotient_towards_zero(3 * lead + self.lead_sum + (lead - self.lead), 4)
        self.lead = lead
        for port, target in ((one, one.target_power - wanted), (two, two.target_power + wanted)):
            port.power = clipped(target, abs(port.target_power) if one.setting.turn_ratio else 100)


class OutputPorts:
    """The output ports A, B and C with their motors, and by opcode the commands that drive them (`commands`).

    The simulation starts at `now_s`; `watch` is called every 10 ms while a motor turns.
    """

    def __init__(self, motors: Sequence[Motor], *, now_s: float, watch: Callable[[], None] = lambda: None) -> None:
        self._watch = watch
        self.ports = tuple(OutputPort(motor) for motor in motors)
        self._ticked_s = now_s
        self._synchronisation = _Synchronisation()
        self.commands: Mapping[int, Callable[..., bytes]] = {
            0x04: self._set_state,
            0x06: self._get_state,
            0x0A: self._reset_counter,
        }

    def advance(self, now_s: float, battery_mv: float) -> None:
        """Simulate all milliseconds from the last call up to `now_s`."""
        n_ticks = int((now_s - self._ticked_s) / _TICK_S + 1e-6)
        self._ticked_s += n_ticks * _TICK_S
        moving = [port for port in self.ports if not port.is_at_rest]
        for number in range(n_ticks):
            if not moving:
                return
            self._simulate_millisecond(moving, battery_mv)
            if number % _WATCHED_TICKS == 0:
                self._watch()
            moving = [port for port in moving if not port.is_at_rest]  # one at rest stays there without a command

    def release(self) -> None:
        """Let all motors coast, as the firmware does when a program starts or ends."""
        for port in self.ports:
            port.apply_setting(OutputSetting())

    def _simulate_millisecond(self, moving: Sequence[OutputPort], battery_mv: float) -> None:
        """Simulate a millisecond of the moving ports; a synchronised pair stops when one of them reaches its limit."""
        for port in moving:
            port.simulate_millisecond(battery_mv)
        pair = [port for port in moving if port.is_synchronised][:2]
        if len(pair) == 2 and any(port.is_at_limit for port in pair):
            for port in pair:
                port.run_state = RunState.IDLE
        regulated = [port for port in moving if port.regulate_if_due()]
        if len(pair) == 2 and pair[0] in regulated:
            self._synchronisation.correct_powers(*pair)

    def _set_state(
        self, port: int, power: int, mode: int, regulation: int, turn_ratio: int, run_state: int, tacho_limit: int
    ) -> bytes:
        setting = OutputSetting(power, mode, regulation, turn_ratio, run_state, tacho_limit)
        for output in self.ports if port == _ALL else (self._checked_port(port),):
            output.apply_setting(setting)
            if output.is_synchronised:
                self._synchronisation = _Synchronisation()
        return b""

    def _get_state(self, port: int) -> bytes:
        return struct.pack("<BbBBbBIiii", port, *self._checked_port(port).reply_fields())

    def _reset_counter(self, port: int, relative: int) -> bytes:
        setattr(self._checked_port(port), "block_count" if relative else "rotation_count", 0)  # neither moves the goal
        return b""

    def _checked_port(self, port: int) -> OutputPort:
        if port >= len(self.ports):
            raise RefusedError(Status.OUT_OF_RANGE)
        return self.ports[port]
