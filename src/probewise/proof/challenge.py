"""Challenges: sensors or systems with concealed effects, each drawn, diagnosed blind and compared with the truth."""

from __future__ import annotations

import math
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise._version import __version__
from probewise.calibration import predict
from probewise.diagnosis import Diagnosis, EffectFound, ModelSamples, Place, diagnose, model_with
from probewise.diagnosis.diagnose_simulator import diagnose_system
from probewise.diagnosis.evidence import covariance_root
from probewise.diagnosis.fit_simulator import calibrated_of, fitted_system_from_samples, repaired_of
from probewise.effects import VOCABULARY, Extent
from probewise.errors import DoubtfulResultWarning, NotConvergedError, ParameterError, ProbewiseError
from probewise.investigation import investigate
from probewise.proof import refits, sensors
from probewise.proof.campaign import ROUNDS_CASE, SENSOR_CASE, SYSTEM_CASE, Campaign, Result, misfit_of_case
from probewise.proof.systems.cases import SystemCase, draw_system_case, system_stratum_of, write_system_case
from probewise.proof.systems.forms import SystemEffect
from probewise.proof.tables import HONEST_NATS, NOISE, names_in_label
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import footprint_of
from probewise.systems import FittedSystem, RunTable, predict_system, read_simulator, read_table_for
from probewise.world.world import World

__all__ = ["challenge", "run_case"]

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
    """Pair the true moments of the footprint, and the levels, with their 95 % intervals: name -> [truth, low, high]."""
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


def place_overlap(region: sensors.CovariateRegion, places: Sequence[Place]) -> float:
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
    case: sensors.Case, diagnosis: Diagnosis, *, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """Return the log predictive density of each held-out scan, by its name, under up to three models, by name, in nats.

    "null" and "repaired" are the diagnosis's models without effects and with those found. "right", if all concealed
    effects are in the vocabulary and detectable in this plan, is the model with exactly these effects, fitted to the
    same readings.
    """
    fitting, *drawing = rng.spawn(4)
    models = {"null": diagnosis.null, "repaired": diagnosis.repaired}
    extent = Extent.of(case.recording)
    names = [h.name for h in case.hidden if h.name not in sensors.NO_PHYSICS and h.name in VOCABULARY]
    showing = [name for name in names if VOCABULARY[name].for_extent(extent) is not None]
    if showing and len(showing) == len(case.hidden):
        with suppress(ParameterError):  # under a model with dropouts, none of these readings was lost
            models["right"] = model_with(case.recording, showing, rng=fitting)
    scans = sensors.held_out_recordings(case)
    scores: dict[str, dict[str, float]] = {}
    for (name, samples), child in zip(models.items(), drawing, strict=False):
        if name == "repaired" and samples is diagnosis.null:  # nothing is concealed: the right model is the null
            scores[name] = scores["null"]
            continue
        sensor = samples.fitted_sensor(diagnosis.recording, rng=child)
        scored = {scan: predict(sensor, later.plan, later.readings).log_density for scan, later in scans.items()}
        scores[name] = {scan: float(np.nansum(density)) for scan, density in scored.items()}
    return {scan: {name: own[scan] for name, own in scores.items()} for scan in scans}


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


@own_arithmetic
def run_case(task: Task, rounds: int = 1) -> dict[str, Any]:
    """Draw a case and diagnose it from its recording alone; return a `results.SENSOR_CASE`, or what failed.

    In more than one of `rounds`, take the advised readings after each; the result is then a `results.ROUNDS_CASE`.
    """

    def parts() -> Iterator[dict[str, Any]]:
        refit = refits.NullRefit()
        case = sensors.draw_case(task.seed, task.number, norm_after_refit=refit)
        yield _truth_result(case, refit)
        yield _diagnosis_result(case, task) if rounds == 1 else _investigation_result(case, task, rounds)

    return _result_or_failure(sensors.stratum_of(task.number)[0], parts())


