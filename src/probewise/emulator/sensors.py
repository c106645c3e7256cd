"""Sensors for an input port: analog ones, and digital ones with I2C."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from probewise.emulator.clock import Clock

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
    """The light sensor 9844: more light gives a lower voltage.

    Parameters
    ----------
    seen
        Function of whether the LED is on; returns an unrounded reading on the firmware's scale 0 to 100.
    clock
        Time in seconds; the converter takes a new sample every 3 ms.
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
