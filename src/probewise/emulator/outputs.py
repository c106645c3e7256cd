"""The three output ports: simulation in time, synchronised pairs, and the motor commands."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from probewise.emulator.motor import Motor
from probewise.emulator.output import OutputPort, OutputSetting, RunState, clipped, quotient_towards_zero
from probewise.emulator.protocol import RefusedError, Status

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

    Parameters
    ----------
    motors
        The motors at ports A, B, C.
    now_s
        Time of the clock now; the simulation starts there.
    watch
        Function called every 10 ms while a motor turns.
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
        self._checked_port(port).reset_counter(block=bool(relative))
        return b""

    def _checked_port(self, port: int) -> OutputPort:
        if port >= len(self.ports):
            raise RefusedError(Status.OUT_OF_RANGE)
        return self.ports[port]
