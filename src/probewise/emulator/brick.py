"""The brick: input ports with their sensors, battery, sleep timer, and replies to telegrams.

What an arm never asks for is an unknown command.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from probewise.emulator.motors import Motor, OutputPorts
from probewise.emulator.protocol import Clock, RefusedError, Status, build_reply, parse_request
from probewise.errors import require

AD_MAX = 1023


Sensor: TypeAlias = Callable[[bool], int]
"""What an input port's AD converter reads, 0 to 1023 for 0 to 5 V: a function of whether the LED is on."""


def empty_port(lit: bool) -> int:
    """Return 1023, the full voltage: of an empty port, the pull-up resistor alone."""
    return AD_MAX


@dataclass
class LightSensor:
    """The light sensor 9844, of whose converter a sample is taken every 3 ms: more light gives a lower voltage.

    `seen` is a function of whether the LED is on; it returns an unrounded reading on the firmware's scale 0 to 100.
    """

    seen: Callable[[bool], float]
    clock: Clock
    _sample: tuple[int, bool, int] = field(default=(-1, False, AD_MAX))

    def __call__(self, lit: bool) -> int:
        """Return the AD converter's current sample, 0 to 1023."""
        number = int(self.clock() / 0.003)
        if self._sample[:2] != (number, lit):
            # The inverse of `normalized` below: 0 % is 896 counts, 100 % is 200; beyond, linear within 0 to 1023.
            raw = round(_BRIGHT_COUNTS + _SPAN_PERCENT / 100 * (AD_MAX - self.seen(lit) * AD_MAX / 100))
            self._sample = (number, lit, min(max(raw, 0), AD_MAX))
        return self._sample[2]


_NONE, _LIGHT_ON, _LIGHT_OFF = 0x00, 0x05, 0x06
_RAW, _PERCENT = 0x00, 0x80
_BRIGHT_COUNTS, _SPAN_PERCENT = 200, 68  # counts at full scale, percent of the converter's range


@dataclass
class _InputPort:
    """An input port: its sensor, the type (`kind`) and mode to which it is set, and its last values."""

    sensor: Sensor
    kind: int = _NONE
    mode: int = _RAW
    valid_s: float = 0.0  # time from which readings are valid
    shown: tuple[int, int, int] = (0, 0, 0)  # raw, normalized, scaled: the last conversion


class InputPorts:
    """The input ports 1 to 4 with their sensors, and by opcode the commands that set and read them (`commands`)."""

    def __init__(self, sensors: Sequence[Sensor], clock: Clock) -> None:
        self.clock = clock
        self._ports = tuple(_InputPort(sensor) for sensor in sensors)
        self.commands: Mapping[int, Callable[..., bytes]] = {0x05: self._set_mode, 0x07: self._get_values}

    def _set_mode(self, number: int, kind: int, mode: int) -> bytes:
        """Set a port's type and mode; its readings are invalid for some milliseconds, and the old values stay."""
        port = self._checked_port(number)
        self._update_reading(port)
        now_s = self.clock()
        port.valid_s = now_s + 0.021 if kind != port.kind else max(port.valid_s, now_s + 0.001)
        port.kind, port.mode = kind, mode
        return b""

    def _get_values(self, number: int) -> bytes:
        port = self._checked_port(number)
        valid = self._update_reading(port)
        raw, normalized, scaled = port.shown
        return struct.pack(
            "<BBBBBHHhh", number, valid, False, port.kind, port.mode, raw, normalized, scaled, normalized
        )

    def _update_reading(self, port: _InputPort) -> bool:
        """Read the port's sensor and update the port's values; return whether they are valid."""
        if self.clock() < port.valid_s:
            return False
        if port.kind != _NONE:
            raw = port.sensor(port.kind == _LIGHT_ON)
            dark = max(raw - _BRIGHT_COUNTS, 0) * 100 // _SPAN_PERCENT  # in integers, as the firmware does
            normalized = AD_MAX - min(dark, AD_MAX) if port.kind in (_LIGHT_ON, _LIGHT_OFF) else raw
            scaled = normalized * 100 // AD_MAX if port.mode & 0xE0 == _PERCENT else normalized
            port.shown = (raw, normalized, scaled)
        return True

    def _checked_port(self, number: int) -> _InputPort:
        if number >= len(self._ports):
            raise RefusedError(Status.OUT_OF_RANGE)
        return self._ports[number]


