"""The LEGO light sensor 9844: its LED, and conversion of its A/D counts as in the brick's firmware."""

from __future__ import annotations

import contextlib
import time

from probewise.arm.instrument import Clock
from probewise.arm.nxt.link import Link
from probewise.arm.nxt.telegram import (
    LED_OFF,
    LED_ON,
    NO_SENSOR,
    RAW,
    GetInputValues,
    InputValues,
    SetInputMode,
    TelegramError,
)
from probewise.errors import LinkError, require

AD_MAX = 1023
N_INVALID = 3  # least number of attempts, since one may use up the allowed time on a slow connection
_BRIGHT_COUNTS = 200  # 800 mV of 5000 mV in the firmware's integer arithmetic: 5 V is 1023 counts
_SPAN_PERCENT = 68  # share of the converter's range between bright and dark, in percent


class SensorError(LinkError):
    """Raised for a sensor that gives no usable reading."""


def normalized_from_counts(raw_counts: int) -> int:
    """Convert A/D counts, 0 to 1023 (else ParameterError), which fall with brightness, to 0 (dark) to 1023 (bright).

    The firmware's integer arithmetic for types 05 and 06: only 697 of the 1024 values occur.
    """
    require(0 <= raw_counts <= AD_MAX, "raw_counts", raw_counts, f"0 to {AD_MAX}")
    dark = max(raw_counts - _BRIGHT_COUNTS, 0) * 100 // _SPAN_PERCENT
    return AD_MAX - min(dark, AD_MAX)


def percent_from_counts(raw_counts: int) -> float:
    """Convert A/D counts to percent, 0 (dark) to 100 (bright), about seven steps per percent."""
    return normalized_from_counts(raw_counts) * 100 / AD_MAX


class LightSensor:
    """A light sensor at one of the brick's inputs, 0 to 3 for 1 to 4, read in RAW mode: A/D counts.

    While the brick marks a reading as invalid, the read is repeated for `valid_s`, three times at least.
    """

    def __init__(self, link: Link, port: int, *, clock: Clock = time, valid_s: float = 1.0) -> None:
        self._link, self.port, self._clock, self._valid_s = link, port, clock, valid_s
        self._type: int | None = None

    def set_led(self, lit: bool = True) -> None:
        """Switch the LED on (`lit`) or off, and set the input to raw readings."""
        self._type = LED_ON if lit else LED_OFF
        self._link.ask(SetInputMode(self.port, self._type, RAW))

    def flash(self) -> int:
        """Light the LED for one reading, as in the paper: it is at the same temperature in all of them.

        The reading is the first that the brick marks as valid, 20 ms or more after the LED came on. A lost connection
        afterwards does not lose it. Raises as `read` does.
        """
        self.set_led()
        try:
            return self.read()
        finally:
            self._type = None
            with contextlib.suppress(LinkError):
                self._link.tell(self.off_command)

    def read(self) -> int:
        """Read once, with the LED as last set (by default on).

        Raises SensorError if the brick marks every reading as invalid, TelegramError if its answers remain
        inconsistent.
        """
        if self._type is None:
            self.set_led()
        deadline = self._clock.monotonic() + self._valid_s
        number = 0
        while True:
            number += 1
            values = self._link.ask(GetInputValues(self.port), check=_require_consistent)
            as_set = (values.type, values.mode) == (self._type, RAW)
            # An invalid reading still holds the old values.
            if as_set and values.valid:
                return values.raw
            if number >= N_INVALID and self._clock.monotonic() > deadline:
                raise SensorError(
                    f"input {self.port + 1} gave no valid reading for {self._valid_s:g} s; "
                    "is the light sensor plugged in?"
                )
            if not as_set:  # a program that starts or stops resets all settings
                self.set_led(self._type == LED_ON)

    @property
    def off_command(self) -> SetInputMode:
        """The command that switches the LED off and unconfigures the input."""
        return SetInputMode(self.port, NO_SENSOR, RAW)


def _require_consistent(values: InputValues) -> None:
    """Raise TelegramError if counts and converted values contradict each other: a byte was corrupted on the way.

    The protocol has no checksum, but the firmware sends each reading four times, as counts and converted.
    """
    if values.valid not in (0, 1) or values.calibrated or values.raw > AD_MAX:
        raise TelegramError(
            f"input {values.port + 1} says valid {values.valid}, calibrated {values.calibrated}, {values.raw} counts; "
            f"allowed: 0 or 1, 0, 0 to {AD_MAX}"
        )
    is_light = values.type in (LED_ON, LED_OFF) and values.mode == RAW
    if (
        values.valid
        and is_light
        and {values.normalized, values.scaled, values.calibrated_value} != {normalized_from_counts(values.raw)}
    ):
        raise TelegramError(
            f"input {values.port + 1} says {values.raw} counts, and converted {values.normalized}, {values.scaled} and "
            f"{values.calibrated_value}; allowed: {normalized_from_counts(values.raw)} three times"
        )
