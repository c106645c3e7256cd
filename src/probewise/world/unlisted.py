"""Effects outside the vocabulary, which a diagnosis can detect and locate but not name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.stages import FootprintPart, Rows, Stage


@dataclass(frozen=True)
class QuadraticPositionError:
    """An error in X quadratic in X: `amp_mm` at 10 mm from the origin."""

    name: ClassVar[str] = "bent_rail"
    stage: ClassVar[Stage] = "place"
    amp_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return _with_x_error(values, self.amp_mm * (values[:, 0] / 10) ** 2)


@dataclass(frozen=True)
class CubicPositionError:
    """An error in X cubic in X: `amp_mm` at 10 mm from the origin."""

    name: ClassVar[str] = "twisted_rail"
    stage: ClassVar[Stage] = "place"
    amp_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return _with_x_error(values, self.amp_mm * (values[:, 0] / 10) ** 3)


@dataclass(frozen=True)
class PlaceStep:
    """A missing gear tooth: true X is larger than commanded by `amp_mm` where X exceeds `at_mm`."""

    name: ClassVar[str] = "place_step"
    stage: ClassVar[Stage] = "place"
    amp_mm: float
    at_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return _with_x_error(values, np.where(values[:, 0] > self.at_mm, self.amp_mm, 0.0))


@dataclass(frozen=True)
class StickSlip:
    """Stick-slip of the slide: an error in X, a sawtooth of X between -`amp_mm` and `amp_mm`, period `period_mm`."""

    name: ClassVar[str] = "stick_slip"
    stage: ClassVar[Stage] = "place"
    amp_mm: float
    period_mm: float
    phase: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        turns = values[:, 0] / self.period_mm + self.phase
        return _with_x_error(values, self.amp_mm * (2 * (turns - np.floor(turns)) - 1))


@dataclass(frozen=True)
class SlippedPaper:
    """The paper slips by `offset_mm` across its edge at time `at_s`, and stays there."""

    name: ClassVar[str] = "slipped_paper"
    stage: ClassVar[Stage] = "pattern"
    offset_mm: float
    at_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.offset_mm * rows.across * (rows.time_s > self.at_s)[:, None]


@dataclass(frozen=True)
class Ghost:
    """A faint second image from a glass plate: a `share` of the light, its footprint moved by `dx_mm`, `dy_mm`."""

    name: ClassVar[str] = "ghost"
    stage: ClassVar[Stage] = "footprint"
    share: float
    dx_mm: float
    dy_mm: float

    def change_footprint(self, parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        first = (replace(g, share=g.share * (1 - self.share)) for g in parts)
        second = (
            replace(g, share=g.share * self.share, shift_mm=(g.shift_mm[0] + self.dx_mm, g.shift_mm[1] + self.dy_mm))
            for g in parts
        )
        return (*first, *second)


@dataclass(frozen=True)
class ThermalGain:
    """Gain that wanders with room temperature by a relative sd `frac`: slow waves with a 1/f power spectrum.

    Frequencies are the first multiples of 1/`longest_s`, one for each of `phases` (rad).
    """

    name: ClassVar[str] = "thermal_gain"
    stage: ClassVar[Stage] = "gain"
    frac: float
    longest_s: float
    phases: tuple[float, ...]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Multiply the signal by 1 + frac w, where the sum of waves w has sd 1 over the longest period."""
        order = np.arange(1, len(self.phases) + 1)
        waves = np.cos(2 * math.pi * np.outer(rows.time_s / self.longest_s, order) + np.array(self.phases))
        heights = np.sqrt(1 / order)
        wave: FloatArray = waves @ heights * math.sqrt(2 / float(heights @ heights))
        return values * (1 + self.frac * wave)


@dataclass(frozen=True)
class OrientationDependentGain:
    """Gain that varies by a fraction `frac` with twice the orientation, as when a pulled cable disturbs the signal."""

    name: ClassVar[str] = "cross_talk"
    stage: ClassVar[Stage] = "gain"
    frac: float
    phase: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Multiply the signal by 1 + frac cos(2 orientation + phase)."""
        return values * (1 + self.frac * np.cos(2 * rows.orientation_rad + self.phase))


@dataclass(frozen=True)
class DeadZone:
    """A dead zone: light below a `share` of white gives no signal."""

    name: ClassVar[str] = "floor"
    stage: ClassVar[Stage] = "response"
    share: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.where(values < self.share, 0.0, values)


@dataclass(frozen=True)
class PeakMemory:
    """Persistence of the photodiode: adds a `share` of the brightest light since the start of the scan."""

    name: ClassVar[str] = "peak_memory"
    stage: ClassVar[Stage] = "response"
    share: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        peaks = values.copy()
        for part in np.split(np.arange(len(values)), np.flatnonzero(rows.scan_start_mask())[1:]):
            peaks[part] = np.maximum.accumulate(values[part])
        return values + self.share * peaks


@dataclass(frozen=True)
class AfterGlow:
    """A pulse of height `amp` that decays with `tau_s`, added each time the reading rises through `level`."""

    name: ClassVar[str] = "after_glow"
    stage: ClassVar[Stage] = "offset"
    amp: float
    tau_s: float
    level: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Add amp exp(-t / tau) for every rise of the reading through `level`, t >= 0 the time since then."""
        bright = values > self.level
        rises = rows.time_s[np.flatnonzero(bright & ~np.concatenate([[True], bright[:-1]]))]
        since = rows.time_s[:, None] - rises
        pulses: FloatArray = np.where(since >= 0, np.exp(-np.maximum(since, 0.0) / self.tau_s), 0.0)
        pulse: FloatArray = pulses.sum(axis=1)
        return values + self.amp * pulse


@dataclass(frozen=True)
class Chirp:
    """An oscillating offset, as of a fan running up: amplitude `amp`, frequency `first_hz` + `rate_hz_per_s` t."""

    name: ClassVar[str] = "chirp"
    stage: ClassVar[Stage] = "offset"
    amp: float
    first_hz: float
    rate_hz_per_s: float
    phase: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Add amp sin(2 pi (f t + r t^2 / 2) + phase)."""
        t = rows.time_s
        turns = self.first_hz * t + self.rate_hz_per_s * t * t / 2
        return values + self.amp * np.sin(2 * math.pi * turns + self.phase)


@dataclass(frozen=True)
class PlayOfAxes:
    """Play of each axis by itself: it stops `x_mm` / 2 or `y_mm` / 2 short, whatever the way of the other."""

    name: ClassVar[str] = "play_of_axes"
    stage: ClassVar[Stage] = "place"
    x_mm: float
    y_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(values - np.sign(rows.direction) * [self.x_mm / 2, self.y_mm / 2])


@dataclass(frozen=True)
class FadingLamp:
    """A lamp that fades linearly: every `each_s` it loses a `share` of its first signal, down to zero."""

    name: ClassVar[str] = "gain_loss"
    stage: ClassVar[Stage] = "gain"
    share: float
    each_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(values * np.maximum(1.0 - self.share * rows.time_s / self.each_s, 0.0))


def _with_x_error(place_mm: FloatArray, error_mm: FloatArray) -> FloatArray:
    return place_mm + np.stack([error_mm, np.zeros_like(error_mm)], axis=-1)
