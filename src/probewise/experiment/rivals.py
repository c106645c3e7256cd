"""Effects that the sensor model may leave out in a run, as rivals of the calibrated sensor.

The effects and their typical sizes are those of the diagnosis. But before the first reading of a run, nothing is known
of places and times. So effects of the pose and of the footprint take their scales from a scan of 100 mm, as in a
calibration; effects that change with the place, from the whole field. Effects in time use paced time, which is 0 at the
first reading and scaled so that each reading takes eight seconds on average: their priors are set before the speed of
the instrument is known. Effects too small for a dozen readings are excluded (`_prior_for_run`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self, cast

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.arm.instrument import Reading
from probewise.effects import (
    Effect,
    Extent,
    HeavyTailedPrior,
    LightEffect,
    LogHeavyTailedPrior,
    light_effect,
    optics,
    pose,
    reading,
)
from probewise.effects.effect import AMPLITUDE
from probewise.effects.optics import PatchPrior
from probewise.errors import ParameterError
from probewise.experiment.noise_rivals import DeclaredNoise, noise_likelihoods
from probewise.inference.problem import Likelihood
from probewise.priors import LogUniform, Marginal, Uniform
from probewise.recordings.plan import Instrumentation, Plan
from probewise.sensor import Chain, FixedLevels
from probewise.sensor.chain import cards_of
from probewise.sensor.stages import AnyEffect, Poses, SensorModel, Stage

OF_MOTION = frozenset({"backlash", "hysteresis"})
"""Effects of the direction from which the arm comes."""

PACED_S_PER_READING = 8.0
"""Seconds of paced time that each reading takes on average."""

_IN_TIME = frozenset({"ambient_step", "offset_drift", "gain_drift", "lag"})
_PACED = "paced_s"  # column of a plan
_DURATION_S = 150.0
_SCAN_MM = 100.0
_SMALLEST = 4.0  # sd of an effect's size, in typical sizes of a recording: a smaller one hardly moves the shape
_POWERS_OF_S = {"at_s": 1, "tau_s": 1, "per_hour": -1}
_SCALE_SAYS = (
    "the arm moves {} % too far along {}, or as much too short along {}: the shape is in the arm's own lengths"
)


@dataclass(frozen=True, eq=False)
class SensorModelRival:
    """One alternative to the sensor model: an `effect` on the noise-free reading, or another `likelihood`; not both."""

    name: str
    effect: Effect | None = None
    likelihood: Likelihood | None = None


def rivals_of(
    model: SensorModel, likelihood: Likelihood, field_mm: tuple[float, float], *, height_mm: float | None = None
) -> tuple[SensorModelRival, ...]:
    """Return the rivals of a sensor model: effects that it leaves out, and other noise.

    The model has to be a chain with known levels (else ParameterError); unless the likelihood is `GaussianKnown` with
    one sd, or `Rounded`, no noise models are among the rivals. `field_mm` is width and height of the field, `height_mm`
    that of the sensor above the surface as it was calibrated (None: not known).
    """
    if not isinstance(model, Chain) or not isinstance(model.levels, FixedLevels):
        allowed = '1 with a sensor model that is naive, is learnt along, or is one of your own: "--trust 1"'
        raise ParameterError("trust", "below 1", allowed)
    dark, bright = model.levels.i_min, model.levels.i_max
    carried = {effect.name for effect in model.effects}
    rivals = []
    n = 2 * int(_DURATION_S / PACED_S_PER_READING / 2) + 1
    zeros = np.zeros(n, dtype=np.int64)
    for kind in (*ON_FIELD, *(WITH_CARDS if cards_of(model) else WITHOUT_CARDS)):
        length_mm = math.hypot(*field_mm) if kind in _OF_WHOLE_FIELD else _SCAN_MM
        plan = Plan(  # a scan there and back, from which effects take their scales
            x_mm=length_mm * (1.0 - np.abs(np.linspace(-1.0, 1.0, n))),
            y_mm=np.zeros(n),
            orientation_rad=np.zeros(n),
            time_s=np.linspace(0.0, _DURATION_S, n),
            scan=zeros,
            scan_names=("field",),
            pattern=zeros,
            pattern_names=("field",),
            instrumentation=Instrumentation(height_mm=height_mm),
        )
        effect = kind.for_extent(Extent(min(dark, bright), max(dark, bright), plan))
        if effect is not None and carried.isdisjoint(kind.name.split("+")):
            in_run = replace(effect, parameters=_prior_for_run(effect, field_mm))
            if kind.name in OF_MOTION:
                in_run = from_rest(in_run)
            elif kind.name in _IN_TIME:
                in_run = in_paced_time(in_run)
            rivals.append(SensorModelRival(kind.name, effect=in_run))
    noise = DeclaredNoise.from_likelihood(likelihood)
    laws = {} if noise is None else noise_likelihoods(noise, (dark, bright))
    return (*rivals, *(SensorModelRival(name, likelihood=law) for name, law in laws.items()))


@light_effect("gain_drift", Stage.GAIN, "a gain that drifts", ("time",), counts="time")
def gain_loss(kind: LightEffect, of: Extent) -> Effect:
    """Return a lamp that starts as calibrated and then changes: signal x (1 + frac (1 - exp(-t / tau_s)))."""

    def act(value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        gone = -np.expm1(-np.maximum(plan.time_s, 0.0) / theta[:, 1:2])
        return value * np.maximum(1 + theta[:, :1] * gone, 0.0)

    def says(mean: FloatArray, sd: FloatArray) -> str:
        way, in_the_end = "rises" if mean[0] > 0 else "falls", 100 * abs(mean[0])
        return (
            f"the signal {way} by {in_the_end:.2g} % in the end, {-in_the_end * math.expm1(-60 / mean[1]):.2g} % in "
            "the first minute of this: the lamp or its battery changes"
        )

    return replace(cast(Effect, reading.gain_drift.build(kind, of)), apply=act, sentence=says)


@light_effect("position_scale", Stage.POSE, "a wrong scale of one axis", ("place", "slope"))
def scale_of_x(kind: LightEffect, of: Extent) -> Effect:
    """Return a wrong scale of X alone, which no circle can imitate."""
    return _scale_of_axis(kind, of, "x", "y")


@light_effect("position_scale", Stage.POSE, "a wrong scale of one axis", ("place", "slope"))
def scale_of_y(kind: LightEffect, of: Extent) -> Effect:
    """Return a wrong scale of Y alone, which no circle can imitate."""
    return _scale_of_axis(kind, of, "y", "x")


def _scale_of_axis(kind: LightEffect, of: Extent, axis: str, other: str) -> Effect:
    place = f"{axis}_mm"

    def act(value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        return replace(value, **{place: getattr(value, place) * (1 + theta[:, :1])})

    def says(mean: FloatArray, sd: FloatArray) -> str:
        return _SCALE_SAYS.format(value_with_sd(mean[0], sd[0], factor=100), axis.upper(), other.upper())

    return kind.bind(of, {axis: (AMPLITUDE, "1")}, act, says, typical=0.01)


@light_effect("dark_level+gain", Stage.GAIN, "other levels than at the calibration", ("level",))
def dark_level_and_gain(kind: LightEffect, of: Extent) -> Effect:
    """Return both changes since the calibration at once, as on another day: signal x (1 + frac) + offset."""
    level, signal = (cast(Effect, form.for_extent(of)) for form in (reading.dark_level, reading.gain))

    def act(value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(level.apply(signal.apply(value, theta[:, 1:], plan), theta[:, :1], plan))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        return f"{level.sentence(mean[:1], sd[:1])}; and {signal.sentence(mean[1:], sd[1:])}"

    priors = {**level.marginals, **signal.marginals}
    return kind.bind(of, {name: (prior, "") for name, prior in priors.items()}, act, says, np.zeros((0, 1, 2)))


LEVELS_CHANGED = (reading.dark_level, reading.gain, dark_level_and_gain)
"""Changes of the levels since the calibration, one or both, constant in a run."""

ON_FIELD = (
    reading.ambient_gradient,
    reading.ambient_step,
    reading.offset_drift,
    reading.gain_drift,
    gain_loss,
    reading.saturation,
    reading.nonlinearity,
    optics.albedo_gradient,
    reading.hysteresis,
    reading.lag,
    pose.backlash,
    pose.play_of_axes,
    optics.edge_blur,
    optics.edge_shadow,
    optics.halo,
    pose.periodic_position_error,
    optics.height_gradient,
    optics.albedo_patch,
    optics.glint,
)
"""Effects on the mean that are detectable over a shape on a field, each form of one by itself."""

WITH_CARDS = (pose.sensor_tilt, pose.position_scale, *LEVELS_CHANGED)
WITHOUT_CARDS = (*LEVELS_CHANGED, scale_of_x, scale_of_y)
"""Further ones: a tilt and a scale of both axes are aliased with another shape, unless a card is at a known place."""

_OF_WHOLE_FIELD = (  # their scale is the field's
    reading.ambient_gradient,
    optics.albedo_gradient,
    optics.height_gradient,
    optics.albedo_patch,
    optics.glint,
    pose.position_scale,
)


def _prior_for_run(effect: Effect, field_mm: tuple[float, float]) -> Mapping[str, Marginal]:
    """Return an effect's priors for a single run: sizes large enough to matter, and times within the run.

    A diagnosis of hundreds of readings weighs effects of all sizes, most of them far too small to change the dozen
    readings of a run or its shape. A change point is log-uniform over up to a hundred readings. A patch may lie
    anywhere on the field, of width and height `field_mm`, not only along scanned lines.
    """
    if isinstance(prior := effect.prior, PatchPrior):
        size = HeavyTailedPrior(prior.typical, smallest=_SMALLEST)
        x, y = (Uniform(0.0, length) for length in field_mm)
        return {prior.size: size, "x": x, "y": y, "r": prior.radius_prior}
    marginals = dict(effect.marginals)
    for name, marginal in marginals.items():
        if isinstance(marginal, HeavyTailedPrior | LogHeavyTailedPrior):
            marginals[name] = replace(marginal, smallest=_SMALLEST)
        elif name == "at_s":
            marginals[name] = LogUniform(0.5 * PACED_S_PER_READING, 100.0 * PACED_S_PER_READING)
    return marginals


def in_paced_time(effect: Effect) -> Effect:
    """Return an effect whose times and rates are in paced time; in recorded time if the plan has no paced time."""

    def act(value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        time_s = paced_time_s(plan)
        return np.asarray(effect.apply(value, theta, plan if time_s is None else replace(plan, time_s=time_s)))

    return replace(effect, apply=act, binding=replace(effect.binding, source=partial(in_paced_time, effect)))


def from_rest(effect: Effect) -> Effect:
    """Return an effect of the direction of motion that spares a run's first reading: the arm may have rested before."""

    def act(value: Any, theta: FloatArray, plan: Plan) -> Any:
        moved = effect.apply(value, theta, plan)
        time_s = paced_time_s(plan)
        if time_s is None or not (first := time_s <= 0.0).any():
            return moved
        if not isinstance(value, Poses):
            return np.where(first, value, moved)
        x_mm, y_mm = np.where(first, value.x_mm, moved.x_mm), np.where(first, value.y_mm, moved.y_mm)
        return replace(moved, x_mm=x_mm, y_mm=y_mm)

    return replace(effect, apply=act, binding=replace(effect.binding, source=partial(from_rest, effect)))


