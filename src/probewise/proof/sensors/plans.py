"""The plans of a challenge with randomly displaced patterns, and plans of held-out readings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.recordings.patterns import Disc, HalfPlane, Pattern, Polygon, Quadrant
from probewise.recordings.plan import Plan
from probewise.recordings.plans import paper_plan, two_way_plan, with_jittered_times

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
        corners = tuple(
            (28 * math.cos(turn), 28 * math.sin(turn)) for turn in rng.uniform(0, 2) + np.arange(3) * 2 * math.pi / 3
        )
        pattern: Pattern = Polygon(corners)
    else:
        pattern = _randomly_displaced_pattern(Disc((0.0, 0.0), 30.0), rng)
    slant = math.radians(rng.uniform(30, 60))
    oblique = HalfPlane(slant, 0.0), line[:, :1] * [math.cos(slant), math.sin(slant)], math.pi / 2
    scans: dict[str, tuple[Pattern, FloatArray, float]] = {
        "angle": (boundary, line, angle),
        "pattern": (pattern, line + beside, 0.0),
        "direction": (boundary, line[::-1], 0.0) if one_way else oblique,
    }
    start_s, plans = float(plan.time_s[-1]), {}
    for name, (surface, places_mm, turn) in scans.items():
        plans[name] = _single_scan_plan(plan, name, surface, places_mm, turn, start_s + _BREAK_S)
        start_s = float(plans[name].time_s[-1])
    return plans


def _randomly_displaced_pattern(pattern: Pattern, rng: np.random.Generator) -> Pattern:
    """Return a boundary (also turned by up to 2 degrees), quadrant or disc (also resized) moved by up to 0.5 mm.

    Other patterns are returned unchanged.
    """
    dx, dy, turn = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), math.radians(rng.uniform(-2, 2))
    match pattern:
        case HalfPlane():
            return replace(pattern, normal_rad=pattern.normal_rad + turn, offset_mm=pattern.offset_mm + dx)
        case Quadrant():
            return replace(pattern, corner_mm=(pattern.corner_mm[0] + dx, pattern.corner_mm[1] + dy))
        case Disc():
            center = (pattern.center_mm[0] + dx, pattern.center_mm[1] + dy)
            return replace(pattern, center_mm=center, radius_mm=pattern.radius_mm + dx)
        case _:
            return pattern


def _single_scan_plan(
    plan: Plan, name: str, pattern: Pattern, places_mm: FloatArray, orientation_rad: float, start_s: float
) -> Plan:
    """Return a plan of one scan from `start_s`; each covariate continues the line in time fitted to that of `plan`."""
    n_points = len(places_mm)
    time_s = start_s + _READING_S * np.arange(n_points)
    # The battery keeps draining at the same rate.
    covariates = {
        name: np.asarray(np.round(np.polyval(np.polyfit(plan.time_s, values, 1), time_s)), dtype=np.float64)
        for name, values in plan.covariates.items()
    }
    return Plan(
        x_mm=places_mm[:, 0],
        y_mm=places_mm[:, 1],
        orientation_rad=np.full(n_points, orientation_rad),
        time_s=np.round(time_s, 3),
        scan=np.zeros(n_points, dtype=np.int64),
        scan_names=(f"test_{name}",),
        pattern=np.zeros(n_points, dtype=np.int64),
        pattern_names=(name,),
        patterns={name: pattern},
        covariates=covariates,
        instrumentation=plan.instrumentation,
    )