ADDRESS = bytes.fromhex("0016530A0B0C")
SLEEP_MIN = (0, 2, 5, 10, 30, 60)
"""The sleep times of the brick's menu, in minutes; 0 is never."""

_FLASH_BYTES = 61440
_VERSIONS = bytes((124, 1, 31, 1))  # protocol 1.124, firmware 1.31, the smaller number first


class Brick:
    """An NXT brick, switched on at construction; ParameterError if `sleep_min` is none of its menu's.

    Parameters
    ----------
    clock
        Time in seconds, for motors and timers.
    motors, sensors
        Motors at ports A, B, C; sensors at ports 1 to 4.
    sleep_min
        Minutes without KEEPALIVE until the brick switches itself off, 0: never.
    full_mv, sag_mv_min
        The battery's voltage at the start, and its loss per minute, in mV.
    watch
        Function called every 10 ms while a motor turns.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        motors: Sequence[Motor] | None = None,
        sensors: Sequence[Sensor] | None = None,
        full_mv: float = 7412.0,
        sag_mv_min: float = 0.0,
        sleep_min: int = 10,
        watch: Callable[[], None] = lambda: None,
    ) -> None:
        require(sleep_min in SLEEP_MIN, "sleep_min", sleep_min, f"one of {', '.join(map(str, SLEEP_MIN))}")
        self._clock, self._sleep_s = clock, 60.0 * sleep_min
        self._began_s = self._awake_s = clock()
        self._full_mv, self._sag_mv_min = full_mv, sag_mv_min
        plugged = [Motor() for _ in range(3)] if motors is None else motors
        self.outputs = OutputPorts(plugged, now_s=self._began_s, watch=watch)
        self.inputs = InputPorts([empty_port] * 4 if sensors is None else sensors, clock)
        self._commands: Mapping[int, Callable[..., bytes]] = {
            **self.outputs.commands,
            **self.inputs.commands,
            0x03: lambda hertz, ms: b"",
            0x0B: lambda: struct.pack("<H", int(self.battery_mv)),
            0x0D: self._keep_alive,
            0x11: self._refuse_name_of_program,
            0x88: lambda: _VERSIONS,
            0x9B: lambda: struct.pack("<15s7s4xI", b"NXT", ADDRESS, _FLASH_BYTES),
        }

    @property
    def battery_mv(self) -> float:
        """The battery's voltage now, in mV, at least 5500."""
        return max(self._full_mv - self._sag_mv_min * (self._clock() - self._began_s) / 60, 5500.0)

    @property
    def is_off(self) -> bool:
        """Whether the brick has gone to sleep; only its orange button could wake it."""
        return self._sleep_s > 0 and self._clock() - self._awake_s >= self._sleep_s

    def advance(self) -> None:
        """Simulate the motors up to the clock's time; from the brick's sleep on, they coast."""
        if self.is_off:
            self.outputs.advance(self._awake_s + self._sleep_s, self.battery_mv)
            self.outputs.release()
        self.outputs.advance(self._clock(), self.battery_mv)

    def answer(self, telegram: bytes) -> bytes | None:
        """Execute a telegram and return the reply, or None for no reply.

        There is no reply to a command with the no-reply bit, even after an error, nor while the brick is off.
        """
        self.advance()
        request = None if self.is_off else parse_request(telegram)
        if request is None:
            return None
        status, payload = Status.OK, b""
        try:
            if request.command is None:
                raise RefusedError(Status.UNKNOWN_COMMAND)
            payload = self._commands[request.opcode](*request.command.parse_fields(request.body))
        except RefusedError as refused:
            status, payload = refused.status, bytes(0 if request.command is None else request.command.error_bytes)
        return build_reply(request.opcode, status, payload) if request.wants_reply else None

    def _refuse_name_of_program(self) -> bytes:
        raise RefusedError(Status.NO_PROGRAM)  # none ever runs

    def _keep_alive(self) -> bytes:
        self._awake_s = self._clock()
        return struct.pack("<I", int(1000 * self._sleep_s))
