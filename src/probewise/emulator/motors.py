"""Motors and the firmware's output ports, simulated in steps of a millisecond: limits, regulation, counters.

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

from probewise.emulator.protocol import FieldValue, RefusedError, Status


@dataclass
class Motor:
    """A motor under its load: angle and speed of the shaft, angle of the load; the rest as measured on the NXT motor.

    That runs at 170 revolutions per minute at full power and 9 V without load, in proportion to power and voltage, does
    not start below about 8 % of power, and overshoots by about 60 degrees after an unregulated limited run at power 75.
    """

    angle_deg: float = 0.0
    speed_deg_s: float = 0.0
    driven_deg: float = 0.0
    full_speed_deg_s: float = 1020.0  # without load, at power 100 and a battery of `rated_mv`
    rated_mv: float = 9000.0
    driven_s: float = 0.06  # time constant of the approach to the commanded speed, and of the electric brake
    coasting_s: float = 0.4  # time constant of slowing down without current
    friction_deg_s2: float = 1200.0  # dry friction, which also keeps a weakly driven motor from starting
    stops_deg: tuple[float, float] = (-math.inf, math.inf)  # of the shaft
    play_deg: float = 0.0  # backlash: what the shaft turns after a reversal before its load follows

    def step(self, seconds: float, power: float, *, brake: bool, battery_mv: float) -> None:
        """Simulate a time step, much shorter than the time constants, at a power of -100 to 100.

        At power 0 the motor brakes (shorted) if `brake`, and coasts without current otherwise.
        """
        if power or brake:
            asked = self.full_speed_deg_s * (power / 100) * (battery_mv / self.rated_mv)
            speed = self.speed_deg_s + (asked - self.speed_deg_s) * seconds / self.driven_s
        else:
            speed = self.speed_deg_s * (1 - seconds / self.coasting_s)
        # Dry friction reduces the speed towards zero and never reverses it.
        lost = self.friction_deg_s2 * seconds
        self.speed_deg_s = speed - lost if speed > lost else speed + lost if speed < -lost else 0.0
        low, high = self.stops_deg
        angle = self.angle_deg + self.speed_deg_s * seconds
        if not low <= angle <= high:
            angle, self.speed_deg_s = min(max(angle, low), high), 0.0
        self.angle_deg = angle
        slack = self.play_deg / 2
        self.driven_deg = min(max(self.driven_deg, angle - slack), angle + slack)


_ON, _BRAKE, _REGULATED = 0x01, 0x02, 0x04  # bits of the mode byte
_SPEED = 0x01  # bit of the regulation byte
_REGULATION_MS = 100
_GAIN_P, _GAIN_I, _GAIN_D = 3, 1, 1


IDLE, RUNNING = 0x00, 0x20
"""Run states of a port; ramps, which the firmware knows too, run at once at full power here."""


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
    run_state: int = IDLE
    tacho_count: int = 0
    block_count: int = 0
    rotation_count: int = 0

    set_power: int = 0  # commanded power
    target_power: int = 0  # the set point of the speed regulation
    power: int = 0  # power applied to the motor
    _brake: bool = False
    _regulated: bool = False
    _goal: int = 0
    _endless: bool = True
    _clock_ms: int = 0
    _moved: int = 0  # counts since the last regulation
    _error: int = 0
    _error_sum: int = 0
    _seen_deg: int = 0
    _settled: bool = False

    def __post_init__(self) -> None:
        self._seen_deg = self._encoder_deg

    def apply_setting(self, setting: OutputSetting) -> None:
        """Apply a command in the firmware's sequence: speed, then regulation, then limit."""
        self.setting, self._settled = setting, False
        self._brake = bool(setting.mode & _BRAKE)
        on = bool(setting.mode & _ON)
        self._change_run_state(RUNNING if on and setting.run_state else IDLE, setting.power * on)
        self._regulated = bool(on and setting.mode & _REGULATED and setting.regulation & _SPEED)
        if self._regulated and not self.set_power:
            self._error = self._error_sum = 0
        self._endless = not setting.tacho_limit
        forward = (self.set_power or self.target_power) > 0
        self._goal += setting.tacho_limit if forward else -setting.tacho_limit

    def reply_fields(self) -> tuple[FieldValue, ...]:
        """Return the fields of a GETOUTPUTSTATE reply after the port's number."""
        s = self.setting
        asked = (s.power, s.mode, s.regulation, s.turn_ratio, self.run_state, s.tacho_limit)
        return (*asked, self.tacho_count, self.block_count, self.rotation_count)

    def simulate_millisecond(self, battery_mv: float) -> None:
        """Simulate a millisecond of motor and firmware."""
        self.motor.step(1e-3, self.power, brake=self._brake, battery_mv=battery_mv)
        seen = self._encoder_deg
        turned, self._seen_deg = seen - self._seen_deg, seen
        self.tacho_count += turned
        self.block_count += turned
        self.rotation_count += turned
        self._moved += turned
        self._clock_ms += 1
        if self.run_state == RUNNING:
            if self._endless:
                if self.target_power:
                    self._goal = self.tacho_count
            elif self.set_power and (self.tacho_count - self._goal) * self.set_power >= 0:
                self.run_state, self._regulated = IDLE, False
            if not self._regulated:
                self.power = clipped(self.target_power, 100)
        if self.run_state == IDLE:
            # After a limit the power falls by 1 a millisecond: a host sees IDLE well before the motor rests.
            self._brake = False
            self.power, self.target_power, self.set_power = (
                power - (power > 0) + (power < 0) for power in (self.power, self.target_power, self.set_power)
            )
        if self._clock_ms > _REGULATION_MS:
            self._regulate()

    @property
    def is_at_rest(self) -> bool:
        """Whether nothing will change without a command or a hand that turns the motor."""
        if self.motor.speed_deg_s or self.target_power or self.set_power or self._seen_deg != self._encoder_deg:
            return False
        return self._settled and not self._moved if self._regulated else not self.power

    @property
    def _encoder_deg(self) -> int:
        """Angle that the motor's encoder shows: the nearest whole degree, so that home is in the middle of count 0."""
        # A real encoder's count may change at any angle. If it changed at home, a count would mean an angle half a
        # degree larger on average, and every place would be off accordingly.
        return math.floor(self.motor.angle_deg + 0.5)

    def _change_run_state(self, run_state: int, power: int) -> None:
        """Enter a run state with a power; a run that already has both goes on unchanged."""
        if run_state == self.run_state != IDLE and power == self.set_power:
            return
        if not self.target_power:
            self._error = self._error_sum = self._clock_ms = self._moved = 0
        if run_state == RUNNING:
            self.set_power = self.target_power = power
            if not power:  # hold the present position
                self.power = self._clock_ms = self._moved = 0
        self.run_state = run_state

    def _regulate(self) -> None:
        """Set the power by the firmware's PID regulator, which acts every 101 ms."""
        if self._regulated:
            before = (self.power, self._error, self._error_sum)
            error = self._error - self._moved + self.target_power
            steepness, self._error = error - self._error, error
            self._error_sum = clipped(int((3 * self._error_sum + error) / 4), 800)  # towards 0, as C divides
            wanted = clipped(_GAIN_P * error, 100) + clipped(_GAIN_I * self._error_sum, 100) + _GAIN_D * steepness
            self.power = clipped(int(wanted / 2), 100)
            # A remaining error too small to overcome friction: the motor stays.
            self._settled = not self._moved and before == (self.power, self._error, self._error_sum)
        self._clock_ms = self._moved = 0


