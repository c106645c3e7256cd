"""Samplers of effects to conceal: all parameters are drawn except the amplitude."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from probewise.recordings.patterns import Uniform
from probewise.recordings.plan import Plan
from probewise.world import concealed, unlisted
from probewise.world.stages import Concealed
from probewise.world.world import World

OfAmplitude: TypeAlias = Callable[[float], Concealed]
"""Amplitude (greater than 0) to effect."""


@dataclass(frozen=True, eq=False)
class CleanSetup:
    """A plan and a simulated sensor without effects, in which an effect will be concealed."""

    plan: Plan
    world: World

    @property
    def start_s(self) -> float:
        """Time of the first reading, s."""
        return float(self.plan.time_s[0])

    @property
    def duration_s(self) -> float:
        """Time from the first reading to the last, s."""
        return float(self.plan.time_s[-1] - self.plan.time_s[0])

    @property
    def nyquist_hz(self) -> float:
        """Half the median rate of the readings, Hz: the highest frequency that they determine."""
        return 0.5 / float(np.median(np.diff(self.plan.time_s)))

    @cached_property
    def edge_scan_names(self) -> tuple[str, ...]:
        """Names of the scans of 20 readings or more whose first reading is over a pattern that is not uniform."""
        return tuple(
            self.plan.scan_names[k]
            for k, rows in enumerate(self.plan.rows_by_scan())
            if rows.size >= 20
            and not isinstance(self.plan.patterns[self.plan.pattern_names[self.plan.pattern[rows[0]]]], Uniform)
        )

    def scans_at_orientation_of(self, scan: str) -> tuple[str, ...]:
        """Return the names of all scans, `scan` included, that start at the orientation of `scan`, in plan order."""
        first = {name: rows[0] for name, rows in zip(self.plan.scan_names, self.plan.rows_by_scan(), strict=True)}
        turn = self.plan.orientation_rad
        return tuple(name for name, row in first.items() if turn[row] == turn[first[scan]])


Draw: TypeAlias = Callable[[CleanSetup, np.random.Generator], Any]
"""Draws one parameter of an effect."""


@dataclass(frozen=True)
class EffectSampler:
    """A distribution over one kind of effect, up to its amplitude.

    `residual_covariates`: names of the covariates along which its residual is visible; `make`: function of the
    amplitude and the values that `draws` drew; returns the effect; `draws`: draw the parameters, one each, in this
    order; `first`: first amplitude of the search for a size; `limit`: largest plausible amplitude; `scalable`: whether
    the search chooses the amplitude; if False, the amplitude is `first`.
    """

    residual_covariates: tuple[str, ...]
    make: Callable[..., Concealed]
    draws: tuple[Draw, ...]
    first: float
    limit: float
    scalable: bool = True

    def draw(self, setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
        """Draw all parameters but the amplitude."""
        drawn = [draw(setup, rng) for draw in self.draws]
        return lambda amplitude: self.make(amplitude, *drawn)


def _one_of(*values: float) -> Draw:
    return lambda setup, rng: float(rng.choice(values))


def _uniform(low: float, high: float) -> Draw:
    return lambda setup, rng: rng.uniform(low, high)


def _log_uniform(low: float, high: float) -> Draw:
    return lambda setup, rng: math.exp(rng.uniform(math.log(low), math.log(high)))


def _log_uniform_up_to(low: float, high: Callable[[CleanSetup], float]) -> Draw:
    return lambda setup, rng: math.exp(rng.uniform(math.log(low), math.log(high(setup))))


def _moment(low: float, high: float) -> Draw:
    """Draw a time between these shares of the recording, s."""
    return lambda setup, rng: setup.start_s + rng.uniform(low, high) * setup.duration_s


def _edge_scan(setup: CleanSetup, rng: np.random.Generator) -> str:
    return str(rng.choice(setup.edge_scan_names))


def _edge_scans(setup: CleanSetup, rng: np.random.Generator) -> tuple[str, ...]:
    """Draw a scan, or all scans at its orientation."""
    scan = _edge_scan(setup, rng)
    return setup.scans_at_orientation_of(scan) if rng.random() < 0.5 else (scan,)


def _duration_s(setup: CleanSetup, rng: np.random.Generator) -> float:
    return setup.duration_s


_SIGN, _PHASE = _one_of(-1.0, 1.0), _uniform(0, 2 * math.pi)
_DIRECTION = (_SIGN, _uniform(-math.pi / 3, math.pi / 3))
_SPOT = (_uniform(-40, 40), _uniform(-4, 4), _log_uniform(3.0, 10.0))  # x, y and sd of a stain or glint, mm


def _signed(kind: Callable[..., Concealed]) -> Callable[..., Concealed]:
    """Return the maker of an effect whose amplitude has a random sign."""
    return lambda a, sign, *more: kind(sign * a, *more)


def _directed(kind: Callable[[float, float], Concealed]) -> Callable[..., Concealed]:
    """Return the maker of a vector within 60 degrees of +X or -X, whose length is the amplitude."""
    return lambda a, sign, angle: kind(sign * a * math.cos(angle), sign * a * math.sin(angle))


def _saturation(a: float, levels: tuple[float, float], softness: float) -> Concealed:
    """Saturate at a share `a` of the span below white, sharply or rounded over one reading unit."""
    black, white = levels
    return concealed.Saturation(white - a * (white - black), softness)


def _extra_gaussian(a: float, turn: float, sd_mm: float) -> Concealed:
    return concealed.ExtraGaussian(a, 5.0 * math.cos(turn), 1.5 + 5.0 * math.sin(turn), sd_mm)


def _chirp(a: float, phase: float, cycles: float, duration_s: float) -> Concealed:
    """Let the frequency, `cycles` per recording at first, grow eightfold by its end."""
    first_hz = cycles / duration_s
    return unlisted.Chirp(a, first_hz, 7 * first_hz / duration_s, phase)


INSIDE: Mapping[str, EffectSampler] = {
    "ambient_gradient": EffectSampler(("place",), _directed(concealed.AmbientGradient), _DIRECTION, 0.01, 2.0),
    "ambient_step": EffectSampler(("time",), _signed(concealed.AmbientStep), (_SIGN, _moment(0.15, 0.85)), 0.5, 30.0),
    "offset_drift": EffectSampler(("time",), _signed(concealed.OffsetDrift), (_SIGN,), 5.0, 500.0),
    "gain_drift": EffectSampler(
        ("time",),
        _signed(concealed.GainDrift),
        (_SIGN, _log_uniform_up_to(60.0, lambda setup: setup.duration_s)),
        0.03,
        0.9,
    ),
    "battery_sag": EffectSampler(("battery_mv",), _signed(concealed.BatterySag), (_SIGN,), 0.5, 10.0),
    "flicker": EffectSampler(
        ("time",), concealed.Flicker, (_log_uniform_up_to(0.01, lambda setup: setup.nyquist_hz), _PHASE), 0.3, 20.0
    ),
    "saturation": EffectSampler(
        ("level",),
        _saturation,
        (lambda setup, rng: (setup.world.black, setup.world.white), _one_of(0.0, 1.0)),
        0.05,
        0.9,
    ),
    "nonlinearity": EffectSampler(
        ("level",), _signed(lambda a: concealed.Nonlinearity(math.exp(a))), (_SIGN,), 0.1, 1.5
    ),
    "quantisation": EffectSampler(("lattice",), concealed.Quantisation, (), 1.0, 20.0),
    "hysteresis": EffectSampler(("direction",), _signed(concealed.Hysteresis), (_SIGN,), 0.3, 20.0),
    "lag": EffectSampler(("slope", "direction"), concealed.Lag, (), 0.5, 20.0),
    "backlash": EffectSampler(("slope", "direction"), concealed.Backlash, (), 0.5, 15.0),
    "position_scale": EffectSampler(
        ("place",),
        lambda a, sign, ratio: concealed.PositionScale(sign * a, ratio * a),
        (_SIGN, _uniform(-1, 1)),
        0.02,
        0.4,
    ),
    "periodic_position_error": EffectSampler(
        ("place",), concealed.PeriodicPositionError, (_log_uniform(4.0, 25.0), _PHASE), 0.3, 10.0
    ),
    "edge_misplacement": EffectSampler(("slope",), _signed(concealed.EdgeMisplacement), (_SIGN,), 0.3, 8.0),
    "scan_misplacement": EffectSampler(
        ("slope", "scan"), _signed(concealed.ScanMisplacement), (_SIGN, _edge_scan), 0.3, 8.0
    ),
    "scan_angle_error": EffectSampler(
        ("scan", "orientation"), _signed(concealed.ScanAngleError), (_SIGN, _edge_scans), 5.0, 45.0
    ),
    "orientation_error": EffectSampler(("orientation",), _signed(concealed.OrientationError), (_SIGN,), 5.0, 45.0),
    "sensor_tilt": EffectSampler(("orientation", "slope"), _directed(concealed.SensorTilt), _DIRECTION, 0.3, 8.0),
    "height_gradient": EffectSampler(("place",), _signed(concealed.HeightGradient), (_SIGN,), 0.01, 0.12),
    "height_offset": EffectSampler(("scan",), _signed(concealed.HeightOffset), (_SIGN, _edge_scans), 0.3, 8.0),
    "albedo_gradient": EffectSampler(("place",), _directed(concealed.AlbedoGradient), _DIRECTION, 5e-4, 0.012),
    "albedo_patch": EffectSampler(("place",), _signed(concealed.AlbedoPatch), (_SIGN, *_SPOT), 0.05, 1.0),
    "edge_blur": EffectSampler(("edge_distance",), concealed.EdgeBlur, (), 1.0, 8.0),
    "edge_shadow": EffectSampler(("edge_distance",), concealed.EdgeShadow, (_log_uniform(2.0, 8.0),), 0.02, 0.6),
    "halo": EffectSampler(("edge_distance",), concealed.Halo, (_log_uniform(12.0, 40.0),), 0.05, 0.6),
    "glint": EffectSampler(("place",), concealed.Glint, _SPOT, 1.0, 40.0),
    "ssf_order": EffectSampler(("edge_distance",), _extra_gaussian, (_PHASE, _uniform(1.5, 4.0)), 0.05, 0.5),
    "signal_dependent_noise": EffectSampler(("level",), concealed.SignalDependentNoise, (), 1.0, 100.0),
    "correlated_noise": EffectSampler(("scan",), concealed.CorrelatedNoise, (), 0.3, 0.95),
    "outliers": EffectSampler(
        (), lambda a, share: concealed.Outliers(share, a), (_log_uniform(0.01, 0.05),), 5.0, 30.0
    ),
    # The share of lost readings is half to five times the amplitude, which is fixed.
    "dropouts": EffectSampler(
        (),
        lambda a, value, factor: concealed.Dropouts(factor * a, value),
        (_one_of(0.0, 100.0), _log_uniform(0.5, 5.0)),
        0.01,
        0.01,
        scalable=False,
    ),
}
"""Samplers of the vocabulary's effects by name, in the order of the diagnosis page, section 2."""

