"""Effects on the signal and the reading: response, gain, offset, memory in the readings, saturation."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray, varies
from probewise._words import value_with_sd
from probewise.effects.effect import (
    AMPLITUDE,
    MOST_FREQUENCIES,
    PHASE,
    POSITIVE,
    Declared,
    Effect,
    LightEffect,
    WaveEffect,
    acting,
    in_words,
    light_effect,
    sine_and_cosine_entries,
    single_column_bank,
    sizes_inside,
)
from probewise.effects.reference import Extent, sign_of_motion
from probewise.priors import LogHeavyTailedPrior, LogUniform, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage

_BATTERY = "battery_mv"
_REFERENCE_MV = 8000.0
_MOST_EQUAL = 0.01
_LOWEST_HZ = 0.01
_SHARE = 0.02  # typical change of the signal
_IN_DIRECTION = {-1.0: "of backward motion", 0.0: "at rest", 1.0: "of forward motion"}
_ALIKE = "over black and white alike"


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


@light_effect("nonlinearity", Stage.RESPONSE, "a bent response curve", ("level",))
def nonlinearity(kind: LightEffect, of: Extent) -> Effect:
    """A bent response curve: u -> u^gamma, u the seen white fraction clipped to 0..1."""
    return kind.bind(
        of,
        {"gamma": (LogHeavyTailedPrior(0.1), "1")},
        acting(lambda value, plan, gamma: np.clip(value, 0.0, 1.0) ** gamma),
        lambda mean, sd: (
            f"the response is bent with exponent {value_with_sd(mean[0], sd[0])}: "
            f"a half-white view reads as {100 * 0.5 ** mean[0]:.1f} % white"
        ),
        single_column_bank(np.exp([-0.1, 0.1])),
        absent={0: 1.0},
    )


_DARK, _GAIN = "another dark level than at the calibration", "another gain than at the calibration"


@light_effect("dark_level", Stage.OFFSET, _DARK, ("level",), is_absorbed_by_ssf=lambda plan: True)
def dark_level(kind: LightEffect, of: Extent) -> Effect:
    """Another dark level than at the calibration: reading + offset."""

    def says(mean: FloatArray, sd: FloatArray) -> str:
        way = "higher" if mean[0] > 0 else "lower"
        return f"since the calibration every reading is {value_with_sd(abs(mean[0]), sd[0])} {way}: other light"

    act = acting(lambda value, plan, offset: value + offset)
    return kind.bind(of, {"offset": (AMPLITUDE, "reading")}, act, says, typical=of.small_change)


@light_effect("gain", Stage.GAIN, _GAIN, ("level",), is_absorbed_by_ssf=lambda plan: True)
def gain(kind: LightEffect, of: Extent) -> Effect:
    """Another gain than at the calibration: signal x (1 + frac)."""

    def says(mean: FloatArray, sd: FloatArray) -> str:
        changed = value_with_sd(abs(mean[0]), sd[0], factor=100)
        way = "stronger" if mean[0] > 0 else "weaker"
        return f"since the calibration the signal is {changed} % {way}: the lamp, its battery or the paper"

    act = acting(lambda value, plan, frac: value * np.maximum(1 + frac, 0.0))
    return kind.bind(of, {"frac": (AMPLITUDE, "1")}, act, says, typical=_SHARE)


@light_effect("gain_drift", Stage.GAIN, "a gain that drifts", ("time",), counts="time")
def gain_drift(kind: LightEffect, of: Extent) -> Effect:
    """A lamp that warms up: signal x (1 + frac exp(-t / tau_s)), t the plan's time since the origin, 0 before it."""
    taus = LogUniform(0.01 * of.duration_s, 2 * of.duration_s)

    def since(plan: Plan) -> FloatArray:
        return np.maximum(of.origin.seconds(plan), 0.0)  # a negative time would let the exponential overflow

    says = "the signal starts {|0|} % {too strong/too weak} at time 0 and settles with a time constant of {1} s: "
    act = acting(lambda value, plan, frac, tau_s: value * (1 + frac * np.exp(-since(plan) / tau_s)))
    parameters: Declared = {"frac": (AMPLITUDE, "1"), "tau_s": (taus, "s")}
    words, bank = in_words(f"{says}the lamp warms up", factors=(100,)), single_column_bank(1.0, sizes_inside(taus, 7))
    return kind.bind(of, parameters, act, words, bank, typical=_SHARE)


