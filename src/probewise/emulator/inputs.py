"""The firmware's four input ports with their sensors: types, modes, times of validity, I2C."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

from probewise.emulator.protocol import Clock, RefusedError, Status

AD_MAX = 1023


class AnalogSensor(Protocol):
    """What an input port's AD converter reads: a sensor with a voltage output, or an empty port."""

    def counts(self, *, lit: bool) -> int:
        """Return the output of the AD converter, 0 to 1023 for 0 to 5 V; `lit`: whether the LED is on."""
        ...


@dataclass(frozen=True)
class EmptyPort:
    """An empty port: the pull-up resistor alone."""

    def counts(self, *, lit: bool) -> int:
        """Return 1023, the full voltage."""
        return AD_MAX


@dataclass
class LightSensor:
    """The light sensor 9844, of whose converter a sample is taken every 3 ms: more light gives a lower voltage.

    `seen` is a function of whether the LED is on; it returns an unrounded reading on the firmware's scale 0 to 100.
    """

    seen: Callable[[bool], float]
    clock: Clock
    _sample: tuple[int, bool, int] = field(default=(-1, False, AD_MAX))

    def counts(self, *, lit: bool) -> int:
        """Return the AD converter's current sample, 0 to 1023, taken every 3 ms."""
        number = int(self.clock() / 0.003)
        if self._sample[:2] != (number, lit):
            self._sample = (number, lit, _counts_of_percent(self.seen(lit)))
        return self._sample[2]


def _counts_of_percent(percent: float) -> int:
    """Invert the firmware's conversion: 0 % is 896 counts, 100 % is 200; beyond, linear within 0 to 1023."""
    return min(max(round(200 + 68 / 100 * (AD_MAX - percent * AD_MAX / 100)), 0), AD_MAX)


@dataclass
class DigitalSensor:
    """A sensor at one I2C address; `registers` are bytes by the number of their first register."""

    address: int
    registers: dict[int, bytes]

    def transfer(self, written: bytes, wanted: int) -> bytes | None:
        """Write any data to a register and return `wanted` bytes from it; None if the address is not this sensor's.

        `written` holds the address, the register and the data.
        """
        if len(written) < 2 or written[0] & 0xFE != self.address:
            return None
        begin = written[1]
        if len(written) > 2:
            self.registers[begin] = written[2:]
        return self.registers.get(begin, b"")[:wanted].ljust(wanted, b"\0")


def ultrasonic_sensor(distance_cm: int) -> DigitalSensor:
    """Make an ultrasonic sensor that stands `distance_cm` from a wall."""
    version, maker, kind = b"V1.0".ljust(8, b"\0"), b"LEGO".ljust(8, b"\0"), b"Sonar".ljust(8, b"\0")
    heads = {0x00: version, 0x08: maker, 0x10: kind, 0x14: b"10E-2m\0", 0x41: b"\x02", 0x42: bytes((distance_cm,))}
    return DigitalSensor(0x02, heads)


Sensor: TypeAlias = AnalogSensor | DigitalSensor

_NONE, _LIGHT_ON, _LIGHT_OFF, _SOUND, _DIGITAL = 0x00, 0x05, 0x06, (0x07, 0x08), (0x0A, 0x0B)
_COLOUR = range(0x0D, 0x12)
_RAW = 0x00
_LIGHT_SCALE, _SOUND_SCALE = (200, 68), (162, 83)  # counts at full scale, percent of the converter's range
_I2C_BIT_S = 1 / 9600


@dataclass
class _InputPort:
    """An input port: its sensor, the type (`kind`) and mode to which it is set, and its last values."""

    sensor: Sensor
    kind: int = _NONE
    mode: int = _RAW
    valid_s: float = 0.0  # time from which readings are valid
    shown: tuple[int, int, int] = (0, 0, 0)  # raw, normalized, scaled: the last conversion
    boolean: int = 0
    answer: bytes = b""
    answered_s: float = 0.0
    failed: bool = False


