"""What a case may conceal that no name of the vocabulary stands for."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from probewise.world.challenge.candidates import Candidate, OfAmplitude, Setting, log_uniform, plain, sign, signed
from probewise.world.concealed import (
    AfterGlow,
    BentRail,
    Chirp,
    CrossTalk,
    Floor,
    Ghost,
    PeakMemory,
    PlaceStep,
    SlippedPaper,
    StickSlip,
    ThermalGain,
    TwistedRail,
)

__all__ = ["OUTSIDE"]


def _place_step(setting: Setting, rng: np.random.Generator) -> OfAmplitude:
    s, at_mm = sign(rng), rng.uniform(-3, 3)
    return lambda a: PlaceStep(s * a, at_mm)


def _stick_slip(setting: Setting, rng: np.random.Generator) -> OfAmplitude:
    period_mm, phase = log_uniform(rng, 3.0, 8.0), rng.random()
    return lambda a: StickSlip(a, period_mm, phase)


def _slipped_paper(setting: Setting, rng: np.random.Generator) -> OfAmplitude:
    s, at_s = sign(rng), setting.start_s + rng.uniform(0.2, 0.8) * setting.duration_s
    return lambda a: SlippedPaper(s * a, at_s)


def _ghost(setting: Setting, rng: np.random.Generator) -> OfAmplitude:
    dx_mm, dy_mm = sign(rng) * rng.uniform(8, 20), rng.uniform(-5, 5)
    return lambda a: Ghost(a, dx_mm, dy_mm)


def _thermal_gain(setting: Setting, rng: np.random.Generator) -> OfAmplitude:
    phases = tuple(float(phase) for phase in rng.uniform(0, 2 * math.pi, 12))
    return lambda a: ThermalGain(a, setting.duration_s, phases)


def _cross_talk(setting: Setting, rng: np.random.Generator) -> OfAmplitude:
    phase = rng.uniform(0, 2 * math.pi)
    return lambda a: CrossTalk(a, phase)


def _after_glow(setting: Setting, rng: np.random.Generator) -> OfAmplitude:
    tau_s, level = log_uniform(rng, 5.0, 20.0), (setting.world.black + setting.world.white) / 2
    return lambda a: AfterGlow(a, tau_s, level)


def _chirp(setting: Setting, rng: np.random.Generator) -> OfAmplitude:
    phase = rng.uniform(0, 2 * math.pi)
    # From slow waves to eight times as fast ones, at the end of the recording.
    first_hz = log_uniform(rng, 2.0, 6.0) / setting.duration_s
    rate = 7 * first_hz / setting.duration_s
    return lambda a: Chirp(a, first_hz, rate, phase)


OUTSIDE: Mapping[str, Candidate] = {
    "bent_rail": Candidate(("place",), signed(BentRail), 0.5, 20.0),
    "twisted_rail": Candidate(("place",), signed(TwistedRail), 0.5, 20.0),
    "place_step": Candidate(("place",), _place_step, 0.5, 10.0),
    "stick_slip": Candidate(("place",), _stick_slip, 0.5, 8.0),
    "slipped_paper": Candidate(("time",), _slipped_paper, 0.5, 10.0),
    "ghost": Candidate(("edge_distance",), _ghost, 0.03, 0.5),
    "thermal_gain": Candidate(("time",), _thermal_gain, 0.02, 0.5),
    "cross_talk": Candidate(("orientation",), _cross_talk, 0.03, 0.9),
    "floor": Candidate(("level",), plain(Floor), 0.03, 0.6),
    "peak_memory": Candidate(("level",), plain(PeakMemory), 0.05, 2.0),
    "after_glow": Candidate(("time",), _after_glow, 1.0, 40.0),
    "chirp": Candidate(("time",), _chirp, 0.3, 20.0),
}