@light_effect("battery_sag", Stage.GAIN, "a signal that follows the battery", (_BATTERY,), reads=(_BATTERY,))
def battery_sag(kind: LightEffect, of: Extent) -> Effect | None:
    """A lamp that dims with its battery: signal x (1 + per_volt (V - V0)), V from `battery_mv`, V0 = 8 V.

    Between recorded voltages V is interpolated in time, and beyond them it is the nearest one; it is V0 if there is
    none.
    """
    millivolts = of.plan.covariates.get(_BATTERY, np.empty(0))
    recorded = (millivolts[np.isfinite(millivolts)] - _REFERENCE_MV) / 1000
    fall = float(np.ptp(recorded)) if recorded.size else 0.0
    if not fall > 0:
        return None
    says = "the signal {loses/gains} {|0|} % for each volt that the battery falls: the lamp follows the battery"
    act = acting(lambda value, plan, per_volt: value * (1 + per_volt * _volts_above_reference(plan)))
    return kind.bind(of, {"per_volt": (AMPLITUDE, "1/V")}, act, in_words(says, factors=(100,)), typical=_SHARE / fall)


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


@light_effect("gain_jump", Stage.GAIN, "a sudden change of the signal's strength", ("time", "level"))
def gain_jump(kind: LightEffect, of: Extent) -> Effect | None:
    """The lamp or lens changes suddenly: signal x (1 + frac 1(t > at_s))."""
    says = "from {1} s on, the signal is {|0|} % {stronger/weaker}: the lamp or the lens changed suddenly"
    words = in_words(says, factors=(100,))
    return kind.step(of, {"frac": (_SHARE, "1")}, lambda v, theta, after: v * (1 + theta[:, :1] * after), words)


@light_effect("polarisation", Stage.GAIN, "a signal that depends on the orientation", ("orientation",))
def polarisation(kind: LightEffect, of: Extent) -> Effect | None:
    """Glossy paper partly polarises the light, and the sensor is more sensitive to one polarisation (law of Malus).

    signal x (1 + cos_frac cos 2 psi + sin_frac sin 2 psi), psi the sensor's orientation.
    """

    def columns(plan: Plan) -> FloatArray:
        return np.stack([np.cos(2 * plan.orientation_rad), np.sin(2 * plan.orientation_rad)])

    def says(mean: FloatArray, sd: FloatArray) -> str:
        size = float(np.hypot(*mean))
        size_sd = float(np.hypot(*(mean * sd))) / size if size > 0 else float(np.hypot(*sd))
        strongest_deg = float(np.rad2deg(np.arctan2(mean[1], mean[0])) / 2) % 180
        return (
            f"the signal varies by {value_with_sd(size, size_sd, factor=100)} % with twice the orientation and is "
            f"strongest at {strongest_deg:.0f} degrees: the light is polarised"
        )

    if np.ptp(columns(of.plan), axis=1).max() <= _MOST_EQUAL:
        return None
    sizes: Declared = {"cos_frac": (AMPLITUDE, "1"), "sin_frac": (AMPLITUDE, "1")}
    return kind.bind(of, sizes, lambda value, theta, plan: value * (1 + theta @ columns(plan)), says, typical=_SHARE)


@light_effect("ambient_gradient", Stage.OFFSET, "stray light from one side", ("place",), counts="place")
def ambient_gradient(kind: LightEffect, of: Extent) -> Effect | None:
    """Stray light that grows across the table: reading + per_mm_x X + per_mm_y Y, lab frame, from the origin."""
    if not (varies(of.plan.x_mm) or varies(of.plan.y_mm)):
        return None
    at, unit = of.origin, of.reading_unit
    slopes: Declared = {"per_mm_x": (AMPLITUDE, "reading/mm"), "per_mm_y": (AMPLITUDE, "reading/mm")}
    says = f"the reading changes by {{0}} per 100 mm along X and by {{1}} per 100 mm along Y, {_ALIKE}: stray light "
    words = in_words(f"{says}from one side", unit, unit, factors=(100, 100))
    act = acting(lambda value, plan, x, y: value + x * (plan.x_mm - at.x_mm) + y * (plan.y_mm - at.y_mm))
    return kind.bind(of, slopes, act, words, typical=of.small_change / of.length_mm)