@own_arithmetic
def run_system_case(task: Task) -> dict[str, Any]:
    """Draw a case and diagnose it from its files alone; return a `results.SYSTEM_CASE`, or what failed."""

    def parts() -> Iterator[dict[str, Any]]:
        refit = refits.SystemRefit()
        case = draw_system_case(task.seed, task.number, after_refit=refit)
        yield _system_truth_result(case, refit)
        yield _system_diagnosis_result(case, task, refit)

    return _result_or_failure(system_stratum_of(task.number)[0], parts())


def _result_or_failure(stratum: sensors.Stratum, parts: Iterator[dict[str, Any]]) -> dict[str, Any]:
    """Return stratum, truth and diagnosis, the parts of a result, or where drawing or diagnosis fails, what failed."""
    result, at = asdict(stratum), "drawing"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # doubtful results are scored like the others
        try:
            for part in parts:
                result, at = result | part, "diagnosis"
        # A campaign of thousands survives a case that breaks the diagnosis, and reports it.
        except _BREAKS as error:
            result |= {"failed": f"{type(error).__name__}: {error}", "at": at}
    return result


def _hidden_result(
    effect: sensors.HiddenEffect | SystemEffect, cosines: Mapping[str, float], on_noise: bool = False
) -> dict[str, Any]:
    return {
        "name": effect.name,
        "size_lambda": effect.size_lambda,
        "on_noise": on_noise,
        "in_vocabulary": effect.in_vocabulary,
        "shows_in": list(effect.covariates),
        "cosines": cosines,
    }


def _truth_result(case: sensors.Case, refit: refits.NullRefit) -> dict[str, Any]:
    setup = sensors.CleanSetup(case.recording.plan, replace(case.world, concealed=(), step=None), refit)
    hidden = []
    for one in case.hidden:
        # The world counts rounding apart from noise, but the diagnosis names it among the noise effects.
        on_noise = one.effect.disturbs or one.name == "quantisation"
        changed = None if on_noise else setup.recording_with_effects(one.effect)
        like = {} if changed is None else refits.cosines_with_vocabulary(refit, setup.clean_recording, changed)
        hidden.append(_hidden_result(one, {name: rho for name, rho in like.items() if rho > _LEAST_COSINE}, on_noise))
    return {
        **{name: getattr(case, name) for name in ("plan", "ssf", "noise_level", "noise_model")},
        "readings": len(case.recording),
        "truth": list(case.combination),
        "hidden": hidden,
        "alias": case.alias,
        "cosine": case.cosine,
    }


def _diagnosis_result(case: sensors.Case, task: Task) -> dict[str, Any]:
    blind, later, files = task.generators(3)
    begun_s = time.process_time()
    diagnosis = diagnose(case.recording, rng=blind)
    cpu_s = time.process_time() - begun_s
    region = case.hidden[0].region if len(case.hidden) == 1 else None
    settled = None
    if case.stratum.kind == "alias" and (advised := diagnosis.next_measurement) is not None:
        more = case.world.simulate(advised.plan, rng=later)
        settled = {"readings": len(more), **statements_to_score(diagnose([case.recording, more], rng=later))}
    return {
        **statements_to_score(diagnosis),
        "where": [place.covariate for place in diagnosis.where],
        "overlap": None if region is None else place_overlap(region, diagnosis.where),
        "parameters": _intervals_of_named(diagnosis, {h.name: h.effect.parameters for h in case.hidden}),
        "sensor": sensor_truths_and_intervals(case.world, diagnosis.repaired),
        "held_out": log_densities_of_scans(case, diagnosis, rng=files),
        "settled": settled,
        "cpu_s": cpu_s,
    }


