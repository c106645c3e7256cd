"""Draw a case: a recording, what it conceals, and what is kept back to test the diagnosis on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from probewise.errors import NotConvergedError
from probewise.recordings.plan import Instrumentation, Plan, Recording
from probewise.world.challenge.candidates import Setting
from probewise.world.challenge.inside import INSIDE, PAIRABLE, SINGLES
from probewise.world.challenge.outsiders import OUTSIDE
from probewise.world.challenge.plans import PLANS, draw_plan, kept_back_plans
from probewise.world.challenge.regions import region_of
from probewise.world.challenge.sensors import NOISE_LEVELS, OTHER_NOISE, SSFS, draw_sensor, with_noise
from probewise.world.challenge.sizing import Ruler, Surviving, amplitude_of_size
from probewise.world.challenge.strata import Stratum, stratum_of
from probewise.world.challenge.truth import Alias, Hidden, Truth
from probewise.world.concealed import Disturbs
from probewise.world.world import World

__all__ = ["ALIASES", "Case", "draw_case", "kept_back"]

ALIASES: tuple[tuple[str, str], ...] = (
    ("backlash", "edge_misplacement"),
    ("height_gradient", "albedo_gradient"),
    ("lag", "edge_misplacement"),
    ("edge_misplacement", "sensor_tilt"),
    ("backlash", "sensor_tilt"),
)
"""What may not be told apart in the paper's plan; either may be the concealed one."""

_HONEST_NATS = 3.0  # below it two effects cannot be told apart (diagnosis, section 3)
_APART = 0.5  # cosine of the two of a pair, less
_ATTEMPTS = 6


@dataclass(frozen=True, eq=False)
class Case:
    """One case of a challenge.

    Parameters
    ----------
    recording
        All that a diagnosis may see.
    truth
        What it is scored against.
    world
        The world with everything that it conceals.
    test_plans
        What `kept_back` reads, by name.
    test_seed
        Where the noise of those readings comes from.
    """

    recording: Recording
    truth: Truth
    world: World
    test_plans: Mapping[str, Plan]
    test_seed: np.random.SeedSequence


def draw_case(seed: int, number: int, *, surviving: Surviving) -> Case:
    """Draw case `number` of a challenge; it depends on the seed and the number alone.

    Parameters
    ----------
    seed
        The sealed seed of the challenge.
    number
        Which case, from 0 on: tells its stratum (stratum_of) and, with the seed, all else.
    surviving
        What the null model leaves of an effect, in units of the reading.

    Raises
    ------
    NotConvergedError
        If no effect drawn for it can have the size wanted in this plan.
    """
    stratum, turn = stratum_of(number)
    drawing, laying, noise, test, test_noise = np.random.SeedSequence(seed, spawn_key=(number,)).spawn(5)
    rng = np.random.default_rng(drawing)
    ssf = "gaussian" if stratum.kind == "ssf_order" else str(rng.choice(list(SSFS)))
    level, model = str(rng.choice(list(NOISE_LEVELS))), str(rng.choice(OTHER_NOISE)) if stratum.other_noise else "white"
    sensor = draw_sensor(ssf, level, rng=rng)
    plan_names = ["paper"] if stratum.kind == "alias" else [str(name) for name in rng.permutation(list(PLANS))]
    plan_name, setting, secret = _settle(
        stratum, turn, plan_names, sensor, surviving, rng, np.random.default_rng(laying)
    )
    if any(isinstance(hidden.effect, Disturbs) for hidden in secret.hidden):
        model = "white"  # one thing at a time is wrong with the noise
    plan = replace(setting.plan, instrumentation=_instrument(setting.plan, model))
    concealing = replace(sensor, concealed=tuple(hidden.effect for hidden in secret.hidden))
    world = with_noise(concealing, model, duration_s=setting.duration_s)
    truth = Truth(
        seed=seed,
        number=number,
        stratum=stratum,
        ssf=ssf,
        noise_level=level,
        noise_model=model,
        plan=plan_name,
        noise_sd=world.noise_sd,
        black=world.black,
        white=world.white,
        hidden=secret.hidden,
        cosine=secret.cosine,
        alias=secret.alias,
    )
    recording = world.simulate(plan, rng=np.random.default_rng(noise))
    return Case(recording, truth, world, kept_back_plans(plan, rng=np.random.default_rng(test)), test_noise)


