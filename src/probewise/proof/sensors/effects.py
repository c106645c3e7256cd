"""Samplers of effects to conceal: all parameters are drawn except the amplitude."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

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


Draw: TypeAlias = Callable[[CleanSetup, np.random.Generator], OfAmplitude]
"""Draws all parameters of an effect except its amplitude."""


@dataclass(frozen=True)
class EffectSampler:
    """A distribution over one kind of effect, up to its amplitude.

    Parameters
    ----------
    residual_covariates
        Names of the covariates along which its residual is visible.
    draw
        Function of a setup and a generator that draws all parameters but the amplitude: returns amplitude -> effect.
    first
        First amplitude of the search for a size.
    limit
        Largest plausible amplitude.
    scalable
        Whether the search chooses the amplitude; if False, the amplitude is `first`.
    """

    residual_covariates: tuple[str, ...]
    draw: Draw
    first: float
    limit: float
    scalable: bool = True


def draw_sign(rng: np.random.Generator) -> float:
    """Draw +1.0 or -1.0, equally likely."""
    return float(rng.choice([-1.0, 1.0]))


def draw_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number between `low` and `high` whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def make_draw_without_random_parameters(make: OfAmplitude) -> Draw:
    """Return `EffectSampler.draw` for an effect whose only parameter is its amplitude: nothing is drawn."""
    return lambda setup, rng: make


def make_draw_with_random_sign(make: OfAmplitude) -> Draw:
    """Return `EffectSampler.draw` for an effect of which only the sign of the amplitude is drawn."""

    def draw(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
        s = draw_sign(rng)
        return lambda a: make(s * a)

    return draw


def _make_draw_with_random_direction(make: Callable[[float, float], Concealed]) -> Draw:
    """Return `EffectSampler.draw` for a vector: direction within 60 degrees of +X or -X, length = amplitude."""

    def draw(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
        s, angle = draw_sign(rng), rng.uniform(-math.pi / 3, math.pi / 3)
        return lambda a: make(s * a * math.cos(angle), s * a * math.sin(angle))

    return draw


def _draw_ambient_step(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, at_s = draw_sign(rng), setup.start_s + rng.uniform(0.15, 0.85) * setup.duration_s
    return lambda a: concealed.AmbientStep(s * a, at_s)


def _draw_gain_drift(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, tau_s = draw_sign(rng), draw_log_uniform(rng, 60.0, setup.duration_s)
    return lambda a: concealed.GainDrift(s * a, tau_s)


def _draw_flicker(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    alias_hz, phase = draw_log_uniform(rng, 0.01, setup.nyquist_hz), rng.uniform(0, 2 * math.pi)
    return lambda a: concealed.Flicker(a, alias_hz, phase)


def _draw_saturation(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    """Draw a saturation, sharp or rounded over one reading unit; amplitude: (white - level) / (white - black)."""
    white, span = setup.world.white, setup.world.white - setup.world.black
    softness = float(rng.choice([0.0, 1.0]))
    return lambda a: concealed.Saturation(white - a * span, softness)


def _draw_position_scale(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, ratio = draw_sign(rng), rng.uniform(-1, 1)
    return lambda a: concealed.PositionScale(s * a, ratio * a)


def _draw_periodic_position_error(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    period_mm, phase = draw_log_uniform(rng, 4.0, 25.0), rng.uniform(0, 2 * math.pi)
    return lambda a: concealed.PeriodicPositionError(a, period_mm, phase)


def _draw_scan_misplacement(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, scan = draw_sign(rng), str(rng.choice(setup.edge_scan_names))
    return lambda a: concealed.ScanMisplacement(s * a, scan)


def _make_draw_with_random_scans(make: Callable[[float, tuple[str, ...]], Concealed]) -> Draw:
    """Return `EffectSampler.draw` for an effect of random sign on a random scan or all scans at its orientation."""

    def draw(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
        s, scan = draw_sign(rng), str(rng.choice(setup.edge_scan_names))
        scans = setup.scans_at_orientation_of(scan) if rng.random() < 0.5 else (scan,)
        return lambda a: make(s * a, scans)

    return draw


def _draw_patch_place(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw x (-40 to 40), y (-4 to 4) and sd (3 to 10) of a stain or glint, all in mm."""
    return rng.uniform(-40, 40), rng.uniform(-4, 4), draw_log_uniform(rng, 3.0, 10.0)