@light_effect("offset_drift", Stage.OFFSET, "a slow drift of all readings", ("time",), counts="time")
def offset_drift(kind: LightEffect, of: Extent) -> Effect:
    """A slow drift: reading + per_hour t, t the plan's time since the origin in hours."""
    says = f"the reading {{rises/falls}} by {{|0|}} per hour, {_ALIKE}: the electronics or the room light drift"
    typical, words = of.small_change / (of.duration_s / 3600), in_words(says, of.reading_unit)
    act = acting(lambda value, plan, per_hour: value + per_hour * of.origin.hours(plan))
    return kind.bind(of, {"per_hour": (AMPLITUDE, "reading/h")}, act, words, typical=typical)


@light_effect("ambient_step", Stage.OFFSET, "a sudden change of the room light", ("time",))
def ambient_step(kind: LightEffect, of: Extent) -> Effect | None:
    """Light switched on or off in the room: reading + amp 1(t > at_s)."""
    says = f"the reading {{jumps up/drops}} by {{|0|}} at {{1}} s and stays there, {_ALIKE}: the room light changed"
    words, sizes = in_words(says, of.reading_unit), {"amp": (of.small_change, "reading")}
    return kind.step(of, sizes, lambda value, theta, after: value + theta[:, :1] * after, words, is_thinned=False)


@light_effect("flicker", Stage.OFFSET, "a flickering lamp", ("time",), counts="time")
def flicker(kind: LightEffect, of: Extent) -> Effect | None:
    """One frequency in the light: reading + amp sin(2 pi alias_hz t + phase), t the time since the origin.

    The mains frequency aliased by the sampling, or a slow lamp: any frequency up to half the rate of readings.
    """
    highest = 0.5 / of.gap_s
    if highest <= _LOWEST_HZ:
        return None
    n = int(np.clip(np.ceil(2 * (highest - _LOWEST_HZ) * of.duration_s), 8, MOST_FREQUENCIES))
    return kind.bind(
        of,
        {"amp": (POSITIVE, "reading"), "alias_hz": (Uniform(_LOWEST_HZ, highest), "Hz"), "phase": (PHASE, "rad")},
        acting(lambda value, plan, a, hz, at: value + a * np.sin(2 * np.pi * hz * of.origin.seconds(plan) + at)),
        lambda mean, sd: (
            f"the reading oscillates with an amplitude of {value_with_sd(mean[0], sd[0], of.reading_unit)} at "
            f"{value_with_sd(mean[1], sd[1])} Hz (a period of {1 / mean[1]:.4g} s), {_ALIKE}: a lamp flickers"
        ),
        sine_and_cosine_entries(1.0, np.linspace(_LOWEST_HZ, highest, n + 2)[1:-1]),
        typical=of.small_change,
        kind=WaveEffect,
    )


@light_effect("hysteresis", Stage.OFFSET, "an offset that depends on the direction", ("direction",))
def hysteresis(kind: LightEffect, of: Extent) -> Effect | None:
    """A reading that depends on the direction of motion: reading + amp d.

    d is the sign of the last motion along X, or along Y if X did not change; 0 without motion.
    """
    least, *more = np.unique(sign_of_motion(of.plan)).tolist()
    if not more:
        return None
    way, other = _IN_DIRECTION[more[-1]], _IN_DIRECTION[least]
    says = f"readings {way} are {{|0|}} {{higher/lower}} than those {other}, {_ALIKE}: hysteresis"
    words = in_words(says, of.reading_unit, factors=(more[-1] - least,))
    act = acting(lambda value, plan, amp: value + amp * sign_of_motion(plan))
    return kind.bind(of, {"amp": (AMPLITUDE, "reading")}, act, words, typical=of.small_change)


