"""Draw a case: a simulated recording, its concealed effects, and held-out plans to test the diagnosis on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

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
from probewise.proof.sensors.sensors import (
    NOISE_LEVELS,
    NOISE_NAMES,
    OTHER_NOISE,
    PLANS,
    SSFS,
    draw_plan_with_displaced_patterns,
    draw_sensor,
    held_out_plans,
    with_noise_model,
)
from probewise.recordings.plan import Plan, Recording
from probewise.world.stages import Concealed
from probewise.world.world import World

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