def _draw_albedo_patch(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, (x, y, r) = draw_sign(rng), _draw_patch_place(rng)
    return lambda a: concealed.AlbedoPatch(s * a, x, y, r)


def _draw_glint(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    x, y, r = _draw_patch_place(rng)
    return lambda a: concealed.Glint(a, x, y, r)


def _draw_edge_shadow(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    w = draw_log_uniform(rng, 2.0, 8.0)
    return lambda a: concealed.EdgeShadow(a, w)


def _draw_halo(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    r_mm = draw_log_uniform(rng, 12.0, 40.0)
    return lambda a: concealed.Halo(a, r_mm)


def _draw_extra_gaussian(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    turn, sd_mm = rng.uniform(0, 2 * math.pi), rng.uniform(1.5, 4.0)
    return lambda a: concealed.ExtraGaussian(a, 5.0 * math.cos(turn), 1.5 + 5.0 * math.sin(turn), sd_mm)


def _draw_outliers(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    share = draw_log_uniform(rng, 0.01, 0.05)
    return lambda a: concealed.Outliers(share, a)


def _draw_dropouts(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    """Draw the value of lost readings, 0 or 100, and their share: 0.5 to 5 times the amplitude (fixed at 0.01)."""
    value, factor = float(rng.choice([0.0, 100.0])), draw_log_uniform(rng, 0.5, 5.0)
    return lambda a: concealed.Dropouts(factor * a, value)


INSIDE: Mapping[str, EffectSampler] = {
    "ambient_gradient": EffectSampler(
        ("place",), _make_draw_with_random_direction(concealed.AmbientGradient), 0.01, 2.0
    ),
    "ambient_step": EffectSampler(("time",), _draw_ambient_step, 0.5, 30.0),
    "offset_drift": EffectSampler(("time",), make_draw_with_random_sign(concealed.OffsetDrift), 5.0, 500.0),
    "gain_drift": EffectSampler(("time",), _draw_gain_drift, 0.03, 0.9),
    "battery_sag": EffectSampler(("battery_mv",), make_draw_with_random_sign(concealed.BatterySag), 0.5, 10.0),
    "flicker": EffectSampler(("time",), _draw_flicker, 0.3, 20.0),
    "saturation": EffectSampler(("level",), _draw_saturation, 0.05, 0.9),
    "nonlinearity": EffectSampler(
        ("level",), make_draw_with_random_sign(lambda a: concealed.Nonlinearity(math.exp(a))), 0.1, 1.5
    ),
    "quantisation": EffectSampler(("lattice",), make_draw_without_random_parameters(concealed.Quantisation), 1.0, 20.0),
    "hysteresis": EffectSampler(("direction",), make_draw_with_random_sign(concealed.Hysteresis), 0.3, 20.0),
    "lag": EffectSampler(("slope", "direction"), make_draw_without_random_parameters(concealed.Lag), 0.5, 20.0),
    "backlash": EffectSampler(
        ("slope", "direction"), make_draw_without_random_parameters(concealed.Backlash), 0.5, 15.0
    ),
    "position_scale": EffectSampler(("place",), _draw_position_scale, 0.02, 0.4),
    "periodic_position_error": EffectSampler(("place",), _draw_periodic_position_error, 0.3, 10.0),
    "edge_misplacement": EffectSampler(("slope",), make_draw_with_random_sign(concealed.EdgeMisplacement), 0.3, 8.0),
    "scan_misplacement": EffectSampler(("slope", "scan"), _draw_scan_misplacement, 0.3, 8.0),
    "scan_angle_error": EffectSampler(
        ("scan", "orientation"), _make_draw_with_random_scans(concealed.ScanAngleError), 5.0, 45.0
    ),
    "orientation_error": EffectSampler(
        ("orientation",), make_draw_with_random_sign(concealed.OrientationError), 5.0, 45.0
    ),
    "sensor_tilt": EffectSampler(
        ("orientation", "slope"), _make_draw_with_random_direction(concealed.SensorTilt), 0.3, 8.0
    ),
    "height_gradient": EffectSampler(("place",), make_draw_with_random_sign(concealed.HeightGradient), 0.01, 0.12),
    "height_offset": EffectSampler(("scan",), _make_draw_with_random_scans(concealed.HeightOffset), 0.3, 8.0),
    "albedo_gradient": EffectSampler(
        ("place",), _make_draw_with_random_direction(concealed.AlbedoGradient), 5e-4, 0.012
    ),
    "albedo_patch": EffectSampler(("place",), _draw_albedo_patch, 0.05, 1.0),
    "edge_blur": EffectSampler(("edge_distance",), make_draw_without_random_parameters(concealed.EdgeBlur), 1.0, 8.0),
    "edge_shadow": EffectSampler(("edge_distance",), _draw_edge_shadow, 0.02, 0.6),
    "halo": EffectSampler(("edge_distance",), _draw_halo, 0.05, 0.6),
    "glint": EffectSampler(("place",), _draw_glint, 1.0, 40.0),
    "ssf_order": EffectSampler(("edge_distance",), _draw_extra_gaussian, 0.05, 0.5),
    "signal_dependent_noise": EffectSampler(
        ("level",), make_draw_without_random_parameters(concealed.SignalDependentNoise), 1.0, 100.0
    ),
    "correlated_noise": EffectSampler(
        ("scan",), make_draw_without_random_parameters(concealed.CorrelatedNoise), 0.3, 0.95
    ),
    "outliers": EffectSampler((), _draw_outliers, 5.0, 30.0),
    "dropouts": EffectSampler((), _draw_dropouts, 0.01, 0.01, scalable=False),
}
"""Samplers of the vocabulary's effects by name, in the order of the diagnosis page, section 2."""

NEEDS_SENSOR = frozenset({"orientation_error", "edge_blur"})
"""Effects that an SSF fitted to the same recording absorbs."""

NO_PHYSICS = frozenset({"ssf_order"})

SINGLES = tuple(name for name in INSIDE if name not in NEEDS_SENSOR | NO_PHYSICS)
"""Effects that a case may conceal when the sensor is calibrated on the same recording."""

PAIRABLE = tuple(name for name in SINGLES[: SINGLES.index("signal_dependent_noise")] if name != "quantisation")
"""Effects on the mean of the readings, for which a pair has a cosine."""


def _draw_place_step(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, at_mm = draw_sign(rng), rng.uniform(-3, 3)
    return lambda a: unlisted.PlaceStep(s * a, at_mm)


def _draw_stick_slip(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    period_mm, phase = draw_log_uniform(rng, 3.0, 8.0), rng.random()
    return lambda a: unlisted.StickSlip(a, period_mm, phase)


def _draw_slipped_paper(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    s, at_s = draw_sign(rng), setup.start_s + rng.uniform(0.2, 0.8) * setup.duration_s
    return lambda a: unlisted.SlippedPaper(s * a, at_s)


def _draw_ghost(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    dx_mm, dy_mm = draw_sign(rng) * rng.uniform(8, 20), rng.uniform(-5, 5)
    return lambda a: unlisted.Ghost(a, dx_mm, dy_mm)


def _draw_thermal_gain(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    phases = tuple(float(phase) for phase in rng.uniform(0, 2 * math.pi, 12))
    return lambda a: unlisted.ThermalGain(a, setup.duration_s, phases)


def _draw_orientation_dependent_gain(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    phase = rng.uniform(0, 2 * math.pi)
    return lambda a: unlisted.OrientationDependentGain(a, phase)


def _draw_after_glow(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    tau_s, level = draw_log_uniform(rng, 5.0, 20.0), (setup.world.black + setup.world.white) / 2
    return lambda a: unlisted.AfterGlow(a, tau_s, level)


def _draw_chirp(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
    phase = rng.uniform(0, 2 * math.pi)
    # By the end of the recording the frequency has grown eightfold.
    first_hz = draw_log_uniform(rng, 2.0, 6.0) / setup.duration_s
    rate = 7 * first_hz / setup.duration_s
    return lambda a: unlisted.Chirp(a, first_hz, rate, phase)


OUTSIDE: Mapping[str, EffectSampler] = {
    "bent_rail": EffectSampler(("place",), make_draw_with_random_sign(unlisted.QuadraticPositionError), 0.5, 20.0),
    "twisted_rail": EffectSampler(("place",), make_draw_with_random_sign(unlisted.CubicPositionError), 0.5, 20.0),
    "place_step": EffectSampler(("place",), _draw_place_step, 0.5, 10.0),
    "stick_slip": EffectSampler(("place",), _draw_stick_slip, 0.5, 8.0),
    "slipped_paper": EffectSampler(("time",), _draw_slipped_paper, 0.5, 10.0),
    "ghost": EffectSampler(("edge_distance",), _draw_ghost, 0.03, 0.5),
    "thermal_gain": EffectSampler(("time",), _draw_thermal_gain, 0.02, 0.5),
    "cross_talk": EffectSampler(("orientation",), _draw_orientation_dependent_gain, 0.03, 0.9),
    "floor": EffectSampler(("level",), make_draw_without_random_parameters(unlisted.DeadZone), 0.03, 0.6),
    "peak_memory": EffectSampler(("level",), make_draw_without_random_parameters(unlisted.PeakMemory), 0.05, 2.0),
    "after_glow": EffectSampler(("time",), _draw_after_glow, 1.0, 40.0),
    "chirp": EffectSampler(("time",), _draw_chirp, 0.3, 20.0),
}
