"""One case of a challenge on systems: drawn, written to files, diagnosed blind, compared with the truth."""

from __future__ import annotations

import math
import tempfile
import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from probewise._arrays import own_arithmetic
from probewise.diagnosis import Diagnosis
from probewise.diagnosis.diagnose_simulator import diagnose_system
from probewise.errors import DoubtfulResultWarning, ProbewiseError
from probewise.proof.challenge.case import Task, statements_to_score
from probewise.proof.challenge.coverage import effect_truths_and_intervals
from probewise.proof.challenge.scoring import NOISE, names_in_label
from probewise.proof.challenge.systems.held_out import log_densities_of_runs
from probewise.proof.systems import (
    SystemCase,
    SystemEffect,
    draw_system_case,
    nats_of_alternative,
    system_stratum_of,
    write_system_case,
)
from probewise.systems import read_simulator, read_table_for

_LIKELY = 0.05


@own_arithmetic
def run_system_case(task: Task) -> dict[str, Any]:
    """Draw a case, diagnose it from its simulator file and table alone, and return the diagnosis and the truth.

    Returns
    -------
    A dict for JSON, with keys as of `run_case`. A case that could not be drawn or whose diagnosis failed has "failed",
    the reason, and "at", "drawing" or "diagnosis"; every case has its stratum: "kind", "size" and "other_noise".
    """
    stratum, _ = system_stratum_of(task.number)
    result: dict[str, Any] = asdict(stratum)
    at = "drawing"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # doubtful results are scored like the others
        try:
            case = draw_system_case(task.seed, task.number)
            result |= _truth_json(case)
            at = "diagnosis"
            result |= _diagnosis_result(case, task)
        # A campaign survives a case that breaks the diagnosis, and reports it.
        except (
            ProbewiseError,
            ArithmeticError,
            LookupError,
            ValueError,
            TypeError,
            AttributeError,
            NotImplementedError,
        ) as error:
            result |= {"failed": f"{type(error).__name__}: {error}", "at": at}
    return result


def _truth_json(case: SystemCase) -> dict[str, Any]:
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
        "hidden": [_effect_json(effect) for effect in case.effects],
        "alias": None,
        "cosine": case.cosine,
    }


def _effect_json(effect: SystemEffect) -> dict[str, Any]:
    """Return an effect as a dict; an alias's loss in nats is converted to a cosine, sqrt(1 - 2 nats / lambda^2)."""
    squared = effect.size_lambda**2
    return {
        "name": effect.name,
        "size_lambda": effect.size_lambda,
        "on_noise": False,
        "in_vocabulary": effect.in_vocabulary,
        "shows_in": list(effect.covariates),
        "cosines": {name: math.sqrt(max(1 - 2 * nats / squared, 0.0)) for name, nats in effect.aliases.items()},
        "rival_nats": dict(effect.rivals),
        "parameters": {name: value for name, value in effect.parameters.items() if isinstance(value, float)},
    }


def _diagnosis_result(case: SystemCase, task: Task) -> dict[str, Any]:
    blind, later = task.generators(2)
    with tempfile.TemporaryDirectory() as directory:
        file, table, test, _ = write_system_case(case, directory)
        simulator = read_simulator(file)
        seen, kept_back = (read_table_for(simulator, path) for path in (table, test))
        begun_s = time.process_time()
        diagnosis = diagnose_system(simulator, seen, rng=blind)
        cpu_s = time.process_time() - begun_s
    found = {effect.name: effect for effect in diagnosis.effects}
    named = [e for e in case.effects if e.name in diagnosis.combination and e.name in found]
    return {
        **(said := statements_to_score(diagnosis)),
        "alternative_nats": nats_of_alternatives(case, said),
        "where": [place.covariate for place in diagnosis.where],
        "parameters": {e.name: effect_truths_and_intervals(_truths(e, case), found[e.name]) for e in named},
        "formula": _has_formula(diagnosis),
        "held_out": log_densities_of_runs(case, diagnosis, kept_back, rng=later),
        "cpu_s": cpu_s,
    }


def _truths(effect: SystemEffect, case: SystemCase) -> dict[str, Any]:
    """Return the parameters of an effect, values per run by the names of the runs, as in a diagnosis."""
    values: list[float] = effect.parameters.get("values", [])
    return {**effect.parameters, **{f"values[{run}]": v for run, v in zip(case.labels, values, strict=False)}}


def nats_of_alternatives(case: SystemCase, said: Mapping[str, Any]) -> dict[str, float]:
    """Return how much worse what was said in other words explains a case, by its names joined with "+".

    Said are the hypotheses of more than 5 % and those of the credible set (`statements_to_score`), without effects on
    the noise. The loss is that of `world.systems.nats_of_alternative`; infinite ones are left out.
    """
    if not case.effects:
        return {}
    likely = [tuple(names) for names, probability in said["hypotheses"] if probability > _LIKELY]
    labels = {*likely, *map(names_in_label, said["credible_set"])}
    own = tuple(sorted(effect.name for effect in case.effects))
    others = {tuple(sorted(set(names) - NOISE - {"unknown"})) for names in labels} - {(), own}
    nats = {"+".join(names): nats_of_alternative(case, names) for names in sorted(others)}
    return {label: loss for label, loss in nats.items() if math.isfinite(loss)}


def _has_formula(diagnosis: Diagnosis) -> bool:
    """Return whether an effect of the diagnosis's repaired model is a formula that the diagnosis found."""
    return any(getattr(effect, "expression", "") for effect in getattr(diagnosis.repaired.chain, "effects", ()))
