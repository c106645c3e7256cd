"""Effects outside the vocabulary, which a diagnosis can detect and locate but not name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.stages import Act, FootprintPart, Rows, acts_at


@acts_at("place")
def bent_rail(amp_mm: float) -> Act:
    """Conceal an error in X quadratic in X: `amp_mm` at 10 mm from the origin."""
    return lambda values, rows: _with_x_error(values, amp_mm * (values[:, 0] / 10) ** 2)


@acts_at("place")
def twisted_rail(amp_mm: float) -> Act:
    """Conceal an error in X cubic in X: `amp_mm` at 10 mm from the origin."""
    return lambda values, rows: _with_x_error(values, amp_mm * (values[:, 0] / 10) ** 3)


@acts_at("place")
def place_step(amp_mm: float, at_mm: float) -> Act:
    """Conceal a missing gear tooth: true X is larger than commanded by `amp_mm` where X exceeds `at_mm`."""
    return lambda values, rows: _with_x_error(values, np.where(values[:, 0] > at_mm, amp_mm, 0.0))


@acts_at("place")
def stick_slip(amp_mm: float, period_mm: float, phase: float) -> Act:
    """Stick-slip of the slide: an error in X, a sawtooth of X between -`amp_mm` and `amp_mm`, period `period_mm`."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        turns = values[:, 0] / period_mm + phase
        return _with_x_error(values, amp_mm * (2 * (turns - np.floor(turns)) - 1))

    return act


@acts_at("pattern")
def slipped_paper(offset_mm: float, at_s: float) -> Act:
    """Slip the paper by `offset_mm` across its edge at time `at_s`; it stays there."""
    return lambda values, rows: values + offset_mm * rows.across * (rows.time_s > at_s)[:, None]


@acts_at("footprint")
def ghost(share: float, dx_mm: float, dy_mm: float) -> Act:
    """Add a faint second image from a glass plate: a `share` of the light, its footprint moved by `dx_mm`, `dy_mm`."""

    def act(parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        first = (replace(g, share=g.share * (1 - share)) for g in parts)
        second = (
            replace(g, share=g.share * share, shift_mm=(g.shift_mm[0] + dx_mm, g.shift_mm[1] + dy_mm)) for g in parts
        )
        return (*first, *second)

    return act


@acts_at("gain")
def thermal_gain(frac: float, longest_s: float, phases: tuple[float, ...]) -> Act:
    """Gain that wanders with room temperature by a relative sd `frac`: slow waves with a 1/f power spectrum.

    Frequencies are the first multiples of 1/`longest_s`, one for each of `phases` (rad); the sum of all waves has sd 1
    over the longest period.
    """

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        order = np.arange(1, len(phases) + 1)
        waves = np.cos(2 * math.pi * np.outer(rows.time_s / longest_s, order) + np.array(phases))
        heights = np.sqrt(1 / order)
        return np.asarray(values * (1 + frac * (waves @ heights * math.sqrt(2 / float(heights @ heights)))))

    return act


@acts_at("gain")
def cross_talk(frac: float, phase: float) -> Act:
    """Gain that varies by a fraction `frac` with twice the orientation, as when a pulled cable disturbs the signal."""
    return lambda values, rows: values * (1 + frac * np.cos(2 * rows.orientation_rad + phase))


@acts_at("response")
def floor(share: float) -> Act:
    """Conceal a dead zone: light below a `share` of white gives no signal."""
    return lambda values, rows: np.where(values < share, 0.0, values)


@acts_at("response")
def peak_memory(share: float) -> Act:
    """Let the photodiode remember: adds a `share` of the brightest light since the start of the scan."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        peaks = values.copy()
        for part in np.split(np.arange(len(values)), np.flatnonzero(rows.scan_start_mask())[1:]):
            peaks[part] = np.maximum.accumulate(values[part])
        return values + share * peaks

    return act


@acts_at("offset")
def after_glow(amp: float, tau_s: float, level: float) -> Act:
    """Conceal a pulse of height `amp` that decays with `tau_s`, added each time the reading rises through `level`."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        bright = values > level
        rises = rows.time_s[np.flatnonzero(bright & ~np.concatenate([[True], bright[:-1]]))]
        since = rows.time_s[:, None] - rises
        pulses = np.where(since >= 0, np.exp(-np.maximum(since, 0.0) / tau_s), 0.0)
        return np.asarray(values + amp * pulses.sum(axis=1))

    return act


@acts_at("offset")
def chirp(amp: float, first_hz: float, rate_hz_per_s: float, phase: float) -> Act:
    """Conceal an oscillating offset, as of a fan: amplitude `amp`, frequency `first_hz` + `rate_hz_per_s` t."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        turns = first_hz * rows.time_s + rate_hz_per_s * rows.time_s * rows.time_s / 2
        return values + amp * np.sin(2 * math.pi * turns + phase)

    return act


@acts_at("place")
def play_of_axes(x_mm: float, y_mm: float) -> Act:
    """Play of each axis by itself: it stops `x_mm` / 2 or `y_mm` / 2 short, whatever the way of the other."""
    return lambda values, rows: values - np.sign(rows.direction) * [x_mm / 2, y_mm / 2]


@acts_at("gain")
def gain_loss(share: float, each_s: float) -> Act:
    """Conceal a lamp that fades linearly: every `each_s` it loses a `share` of its first signal, down to zero."""
    return lambda values, rows: values * np.maximum(1.0 - share * rows.time_s / each_s, 0.0)


def _with_x_error(place_mm: FloatArray, error_mm: FloatArray) -> FloatArray:
    return place_mm + np.stack([error_mm, np.zeros_like(error_mm)], axis=-1)
