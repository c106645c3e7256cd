"""Draw a case: a sensor, a plan, a simulated recording, its concealed effects, and held-out plans to test with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.proof.sensors.effects import (
    INSIDE,
    NO_PHYSICS,
    OUTSIDE,
    PAIRABLE,
    SAMPLERS,
    SINGLES,
    CleanSetup,
    CovariateRegion,
    NormAfterRefit,
    amplitude_of_size,
)
from probewise.recordings.patterns import Disc, HalfPlane, Pattern, Polygon, Quadrant
from probewise.recordings.plan import Plan, Recording
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


WHEEL: tuple[Stratum, ...] = (
    *[Stratum("clean")] * 20,
    *[Stratum("clean", other_noise=True)] * 5,
    *[Stratum("single", 8.0)] * 12,
    Stratum("single", 8.0, other_noise=True),
    *[Stratum("single", 5.0)] * 2,
    *[Stratum("single", 6.0)] * 2,
    *[Stratum("single", 12.0)] * 3,
    *[Stratum("single", 20.0)] * 5,
    *[Stratum("pair", 12.0)] * 3,
    *[Stratum("outside", 12.0)] * 3,
    *[Stratum("outside", 20.0)] * 2,
    Stratum("alias", 12.0),
    Stratum("ssf_order", 12.0),
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
