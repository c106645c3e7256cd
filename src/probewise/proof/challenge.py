"""A challenge: sensors with concealed effects, each drawn, diagnosed blind and compared with the truth."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise._version import __version__
from probewise.calibration import predict
from probewise.diagnosis import Diagnosis, EffectFound, ModelSamples, Place, diagnose, model_with
from probewise.effects import VOCABULARY, Extent
from probewise.effects.noise_distribution import log_gaussian_density
from probewise.errors import DoubtfulResultWarning, ParameterError, ProbewiseError
from probewise.investigation import investigate
from probewise.proof.campaign import Campaign, Result
from probewise.proof.refits import NullRefit, cosines_with_vocabulary, residual_norms_with_one_named
from probewise.proof.results import ROUNDS_CASE, SENSOR_CASE, SYSTEM_CASE, misfit_of_case
from probewise.proof.sensors.cases import Case, HiddenEffect, Stratum, draw_case, held_out_recordings, stratum_of
from probewise.proof.sensors.effects import NO_PHYSICS, CleanSetup
from probewise.proof.sensors.sizing import CovariateRegion, EffectSizer
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import footprint_of
from probewise.world.world import World

__all__ = ["challenge", "run_case"]

_RESULTS = {"": SENSOR_CASE, "systems": SYSTEM_CASE}
_NOT_STATED = frozenset({"softness"})  # parameters that the vocabulary does not estimate


def effect_truths_and_intervals(parameters: Mapping[str, Any], found: EffectFound) -> dict[str, list[float]]:
    """Pair each parameter's truth with its 95 % interval: name -> [truth, low, high].

    Angles are compared modulo a turn. Parameters with one value per run are left out.
    """
    out = {}
    for stated in found.parameters:
        truth = parameters.get(stated.name)
        if not isinstance(truth, float) or stated.name in _NOT_STATED:
            continue
        low, high = stated.interval95
        if stated.unit == "rad":
            truth += 2 * math.pi * round(((low + high) / 2 - truth) / (2 * math.pi))
        out[stated.name] = [truth, low, high]
    return out


def sensor_truths_and_intervals(world: World, samples: ModelSamples) -> dict[str, list[float]]:
    """Pair the true moments of the footprint, and the levels, with their 95 % intervals: name -> [truth, low, high].

    Names: "u_mm", "v_mm", "var_u_mm2", "var_v_mm2", "cov_uv_mm2", "I_min", "I_max".
    """
    mean, covariance = world.spot.moments()
    ssf, levels = np.split(samples.theta, [6 * samples.n_gaussians], axis=1)
    f = footprint_of(ssf, samples.n_gaussians)

    def average(values: FloatArray) -> FloatArray:
        return np.asarray(np.sum(f.weight * values, axis=-1).reshape(len(levels)))

    u, v = average(f.u_mm), average(f.v_mm)
    pairs = {
        "u_mm": (mean[0], u),
        "v_mm": (mean[1], v),
        "var_u_mm2": (covariance[0, 0], average(f.var_u + f.u_mm**2) - u**2),
        "var_v_mm2": (covariance[1, 1], average(f.var_v + f.v_mm**2) - v**2),
        "cov_uv_mm2": (covariance[0, 1], average(f.cov_uv + f.u_mm * f.v_mm) - u * v),
        "I_min": (world.black, levels[:, 0]),
        "I_max": (world.white, levels[:, 1]),
    }
    return {name: [float(true), *np.quantile(own, [0.025, 0.975]).tolist()] for name, (true, own) in pairs.items()}


def place_overlap(region: CovariateRegion, places: Sequence[Place]) -> float:
    """Return intersection over union of an effect's region and the first of `places` in its covariate; 0 if none."""
    place = next((p for p in places if p.covariate == region.covariate), None)
    if place is None:
        return 0.0
    if region.scans:  # an effect with several scans is located in each by itself, with its own strength
        own = {p.scan for p in places if (p.covariate, p.p_value, p.z) == ("scan", place.p_value, place.z)}
        return len(own & {*region.scans}) / len(own | {*region.scans})
    if region.low is None or region.high is None or place.start is None or place.end is None:
        return 0.0
    both = min(region.high, place.end) - max(region.low, place.start)
    either = max(region.high, place.end) - min(region.low, place.start)
    return max(both, 0.0) / either if either > 0 else float(both == 0.0)