def _intervals_of_named(diagnosis: Diagnosis, truths: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return `effect_truths_and_intervals` of the concealed effects that a diagnosis names, given their true ones."""
    named = {effect.name: effect for effect in diagnosis.effects if effect.name in diagnosis.combination}
    return {name: effect_truths_and_intervals(true, named[name]) for name, true in truths.items() if name in named}


def _investigation_result(case: sensors.Case, task: Task, rounds: int) -> dict[str, Any]:
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
    likely = [[list(h.effects), h.probability] for h in diagnosis.hypotheses if h.probability > _LEAST_PROBABILITY]
    return {
        "verdict": diagnosis.verdict,
        "p_value": diagnosis.p_value,
        "combination": list(diagnosis.combination),
        "hypotheses": likely,
        "credible_set": list(diagnosis.credible),
    }


def challenge(
    numbers: Iterable[int], *, seed: int, work: Callable[[Task], Result] = run_case, of: str = ""
) -> Campaign[Task]:
    """Return the campaign of the cases of these numbers.

    `seed`: the secret seed, which with its number determines a case; `work`: function that runs a case; `of`: name of
    what is diagnosed, if not the light sensor: a file of another name is refused.
    """
    settings = {"challenge": __version__, "seed": seed} | ({"of": of} if of else {})
    schema = {"": SENSOR_CASE, "systems": SYSTEM_CASE}.get(of, ROUNDS_CASE)
    tasks = {task.key: task for task in (Task(seed, n) for n in numbers)}
    return Campaign(work, tasks, settings, partial(misfit_of_case, schema=schema), "cases")


_N_SAMPLES = 500


def log_densities_of_runs(
    case: SystemCase, diagnosis: Diagnosis, later: RunTable, refit: refits.SystemRefit, *, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """Return as `log_densities_of_scans` for the held-out runs "inside" the range of the recorded ones and "beyond" it.

    "right" knows the concealed effects: absent without effects or if the fit fails. What cannot be predicted is left
    out.
    """
    (fitting,), seed = rng.spawn(1), int(rng.integers(2**32))  # the same draws for all: their differences count
    models = {"null": (calibrated_of(diagnosis), later), "repaired": (repaired_of(diagnosis), later)}
    if case.effects:
        with suppress(NotConvergedError):  # no fit was possible, so the case does not count for the share
            models["right"] = _right_model_and_readings(case, later, refit, rng=fitting)
    drawn, scores = case.drawn, {"inside": dict[str, float](), "beyond": dict[str, float]()}
    run = drawn.table.run[drawn.held_out_row_numbers]
    for name, (model, table) in models.items():
        with suppress(ParameterError):  # no reading can be predicted
            density = predict_system(model, table, rng=np.random.default_rng(seed)).log_density
            for of_run, number in zip(scores.values(), np.unique(run), strict=True):
                if np.isfinite(density[run == number]).all():
                    of_run[name] = float(density[run == number].sum())
    return scores


def _right_model_and_readings(
    case: SystemCase, later: RunTable, refit: refits.SystemRefit, *, rng: np.random.Generator
) -> tuple[FittedSystem, RunTable]:
    """Return the model without effects, fitted beside the true ones, and held-out readings without their change.

    It is fitted to the readings without the change by the effects at the true parameters. An effect's values for the
    held-out runs, which nobody can know, are the mean of the others.
    """
    drawn, known = case.drawn, []
    for effect in case.effects:
        of_runs = [v for name, v in effect.values.items() if name.startswith("values[")]
        unseen = [f"values[{k}]" for k in (drawn.table.n_runs - 2, drawn.table.n_runs - 1)] if of_runs else []
        mean = float(np.mean(of_runs[:-2])) if of_runs else 0.0
        known.append(replace(effect, values={**effect.values, **dict.fromkeys(unseen, mean)}))
    change = drawn.simulate_all_rows(known) - drawn.simulate_all_rows([])
    seen, rows, sd = drawn.diagnosed_row_numbers, drawn.held_out_row_numbers, drawn.kind.sd
    found = refit.refit(drawn, (case.readings - change)[seen])
    z = found.z + rng.standard_normal((_N_SAMPLES, len(found.z))) @ covariance_root(found.slopes, sd**2).T
    samples = ModelSamples(found.model.chain, found.model.theta(z), np.full(len(z), sd), 0)
    model = fitted_system_from_samples(
        refit.reference(found), samples, refit.recording(case.readings[seen]), found.predicted
    )
    return model, later.with_columns({drawn.kind.reading: later.covariates[drawn.kind.reading] - change[rows]})


_LIKELY = 0.05


def _system_truth_result(case: SystemCase, refit: refits.SystemRefit) -> dict[str, Any]:
    kind, hidden = case.drawn.kind, []
    for effect in case.effects:
        rivals = refits.rivals_with_nats(refit, case, effect)
        # An alias's loss in nats is converted to a cosine.
        of_alias = {name: 1 - 2 * nats / effect.size_lambda**2 for name, nats in rivals.items() if nats < HONEST_NATS}
        like = {name: math.sqrt(max(squared, 0.0)) for name, squared in of_alias.items()}
        shared = {name: value for name, value in effect.values.items() if not name.startswith("values[")}
        hidden.append({**_hidden_result(effect, like), "rival_nats": dict(rivals), "parameters": shared})
    of_noise = {"white": [], "quantised": [], "t4": ["outliers"]}.get(case.noise.name, [case.noise.name])
    strange = any(not effect.in_vocabulary for effect in case.effects)
    return {
        "system": kind.name,
        "law": kind.law is not None,
        "noise_model": case.noise.name,
        "noise_text": case.noise_text,
        "readings": len(case.drawn.diagnosed_row_numbers),
        "truth": ["unknown"] if strange else sorted([*(effect.name for effect in case.effects), *of_noise]),
        "hidden": hidden,
        "alias": None,
        "cosine": case.cosine,
    }


def _system_diagnosis_result(case: SystemCase, task: Task, refit: refits.SystemRefit) -> dict[str, Any]:
    blind, later = task.generators(2)
    with tempfile.TemporaryDirectory() as directory:
        file, table, test = write_system_case(case, directory)
        simulator = read_simulator(file)
        seen, kept_back = (read_table_for(simulator, path) for path in (table, test))
        begun_s = time.process_time()
        diagnosis = diagnose_system(simulator, seen, rng=blind)
        cpu_s = time.process_time() - begun_s
    # Values per run by the names of the runs, as in a diagnosis.
    of_run = {f"values[{k}]": f"values[{run}]" for k, run in enumerate(case.labels)}
    truths = {e.name: {of_run.get(name, name): value for name, value in e.values.items()} for e in case.effects}
    said = statements_to_score(diagnosis)
    return {
        **said,
        "alternative_nats": nats_of_alternatives(case, said, refit),
        "where": [place.covariate for place in diagnosis.where],
        "parameters": _intervals_of_named(diagnosis, truths),
        "held_out": log_densities_of_runs(case, diagnosis, kept_back, refit, rng=later),
        "cpu_s": cpu_s,
    }


def nats_of_alternatives(case: SystemCase, said: Mapping[str, Any], refit: refits.SystemRefit) -> dict[str, float]:
    """Return how much worse what was said in other words explains a case, by its names joined with "+".

    Said are the hypotheses of more than 5 % and those of the credible set (`statements_to_score`), without effects on
    the noise. The loss is that of `nats_of_alternative`; infinite ones are left out.
    """
    if not case.effects:
        return {}
    likely = [tuple(names) for names, probability in said["hypotheses"] if probability > _LIKELY]
    labels = {*likely, *map(names_in_label, said["credible_set"])}
    own = tuple(sorted(effect.name for effect in case.effects))
    others = {tuple(sorted(set(names) - NOISE - {"unknown"})) for names in labels} - {(), own}
    nats = {"+".join(names): refits.nats_of_alternative(refit, case, names) for names in sorted(others)}
    return {label: loss for label, loss in nats.items() if math.isfinite(loss)}