NEEDS_SENSOR = frozenset({"orientation_error", "edge_blur"})
"""Effects that an SSF fitted to the same recording absorbs."""

NO_PHYSICS = frozenset({"ssf_order"})

SINGLES = tuple(name for name in INSIDE if name not in NEEDS_SENSOR | NO_PHYSICS)
"""Effects that a case may conceal when the sensor is calibrated on the same recording."""

PAIRABLE = tuple(name for name in SINGLES[: SINGLES.index("signal_dependent_noise")] if name != "quantisation")
"""Effects on the mean of the readings, for which a pair has a cosine."""

OUTSIDE: Mapping[str, EffectSampler] = {
    "bent_rail": EffectSampler(("place",), _signed(unlisted.QuadraticPositionError), (_SIGN,), 0.5, 20.0),
    "twisted_rail": EffectSampler(("place",), _signed(unlisted.CubicPositionError), (_SIGN,), 0.5, 20.0),
    "place_step": EffectSampler(("place",), _signed(unlisted.PlaceStep), (_SIGN, _uniform(-3, 3)), 0.5, 10.0),
    "stick_slip": EffectSampler(("place",), unlisted.StickSlip, (_log_uniform(3.0, 8.0), _uniform(0, 1)), 0.5, 8.0),
    "slipped_paper": EffectSampler(("time",), _signed(unlisted.SlippedPaper), (_SIGN, _moment(0.2, 0.8)), 0.5, 10.0),
    "ghost": EffectSampler(
        ("edge_distance",),
        lambda a, sign, dx_mm, dy_mm: unlisted.Ghost(a, sign * dx_mm, dy_mm),
        (_SIGN, _uniform(8, 20), _uniform(-5, 5)),
        0.03,
        0.5,
    ),
    "thermal_gain": EffectSampler(
        ("time",),
        unlisted.ThermalGain,
        (_duration_s, lambda setup, rng: tuple(float(phase) for phase in rng.uniform(0, 2 * math.pi, 12))),
        0.02,
        0.5,
    ),
    "cross_talk": EffectSampler(("orientation",), unlisted.OrientationDependentGain, (_PHASE,), 0.03, 0.9),
    "floor": EffectSampler(("level",), unlisted.DeadZone, (), 0.03, 0.6),
    "peak_memory": EffectSampler(("level",), unlisted.PeakMemory, (), 0.05, 2.0),
    "after_glow": EffectSampler(
        ("time",),
        unlisted.AfterGlow,
        (_log_uniform(5.0, 20.0), lambda setup, rng: (setup.world.black + setup.world.white) / 2),
        1.0,
        40.0,
    ),
    "chirp": EffectSampler(("time",), _chirp, (_PHASE, _log_uniform(2.0, 6.0), _duration_s), 0.3, 20.0),
}
"""Samplers of effects outside the vocabulary."""
