"""Samplers of effects outside the vocabulary of a diagnosis."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from probewise.proof.sensors.effect_samplers import (
    CleanSetup,
    EffectSampler,
    OfAmplitude,
    draw_log_uniform,
    draw_sign,
    make_draw_with_random_sign,
    make_draw_without_random_parameters,
)
from probewise.world import concealed


def _draw_place_step(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, at_mm = draw_sign(rng), rng.uniform(-3, 3)
    return lambda a: concealed.PlaceStep(s * a, at_mm)


def _draw_stick_slip(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    period_mm, phase = draw_log_uniform(rng, 3.0, 8.0), rng.random()
    return lambda a: concealed.StickSlip(a, period_mm, phase)


def _draw_slipped_paper(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, at_s = draw_sign(rng), setup.start_s + rng.uniform(0.2, 0.8) * setup.duration_s
    return lambda a: concealed.SlippedPaper(s * a, at_s)


def _draw_ghost(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    dx_mm, dy_mm = draw_sign(rng) * rng.uniform(8, 20), rng.uniform(-5, 5)
    return lambda a: concealed.Ghost(a, dx_mm, dy_mm)


def _draw_thermal_gain(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    phases = tuple(float(phase) for phase in rng.uniform(0, 2 * math.pi, 12))
    return lambda a: concealed.ThermalGain(a, setup.duration_s, phases)


def _draw_orientation_dependent_gain(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    phase = rng.uniform(0, 2 * math.pi)
    return lambda a: concealed.OrientationDependentGain(a, phase)


def _draw_after_glow(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    tau_s, level = draw_log_uniform(rng, 5.0, 20.0), (setup.world.black + setup.world.white) / 2
    return lambda a: concealed.AfterGlow(a, tau_s, level)


def _draw_chirp(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    phase = rng.uniform(0, 2 * math.pi)
    # By the end of the recording the frequency has grown eightfold.
    first_hz = draw_log_uniform(rng, 2.0, 6.0) / setup.duration_s
    rate = 7 * first_hz / setup.duration_s
    return lambda a: concealed.Chirp(a, first_hz, rate, phase)


OUTSIDE: Mapping[str, EffectSampler] = {
    "bent_rail": EffectSampler(("place",), make_draw_with_random_sign(concealed.QuadraticPositionError), 0.5, 20.0),
    "twisted_rail": EffectSampler(("place",), make_draw_with_random_sign(concealed.CubicPositionError), 0.5, 20.0),
    "place_step": EffectSampler(("place",), _draw_place_step, 0.5, 10.0),
    "stick_slip": EffectSampler(("place",), _draw_stick_slip, 0.5, 8.0),
    "slipped_paper": EffectSampler(("time",), _draw_slipped_paper, 0.5, 10.0),
    "ghost": EffectSampler(("edge_distance",), _draw_ghost, 0.03, 0.5),
    "thermal_gain": EffectSampler(("time",), _draw_thermal_gain, 0.02, 0.5),
    "cross_talk": EffectSampler(("orientation",), _draw_orientation_dependent_gain, 0.03, 0.9),
    "floor": EffectSampler(("level",), make_draw_without_random_parameters(concealed.DeadZone), 0.03, 0.6),
    "peak_memory": EffectSampler(("level",), make_draw_without_random_parameters(concealed.PeakMemory), 0.05, 2.0),
    "after_glow": EffectSampler(("time",), _draw_after_glow, 1.0, 40.0),
    "chirp": EffectSampler(("time",), _draw_chirp, 0.3, 20.0),
}
