"""Effects that the sensor model may leave out in a run, as rivals of the calibrated sensor.

The effects and their typical sizes are those of the diagnosis. But before the first reading of a run, nothing is known
of places and times. So effects of the pose and of the footprint take their scales from a scan of 100 mm, as in a
calibration; effects that change with the place, from the whole field; with time, from 150 s. Effects too small for a
dozen readings are excluded (`EffectWithRunPrior`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects import VOCABULARY, Extent, NamedEffect
from probewise.effects.pose import Backlash
from probewise.effects.reading import AmbientStep, GainDrift, Hysteresis, Lag, OffsetDrift
from probewise.errors import ParameterError
from probewise.experiment.declared_noise import DeclaredNoise
from probewise.experiment.effect_with_run_prior import EffectWithRunPrior
from probewise.experiment.noise_rivals import noise_likelihoods
from probewise.experiment.pace import EACH_S, DescribedEffect, EffectInPacedTime, FromRest
from probewise.inference.problem import Likelihood
from probewise.inquiry import cards_of
from probewise.recordings.plan import Instrumentation, Plan
from probewise.sensor import Chain, FixedLevels
from probewise.sensor.stages import SensorModel

_DURATION_S = 150.0
_SCAN_MM = 100.0

ON_FIELD = {
    "ambient_gradient": True,
    "ambient_step": False,
    "offset_drift": False,
    "gain_drift": False,
    "saturation": False,
    "nonlinearity": False,
    "albedo_gradient": True,
    "hysteresis": False,
    "lag": False,
    "backlash": False,
    "edge_blur": False,
    "edge_shadow": False,
    "halo": False,
    "periodic_position_error": False,
    "height_gradient": True,
    "albedo_patch": True,
    "glint": True,
}
"""Effects on the mean that are detectable over a shape on a field, and whether their scale is the field's."""

WITH_CARDS = {"sensor_tilt": False, "position_scale": True}
"""Effects that are aliased with another shape, unless there is a card at a known place."""

_IN_TIME = frozenset({AmbientStep.name, OffsetDrift.name, GainDrift.name, Lag.name})

OF_MOTION = frozenset({Backlash.name, Hysteresis.name})
"""Effects of the direction from which the arm comes."""


@dataclass(frozen=True, eq=False)
class SensorModelRival:
    """One alternative to the sensor model: an `effect` on the noise-free reading, or another `likelihood`; not both."""

    name: str
    effect: DescribedEffect | None = None
    likelihood: Likelihood | None = None


def rivals_of(
    model: SensorModel, likelihood: Likelihood, field_mm: tuple[float, float], *, height_mm: float | None = None
) -> tuple[SensorModelRival, ...]:
    """Return the rivals of a sensor model: effects that it leaves out, and other noise.

    Parameters
    ----------
    model
        A chain with known levels.
    likelihood
        `GaussianKnown` with one sd, or `Rounded`; for any other, no noise models are among the rivals.
    field_mm
        Width and height of the field.
    height_mm
        Height of the sensor above the surface as it was calibrated; None: not known.

    Raises
    ------
    ParameterError
        If the model is no `Chain` with known levels, and so does not support effects.
    """
    if not isinstance(model, Chain) or not isinstance(model.levels, FixedLevels):
        raise ParameterError(
            "trust",
            "below 1",
            '1 with a sensor model that is naive, is learnt along, or is one of your own: "--trust 1"',
        )
    ends = sorted((model.levels.i_min, model.levels.i_max))
    carried = {effect.name for effect in model.effects}
    found = []
    shown = {**ON_FIELD, **WITH_CARDS} if cards_of(model) else ON_FIELD
    for name, wide in shown.items():
        reach_mm = math.hypot(*field_mm) if wide else _SCAN_MM
        effect = VOCABULARY[name].for_extent(Extent(ends[0], ends[1], _plan_there_and_back(reach_mm, height_mm)))
        if effect is not None and name not in carried:
            found += [SensorModelRival(name, effect=way) for way in _forms_of_effect_in_run(effect, field_mm)]
    noise = DeclaredNoise.from_likelihood(likelihood)
    if noise is not None:
        laws = noise_likelihoods(noise, (model.levels.i_min, model.levels.i_max))
        found += [SensorModelRival(name, likelihood=law) for name, law in laws.items()]
    return tuple(found)


def _forms_of_effect_in_run(effect: NamedEffect[FloatArray], field_mm: tuple[float, float]) -> list[DescribedEffect]:
    """Return the forms in which an effect may act in a run, with a run's prior; effects of time act in paced time."""
    if effect.name in OF_MOTION:
        return [EffectWithRunPrior(effect, field_mm), FromRest(EffectWithRunPrior(effect, field_mm))]
    if effect.name not in _IN_TIME:
        return [EffectWithRunPrior(effect, field_mm)]
    ways = [effect, GainLoss.from_gain_drift(effect)] if isinstance(effect, GainDrift) else [effect]
    return [EffectInPacedTime(EffectWithRunPrior(way, field_mm)) for way in ways]


@dataclass(frozen=True)
class GainLoss(GainDrift):
    """A lamp that starts as calibrated and then changes: signal x (1 + frac (1 - exp(-t / tau_s)))."""

    @classmethod
    def from_gain_drift(cls, drift: GainDrift) -> Self:
        """Build with the scales of the priors of `drift`, an effect whose signal ends as calibrated."""
        return cls(drift.typical, drift.shortest_s, drift.longest_s)

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Scale the signal, (n_samples, n_points), but not the dark level."""
        gone = -np.expm1(-np.maximum(plan.time_s, 0.0) / theta[:, 1:2])
        return np.asarray(value * np.maximum(1 + theta[:, :1] * gone, 0.0))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Describe the change of the signal in percent, and its speed."""
        way = "rises" if mean[0] > 0 else "falls"
        in_the_end = 100 * abs(mean[0])
        return (
            f"the signal {way} by {in_the_end:.2g} % in the end, {-in_the_end * math.expm1(-60 / mean[1]):.2g} % in "
            "the first minute of this: the lamp or its battery changes"
        )


def _plan_there_and_back(length_mm: float, height_mm: float | None) -> Plan:
    """Return a plan of one scan of `length_mm` there and back over 150 s, from which effects take their scales."""
    n = 2 * int(_DURATION_S / EACH_S / 2) + 1
    zeros = np.zeros(n, dtype=np.int64)
    return Plan(
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
