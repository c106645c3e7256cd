"""The light sensor 9844: LED on or off, and its counts converted as the brick's firmware converts them."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass

from probewise.arm.basics import Clock
from probewise.arm.nxt.link import Link
from probewise.arm.nxt.telegram import GetInputValues, InputValues, Mode, SensorType, SetInputMode
from probewise.arm.nxt.wire import TelegramError
from probewise.errors import LinkError, ParameterError

__all__ = ["Light", "LightReading", "SensorError", "normalized_of"]

AD_MAX = 1023
N_INVALID = 3  # readings at least, for a slow line may take all the time that there is for one
_BRIGHT_COUNTS = 200  # 800 mV of 5000 mV, as the firmware's whole numbers have it: 5 V is 1023 counts
_SPAN_PERCENT = 68  # share of the converter's range that lies between bright and dark


class SensorError(LinkError):
    """Report a sensor that gives no reading that can be used."""


def normalized_of(raw_counts: int) -> int:
    """Convert counts of the converter, more light fewer of them, to 0 (dark) to 1023 (bright).

    The firmware's arithmetic for types 05 and 06, in whole numbers: only 697 of the 1024 values occur.

    Raises
    ------
    ParameterError
        If the counts are outside the converter's 0 to 1023.
    """
    if not 0 <= raw_counts <= AD_MAX:
        raise ParameterError("raw_counts", raw_counts, f"0 to {AD_MAX}")
    dark = max(raw_counts - _BRIGHT_COUNTS, 0) * 100 // _SPAN_PERCENT
    return AD_MAX - min(dark, AD_MAX)


@dataclass(frozen=True)
class LightReading:
    """One reading, as the converter's counts."""

    raw_counts: int

    @property
    def normalized(self) -> int:
        """0 (dark) to 1023 (bright)."""
        return normalized_of(self.raw_counts)

    @property
    def percent(self) -> int:
        """0 to 100 in whole steps, as the brick shows it: the paper's LEGO units."""
        return self.normalized * 100 // AD_MAX

    @property
    def fine_percent(self) -> float:
        """0 to 100 in all steps that the converter has, about seven to one percent."""
        return self.normalized * 100 / AD_MAX


class Light:
    """A light sensor at one of the brick's inputs, read in RAW mode.

    Parameters
    ----------
    link
        The line to the brick.
    port
        0 to 3, for 1 to 4.
    clock
        What is waited with.
    valid_s
        For so long after a change the brick may call its readings invalid.
    """

    def __init__(self, link: Link, port: int, *, clock: Clock = time, valid_s: float = 1.0) -> None:
        self._link, self.port, self._clock, self._valid_s = link, port, clock, valid_s
        self._type: SensorType | None = None

    def light_up(self, lit: bool = True) -> None:
        """Switch the LED on or off."""
        self._type = SensorType.LIGHT_ACTIVE if lit else SensorType.LIGHT_INACTIVE
        self._link.ask(SetInputMode(self.port, self._type, Mode.RAW))

    def read(self) -> LightReading:
        """Read once, with the LED as it was last set; on, where it never was.

        Raises
        ------
        SensorError
            If the brick calls every reading invalid.
        TelegramError
            If what the brick says contradicts itself, however often it is asked.
        """
        if self._type is None:
            self.light_up()
        deadline = self._clock.monotonic() + self._valid_s
        for number in itertools.count(1):
            values = self._link.ask(GetInputValues(self.port), check=_require_sense)
            as_set = (values.type, values.mode) == (self._type, Mode.RAW)
            # An invalid reading still shows the old values.
            if as_set and values.valid:
                return LightReading(values.raw)
            if number >= N_INVALID and self._clock.monotonic() > deadline:
                raise SensorError(
                    f"input {self.port + 1} gave no valid reading for {self._valid_s:g} s; "
                    "is the light sensor plugged in?"
                )
            if not as_set:  # a program that starts or stops takes all settings back
                self.light_up(self._type == SensorType.LIGHT_ACTIVE)
        raise AssertionError("a count has no end")  # pragma: no cover

    @property
    def off(self) -> SetInputMode:
        """The command that switches the LED off and lets the brick forget the sensor."""
        return SetInputMode(self.port, SensorType.NONE, Mode.RAW)


def _require_sense(values: InputValues) -> None:
    """Refuse values that the firmware never sends: it says each reading four times, converted in one go.

    The radio line has no checksum that this program could see. A byte that was changed on its way breaks the
    agreement of the four, or changes nothing that is used.
    """
    if values.valid not in (0, 1) or values.calibrated or values.raw > AD_MAX:
        raise TelegramError(
            f"input {values.port + 1} says valid {values.valid}, calibrated {values.calibrated}, {values.raw} counts; "
            f"allowed: 0 or 1, 0, 0 to {AD_MAX}"
        )
    is_light = values.type in (SensorType.LIGHT_ACTIVE, SensorType.LIGHT_INACTIVE) and values.mode == Mode.RAW
    if (
        values.valid
        and is_light
        and {values.normalized, values.scaled, values.calibrated_value} != {normalized_of(values.raw)}
    ):
        raise TelegramError(
            f"input {values.port + 1} says {values.raw} counts, and converted {values.normalized}, {values.scaled} and "
            f"{values.calibrated_value}; allowed: {normalized_of(values.raw)} three times"
        )