def clipped(value: int, limit: int) -> int:
    """Clip a value to +-limit."""
    return min(max(value, -limit), limit)


_ALL = 0xFF
_TICK_S = 1e-3
_WATCHED_TICKS = 10


class OutputPorts:
    """The output ports A, B and C with their motors, and by opcode the commands that drive them (`commands`).

    The simulation starts at `now_s`; `watch` is called every 10 ms while a motor turns.
    """

    def __init__(self, motors: Sequence[Motor], *, now_s: float, watch: Callable[[], None] = lambda: None) -> None:
        self._watch = watch
        self.ports = tuple(OutputPort(motor) for motor in motors)
        self._ticked_s = now_s
        self.commands: Mapping[int, Callable[..., bytes]] = {
            0x04: self._set_state,
            0x06: lambda port: struct.pack("<BbBBbBIiii", port, *self._checked_port(port).reply_fields()),
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
            for port in moving:
                port.simulate_millisecond(battery_mv)
            if number % _WATCHED_TICKS == 0:
                self._watch()
            moving = [port for port in moving if not port.is_at_rest]  # one at rest stays there without a command

    def release(self) -> None:
        """Let all motors coast."""
        for port in self.ports:
            port.apply_setting(OutputSetting())

    def _set_state(self, port: int, *setting: int) -> bytes:
        for output in self.ports if port == _ALL else (self._checked_port(port),):
            output.apply_setting(OutputSetting(*setting))
        return b""

    def _reset_counter(self, port: int, relative: int) -> bytes:
        setattr(self._checked_port(port), "block_count" if relative else "rotation_count", 0)  # neither moves the goal
        return b""

    def _checked_port(self, port: int) -> OutputPort:
        if port >= len(self.ports):
            raise RefusedError(Status.OUT_OF_RANGE)
        return self.ports[port]