class InputPorts:
    """The input ports 1 to 4 with their sensors, and by opcode the commands that set and read them (`commands`)."""

    def __init__(self, sensors: Sequence[Sensor], clock: Clock) -> None:
        self.clock = clock
        self._ports = tuple(_InputPort(sensor) for sensor in sensors)
        self.commands: Mapping[int, Callable[..., bytes]] = {
            0x05: self._set_mode,
            0x07: self._get_values,
            0x08: self._reset_scaled,
            0x0E: self._bus_status,
            0x0F: self._bus_write,
            0x10: self._bus_read,
        }

    def reset_ports(self) -> None:
        """Set every port to no sensor, as the firmware does when a program starts or ends."""
        for port in self._ports:
            self._configure_port(port, _NONE, _RAW)

    def _set_mode(self, number: int, kind: int, mode: int) -> bytes:
        self._configure_port(self._checked_port(number), kind, mode)
        return b""

    def _configure_port(self, port: _InputPort, kind: int, mode: int) -> None:
        """Set a port's type and mode; its readings are invalid for some milliseconds, and the old values stay."""
        self._update_reading(port)
        now_s = self.clock()
        if kind != port.kind:
            port.valid_s = now_s + (0.301 if kind in _SOUND else 0.401 if kind in _COLOUR else 0.021)
        else:
            port.valid_s = max(port.valid_s, now_s + 0.001)
        port.kind, port.mode = kind, mode

    def _get_values(self, number: int) -> bytes:
        port = self._checked_port(number)
        valid = self._update_reading(port)
        raw, normalized, scaled = port.shown
        return struct.pack(
            "<BBBBBHHhh", number, valid, False, port.kind, port.mode, raw, normalized, scaled, normalized
        )

    def _reset_scaled(self, number: int) -> bytes:
        port = self._checked_port(number)
        port.shown = (*port.shown[:2], 0)  # until the next conversion
        return b""

    def _update_reading(self, port: _InputPort) -> bool:
        """Read the port's sensor and update the port's values; return whether they are valid."""
        if self.clock() < port.valid_s:
            return False
        if port.kind not in (_NONE, *_DIGITAL):
            sensor = EmptyPort() if isinstance(port.sensor, DigitalSensor) else port.sensor
            raw = sensor.counts(lit=port.kind == _LIGHT_ON)
            normalized = _normalized_value(raw, port.kind)
            port.boolean = _boolean_value(normalized, port.boolean)
            port.shown = (raw, normalized, _scaled_value(normalized, port.mode, port.boolean))
        return True

    def _bus_status(self, number: int) -> bytes:
        port = self._checked_port(number)
        status, ready = self._bus_status_and_bytes(port)
        return _payload_if_ok(status, bytes((len(ready),)))

    def _bus_write(self, number: int, n_written: int, n_wanted: int, written: bytes) -> bytes:
        port = self._checked_port(number)
        status, _ = self._bus_status_and_bytes(port)
        if status in (Status.CHANNEL_NOT_READY, Status.BUS_PENDING):
            raise RefusedError(Status.CHANNEL_NOT_READY)
        if n_written > 16 or n_wanted > 16 or len(written) < n_written:
            raise RefusedError(Status.ILLEGAL_SIZE)
        device = port.sensor
        answer = device.transfer(written[:n_written], n_wanted) if isinstance(device, DigitalSensor) else None
        port.failed, port.answer = answer is None, answer or b""
        port.answered_s = self.clock() + 10 * (n_written + n_wanted) * _I2C_BIT_S
        return b""

    def _bus_read(self, number: int) -> bytes:
        port = self._checked_port(number)
        status, ready = self._bus_status_and_bytes(port)
        if status == Status.OK:
            port.answer = b""
        return _payload_if_ok(status, bytes((len(ready),)) + ready.ljust(16, b"\0"))

    def _bus_status_and_bytes(self, port: _InputPort) -> tuple[Status, bytes]:
        """Return the status of the I2C bus and the bytes ready to be read."""
        if port.kind not in _DIGITAL or self.clock() < port.valid_s:
            return Status.CHANNEL_NOT_READY, b""
        if self.clock() < port.answered_s:
            return Status.BUS_PENDING, b""
        return (Status.BUS_ERROR, b"") if port.failed else (Status.OK, port.answer)

    def _checked_port(self, number: int) -> _InputPort:
        if number >= len(self._ports):
            raise RefusedError(Status.OUT_OF_RANGE)
        return self._ports[number]


def _payload_if_ok(status: Status, payload: bytes) -> bytes:
    if status != Status.OK:
        raise RefusedError(status, payload)
    return payload


def _normalized_value(raw: int, kind: int) -> int:
    """Scale counts to 0..1023 in integers, as the firmware does; more light or sound gives a larger value."""
    if kind in (_LIGHT_ON, _LIGHT_OFF):
        zero, percent = _LIGHT_SCALE
    elif kind in _SOUND:
        zero, percent = _SOUND_SCALE
    else:
        return raw
    return AD_MAX - min(max(raw - zero, 0) * 100 // percent, AD_MAX)


def _boolean_value(normalized: int, before: int) -> int:
    """Return 1 below 45 %, as for a pressed touch sensor, 0 above 55 %, and the value `before` in between."""
    if normalized < AD_MAX * 45 // 100:
        return 1
    return 0 if normalized > AD_MAX * 55 // 100 else before


def _scaled_value(normalized: int, mode: int, boolean: int) -> int:
    """Convert a normalized value by the port's mode; counting modes give 0, since no emulated sensor makes edges."""
    match mode & 0xE0:
        case 0x00:
            return normalized
        case 0x20:
            return boolean
        case 0x80:
            return normalized * 100 // AD_MAX
        case 0xA0:
            return normalized * 900 // AD_MAX - 200
        case 0xC0:
            return 180 * (normalized * 900 // AD_MAX - 200) // 100 + 320
        case _:
            return 0
