"""Simulated sensors with concealed effects: samplers of effects of a requested size, and cases drawn from a seed.

A case is a sensor, a plan, a simulated recording, its concealed effects, and held-out plans to test with. The code is
independent of the sensor models that a diagnosis fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import NotConvergedError, ParameterError
from probewise.recordings.patterns import Disc, HalfPlane, Pattern, Polygon, Quadrant, Uniform
from probewise.recordings.plan import Plan, Recording
from probewise.recordings.plans import paper_plan, two_way_plan, with_jittered_times
from probewise.world import concealed as conceal
from probewise.world.spots import Blob, Spot, gaussian_spot, ridge_spot, ring_spot, tailed_spot
from probewise.world.stages import AFTER_VIEW, Concealed
from probewise.world.world import View, World

NormAfterRefit: TypeAlias = Callable[[Recording, Recording], float]
"""Norm of an effect after a refit of the null model: noise-free readings (without, with effect) to reading units.

It is the 2-norm of `with - null`, where the null model is refitted in full to `with`. The misfit to the readings
without effect (the model cannot have the true SSF's shape) must not be counted.
"""


@dataclass(frozen=True, eq=False)
class CleanSetup:
    """A plan and a simulated sensor without effects, in which effects are concealed; their sizes lambda by a refit."""

    plan: Plan
    world: World
    norm_after_refit: NormAfterRefit

    @property
    def duration_s(self) -> float:
        """Time from the first reading to the last, s."""
        return float(self.plan.time_s[-1] - self.plan.time_s[0])

    @cached_property
    def _view(self) -> View:
        return self.world.view(self.plan)

    @cached_property
    def clean_recording(self) -> Recording:
        """Recording of the plan: noise-free readings without any effect."""
        return self.world.simulate(self.plan, rng=None, view=self._view).without_declared_range()

    def recording_with_effects(self, *concealed: Concealed) -> Recording:
        """Return a recording of the plan: noise-free readings with these effects."""
        same_view = all(effect.stage in AFTER_VIEW for effect in concealed)
        world, view = replace(self.world, concealed=concealed), self._view if same_view else None
        return world.simulate(self.plan, rng=None, view=view).without_declared_range()

    def size(self, *concealed: Concealed) -> float:
        """Return the joint lambda of effects: the norm after the refit over the noise sd.

        Of one on the noise it is that of an equally detectable effect on the mean: lambda^2 / 2 is the expected gain in
        log likelihood of the truth over white Gaussian noise of the best constant variance (Kullback-Leibler divergence
        summed over readings). Lost readings deviate by their distance from the right value.
        """
        if len(concealed) > 1 or not concealed[0].disturbs:
            changed = self.recording_with_effects(*concealed)
            return self.norm_after_refit(self.clean_recording, changed) / self.world.noise_sd
        view, own, name = self._view, concealed[0].parameters, concealed[0].name
        n_points = len(view.seen)
        match name:
            case "correlated_noise":
                n_correlated = n_points - int(view.rows.scan_start_mask().sum())
                return math.sqrt(-n_correlated * math.log(1 - own["rho"] ** 2))
            case "signal_dependent_noise":
                variance = 1 + own["ratio"] * view.seen
                return math.sqrt(n_points * (math.log(variance.mean()) - float(np.log(variance).mean())))
            case "outliers":
                return math.sqrt(2 * n_points * _outlier_divergence(**own))
            case "dropouts":
                squared = float(((own["value"] - self.clean_recording.readings) ** 2).sum())
                return math.sqrt(own["share"] * squared) / self.world.noise_sd
        raise ParameterError("effect", name, "a noise effect of the vocabulary")

    def cosine(self, one: Concealed, other: Concealed) -> float:
        """Return the cosine between two effects' residuals after the refit, from the sizes of each and of both."""
        a, b, both = self.size(one), self.size(other), self.size(one, other)
        return float(np.clip((both**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))

    def region(self, effect: Concealed) -> CovariateRegion | None:
        """Return the region of a local effect, or None for any other.

        Effects on named scans: those scans. Ambient step: from the step to the last reading. Saturation: its level to
        the largest reading. Edge shadow: distances at which it is at least half its maximum. Stain, glint, step in X:
        the range of X in which it changes readings of scans along X by at least half its maximum.
        """
        plan, clean, own = self.plan, self.clean_recording.readings, effect.parameters
        match effect.name:
            case "scan_misplacement":
                return CovariateRegion("scan", scans=(own["scan"],))
            case "scan_angle_error" | "height_offset":
                return CovariateRegion("scan", scans=own["scans"])
            case "ambient_step":
                return CovariateRegion("time", own["at_s"], float(plan.time_s[-1]))
            case "saturation":
                return CovariateRegion("level", own["level"], float(clean.max()))
            case "edge_shadow":
                return CovariateRegion("edge_distance", 0.0, own["w"] * math.sqrt(2 * math.log(2)))
            case "albedo_patch" | "glint" | "place_step":
                along_x: BoolArray = np.abs(plan.direction_of_motion[:, 0]) > 0
                strength = np.where(along_x, np.abs(self.recording_with_effects(effect).readings - clean), 0.0)
                there = plan.x_mm[strength >= strength.max() / 2]
                return CovariateRegion("place", float(there.min()), float(there.max()))
        return None


@dataclass(frozen=True)
class CovariateRegion:
    """The interval `low` to `high` of `covariate`, in its unit; for the covariate "scan", the names `scans` instead."""

    covariate: str
    low: float | None = None
    high: float | None = None
    scans: tuple[str, ...] = ()


def _outlier_divergence(share: float, size: float) -> float:
    """Return KL in nats of (1 - share) N(0, 1) + share N(0, 1 + size^2) from the Gaussian of equal variance."""
    wide, even = math.sqrt(1 + size**2), math.sqrt(1 + share * size**2)

    def integrand(z: float) -> float:
        density = (1 - share) * norm.pdf(z) + share * norm.pdf(z, scale=wide)
        return float(density * (math.log(density) - norm.logpdf(z, scale=even)))

    return 2 * float(quad(integrand, 0, 12 * wide, points=[2.0, 4.0], limit=200)[0])


Draw: TypeAlias = Callable[[CleanSetup, np.random.Generator], Any]
"""Draws one parameter of an effect."""


@dataclass(frozen=True)
class EffectSampler:
    """A distribution over one kind of effect, up to its amplitude."""

    covariates: tuple[str, ...]  # along which its residual is visible
    make: Callable[..., Concealed]  # from the amplitude and the values that `draws` drew, in this order
    first: float  # amplitude of the search for a size
    limit: float  # largest plausible amplitude, or `first` if the search does not choose it
    draws: tuple[Draw, ...] = ()

    def draw(self, setup: CleanSetup, rng: np.random.Generator) -> Callable[[float], Concealed]:
        """Draw all parameters but the amplitude; return a function from that, greater than 0, to the effect."""
        drawn = [draw(setup, rng) for draw in self.draws]
        return lambda amplitude: self.make(amplitude, *drawn)


def _effect(covariates: str, make: Callable[..., Concealed], first: float, limit: float, *draws: Draw) -> EffectSampler:
    return EffectSampler(tuple(covariates.split()), make, first, limit, draws)


def _one_of(*values: float) -> Draw:
    return lambda setup, rng: float(rng.choice(values))


def _uniform(low: float, high: float) -> Draw:
    return lambda setup, rng: rng.uniform(low, high)


def _log_uniform(low: float, high: float | Callable[[CleanSetup], float]) -> Draw:
    return lambda setup, rng: math.exp(rng.uniform(math.log(low), math.log(high(setup) if callable(high) else high)))


def _moment(low: float, high: float) -> Draw:
    return lambda setup, rng: float(setup.plan.time_s[0]) + rng.uniform(low, high) * setup.duration_s


def _edge_scan(setup: CleanSetup, rng: np.random.Generator) -> str:
    """Draw a scan of 20 readings or more whose first reading is over a pattern that is not uniform."""
    plan = setup.plan
    patterns = [plan.patterns[name] for name in plan.pattern_names]
    by_scan = zip(plan.scan_names, plan.rows_by_scan(), strict=True)
    names = [n for n, rows in by_scan if rows.size >= 20 and not isinstance(patterns[plan.pattern[rows[0]]], Uniform)]
    return str(rng.choice(names))


def _edge_scans(setup: CleanSetup, rng: np.random.Generator) -> tuple[str, ...]:
    scan, plan = _edge_scan(setup, rng), setup.plan
    if rng.random() >= 0.5:
        return (scan,)
    turn = {n: plan.orientation_rad[rows[0]] for n, rows in zip(plan.scan_names, plan.rows_by_scan(), strict=True)}
    return tuple(name for name in turn if turn[name] == turn[scan])


def _duration_s(setup: CleanSetup, *_: np.random.Generator) -> float:
    return setup.duration_s


def _nyquist_hz(setup: CleanSetup) -> float:  # half the median rate of the readings
    return 0.5 / float(np.median(np.diff(setup.plan.time_s)))


# The amplitude that the search for a size tries first, and the largest plausible one.
_ADDED, _PULSE, _FACTOR = (0.3, 20.0), (1.0, 40.0), (0.03, 0.9)  # of a reading, a light, a signal
_APART_MM, _TURN_DEG = (0.3, 8.0), (5.0, 45.0)
_SIGN, _PHASE = _one_of(-1.0, 1.0), _uniform(0, 2 * math.pi)
_DIRECTION = (_SIGN, _uniform(-math.pi / 3, math.pi / 3))
_SPOT = (_uniform(-40, 40), _uniform(-4, 4), _log_uniform(3.0, 10.0))  # x, y and sd of a stain or glint, mm


def _signed(kind: Callable[..., Concealed]) -> Callable[..., Concealed]:
    return lambda a, sign, *more: kind(sign * a, *more)


def _directed(kind: Callable[[float, float], Concealed]) -> Callable[..., Concealed]:
    """Return the maker of a vector within 60 degrees of +X or -X, whose length is the amplitude."""
    return lambda a, sign, angle: kind(sign * a * math.cos(angle), sign * a * math.sin(angle))


def _saturation(a: float, levels: tuple[float, float], softness: float) -> Concealed:
    black, white = levels
    return conceal.saturation(white - a * (white - black), softness)


def _ssf_order(a: float, turn: float, sd_mm: float) -> Concealed:
    return conceal.ssf_order(a, 5.0 * math.cos(turn), 1.5 + 5.0 * math.sin(turn), sd_mm)


def _chirp(a: float, phase: float, cycles: float, duration_s: float) -> Concealed:
    """Let the frequency, `cycles` per recording at first, grow eightfold by its end."""
    first_hz = cycles / duration_s
    return conceal.chirp(a, first_hz, 7 * first_hz / duration_s, phase)


INSIDE: Mapping[str, EffectSampler] = {
    "ambient_gradient": _effect("place", _directed(conceal.ambient_gradient), 0.01, 2.0, *_DIRECTION),
    "ambient_step": _effect("time", _signed(conceal.ambient_step), 0.5, 30.0, _SIGN, _moment(0.15, 0.85)),
    "offset_drift": _effect("time", _signed(conceal.offset_drift), 5.0, 500.0, _SIGN),
    "gain_drift": _effect("time", _signed(conceal.gain_drift), *_FACTOR, _SIGN, _log_uniform(60.0, _duration_s)),
    "battery_sag": _effect("battery_mv", _signed(conceal.battery_sag), 0.5, 10.0, _SIGN),
    "flicker": _effect("time", conceal.flicker, *_ADDED, _log_uniform(0.01, _nyquist_hz), _PHASE),
    "saturation": _effect(
        "level", _saturation, 0.05, 0.9, lambda setup, rng: (setup.world.black, setup.world.white), _one_of(0.0, 1.0)
    ),
    "nonlinearity": _effect("level", _signed(lambda a: conceal.nonlinearity(math.exp(a))), 0.1, 1.5, _SIGN),
    "quantisation": _effect("lattice", conceal.quantisation, 1.0, 20.0),
    "hysteresis": _effect("direction", _signed(conceal.hysteresis), *_ADDED, _SIGN),
    "lag": _effect("slope direction", conceal.lag, 0.5, 20.0),
    "backlash": _effect("slope direction", conceal.backlash, 0.5, 15.0),
    "position_scale": _effect(
        "place", lambda a, sign, ratio: conceal.position_scale(sign * a, ratio * a), 0.02, 0.4, _SIGN, _uniform(-1, 1)
    ),
    "periodic_position_error": _effect(
        "place", conceal.periodic_position_error, 0.3, 10.0, _log_uniform(4.0, 25.0), _PHASE
    ),
    "edge_misplacement": _effect("slope", _signed(conceal.edge_misplacement), *_APART_MM, _SIGN),
    "scan_misplacement": _effect("slope scan", _signed(conceal.scan_misplacement), *_APART_MM, _SIGN, _edge_scan),
    "scan_angle_error": _effect("scan orientation", _signed(conceal.scan_angle_error), *_TURN_DEG, _SIGN, _edge_scans),
    "orientation_error": _effect("orientation", _signed(conceal.orientation_error), *_TURN_DEG, _SIGN),
    "sensor_tilt": _effect("orientation slope", _directed(conceal.sensor_tilt), *_APART_MM, *_DIRECTION),
    "height_gradient": _effect("place", _signed(conceal.height_gradient), 0.01, 0.12, _SIGN),
    "height_offset": _effect("scan", _signed(conceal.height_offset), *_APART_MM, _SIGN, _edge_scans),
    "albedo_gradient": _effect("place", _directed(conceal.albedo_gradient), 5e-4, 0.012, *_DIRECTION),
    "albedo_patch": _effect("place", _signed(conceal.albedo_patch), 0.05, 1.0, _SIGN, *_SPOT),
    "edge_blur": _effect("edge_distance", conceal.edge_blur, 1.0, 8.0),
    "edge_shadow": _effect("edge_distance", conceal.edge_shadow, 0.02, 0.6, _log_uniform(2.0, 8.0)),
    "halo": _effect("edge_distance", conceal.halo, 0.05, 0.6, _log_uniform(12.0, 40.0)),
    "glint": _effect("place", conceal.glint, *_PULSE, *_SPOT),
    "ssf_order": _effect("edge_distance", _ssf_order, 0.05, 0.5, _PHASE, _uniform(1.5, 4.0)),
    "signal_dependent_noise": _effect("level", conceal.signal_dependent_noise, 1.0, 100.0),
    "correlated_noise": _effect("scan", conceal.correlated_noise, 0.3, 0.95),
    "outliers": _effect("", lambda a, share: conceal.outliers(share, a), 5.0, 30.0, _log_uniform(0.01, 0.05)),
    # The share of lost readings is half to five times the amplitude, which is fixed.
    "dropouts": _effect(
        "",
        lambda a, value, factor: conceal.dropouts(factor * a, value),
        *(0.01, 0.01),
        *(_one_of(0.0, 100.0), _log_uniform(0.5, 5.0)),
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
    "bent_rail": _effect("place", _signed(conceal.bent_rail), 0.5, 20.0, _SIGN),
    "twisted_rail": _effect("place", _signed(conceal.twisted_rail), 0.5, 20.0, _SIGN),
    "place_step": _effect("place", _signed(conceal.place_step), 0.5, 10.0, _SIGN, _uniform(-3, 3)),
    "stick_slip": _effect("place", conceal.stick_slip, 0.5, 8.0, _log_uniform(3.0, 8.0), _uniform(0, 1)),
    "slipped_paper": _effect("time", _signed(conceal.slipped_paper), 0.5, 10.0, _SIGN, _moment(0.2, 0.8)),
    "ghost": _effect(
        "edge_distance",
        lambda a, sign, dx_mm, dy_mm: conceal.ghost(a, sign * dx_mm, dy_mm),
        *(0.03, 0.5),
        *(_SIGN, _uniform(8, 20), _uniform(-5, 5)),
    ),
    "thermal_gain": _effect(
        "time",
        conceal.thermal_gain,
        *(0.02, 0.5),
        *(_duration_s, lambda setup, rng: tuple(float(phase) for phase in rng.uniform(0, 2 * math.pi, 12))),
    ),
    "cross_talk": _effect("orientation", conceal.cross_talk, *_FACTOR, _PHASE),
    "floor": _effect("level", conceal.floor, 0.03, 0.6),
    "peak_memory": _effect("level", conceal.peak_memory, 0.05, 2.0),
    "after_glow": _effect(
        "time",
        conceal.after_glow,
        *_PULSE,
        *(_log_uniform(5.0, 20.0), lambda setup, rng: (setup.world.black + setup.world.white) / 2),
    ),
    "chirp": _effect("time", _chirp, *_ADDED, _PHASE, _log_uniform(2.0, 6.0), _duration_s),
}
"""Samplers of effects outside the vocabulary."""

SAMPLERS = {**INSIDE, **OUTSIDE}


def amplitude_of_size(
    size: Callable[[float], float],
    wanted: float,
    *,
    first: float,
    limit: float,
    tolerance: float = 0.02,
    acceptable: float = 0.1,
    max_calls: int = 16,
) -> float:
    """Return an amplitude greater than 0 at which `size` has the requested value.

    Size grows roughly as a power of the amplitude: steps follow a straight line in log-log coordinates, first by
    extrapolation, then by interpolation, with bisection where interpolation gains too little. `first`: first amplitude
    tried; `tolerance`: relative error of the size at which the search ends; `acceptable`: accepted when it ends
    otherwise. Raises NotConvergedError if even the limit is too small, or no amplitude has an acceptable size;
    `partial` holds (amplitude, size) of the nearest.
    """
    low: tuple[float, float] | None = None  # log amplitude and log(size / wanted), size too small
    high: tuple[float, float] | None = None  # the same, size too large
    at, nearest = math.log(first), (first, 0.0)
    for call in range(max_calls):
        found = size(math.exp(at))
        if abs(found - wanted) < abs(nearest[1] - wanted):
            nearest = (math.exp(at), found)
        if abs(found - wanted) <= tolerance * wanted:
            break
        off = math.log(max(found, 1e-9 * wanted) / wanted)
        if off < 0:
            if at >= math.log(limit):
                break
            low = (at, off)
        else:
            high = (at, off)
        if low is None or high is None:
            at = min(at - float(np.clip(off, -3.0, 3.0)) * 1.05, math.log(limit))
            continue
        if high[0] - low[0] < 0.01:
            break
        share = -low[1] / (high[1] - low[1]) if call % 3 else 0.5
        at = low[0] + float(np.clip(share, 0.02, 0.98)) * (high[0] - low[0])
    if abs(nearest[1] - wanted) <= acceptable * wanted:
        return nearest[0]
    raise NotConvergedError(
        f"the size nearest to {wanted:g} is {nearest[1]:.3g}, at amplitude {nearest[0]:.3g} (limit {limit:g})", nearest
    )


_PIXEL_MM = 0.5  # resolution of the raster: an SSF may be constant over half a millimetre

NOISE_LEVELS: Mapping[str, float] = {"low": 0.4, "middle": 0.6, "high": 1.0}
"""Sd of a reading's noise, in reading units."""

_NOISE: Mapping[str, tuple[str, Callable[[float], Concealed] | None]] = {
    "ar1": ("correlated_noise", lambda duration_s: conceal.correlated_noise(0.3)),
    "drifting": ("", lambda duration_s: conceal.drifting_noise(2.0, duration_s)),
    "t4": ("outliers", lambda duration_s: conceal.heavy_tails(4.0)),
    "outliers": ("outliers", lambda duration_s: conceal.outliers(0.02, 8.0)),
    "quantised": ("", None),
    "signal_dependent": ("signal_dependent_noise", lambda duration_s: conceal.signal_dependent_noise(2.0)),
    "dropouts": ("dropouts", lambda duration_s: conceal.dropouts(0.01, 0.0)),
}
OTHER_NOISE = tuple(_NOISE)
"""Names of the noise models besides "white"."""

NOISE_NAMES: Mapping[str, str] = {model: name for model, (name, _) in _NOISE.items() if name}
"""Names of noise models in the vocabulary; the other models are declared in the plan or out of vocabulary."""


def _about(rng: np.random.Generator, value: float) -> float:
    return value * float(rng.uniform(0.85, 1.15))


def _center(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(-0.8, 0.8)), float(rng.uniform(0.8, 2.2))


def _draw_two_lobed_spot(rng: np.random.Generator) -> Spot:
    (u, v), apart = _center(rng), _about(rng, 3.5)
    left = Blob(float(rng.uniform(0.5, 0.7)), (u - apart, v), (_about(rng, 2.2), _about(rng, 2.5)), 0.2)
    right = Blob(float(rng.uniform(0.3, 0.5)), (u + apart, v - 1.0), (_about(rng, 2.0), _about(rng, 3.0)), -0.2)
    return gaussian_spot([left, right], pixel_mm=_PIXEL_MM)


SSFS: Mapping[str, Callable[[np.random.Generator], Spot]] = {
    "gaussian": lambda rng: gaussian_spot(
        [Blob(1.0, _center(rng), (_about(rng, 4.0), _about(rng, 2.5)), float(rng.uniform(-0.4, 0.4)))],
        pixel_mm=_PIXEL_MM,
    ),
    "two_lobes": _draw_two_lobed_spot,
    "ridge": lambda rng: ridge_spot(
        _about(rng, 9.0),
        center_mm=_center(rng),
        lobes=float(rng.uniform(0.15, 0.35)),
        ridge_mm=float(rng.uniform(-4.0, -2.0)),
        ridge_width_mm=1.5,
        shadow=float(rng.uniform(0.25, 0.4)),
        pixel_mm=_PIXEL_MM,
    ),
    "ring": lambda rng: ring_spot(
        off_axis=float(rng.uniform(0.2, 0.6)),
        radius_mm=_about(rng, 3.3),
        width_mm=_about(rng, 2.0),
        center_mm=_center(rng),
        pixel_mm=_PIXEL_MM,
    ),
    "skewed": lambda rng: tailed_spot(
        (_about(rng, 1.6), _about(rng, 1.1)),
        center_mm=_center(rng),
        skew=float(rng.uniform(0.3, 0.5)),
        pixel_mm=_PIXEL_MM,
    ),
}
"""The last three are not mixtures of Gaussians; the best mixture of four leaves a residual of lambda about 1 at the
middle noise level: a good but inexact model."""


def draw_sensor(ssf: str, noise_level: str, *, rng: np.random.Generator) -> World:
    """Draw a sensor, as a World without effects: SSF of a kind of SSFS, black, white, noise sd of NOISE_LEVELS."""
    black, white = float(rng.uniform(8, 14)), float(rng.uniform(55, 70))
    return World(SSFS[ssf](rng), black=black, white=white, noise_sd=NOISE_LEVELS[noise_level])


def with_noise_model(world: World, model: str, *, duration_s: float) -> World:
    """Return the world with noise that is "white" or a model of OTHER_NOISE; its `noise_sd` is unchanged.

    This sd is that at the start for "drifting", on black for "signal_dependent", of the core for "outliers".
    "quantised" readings are rounded to whole units, which the plan should declare.
    """
    if model == "white":
        return world
    make = _NOISE[model][1]
    return replace(world, step=1.0) if make is None else replace(world, concealed=(*world.concealed, make(duration_s)))


PLANS: Mapping[str, Callable[[], Plan]] = {"paper": paper_plan, "two_way": two_way_plan}

_READING_S, _BREAK_S = 1.2, 30.0


def draw_plan_with_displaced_patterns(name: str, *, rng: np.random.Generator) -> Plan:
    """Return the plan `name` of PLANS with jittered times and randomly displaced patterns, described where they are."""
    plan = PLANS[name]()
    patterns = {key: _randomly_displaced_pattern(pattern, rng) for key, pattern in plan.patterns.items()}
    return with_jittered_times(replace(plan, patterns=patterns), rng=rng)


def held_out_plans(plan: Plan, *, rng: np.random.Generator) -> dict[str, Plan]:
    """Return three held-out plans of one scan each, by name, which differ from `plan` and are read after it.

    "angle": a scan across a boundary with the sensor at an unused angle. "pattern": a scan beside the middle of a disc,
    or of a triangle if the plan has a disc already. "direction": a boundary crossed from +x to -x where the plan goes
    one way only, or obliquely where it goes both ways.
    """
    one_way = not (plan.direction_of_motion[:, 0] < 0).any()
    line = np.stack([np.linspace(-50, 50, 101), np.zeros(101)], axis=-1)
    boundary = _randomly_displaced_pattern(HalfPlane(0.0, 0.0), rng)
    angle = math.radians(rng.choice([0, 90, 180, 270]) + rng.uniform(25, 65))
    beside = [0.0, float(rng.uniform(4, 9))]
    if any(isinstance(pattern, Disc) for pattern in plan.patterns.values()):
        turns = rng.uniform(0, 2) + np.arange(3) * 2 * math.pi / 3
        pattern: Pattern = Polygon(tuple((28 * math.cos(turn), 28 * math.sin(turn)) for turn in turns))
    else:
        pattern = _randomly_displaced_pattern(Disc((0.0, 0.0), 30.0), rng)
    slant = math.radians(rng.uniform(30, 60))
    oblique = HalfPlane(slant, 0.0), line[:, :1] * [math.cos(slant), math.sin(slant)], math.pi / 2
    scans: dict[str, tuple[Pattern, FloatArray, float]] = {
        "angle": (boundary, line, angle),
        "pattern": (pattern, line + beside, 0.0),
        "direction": (boundary, line[::-1], 0.0) if one_way else oblique,
    }
    # Each covariate continues the line in time fitted to that of the plan: the battery drains at the same rate.
    drains = {name: np.polyfit(plan.time_s, values, 1) for name, values in plan.covariates.items()}
    start_s, plans, none = float(plan.time_s[-1]), {}, np.zeros(len(line), dtype=np.int64)
    for name, (surface, places_mm, turn) in scans.items():
        time_s = start_s + _BREAK_S + _READING_S * np.arange(len(line))
        plans[name] = Plan(
            x_mm=places_mm[:, 0],
            y_mm=places_mm[:, 1],
            orientation_rad=np.full(len(line), turn),
            time_s=np.round(time_s, 3),
            scan=none,
            scan_names=(f"test_{name}",),
            pattern=none,
            pattern_names=(name,),
            patterns={name: surface},
            covariates={key: np.asarray(np.round(np.polyval(fall, time_s))) for key, fall in drains.items()},
            instrumentation=plan.instrumentation,
        )
        start_s = float(plans[name].time_s[-1])
    return plans


def _randomly_displaced_pattern(pattern: Pattern, rng: np.random.Generator) -> Pattern:
    """Return a boundary (also turned by up to 2 degrees), quadrant or disc (also resized) moved by up to 0.5 mm."""
    dx, dy, turn = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), math.radians(rng.uniform(-2, 2))
    match pattern:
        case HalfPlane():
            return replace(pattern, normal_rad=pattern.normal_rad + turn, offset_mm=pattern.offset_mm + dx)
        case Quadrant():
            return replace(pattern, corner_mm=(pattern.corner_mm[0] + dx, pattern.corner_mm[1] + dy))
        case Disc():
            center = (pattern.center_mm[0] + dx, pattern.center_mm[1] + dy)
            return replace(pattern, center_mm=center, radius_mm=pattern.radius_mm + dx)
    return pattern


CaseKind: TypeAlias = Literal["clean", "single", "pair", "outside", "alias", "ssf_order"]
"""What a case conceals: nothing, one effect, two, one out of vocabulary, an aliased one, or one more Gaussian."""


@dataclass(frozen=True)
class Stratum:
    """A case's kind (`CaseKind`), lambda of each effect (0 for clean), and whether its noise is one of OTHER_NOISE."""

    kind: CaseKind
    size: float = 0.0
    other_noise: bool = False


FAINT, SMALL, CLEAR, GROSS = 6.0, 8.0, 12.0, 20.0
"""Sizes lambda of concealed effects, of sensors and of systems; some of 5 are harder still."""

WHEEL: tuple[Stratum, ...] = (
    *[Stratum("clean")] * 20,
    *[Stratum("clean", other_noise=True)] * 5,
    *[Stratum("single", SMALL)] * 12,
    Stratum("single", SMALL, other_noise=True),
    *[Stratum("single", 5.0)] * 2,
    *[Stratum("single", FAINT)] * 2,
    *[Stratum("single", CLEAR)] * 3,
    *[Stratum("single", GROSS)] * 5,
    *[Stratum("pair", CLEAR)] * 3,
    *[Stratum("outside", CLEAR)] * 3,
    *[Stratum("outside", GROSS)] * 2,
    Stratum("alias", CLEAR),
    Stratum("ssf_order", CLEAR),
)
"""The cycle of 60 cases. A hundred cycles have 2,500 clean cases (500 of them with other noise), 2,500 of one effect
(1,300 at lambda 8, of these 100 with other noise; 500 at 20), 300 pairs, 500 outside the vocabulary, 100 aliases and
100 with one more Gaussian.
"""

_STRIDE = 23  # coprime to the length of the cycle, so that successive cases differ in kind


def stratum_of(number: int) -> tuple[Stratum, int]:
    """Return the stratum of case `number`, and how many cases of that stratum have smaller numbers."""
    return stratum_in_wheel(number, WHEEL, _STRIDE)


def stratum_in_wheel(
    number: int, wheel: tuple[Stratum, ...], stride: int, like: Callable[[Stratum], object] = lambda stratum: stratum
) -> tuple[Stratum, int]:
    """Return the stratum of case `number` of a cycle, and how many earlier cases are `like` it."""
    cycle, slot = divmod(number, len(wheel))
    order = [wheel[k * stride % len(wheel)] for k in range(len(wheel))]
    kinds = [like(stratum) for stratum in order]
    return order[slot], cycle * kinds.count(kinds[slot]) + kinds[:slot].count(kinds[slot])


@dataclass(frozen=True)
class HiddenEffect:
    """One concealed effect, with its parameters."""

    name: str
    effect: Concealed
    size_lambda: float  # norm of its change after a refit of the null model, in noise sds
    in_vocabulary: bool
    covariates: tuple[str, ...]  # along which its residual is visible
    region: CovariateRegion | None  # where it acts; None: not a local effect


ALIASES: tuple[tuple[str, str], ...] = (
    ("backlash", "edge_misplacement"),
    ("height_gradient", "albedo_gradient"),
    ("lag", "edge_misplacement"),
    ("edge_misplacement", "sensor_tilt"),
    ("backlash", "sensor_tilt"),
)
"""Pairs of effects that may be aliased in the paper's plan; either may be concealed."""

_ALIASED_NATS = 3.0  # below it two effects are aliased (diagnosis, section 3)
_MOST_COSINE = 0.5  # upper bound on the cosine of a pair
_ATTEMPTS = 6


@dataclass(frozen=True, eq=False)
class Case:
    """One case of a challenge: a recording to diagnose, and the simulated sensor with its concealed effects."""

    recording: Recording
    world: World
    test_plans: Mapping[str, Plan]  # of the held-out readings by name (`held_out_plans`)
    test_seed: np.random.SeedSequence  # of their noise
    stratum: Stratum
    ssf: str  # names in SSFS, NOISE_LEVELS, OTHER_NOISE or "white", and PLANS
    noise_level: str
    noise_model: str
    plan: str
    hidden: tuple[HiddenEffect, ...]  # in the order of the vocabulary
    cosine: float | None  # of a pair, or of an alias and the concealed effect, after the refit
    alias: str | None  # an effect that is aliased with the concealed one, in the stratum of aliases

    @property
    def combination(self) -> tuple[str, ...]:
        """Names that a perfect diagnosis gives, sorted; ("unknown",) if any effect is outside the vocabulary.

        A noise model that the vocabulary has is among them, "ssf_order" is not; () if none is left.
        """
        if any(not hidden.in_vocabulary for hidden in self.hidden):
            return ("unknown",)
        names = {hidden.name for hidden in self.hidden} - NO_PHYSICS
        if self.noise_model in NOISE_NAMES:
            names.add(NOISE_NAMES[self.noise_model])
        return tuple(sorted(names))


def draw_case(seed: int, number: int, *, norm_after_refit: NormAfterRefit) -> Case:
    """Draw case `number` of a challenge; it depends on the secret seed and the number, from 0, alone.

    Raises NotConvergedError if none of six draws in each plan has the stratum's size, a pair's abs(cosine) < 0.5, an
    alias's loss < 3.
    """
    stratum, n_earlier = stratum_of(number)
    drawing, plan_seed, noise, test, test_noise = np.random.SeedSequence(seed, spawn_key=(number,)).spawn(5)
    rng, plan_rng = np.random.default_rng(drawing), np.random.default_rng(plan_seed)
    ssf = "gaussian" if stratum.kind == "ssf_order" else str(rng.choice(list(SSFS)))
    level, model = str(rng.choice(list(NOISE_LEVELS))), str(rng.choice(OTHER_NOISE)) if stratum.other_noise else "white"
    sensor = draw_sensor(ssf, level, rng=rng)
    plans = ["paper"] if stratum.kind == "alias" else [str(name) for name in rng.permutation(list(PLANS))]
    for attempt in range(_ATTEMPTS * len(plans)):
        if attempt % _ATTEMPTS == 0:
            plan_name = plans[attempt // _ATTEMPTS]
            plan = draw_plan_with_displaced_patterns(plan_name, rng=plan_rng)
            setup = CleanSetup(plan, sensor, norm_after_refit)
        try:
            hidden, cosine, alias = _draw_effects(stratum, n_earlier, setup, rng)
            break
        except NotConvergedError:
            if attempt == _ATTEMPTS * len(plans) - 1:
                raise
    if any(each.effect.disturbs for each in hidden):
        model = "white"  # only one noise fault at a time
    step = 1.0 if model == "quantised" else None
    told = replace(plan.instrumentation, step=step, description="Simulated readings of a challenge")
    plan = replace(plan, instrumentation=told)
    concealing = replace(sensor, concealed=tuple(each.effect for each in hidden))
    world = with_noise_model(concealing, model, duration_s=setup.duration_s)
    recording = world.simulate(plan, rng=np.random.default_rng(noise))
    test_plans = held_out_plans(plan, rng=np.random.default_rng(test))
    named = ssf, level, model, plan_name
    return Case(recording, world, test_plans, test_noise, stratum, *named, hidden, cosine, alias)


def held_out_recordings(case: Case) -> dict[str, Recording]:
    """Simulate the held-out plans of a case in its world; return the recordings by name of the plan.

    They follow the recording in time: effects in time continue; effects tied to a named scan do not act.
    """
    rng = np.random.default_rng(case.test_seed)
    return {name: case.world.simulate(plan, rng=rng) for name, plan in case.test_plans.items()}


def _draw_effects(
    stratum: Stratum, n_earlier: int, setup: CleanSetup, rng: np.random.Generator
) -> tuple[tuple[HiddenEffect, ...], float | None, str | None]:
    """Draw the effects of a stratum once; return them, the cosine of a pair or with an alias, and that alias's name.

    Raises NotConvergedError if they cannot have the size, a pair's abs(cosine) is 0.5 or more, an alias loses 3.
    """

    def draw_effect(name: str) -> HiddenEffect:
        return draw_effect_of_size(name, stratum.size, setup, rng)

    match stratum.kind:
        case "clean":
            return (), None, None
        case "pair":
            first, second = (draw_effect(PAIRABLE[k]) for k in sorted(rng.choice(len(PAIRABLE), 2, replace=False)))
            cosine = setup.cosine(first.effect, second.effect)
            if abs(cosine) >= _MOST_COSINE:
                raise NotConvergedError(f"{first.name} and {second.name} are too similar: cosine {cosine:.2f}")
            return (first, second), cosine, None
        case "alias":
            hidden, other = (draw_effect(str(name)) for name in rng.permutation(ALIASES[n_earlier % len(ALIASES)]))
            cosine = setup.cosine(hidden.effect, other.effect)
            if stratum.size**2 * (1 - cosine**2) / 2 >= _ALIASED_NATS:
                raise NotConvergedError(f"{hidden.name} and {other.name} are not aliased: cosine {cosine:.2f}")
            return (hidden,), cosine, other.name
    names = {"single": SINGLES, "outside": tuple(OUTSIDE)}.get(stratum.kind, (stratum.kind,))
    return (draw_effect(names[n_earlier % len(names)]),), None, None


def draw_effect_of_size(name: str, wanted: float, setup: CleanSetup, rng: np.random.Generator) -> HiddenEffect:
    """Return the effect `name`, other parameters drawn, with lambda about `wanted`, or at its fixed amplitude."""
    sampler = SAMPLERS[name]
    of_amplitude, amplitude, limit = sampler.draw(setup, rng), sampler.first, sampler.limit
    if limit > amplitude:  # else it is fixed
        amplitude = amplitude_of_size(lambda a: setup.size(of_amplitude(a)), wanted, first=amplitude, limit=limit)
    effect = of_amplitude(amplitude)
    return HiddenEffect(name, effect, setup.size(effect), name in INSIDE, sampler.covariates, setup.region(effect))