@light_effect("lag", Stage.LAG, "a sensor that follows slowly", ("slope", "direction"))
def lag(kind: LightEffect, of: Extent) -> Effect:
    """First-order lag of the electronics: v_k = a v_(k-1) + (1 - a) y_k with a = exp(-(t_k - t_(k-1)) / tau_s).

    Here y_k are the readings without lag. The first reading of a scan has no lag.
    """
    shortest_s, longest_s = of.gap_s / 6, 30 * of.gap_s

    def act(value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        same, tau_s = np.diff(plan.scan, prepend=-1) == 0, theta[:, :1]
        waited_s = np.where(same, np.maximum(np.diff(plan.time_s, prepend=0.0), 0.0), np.inf)
        kept = np.where(tau_s > 0, np.exp(-waited_s / np.where(tau_s > 0, tau_s, 1.0)), 0.0)  # 0 where a scan begins
        return decaying_sum((1 - kept) * value, kept, longest=int(np.bincount(plan.scan).max(initial=1)))

    says = in_words("each reading keeps part of the previous one, with a time constant of {0} s: the electronics lag")
    parameters: Declared = {"tau_s": (LogUniform(shortest_s, longest_s), "s")}
    bank = single_column_bank(np.geomspace(shortest_s * 1.5, longest_s / 3, 7))
    return kind.bind(of, parameters, act, says, bank, absent={0: 0.0})


@light_effect("overshoot", Stage.OFFSET, "an overshoot where the light grows", ("time", "direction", "level"))
def overshoot(kind: LightEffect, of: Extent) -> Effect | None:
    """An overshoot: at each rise the detector reads too high by `share` times the rise, an excess that decays.

    y_k + share x sum over j <= k of max(y_j - y_(j-1), 0) exp(-(t_k - t_j) / tau_s), y the readings without it. If
    `share` is negative, that fraction of each rise arrives late. Falls cause nothing.
    """
    if not np.any(np.diff(of.plan.time_s) > 0):
        return None
    taus = LogUniform(of.gap_s, 30 * of.gap_s)

    def act(value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        waited_s = np.maximum(np.diff(plan.time_s, prepend=plan.time_s[:1]), 0.0)
        rise = np.maximum(np.diff(value, axis=1, prepend=value[:, :1]), 0.0)
        return value + theta[:, :1] * decaying_sum(rise, np.exp(-waited_s / theta[:, 1:2]), longest=value.shape[1])

    def says(mean: FloatArray, sd: FloatArray) -> str:
        above = "each rise of the signal overshoots by {0} %, which decay"
        how = above if mean[0] > 0 else "{|0|} % of each rise of the signal comes late,"
        return in_words(f"{how} with a time constant of {{1}} s", factors=(100,))(mean, sd)

    parameters: Declared = {"share": (AMPLITUDE, "1"), "tau_s": (taus, "s")}
    return kind.bind(of, parameters, act, says, single_column_bank(1.0, sizes_inside(taus, 6)), typical=_SHARE)


@light_effect("saturation", Stage.SATURATION, "readings cut off at a limit", ("level",))
def saturation(kind: LightEffect, of: Extent) -> Effect:
    """A soft upper limit: reading -> level - softness log(1 + exp((level - reading) / softness)).

    As the softness goes to zero this is min(reading, level).
    """
    lowest, highest = of.low + 0.2 * of.span, of.high + 0.3 * of.span
    sharpest, softest, unit = 1e-3 * of.span, 0.3 * of.span, of.reading_unit
    span = (highest - lowest) / 1.1
    top = highest - 0.3 * span
    sharp = [(top - share * 0.8 * span, sharpest * 5) for share in np.geomspace(0.02, 0.9, 9)]
    soft = [(top + share * span, 0.1 * span) for share in (-0.2, -0.05, 0.1, 0.25)]

    return kind.bind(
        of,
        {"level": (Uniform(lowest, highest), "reading"), "softness": (LogUniform(sharpest, softest), "reading")},
        acting(lambda value, plan, level, soft: level - soft * np.logaddexp(0.0, (level - value) / soft)),
        lambda mean, sd: (
            f"no reading rises above {value_with_sd(mean[0], sd[0], unit)}: the electronics saturate, "
            f"from about {f'{mean[1]:.2g} {unit}'.rstrip()} below that limit"
        ),
        np.array([*sharp, *soft])[:, None, :],
        absent={0: highest + 100 * softest},
    )
