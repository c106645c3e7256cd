"""Effects on the signal and the reading: response, gain, offset, memory in the readings, saturation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray, varies
from probewise._words import value_with_sd
from probewise.effects.effect import (
    PHASE,
    ChangePointEffect,
    LinearEffect,
    NamedEffect,
    WaveEffect,
    candidate_change_times_s,
    sine_and_cosine_entries,
    single_column_bank,
)
from probewise.effects.priors import HeavyTailedPrior, LogHeavyTailedPrior
from probewise.effects.reference import (
    CountsPlaceFromOrigin,
    CountsTimeFromOrigin,
    Extent,
    sign_of_motion,
)
from probewise.priors import LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage

_BATTERY = "battery_mv"
_REFERENCE_MV = 8000.0
_MOST_EQUAL = 0.01
_MOST_FREQUENCIES = 1024
_IN_DIRECTION = {-1.0: "of backward motion", 0.0: "at rest", 1.0: "of forward motion"}


def decaying_sum(added: FloatArray, kept: FloatArray, *, longest: int) -> FloatArray:
    """Return s with s_k = kept_k s_(k-1) + added_k, (n_samples, n_points); no sum reaches over `longest` points.

    Each s_k is an affine map of the one before. A parallel prefix scan composes the maps in pairs, then pairs of
    pairs, until each map starts at the beginning of its sum.
    """
    held, carry = np.broadcast_arrays(added, kept)
    held, carry, reach = held.copy(), carry.copy(), 1
    while reach < longest:
        held[:, reach:] = held[:, reach:] + carry[:, reach:] * held[:, :-reach]
        carry[:, reach:] = carry[:, reach:] * carry[:, :-reach]
        reach *= 2
    return held


@dataclass(frozen=True)
class Nonlinearity(NamedEffect[FloatArray]):
    """A bent response curve: u -> u^gamma, u the seen white fraction clipped to 0..1."""

    typical_log: float = 0.1

    name = "nonlinearity"
    words = "a bent response curve"
    stage = Stage.RESPONSE
    units = ("1",)
    covariates = ("level",)
    amplitudes = ()

    @property
    def nothing(self) -> Mapping[int, float]:
        return {0: 1.0}

    @cached_property
    def prior(self) -> Product:
        return Product({"gamma": LogHeavyTailedPrior(self.typical_log)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(np.clip(value, 0.0, 1.0) ** theta[:, :1])

    def bank(self) -> FloatArray:
        return single_column_bank(np.exp(self.typical_log * np.array([-1.0, 1.0])))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        seen = 100 * 0.5 ** mean[0]
        return (
            f"the response is bent with exponent {value_with_sd(mean[0], sd[0])}: "
            f"a half-white view reads as {seen:.1f} % white"
        )


@dataclass(frozen=True)
class GainDrift(CountsTimeFromOrigin, NamedEffect[FloatArray]):
    """A lamp that warms up: signal x (1 + frac exp(-t / tau_s)), t the plan's time since `origin`, 0 before it."""

    typical: float = 0.02
    shortest_s: float = 5.0
    longest_s: float = 5000.0

    name = "gain_drift"
    words = "a gain that drifts"
    stage = Stage.GAIN
    units = ("1", "s")
    covariates = ("time",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        duration_s = extent.duration_s
        return cls(shortest_s=0.01 * duration_s, longest_s=2 * duration_s, origin=extent.origin)

    @cached_property
    def prior(self) -> Product:
        return Product({"frac": HeavyTailedPrior(self.typical), "tau_s": LogUniform(self.shortest_s, self.longest_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        # A negative time would let the exponential overflow.
        fade = np.exp(-np.maximum(self.origin.seconds(plan), 0.0) / theta[:, 1:2])
        return np.asarray(value * (1 + theta[:, :1] * fade))

    def bank(self) -> FloatArray:
        return single_column_bank(self.typical, np.geomspace(self.shortest_s * 1.5, self.longest_s / 1.5, 7))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        side = "too strong" if mean[0] > 0 else "too weak"
        return (
            f"the signal starts {value_with_sd(abs(mean[0]), sd[0], factor=100)} % {side} at time 0 and settles "
            f"with a time constant of {value_with_sd(mean[1], sd[1])} s: the lamp warms up"
        )


@dataclass(frozen=True)
class BatterySag(LinearEffect[FloatArray]):
    """A lamp that dims with its battery: signal x (1 + per_volt (V - V0)), V from `battery_mv`, V0 = 8 V.

    Between recorded voltages V is interpolated in time, and beyond them it is the nearest one; it is V0 if there is
    none.
    """

    typical_per_volt: float = 0.05

    name = "battery_sag"
    words = "a signal that follows the battery"
    stage = Stage.GAIN
    units = ("1/V",)
    covariates = (_BATTERY,)
    reads = (_BATTERY,)
    parameters = ("per_volt",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        millivolts = extent.plan.covariates.get(_BATTERY, np.empty(0))
        recorded = (millivolts[np.isfinite(millivolts)] - _REFERENCE_MV) / 1000
        fall = float(np.ptp(recorded)) if recorded.size else 0.0
        return cls(typical_per_volt=0.02 / fall) if fall > 0 else None

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value * (1 + theta[:, :1] * _volts_above_reference(plan)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "loses" if mean[0] > 0 else "gains"
        return (
            f"the signal {way} {value_with_sd(abs(mean[0]), sd[0], factor=100)} % for each volt that the battery "
            "falls: the lamp follows the battery"
        )


def _volts_above_reference(plan: Plan) -> FloatArray:
    """Return the battery voltage minus V0 in V, (n_points,), interpolated where it is missing; 0 if all are."""
    millivolts = plan.covariates.get(_BATTERY, np.full(len(plan), np.nan))
    known = np.flatnonzero(np.isfinite(millivolts))
    if not known.size:
        return np.zeros(len(plan))
    above = (millivolts - _REFERENCE_MV) / 1000
    known = known[np.argsort(plan.time_s[known], kind="stable")]
    # A missing voltage is no other voltage: at V0 the gain would jump where the logging stops.
    return np.where(np.isfinite(above), above, np.interp(plan.time_s, plan.time_s[known], above[known]))


@dataclass(frozen=True)
class GainStep(ChangePointEffect[FloatArray]):
    """The lamp or lens changes suddenly: signal x (1 + frac 1(t > at_s))."""

    typical: float = 0.02

    name = "gain_jump"
    words = "a sudden change of the signal's strength"
    stage = Stage.GAIN
    units = ("1", "s")
    covariates = ("time", "level")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        times = candidate_change_times_s(extent)
        return None if times is None else cls(times)

    @property
    def typical_sizes(self) -> Mapping[str, float]:
        return {"frac": self.typical}

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value * (1 + theta[:, :1] * self.after_change_mask(theta, plan)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "stronger" if mean[0] > 0 else "weaker"
        return (
            f"from {value_with_sd(mean[1], sd[1])} s on, the signal is "
            f"{value_with_sd(abs(mean[0]), sd[0], factor=100)} % {way}: the lamp or the lens changed suddenly"
        )


@dataclass(frozen=True)
class Polarisation(LinearEffect[FloatArray]):
    """Glossy paper partly polarises the light, and the sensor is more sensitive to one polarisation (law of Malus).

    signal x (1 + cos_frac cos 2 psi + sin_frac sin 2 psi), psi the sensor's orientation.
    """

    typical: float = 0.02

    name = "polarisation"
    words = "a signal that depends on the orientation"
    stage = Stage.GAIN
    units = ("1", "1")
    covariates = ("orientation",)
    parameters = ("cos_frac", "sin_frac")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        columns = _columns(extent.plan)
        return cls() if np.ptp(columns, axis=1).max() > _MOST_EQUAL else None

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value * (1 + theta @ _columns(plan)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        size = float(np.hypot(*mean))
        size_sd = float(np.hypot(*(mean * sd))) / size if size > 0 else float(np.hypot(*sd))
        strongest_deg = float(np.rad2deg(np.arctan2(mean[1], mean[0])) / 2) % 180
        return (
            f"the signal varies by {value_with_sd(size, size_sd, factor=100)} % with twice the orientation and is "
            f"strongest at {strongest_deg:.0f} degrees: the light is polarised"
        )


def _columns(plan: Plan) -> FloatArray:
    """Return the cosine and the sine of twice the orientation, (2, n_points)."""
    return np.stack([np.cos(2 * plan.orientation_rad), np.sin(2 * plan.orientation_rad)])


@dataclass(frozen=True)
class AmbientGradient(CountsPlaceFromOrigin, LinearEffect[FloatArray]):
    """Stray light that grows across the table: reading + per_mm_x X + per_mm_y Y, lab frame, from `origin`."""

    typical_per_mm: float = 0.005
    unit: str = field(default="", kw_only=True)

    name = "ambient_gradient"
    words = "stray light from one side"
    stage = Stage.OFFSET
    units = ("reading/mm", "reading/mm")
    covariates = ("place",)
    parameters = ("per_mm_x", "per_mm_y")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        if not (varies(extent.plan.x_mm) or varies(extent.plan.y_mm)):
            return None
        typical = 0.01 * extent.span / extent.length_mm
        return cls(typical_per_mm=typical, unit=extent.reading_unit, origin=extent.origin)

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        x_mm, y_mm = plan.x_mm - self.origin.x_mm, plan.y_mm - self.origin.y_mm
        return np.asarray(value + theta[:, :1] * x_mm + theta[:, 1:2] * y_mm)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the reading changes by {value_with_sd(mean[0], sd[0], self.unit, factor=100)} per 100 mm along X and by "
            f"{value_with_sd(mean[1], sd[1], self.unit, factor=100)} per 100 mm along Y, over black and white alike: "
            "stray light from one side"
        )


@dataclass(frozen=True)
class OffsetDrift(CountsTimeFromOrigin, LinearEffect[FloatArray]):
    """A slow drift: reading + per_hour t, t the plan's time since `origin` in hours."""

    typical_per_hour: float = 1.0
    unit: str = field(default="", kw_only=True)

    name = "offset_drift"
    words = "a slow drift of all readings"
    stage = Stage.OFFSET
    units = ("reading/h",)
    covariates = ("time",)
    parameters = ("per_hour",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        typical = 0.01 * extent.span / (extent.duration_s / 3600)
        return cls(typical_per_hour=typical, unit=extent.reading_unit, origin=extent.origin)

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value + theta[:, :1] * self.origin.hours(plan))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "rises" if mean[0] > 0 else "falls"
        return (
            f"the reading {way} by {value_with_sd(abs(mean[0]), sd[0], self.unit)} per hour, over black and white "
            "alike: the electronics or the room light drift"
        )


@dataclass(frozen=True)
class AmbientStep(ChangePointEffect[FloatArray]):
    """Light switched on or off in the room: reading + amp 1(t > at_s)."""

    typical: float = 0.5
    unit: str = field(default="", kw_only=True)

    name = "ambient_step"
    words = "a sudden change of the room light"
    stage = Stage.OFFSET
    units = ("reading", "s")
    covariates = ("time",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        times = candidate_change_times_s(extent)
        return None if times is None else cls(times, typical=0.01 * extent.span, unit=extent.reading_unit)

    @property
    def typical_sizes(self) -> Mapping[str, float]:
        return {"amp": self.typical}

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value + theta[:, :1] * self.after_change_mask(theta, plan))

    def with_fewer_variants(self) -> Self:
        """Return the effect with all intervals: the time of the step is what identifies it."""
        return self

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "jumps up" if mean[0] > 0 else "drops"
        return (
            f"the reading {way} by {value_with_sd(abs(mean[0]), sd[0], self.unit)} at "
            f"{value_with_sd(mean[1], sd[1])} s and stays there, over black and white alike: the room light changed"
        )


@dataclass(frozen=True)
class Flicker(CountsTimeFromOrigin, WaveEffect[FloatArray]):
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
class Hysteresis(LinearEffect[FloatArray]):
    """A reading that depends on the direction of motion: reading + amp d.

    d is the sign of the last motion along X, or along Y if X did not change; 0 without motion.
    """

    typical: float = 0.5
    unit: str = field(default="", kw_only=True)
    directions: tuple[float, ...] = field(default=(-1.0, 1.0), kw_only=True)  # the signs of motion in the recording

    name = "hysteresis"
    words = "an offset that depends on the direction"
    stage = Stage.OFFSET
    units = ("reading",)
    covariates = ("direction",)
    parameters = ("amp",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        signs = tuple(np.unique(sign_of_motion(extent.plan)).tolist())
        return cls(0.01 * extent.span, unit=extent.reading_unit, directions=signs) if len(signs) > 1 else None

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value + theta[:, :1] * sign_of_motion(plan))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way, least, most = "higher" if mean[0] > 0 else "lower", self.directions[0], self.directions[-1]
        size = value_with_sd(abs(mean[0]), sd[0], self.unit, factor=most - least)
        return (
            f"readings {_IN_DIRECTION[most]} are {size} {way} than those {_IN_DIRECTION[least]}, over black and white "
            "alike: hysteresis"
        )


@dataclass(frozen=True)
class Lag(NamedEffect[FloatArray]):
    """First-order lag of the electronics: v_k = a v_(k-1) + (1 - a) y_k with a = exp(-(t_k - t_(k-1)) / tau_s).

    Here y_k are the readings without lag. The first reading of a scan has no lag.
    """

    shortest_s: float = 0.2
    longest_s: float = 20.0

    name = "lag"
    words = "a sensor that follows slowly"
    stage = Stage.LAG
    units = ("s",)
    covariates = ("slope", "direction")
    amplitudes = ()

    @property
    def nothing(self) -> Mapping[int, float]:
        return {0: 0.0}

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        return cls(shortest_s=extent.gap_s / 6, longest_s=30 * extent.gap_s)

    @cached_property
    def prior(self) -> Product:
        return Product({"tau_s": LogUniform(self.shortest_s, self.longest_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        same = np.diff(plan.scan, prepend=-1) == 0
        waited_s = np.where(same, np.maximum(np.diff(plan.time_s, prepend=0.0), 0.0), np.inf)
        tau_s = theta[:, :1]
        kept = np.where(tau_s > 0, np.exp(-waited_s / np.where(tau_s > 0, tau_s, 1.0)), 0.0)  # 0 where a scan begins
        return decaying_sum((1 - kept) * value, kept, longest=int(np.bincount(plan.scan).max(initial=1)))

    def bank(self) -> FloatArray:
        return single_column_bank(np.geomspace(self.shortest_s * 1.5, self.longest_s / 3, 7))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"each reading keeps part of the previous one, with a time constant of {value_with_sd(mean[0], sd[0])} s: "
            "the electronics lag"
        )


@dataclass(frozen=True)
class Overshoot(NamedEffect[FloatArray]):
    """An overshoot: at each rise the detector reads too high by `share` times the rise, an excess that decays.

    y_k + share x sum over j <= k of max(y_j - y_(j-1), 0) exp(-(t_k - t_j) / tau_s), y the readings without it. If
    `share` is negative, that fraction of each rise arrives late. Falls cause nothing.
    """

    typical: float = 0.02
    shortest_s: float = 0.2
    longest_s: float = 20.0

    name = "overshoot"
    words = "an overshoot where the light grows"
    stage = Stage.OFFSET
    units = ("1", "s")
    covariates = ("time", "direction", "level")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        if not np.any(np.diff(extent.plan.time_s) > 0):
            return None
        return cls(shortest_s=extent.gap_s, longest_s=30 * extent.gap_s)

    @cached_property
    def prior(self) -> Product:
        return Product({"share": HeavyTailedPrior(self.typical), "tau_s": LogUniform(self.shortest_s, self.longest_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        waited_s = np.maximum(np.diff(plan.time_s, prepend=plan.time_s[:1]), 0.0)
        rise = np.maximum(np.diff(value, axis=1, prepend=value[:, :1]), 0.0)
        decayed = decaying_sum(rise, np.exp(-waited_s / theta[:, 1:2]), longest=value.shape[1])
        return np.asarray(value + theta[:, :1] * decayed)

    def bank(self) -> FloatArray:
        return single_column_bank(self.typical, np.geomspace(self.shortest_s * 1.5, self.longest_s / 1.5, 6))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        share, tau = value_with_sd(abs(mean[0]), sd[0], factor=100), value_with_sd(mean[1], sd[1])
        if mean[0] > 0:
            return f"each rise of the signal overshoots by {share} %, which decay with a time constant of {tau} s"
        return f"{share} % of each rise of the signal comes late, with a time constant of {tau} s"


@dataclass(frozen=True)
class Saturation(NamedEffect[FloatArray]):
    """A soft upper limit: reading -> level - softness log(1 + exp((level - reading) / softness)).

    As the softness goes to zero this is min(reading, level).
    """

    lowest: float = 0.0
    highest: float = 150.0
    sharpest: float = 0.05
    softest: float = 20.0
    unit: str = field(default="", kw_only=True)

    name = "saturation"
    words = "readings cut off at a limit"
    stage = Stage.SATURATION
    units = ("reading", "reading")
    covariates = ("level",)
    amplitudes = ()

    @property
    def nothing(self) -> Mapping[int, float]:
        return {0: self.highest + 100 * self.softest}

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        return cls(
            lowest=extent.low + 0.2 * extent.span,
            highest=extent.high + 0.3 * extent.span,
            sharpest=1e-3 * extent.span,
            softest=0.3 * extent.span,
            unit=extent.reading_unit,
        )

    @cached_property
    def prior(self) -> Product:
        return Product(
            {"level": Uniform(self.lowest, self.highest), "softness": LogUniform(self.sharpest, self.softest)}
        )

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        level, softness = theta[:, :1], theta[:, 1:2]
        return np.asarray(level - softness * np.logaddexp(0.0, (level - value) / softness))

    def bank(self) -> FloatArray:
        span = (self.highest - self.lowest) / 1.1
        top = self.highest - 0.3 * span
        sharp = [(top - share * 0.8 * span, self.sharpest * 5) for share in np.geomspace(0.02, 0.9, 9)]
        soft = [(top + share * span, 0.1 * span) for share in (-0.2, -0.05, 0.1, 0.25)]
        return np.array([*sharp, *soft])[:, None, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        softness = f"{mean[1]:.2g} {self.unit}".rstrip()
        return (
            f"no reading rises above {value_with_sd(mean[0], sd[0], self.unit)}: the electronics saturate, "
            f"from about {softness} below that limit"
        )
