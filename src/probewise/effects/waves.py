"""Periodic effects: flicker in time, periodic position error, and stick-slip."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.motion import distinct_positions_mm
from probewise.effects.origin import CountsPlaceFromOrigin, CountsTimeFromOrigin
from probewise.effects.vocabulary import NamedEffect, V, single_column_bank
from probewise.priors import LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage

PHASE = Uniform(-2 * np.pi, 2 * np.pi)
"""Prior of a phase, two full turns: every phase has an equivalent far from both ends."""

_MOST_FREQUENCIES = 1024
_ORDERS = np.arange(1, 7)  # harmonics of a sawtooth; the slip takes a sixth of the period
_SHARES = np.sinc(_ORDERS / 7) / _ORDERS * 2 / np.pi  # amplitude of each, damped against Gibbs overshoot


def sine_and_cosine_entries(*parameters: ArrayLike) -> FloatArray:
    """Return bank entries of waves, a sine and a cosine each, (n_bank, 2, n_params).

    `parameters` are those before the phase, which is the last: numbers or (n_bank,); the first is the amplitude.
    """
    return np.concatenate([single_column_bank(*parameters, phase) for phase in (0.0, 0.5 * np.pi)], axis=1)


def starting_point_of_wave(entry: FloatArray, amounts: FloatArray) -> FloatArray:
    """Return the parameters, (n_params,), of the sum of a bank entry's sine and cosine, times the fitted amounts (2,).

    The amplitude is the first, the phase the last; those between are the entry's.
    """
    setting = entry[0].copy()
    sine, cosine = amounts * setting[0]
    setting[0], setting[-1] = np.hypot(sine, cosine), np.arctan2(cosine, sine)
    return np.asarray(setting)


class _PeriodicEffect(NamedEffect[V]):
    """Base of effects whose phase has a prior over two turns, which hold every posterior mode twice."""

    @property
    def n_peaks(self) -> int:
        return 2


class _WaveEffect(_PeriodicEffect[V]):
    """Base of effects with amplitude, frequency or period, and phase; bank entries hold a sine and a cosine."""

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        return starting_point_of_wave(entry, amounts)


@dataclass(frozen=True)
class Flicker(CountsTimeFromOrigin, _WaveEffect[FloatArray]):
    """One frequency in the light: reading + amp sin(2 pi alias_hz t + phase), t the time since `origin`.

    The mains frequency aliased by the sampling, or a slow lamp: any frequency up to half the rate of readings.
    """

    typical: float = 0.5
    lowest_hz: float = 0.01
    highest_hz: float = 0.5
    n_frequencies: int = 128
    unit: str = field(default="", kw_only=True)

    name = "flicker"
    words = "a flickering lamp"
    stage = Stage.OFFSET
    units = ("reading", "Hz", "rad")
    covariates = ("time",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect for 0.01 Hz to half the median rate of readings; None if that range is empty."""
        highest = 0.5 / extent.gap_s
        if highest <= cls.lowest_hz:
            return None
        wanted = 2 * (highest - cls.lowest_hz) * extent.duration_s
        n_frequencies = int(np.clip(np.ceil(wanted), 8, _MOST_FREQUENCIES))
        typical, unit = 0.01 * extent.span, extent.reading_unit
        return cls(typical, cls.lowest_hz, highest, n_frequencies, unit=unit, origin=extent.origin)

    @cached_property
    def prior(self) -> Product:
        frequency = Uniform(self.lowest_hz, self.highest_hz)
        return Product({"amp": HeavyTailedPrior(self.typical, positive=True), "alias_hz": frequency, "phase": PHASE})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        wave = np.sin(2 * np.pi * theta[:, 1:2] * self.origin.seconds(plan) + theta[:, 2:3])
        return np.asarray(value + theta[:, :1] * wave)

    def bank(self) -> FloatArray:
        frequencies = np.linspace(self.lowest_hz, self.highest_hz, self.n_frequencies + 2)[1:-1]
        return sine_and_cosine_entries(self.typical, frequencies)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the reading oscillates with an amplitude of {value_with_sd(mean[0], sd[0], self.unit)} at "
            f"{value_with_sd(mean[1], sd[1])} Hz (a period of {1 / mean[1]:.4g} s), over black and white alike: "
            "a lamp flickers"
        )


