"""The sensors of a challenge, its plans with displaced patterns, and plans of held-out readings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.recordings.patterns import Disc, HalfPlane, Pattern, Polygon, Quadrant
from probewise.recordings.plan import Plan
from probewise.recordings.plans import paper_plan, two_way_plan, with_jittered_times
from probewise.world import concealed as known
from probewise.world.spots import Blob, Spot, gaussian_spot, ridge_spot, ring_spot, tailed_spot
from probewise.world.stages import Concealed
from probewise.world.world import World

_PIXEL_MM = 0.5  # resolution of the raster: an SSF may be constant over half a millimetre

NOISE_LEVELS: Mapping[str, float] = {"low": 0.4, "middle": 0.6, "high": 1.0}
"""Sd of a reading's noise, in reading units."""

_NOISE: Mapping[str, tuple[str, Callable[[float], Concealed] | None]] = {
    "ar1": ("correlated_noise", lambda duration_s: known.correlated_noise(0.3)),
    "drifting": ("", lambda duration_s: known.drifting_noise(2.0, duration_s)),
    "t4": ("outliers", lambda duration_s: known.heavy_tails(4.0)),
    "outliers": ("outliers", lambda duration_s: known.outliers(0.02, 8.0)),
    "quantised": ("", None),
    "signal_dependent": ("signal_dependent_noise", lambda duration_s: known.signal_dependent_noise(2.0)),
    "dropouts": ("dropouts", lambda duration_s: known.dropouts(0.01, 0.0)),
}
OTHER_NOISE = tuple(_NOISE)
"""Names of the noise models besides "white"."""

NOISE_NAMES: Mapping[str, str] = {model: name for model, (name, _) in _NOISE.items() if name}
"""Names of noise models in the vocabulary; the other models are declared in the plan or out of vocabulary."""


def _about(rng: np.random.Generator, value: float) -> float:
    return value * float(rng.uniform(0.85, 1.15))


def _center(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(-0.8, 0.8)), float(rng.uniform(0.8, 2.2))


def _draw_gaussian_spot(rng: np.random.Generator) -> Spot:
    center, sd = _center(rng), (_about(rng, 4.0), _about(rng, 2.5))
    return gaussian_spot([Blob(1.0, center, sd, float(rng.uniform(-0.4, 0.4)))], pixel_mm=_PIXEL_MM)


def _draw_two_lobed_spot(rng: np.random.Generator) -> Spot:
    (u, v), apart = _center(rng), _about(rng, 3.5)
    left = Blob(float(rng.uniform(0.5, 0.7)), (u - apart, v), (_about(rng, 2.2), _about(rng, 2.5)), 0.2)
    right = Blob(float(rng.uniform(0.3, 0.5)), (u + apart, v - 1.0), (_about(rng, 2.0), _about(rng, 3.0)), -0.2)
    return gaussian_spot([left, right], pixel_mm=_PIXEL_MM)


def _draw_ridge_spot(rng: np.random.Generator) -> Spot:
    return ridge_spot(
        _about(rng, 9.0),
        center_mm=_center(rng),
        lobes=float(rng.uniform(0.15, 0.35)),
        ridge_mm=float(rng.uniform(-4.0, -2.0)),
        ridge_width_mm=1.5,
        shadow=float(rng.uniform(0.25, 0.4)),
        pixel_mm=_PIXEL_MM,
    )


def _draw_ring_spot(rng: np.random.Generator) -> Spot:
    off_axis, radius, width = float(rng.uniform(0.2, 0.6)), _about(rng, 3.3), _about(rng, 2.0)
    return ring_spot(radius, width, center_mm=_center(rng), off_axis=off_axis, pixel_mm=_PIXEL_MM)


def _draw_skewed_spot(rng: np.random.Generator) -> Spot:
    core, center = (_about(rng, 1.6), _about(rng, 1.1)), _center(rng)
    return tailed_spot(core, center_mm=center, skew=float(rng.uniform(0.3, 0.5)), pixel_mm=_PIXEL_MM)


SSFS: Mapping[str, Callable[[np.random.Generator], Spot]] = {
    "gaussian": _draw_gaussian_spot,
    "two_lobes": _draw_two_lobed_spot,
    "ridge": _draw_ridge_spot,
    "ring": _draw_ring_spot,
    "skewed": _draw_skewed_spot,
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
