"""The firmware's four input ports with their sensors: types, modes, times of validity."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from probewise.emulator.protocol import Clock, RefusedError, Status

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
            # The inverse of `_normalized_light`: 0 % is 896 counts, 100 % is 200; beyond, linear within 0 to 1023.
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

    def reset_ports(self) -> None:
        """Set every port to no sensor, as the firmware does when a program starts or ends."""
        for number in range(len(self._ports)):
            self._set_mode(number, _NONE, _RAW)

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
            normalized = _normalized_light(raw) if port.kind in (_LIGHT_ON, _LIGHT_OFF) else raw
            scaled = normalized * 100 // AD_MAX if port.mode & 0xE0 == _PERCENT else normalized
            port.shown = (raw, normalized, scaled)
        return True

    def _checked_port(self, number: int) -> _InputPort:
        if number >= len(self._ports):
            raise RefusedError(Status.OUT_OF_RANGE)
        return self._ports[number]


def _normalized_light(raw: int) -> int:
    """Scale counts to 0..1023 in integers, as the firmware does; more light gives a larger value."""
    return AD_MAX - min(max(raw - _BRIGHT_COUNTS, 0) * 100 // _SPAN_PERCENT, AD_MAX)