@dataclass(frozen=True)
class Pace:
    """Start time of a run in seconds, and mean seconds per reading."""

    start_s: float = 0.0
    s_per_reading: float = PACED_S_PER_READING

    @classmethod
    def from_times(cls, time_s: FloatArray) -> Self:
        """Take the start and the mean seconds per reading from the readings' times; the default for fewer than two."""
        if len(time_s) < 2 or time_s[-1] <= time_s[0]:
            return cls(float(time_s[0]) if len(time_s) else 0.0)
        return cls(float(time_s[0]), float(time_s[-1] - time_s[0]) / (len(time_s) - 1))

    @classmethod
    def from_readings(cls, readings: Sequence[Reading]) -> Self:
        """Take the pace of some readings."""
        return cls.from_times(np.array([reading.time_s for reading in readings]))

    def plan_with_paced_time(self, plan: Plan) -> Plan:
        """Return the plan with a column of paced time."""
        paced_s = (plan.time_s - self.start_s) * (PACED_S_PER_READING / self.s_per_reading)
        return replace(plan, covariates={**plan.covariates, _PACED: paced_s})

    def in_seconds(self, effect: AnyEffect, theta: FloatArray) -> FloatArray:
        """Return an effect's parameters, (..., n_params), in seconds: those in paced time are converted."""
        return np.asarray(theta * (self.s_per_reading / PACED_S_PER_READING) ** powers_of_s(effect))


def powers_of_s(effect: AnyEffect | None) -> FloatArray:
    """Return the power of paced seconds in each parameter's unit, (n_params,); 0 but for effects of time."""
    if effect is None or effect.name not in _IN_TIME:
        return np.zeros(0 if effect is None else len(effect.prior.names))
    return np.array([float(_POWERS_OF_S.get(name, 0)) for name in effect.prior.names])


def paced_time_s(plan: Plan) -> FloatArray | None:
    """Return the paced time of each reading, (n_points,); None if the plan has no such column."""
    return plan.covariates.get(_PACED)
