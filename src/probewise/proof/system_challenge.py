"""A challenge on systems: each case drawn, written to files, diagnosed blind and compared with the truth."""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray, own_arithmetic
from probewise.diagnosis import Diagnosis, ModelSamples
from probewise.diagnosis.diagnose_simulator import diagnose_system
from probewise.diagnosis.evidence import covariance_root
from probewise.diagnosis.simulator_rows import SimulatorApparatus
from probewise.effects.noise_distribution import log_gaussian_density
from probewise.errors import NotConvergedError
from probewise.proof.challenge import Task, effect_truths_and_intervals, result_or_failure, statements_to_score
from probewise.proof.refits import SystemRefit, nats_of_alternative, rivals_with_nats, run_table
from probewise.proof.scoring import HONEST_NATS, NOISE, names_in_label
from probewise.proof.systems.cases import (
    SystemCase,
    SystemEffect,
    draw_system_case,
    system_stratum_of,
    write_system_case,
)
from probewise.systems import RunTable, read_simulator, read_table_for
from probewise.systems.forms import ReferenceFit
from probewise.systems.forms.binding import extract_stored_fit, has_value_per_run, rebind_forms
from probewise.systems.prediction import draw_value_for_new_run
from probewise.systems.system import SystemChain

_N_SAMPLES = 200
_N_OF_A_RUN = 4000  # for parameters per run: their prior is wide, and the density must not depend on a few draws