def log_densities_of_scans(
    case: Case, diagnosis: Diagnosis, *, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """Return the log predictive density of each held-out scan under up to four models, in nats, summed over readings.

    "null" and "repaired" are the diagnosis's models without effects and with those found. "right", if all concealed
    effects are in the vocabulary and detectable in this plan, is the model with exactly these effects, fitted to the
    same readings. "true" is an upper limit (exact for white noise): it knows the noise-free readings and the noise sd.

    Returns values by name of the scan ("angle", "pattern", "direction"), then of the model.
    """
    fitting, *drawing = rng.spawn(4)
    models = {"null": diagnosis.null, "repaired": diagnosis.repaired}
    extent = Extent.of(case.recording)
    names = [h.name for h in case.hidden if h.name not in NO_PHYSICS and h.name in VOCABULARY]
    showing = [name for name in names if VOCABULARY[name].for_extent(extent) is not None]
    if showing and len(showing) == len(case.hidden):
        with suppress(ParameterError):  # under a model with dropouts, none of these readings was lost
            models["right"] = model_with(case.recording, showing, rng=fitting)
    scans = held_out_recordings(case)
    scores: dict[str, dict[str, float]] = {}
    for (name, samples), child in zip(models.items(), drawing, strict=False):
        if name == "repaired" and samples is diagnosis.null:  # nothing is concealed: the right model is the null
            scores[name] = scores["null"]
            continue
        sensor = samples.fitted_sensor(diagnosis.recording, rng=child)
        scores[name] = {
            scan: float(np.nansum(predict(sensor, recording.plan, recording.readings).log_density))
            for scan, recording in scans.items()
        }
    scores["true"] = {}
    for scan, recording in scans.items():
        expected = case.world.expected_readings(recording.plan)
        density = log_gaussian_density(recording.readings, expected, case.world.noise_sd)
        scores["true"][scan] = float(density[recording.usable].sum())
    return {scan: {name: own[scan] for name, own in scores.items()} for scan in scans}


C = TypeVar("C")
_BREAKS = (ProbewiseError, ArithmeticError, LookupError, ValueError, TypeError, AttributeError, NotImplementedError)
_OWN = 1_000  # child of the case's seed sequence that drawing the case does not use
_LEAST_PROBABILITY = 1e-3
_LEAST_COSINE = 0.5


@dataclass(frozen=True)
class Task:
    """One case of a challenge: the challenge's secret seed and the case's number, from 0."""

    seed: int
    number: int

    @property
    def key(self) -> str:
        """The case's key in the campaign's file."""
        return f"{self.seed} / {self.number}"

    def generators(self, n: int) -> list[np.random.Generator]:
        """Return `n` generators for running the case, independent of those that draw it."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(self.number, _OWN))).spawn(n)


@dataclass(frozen=True)
class RunCaseInRounds:
    """A function that runs a case in up to `rounds` rounds: record, diagnose, then take the advised readings.

    It is a dataclass, not a closure, so that it can be pickled for another process.
    """

    rounds: int

    def __call__(self, task: Task) -> dict[str, Any]:
        """Return the result of `run_case` and, under "rounds", each round's diagnosis and number of readings."""
        return _case_result(task, partial(_investigation_result, rounds=self.rounds))


@own_arithmetic
def run_case(task: Task) -> dict[str, Any]:
    """Draw a case and diagnose it from its recording alone; return a `results.SENSOR_CASE`, or what failed."""
    return _case_result(task, _diagnosis_result)


def _case_result(task: Task, diagnosed: Callable[[Case, Task], dict[str, Any]]) -> dict[str, Any]:
    refit = NullRefit()
    return result_or_failure(
        stratum_of(task.number)[0],
        lambda: draw_case(task.seed, task.number, norm_after_refit=refit),
        lambda case: _truth_result(case, refit),
        lambda case: diagnosed(case, task),
    )


def result_or_failure(
    stratum: Stratum,
    draw: Callable[[], C],
    truth: Callable[[C], dict[str, Any]],
    diagnosed: Callable[[C], dict[str, Any]],
) -> dict[str, Any]:
    """Draw a case; return stratum, truth and diagnosis or, where drawing or diagnosis fails, what failed."""
    result: dict[str, Any] = asdict(stratum)
    at = "drawing"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # doubtful results are scored like the others
        try:
            case = draw()
            result |= truth(case)
            at = "diagnosis"
            result |= diagnosed(case)
        # A campaign of thousands survives a case that breaks the diagnosis, and reports it.
        except _BREAKS as error:
            result |= {"failed": f"{type(error).__name__}: {error}", "at": at}
    return result


def _truth_result(case: Case, refit: NullRefit) -> dict[str, Any]:
    plain = replace(case.world, concealed=(), step=None)
    return {
        "plan": case.plan,
        "ssf": case.ssf,
        "noise_level": case.noise_level,
        "noise_model": case.noise_model,
        "readings": len(case.recording),
        "truth": list(case.combination),
        "hidden": _effect_results(case.hidden, EffectSizer(CleanSetup(case.recording.plan, plain), refit), refit),
        "alias": case.alias,
        "cosine": case.cosine,
    }


def _effect_results(hidden: Sequence[HiddenEffect], sizer: EffectSizer, refit: NullRefit) -> list[dict[str, Any]]:
    """Return one dict per effect; in a pair with "size_beside", its size in sds when the other is in the model."""
    each = [_effect_result(one, sizer, refit) for one in hidden]
    if len(hidden) == 2:
        both = sizer.recording_with_effects(*(one.effect for one in hidden))
        left = residual_norms_with_one_named(refit, sizer.clean_recording, both, [one.name for one in hidden])
        for own, other in zip(each, reversed(each), strict=True):
            own["size_beside"] = left[other["name"]] / sizer.setup.world.noise_sd
    return each


def _effect_result(hidden: HiddenEffect, sizer: EffectSizer, refit: NullRefit) -> dict[str, Any]:
    """Return an effect as a dict; "cosines" are those above 0.5 with effects of the vocabulary, by name."""
    # The world counts rounding apart from noise, but the diagnosis names it among the noise effects.
    on_noise = hidden.effect.disturbs or hidden.name == "quantisation"
    like = (
        {}
        if on_noise
        else cosines_with_vocabulary(refit, sizer.clean_recording, sizer.recording_with_effects(hidden.effect))
    )
    return {
        "name": hidden.name,
        "size_lambda": hidden.size_lambda,
        "on_noise": on_noise,
        "in_vocabulary": hidden.in_vocabulary,
        "shows_in": list(hidden.residual_covariates),
        "cosines": {name: rho for name, rho in like.items() if rho > _LEAST_COSINE},
    }


def _diagnosis_result(case: Case, task: Task) -> dict[str, Any]:
    blind, later, files = task.generators(3)
    begun_s = time.process_time()
    diagnosis = diagnose(case.recording, rng=blind)
    cpu_s = time.process_time() - begun_s
    found = {effect.name: effect for effect in diagnosis.effects}
    named = [h for h in case.hidden if h.name in diagnosis.combination and h.name in found]
    region = case.hidden[0].region if len(case.hidden) == 1 else None
    return {
        **statements_to_score(diagnosis),
        "where": [place.covariate for place in diagnosis.where],
        "overlap": None if region is None else place_overlap(region, diagnosis.where),
        "parameters": {h.name: effect_truths_and_intervals(h.parameters, found[h.name]) for h in named},
        "sensor": sensor_truths_and_intervals(case.world, diagnosis.repaired),
        "held_out": log_densities_of_scans(case, diagnosis, rng=files),
        "settled": _result_after_advice(case, diagnosis, later) if case.stratum.kind == "alias" else None,
        "cpu_s": cpu_s,
    }


def _investigation_result(case: Case, task: Task, *, rounds: int) -> dict[str, Any]:
    thinking, reading = task.generators(2)

    def recording_of_round(number: int, plan: Plan, _: str) -> Recording:
        return case.recording if number == 1 else case.world.simulate(plan, rng=reading)

    begun_s = time.process_time()
    told = [
        {**statements_to_score(each.diagnosis), "readings": len(each.recording), "settled": each.settled}
        for each in investigate(recording_of_round, case.recording.plan, rounds=rounds, rng=thinking)
    ]
    return {**told[-1], "readings": len(case.recording), "rounds": told, "cpu_s": time.process_time() - begun_s}


def statements_to_score(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return "verdict", "p_value", "combination", "hypotheses" ([names, probability]) and "credible_set", for JSON."""
    return {
        "verdict": diagnosis.verdict,
        "p_value": diagnosis.p_value,
        "combination": list(diagnosis.combination),
        "hypotheses": [
            [list(h.effects), h.probability] for h in diagnosis.hypotheses if h.probability > _LEAST_PROBABILITY
        ],
        "credible_set": list(diagnosis.judged.credible),
    }


def _result_after_advice(case: Case, diagnosis: Diagnosis, rng: np.random.Generator) -> Mapping[str, Any] | None:
    """Diagnose the recording together with simulated readings of the advised plan; None if none was advised."""
    asked = diagnosis.next_measurement
    if asked is None:
        return None
    more = case.world.simulate(asked.plan, rng=rng)
    return {"readings": len(more), **statements_to_score(diagnose([case.recording, more], rng=rng))}


def challenge(
    numbers: Iterable[int], *, seed: int, work: Callable[[Task], Result] = run_case, of: str = ""
) -> Campaign[Task]:
    """Return the campaign of the cases of these numbers.

    `seed`: the secret seed, which with its number determines a case; `work`: function that runs a case; `of`: name of
    what is diagnosed, if not the light sensor: a file of another name is refused.
    """
    settings = {"challenge": __version__, "seed": seed} | ({"of": of} if of else {})
    schema = _RESULTS.get(of, ROUNDS_CASE)
    return Campaign(work, [Task(seed, n) for n in numbers], settings, partial(misfit_of_case, schema=schema), "cases")