def kept_back(case: Case) -> dict[str, Recording]:
    """Take the readings that were kept back from a diagnosis, in the same world after the recording.

    What belongs to one scan, by its name, is not in them; time, wear and weather have gone on.
    """
    rng = np.random.default_rng(case.test_seed)
    return {name: case.world.simulate(plan, rng=rng) for name, plan in case.test_plans.items()}


@dataclass(frozen=True)
class _Secret:
    """What was found to conceal."""

    hidden: tuple[Hidden, ...] = ()
    cosine: float | None = None
    alias: Alias | None = None


def _settle(
    stratum: Stratum,
    turn: int,
    plan_names: list[str],
    sensor: World,
    surviving: Surviving,
    rng: np.random.Generator,
    laying: np.random.Generator,
) -> tuple[str, Setting, _Secret]:
    """Try plan after plan, and in each some draws, until the effect can have its size."""
    failure = NotConvergedError("no plan to try")
    for plan_name in plan_names:
        setting = Setting(draw_plan(plan_name, rng=laying), sensor)
        if stratum.kind == "clean":
            return plan_name, setting, _Secret()
        ruler = Ruler(setting, surviving)
        for _ in range(_ATTEMPTS):
            try:
                return plan_name, setting, _conceal(stratum, turn, setting, ruler, rng)
            except NotConvergedError as error:
                failure = error
    raise failure


def _conceal(stratum: Stratum, turn: int, setting: Setting, ruler: Ruler, rng: np.random.Generator) -> _Secret:
    """Draw once what a stratum wants to be concealed."""

    def one(name: str) -> Hidden:
        return _sized(name, stratum.size, setting, ruler, rng)

    match stratum.kind:
        case "single":
            return _Secret((one(SINGLES[turn % len(SINGLES)]),))
        case "outside":
            return _Secret((one(list(OUTSIDE)[turn % len(OUTSIDE)]),))
        case "pair":
            first, second = (one(PAIRABLE[k]) for k in sorted(rng.choice(len(PAIRABLE), 2, replace=False)))
            cosine = ruler.cosine(first.effect, second.effect)
            if abs(cosine) >= _APART:
                raise NotConvergedError(f"{first.name} and {second.name} are alike: cosine {cosine:.2f}")
            return _Secret((first, second), cosine=cosine)
        case "alias":
            hidden, other = (one(str(name)) for name in rng.permutation(ALIASES[turn % len(ALIASES)]))
            cosine = ruler.cosine(hidden.effect, other.effect)
            if stratum.size**2 * (1 - cosine**2) / 2 >= _HONEST_NATS:
                raise NotConvergedError(f"{hidden.name} and {other.name} are not alike: cosine {cosine:.2f}")
            return _Secret((hidden,), alias=Alias(other.effect, cosine))
        case _:
            return _Secret((one(stratum.kind),))


def _sized(name: str, wanted: float, setting: Setting, ruler: Ruler, rng: np.random.Generator) -> Hidden:
    candidate = INSIDE.get(name) or OUTSIDE[name]
    of_amplitude = candidate.draw(setting, rng)
    amplitude = candidate.first
    if candidate.sized:
        amplitude = amplitude_of_size(
            lambda a: ruler.size(of_amplitude(a)), wanted, first=candidate.first, limit=candidate.limit
        )
    effect = of_amplitude(amplitude)
    return Hidden(effect, ruler.size(effect), region_of(effect, ruler))


def _instrument(plan: Plan, model: str) -> Instrumentation:
    step = 1.0 if model == "quantised" else None
    return replace(plan.instrumentation, step=step, description="Simulated readings of a challenge")