def log_densities_of_runs(
    case: SystemCase, diagnosis: Diagnosis, later: RunTable, refit: SystemRefit, *, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """Return the log predictive density of each held-out run under up to four models, in nats, summed over readings.

    "null" and "repaired" are the diagnosis's models without effects and with those found. "right" knows the concealed
    effects: absent without effects or if the fit fails. "true" knows the noise-free reading.

    Returns values by run, "inside" the range of the recorded runs and "beyond" it, then by model; not finite ones are
    left out.
    """
    fitting, *drawing = rng.spawn(3)
    readings = later.covariates[case.drawn.kind.reading]
    sd = case.drawn.kind.sd
    rows = case.drawn.held_out_row_numbers
    about = cast(SimulatorApparatus, diagnosis.apparatus).about
    scores = {
        "null": _log_mean_density(*predict_runs(diagnosis.null, about, later, rng=drawing[0]), readings),
        "true": _log_mean_density(case.noise_free[None, rows], np.array([sd]), readings),
    }
    scores["repaired"] = scores["null"]
    if diagnosis.repaired is not diagnosis.null:
        scores["repaired"] = _log_mean_density(
            *predict_runs(diagnosis.repaired, about, later, rng=drawing[1]), readings
        )
    if case.effects:
        with contextlib.suppress(NotConvergedError):  # no fit was possible, so the case does not count for the share
            scores["right"] = _log_mean_density(*_right_predictions(case, refit, rng=fitting), readings)
    run = case.drawn.table.run[rows]
    names = {case.drawn.table.n_runs - 2: "inside", case.drawn.table.n_runs - 1: "beyond"}
    return {
        name: {model: float(own[run == k].sum()) for model, own in scores.items() if np.isfinite(own[run == k]).all()}
        for k, name in names.items()
    }


def _right_predictions(
    case: SystemCase, refit: SystemRefit, *, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Predict the held-out runs, as `predict_runs` does, by the model without effects fitted beside the true ones.

    It is fitted to the readings without the change by the effects at the true parameters, which is added to what it
    predicts. An effect's values for the held-out runs, which nobody can know, are the mean of the others.
    """
    drawn, known = case.drawn, []
    for form, values in case.forms_with_parameters():
        of_runs = [v for name, v in values.items() if name.startswith("values[")]
        unseen = [f"values[{k}]" for k in (drawn.table.n_runs - 2, drawn.table.n_runs - 1)] if of_runs else []
        known.append((form, {**values, **dict.fromkeys(unseen, float(np.mean(of_runs[:-2])) if of_runs else 0.0)}))
    change = drawn.simulate_all_rows(known) - drawn.simulate_all_rows([])
    seen, rows, sd = drawn.diagnosed_row_numbers, drawn.held_out_row_numbers, drawn.kind.sd
    found = refit.refit(drawn, (case.readings - change)[seen])
    z = found.z + rng.standard_normal((_N_SAMPLES, len(found.z))) @ covariance_root(found.slopes, sd**2).T
    samples = ModelSamples(found.model.chain, found.model.theta(z), np.full(len(z), sd), (), 0)
    later = run_table(drawn.table.select_rows(rows), drawn.kind, case.readings[rows])
    predicted, sds = predict_runs(samples, refit.reference(found), later, rng=rng)
    return predicted + change[rows], sds


def predict_runs(
    samples: ModelSamples, about: ReferenceFit, table: RunTable, *, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Predict new runs: noise-free readings (n_samples, n_points), and the sd of a reading (n_samples,).

    Parameters per run are drawn from their prior, and an effect's values per run as `predict_system` draws them.

    `samples`: posterior samples of the model; `about`: the reference fit of the diagnosis, from which its effects have
    their scales; `table`: the new runs; `rng`: random generator, for the choice of samples and for the values per run.
    """
    chain = cast(SystemChain, samples.chain)
    system = chain.system.with_added_runs(table)
    own = [effect.name for effect in chain.effects if has_value_per_run(effect.name)]
    longer = rebind_forms(own, system.simulator, extract_stored_fit(about), more_runs=table.scan_names)
    effects = tuple(longer.get(effect.name, effect) for effect in chain.effects)
    wider = replace(chain, system=system, effects=effects)
    of_run = [name for name in wider.names if name not in chain.names]
    n = _N_OF_A_RUN if of_run else _N_SAMPLES
    chosen = rng.permutation(np.arange(n) % len(samples.theta))
    known = dict(zip(chain.names, samples.theta[chosen].T, strict=True))
    drawn = {}
    for name in of_run:
        if name in system.marginals:  # stratified: one from each of n parts of equal prior mass
            drawn[name] = system.marginals[name].from_unit((rng.permutation(n) + rng.random(n)) / n)
        else:
            effect = next(own_name for own_name in own if name.startswith(f"{own_name}."))
            drawn[name] = draw_value_for_new_run(samples.effect_samples(effect)[chosen], rng=rng)
    theta = np.stack([(known | drawn)[name] for name in wider.names], axis=1)
    with np.errstate(all="ignore"):
        predicted = np.concatenate([wider.predict(part, table) for part in np.array_split(theta, max(n // 500, 1))])
    return predicted, samples.noise_sd[chosen]


def _log_mean_density(predicted: FloatArray, sd: FloatArray, readings: FloatArray) -> FloatArray:
    """Return the log of the mean density over samples, (n_points,), of readings predicted with `sd` (n_samples,)."""
    each = log_gaussian_density(readings, predicted, sd[:, None])
    return np.asarray(logsumexp(each, axis=0) - math.log(len(each)))


_LIKELY = 0.05


@own_arithmetic
def run_system_case(task: Task) -> dict[str, Any]:
    """Draw a case and diagnose it from its files alone; return a `results.SYSTEM_CASE`, or what failed."""
    refit = SystemRefit()
    return result_or_failure(
        system_stratum_of(task.number)[0],
        lambda: draw_system_case(task.seed, task.number, after_refit=refit),
        lambda case: _truth_json(case, refit),
        lambda case: _diagnosis_result(case, task, refit),
    )


def _truth_json(case: SystemCase, refit: SystemRefit) -> dict[str, Any]:
    kind = case.drawn.kind
    of_noise = {"white": [], "quantised": [], "t4": ["outliers"]}.get(case.noise.name, [case.noise.name])
    names = [effect.name for effect in case.effects]
    strange = any(not effect.in_vocabulary for effect in case.effects)
    return {
        "system": kind.name,
        "law": kind.law is not None,
        "noise_model": case.noise.name,
        "noise_text": case.noise_text,
        "readings": len(case.drawn.diagnosed_row_numbers),
        "truth": ["unknown"] if strange else sorted([*names, *of_noise]),
        "hidden": [_effect_json(effect, rivals_with_nats(refit, case, effect)) for effect in case.effects],
        "alias": None,
        "cosine": case.cosine,
    }


def _effect_json(effect: SystemEffect, rivals: Mapping[str, float]) -> dict[str, Any]:
    """Return an effect as a dict; an alias's loss in nats is converted to a cosine, sqrt(1 - 2 nats / lambda^2)."""
    squared, aliases = effect.size_lambda**2, {name: nats for name, nats in rivals.items() if nats < HONEST_NATS}
    return {
        "name": effect.name,
        "size_lambda": effect.size_lambda,
        "on_noise": False,
        "in_vocabulary": effect.in_vocabulary,
        "shows_in": list(effect.covariates),
        "cosines": {name: math.sqrt(max(1 - 2 * nats / squared, 0.0)) for name, nats in aliases.items()},
        "rival_nats": dict(rivals),
        "parameters": {name: value for name, value in effect.values.items() if not name.startswith("values[")},
    }


def _diagnosis_result(case: SystemCase, task: Task, refit: SystemRefit) -> dict[str, Any]:
    blind, later = task.generators(2)
    with tempfile.TemporaryDirectory() as directory:
        file, table, test = write_system_case(case, directory)
        simulator = read_simulator(file)
        seen, kept_back = (read_table_for(simulator, path) for path in (table, test))
        begun_s = time.process_time()
        diagnosis = diagnose_system(simulator, seen, rng=blind)
        cpu_s = time.process_time() - begun_s
    found = {effect.name: effect for effect in diagnosis.effects}
    named = [e for e in case.effects if e.name in diagnosis.combination and e.name in found]
    return {
        **(said := statements_to_score(diagnosis)),
        "alternative_nats": nats_of_alternatives(case, said, refit),
        "where": [place.covariate for place in diagnosis.where],
        "parameters": {e.name: effect_truths_and_intervals(_truths(e, case), found[e.name]) for e in named},
        "formula": _has_formula(diagnosis),
        "held_out": log_densities_of_runs(case, diagnosis, kept_back, refit, rng=later),
        "cpu_s": cpu_s,
    }


def _truths(effect: SystemEffect, case: SystemCase) -> dict[str, Any]:
    """Return the parameters of an effect, values per run by the names of the runs, as in a diagnosis."""
    of_run = {f"values[{k}]": f"values[{run}]" for k, run in enumerate(case.labels)}
    return {of_run.get(name, name): value for name, value in effect.values.items()}


def nats_of_alternatives(case: SystemCase, said: Mapping[str, Any], refit: SystemRefit) -> dict[str, float]:
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
    nats = {"+".join(names): nats_of_alternative(refit, case, names) for names in sorted(others)}
    return {label: loss for label, loss in nats.items() if math.isfinite(loss)}


def _has_formula(diagnosis: Diagnosis) -> bool:
    """Return whether an effect of the diagnosis's repaired model is a formula that the diagnosis found."""
    return any(getattr(effect, "expression", "") for effect in getattr(diagnosis.repaired.chain, "effects", ()))