@dataclass(frozen=True)
class PeriodicPositionError(CountsPlaceFromOrigin, _WaveEffect[Poses]):
    """A gear or lead screw that is not round: X + amp_mm sin(2 pi (X - X0) / period_mm + phase), X0 of `origin`."""

    typical_mm: float = 0.3
    shortest_mm: float = 3.0
    longest_mm: float = 200.0
    n_periods: int = 48

    name = "periodic_position_error"
    words = "a periodic position error of the arm"
    stage = Stage.POSE
    units = ("mm", "mm", "rad")
    covariates = ("place", "slope")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with periods from three steps of X to twice its range; None for under eight positions."""
        shortest, reach = _shortest_period_and_range_mm(extent.plan)
        return cls(0.003 * extent.length_mm, shortest, 2 * reach, origin=extent.origin) if reach > 0 else None

    @cached_property
    def prior(self) -> Product:
        amp = HeavyTailedPrior(self.typical_mm, positive=True)
        return Product({"amp_mm": amp, "period_mm": LogUniform(self.shortest_mm, self.longest_mm), "phase": PHASE})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        wave = np.sin(2 * np.pi / theta[:, 1:2] * (value.x_mm - self.origin.x_mm) + theta[:, 2:3])
        return replace(value, x_mm=value.x_mm + theta[:, :1] * wave)

    def bank(self) -> FloatArray:
        """Return sines and cosines: periods up to the range, evenly in wave number, and longer ones, in log period."""
        n_even = self.n_periods - 8
        waves = np.linspace(1.0, self.longest_mm / 2 / self.shortest_mm, n_even + 1)[1:]
        periods = np.append(self.longest_mm / 2 / waves, self.longest_mm / np.geomspace(1.05, 2.0, 8))
        return sine_and_cosine_entries(self.typical_mm, np.maximum(periods, self.shortest_mm * 1.001))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the arm's position along X is off by up to {value_with_sd(mean[0], sd[0])} mm, with a period of "
            f"{value_with_sd(mean[1], sd[1])} mm: a gear or lead screw is not round"
        )


@dataclass(frozen=True)
class StickSlip(CountsPlaceFromOrigin, _PeriodicEffect[Poses]):
    """Stick-slip of the slide: X + amp_mm saw((X - X0) / period_mm + phase), a sawtooth of 1 to -1, X0 of `origin`."""

    typical_mm: float = 0.3
    shortest_mm: float = 3.0
    longest_mm: float = 25.0
    n_periods: int = 32
    n_phases: int = 6

    name = "stick_slip"
    words = "a slide that sticks and jumps"
    stage = Stage.POSE
    units = ("mm", "mm", "1")
    covariates = ("place", "slope")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with periods from three steps of X to a quarter of its range; None if that is empty."""
        shortest, reach = _shortest_period_and_range_mm(extent.plan)
        if 0.25 * reach <= shortest:
            return None
        return cls(0.003 * extent.length_mm, shortest, 0.25 * reach, origin=extent.origin)

    @cached_property
    def prior(self) -> Product:
        """Prior of the amplitude, of either sign, the period (log-uniform), and the phase in turns."""
        period = LogUniform(self.shortest_mm, self.longest_mm)
        return Product({"amp_mm": HeavyTailedPrior(self.typical_mm), "period_mm": period, "phase": Uniform(-1.0, 1.0)})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        turns = 2 * np.pi * ((value.x_mm - self.origin.x_mm) / theta[:, 1:2] + theta[:, 2:3])
        saw = sum(share * np.sin(order * turns) for order, share in zip(_ORDERS, _SHARES, strict=True))
        return replace(value, x_mm=value.x_mm + theta[:, :1] * saw)

    def bank(self) -> FloatArray:
        waves = np.linspace(1.0 / self.longest_mm, 1.0 / self.shortest_mm, self.n_periods + 2)[1:-1]
        periods, phases = np.meshgrid(1 / waves, np.arange(self.n_phases) / self.n_phases - 0.5, indexing="ij")
        return single_column_bank(self.typical_mm, periods.ravel(), phases.ravel())

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the slide sticks and then jumps by {value_with_sd(abs(mean[0]), sd[0], factor=2)} mm, once every "
            f"{value_with_sd(mean[1], sd[1])} mm along X: it lacks lubrication"
        )


def _shortest_period_and_range_mm(plan: Plan) -> tuple[float, float]:
    """Return three times the median step of X and the range of X, mm; 0 and 0 for fewer than eight positions."""
    x_mm = distinct_positions_mm(plan.x_mm)
    return (3 * float(np.median(np.diff(x_mm))), float(np.ptp(x_mm))) if len(x_mm) >= 8 else (0.0, 0.0)
