"""One case of a challenge: drawn, diagnosed blind, compared with the truth."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from probewise._arrays import own_arithmetic
from probewise.diagnosis import Diagnosis, diagnose
from probewise.errors import DoubtfulResultWarning, ProbewiseError
from probewise.investigation import investigate
from probewise.proof.challenge.aliasing import cosines_with_vocabulary, residual_norms_with_one_named
from probewise.proof.challenge.coverage import effect_truths_and_intervals, place_overlap, sensor_truths_and_intervals
from probewise.proof.challenge.held_out import log_densities_of_scans
from probewise.proof.challenge.null_refit import NullRefit
from probewise.proof.sensors import Case, EffectSizer, HiddenEffect, draw_case, stratum_of
from probewise.proof.sensors.effect_samplers import CleanSetup
from probewise.recordings.plan import Plan, Recording
from probewise.world.concealed import Disturbs, Quantisation

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
    """Draw a case and diagnose it from its recording alone; return the diagnosis and the truth.

    Returns
    -------
    A dict for JSON: the stratum ("kind", "size", "other_noise"), the truth ("truth", sorted names; "hidden", a dict per
    effect), the diagnosis (`statements_to_score`). If drawing or diagnosis failed: "failed", the reason, and "at".
    """
    return _case_result(task, _diagnosis_result)


def _case_result(task: Task, diagnosed: Callable[[Case, Task], dict[str, Any]]) -> dict[str, Any]:
    stratum, _ = stratum_of(task.number)
    result: dict[str, Any] = asdict(stratum)
    refit = NullRefit()
    at = "drawing"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # doubtful results are scored like the others
        try:
            case = draw_case(task.seed, task.number, norm_after_refit=refit)
            result |= _truth_result(case, refit)
            at = "diagnosis"
            result |= diagnosed(case, task)
        # A campaign of thousands survives a case that breaks the diagnosis, and reports it.
        except (ProbewiseError, ArithmeticError, LookupError, ValueError) as error:
            result |= {"failed": f"{type(error).__name__}: {error}", "at": at}
    return result


def _truth_result(case: Case, refit: NullRefit) -> dict[str, Any]:
    truth = case.truth
    plain = replace(case.world, concealed=(), step=None)
    sizer = EffectSizer(CleanSetup(case.recording.plan, plain), refit)
    return {
        "plan": truth.plan,
        "ssf": truth.ssf,
        "noise_level": truth.noise_level,
        "noise_model": truth.noise_model,
        "readings": len(case.recording),
        "truth": list(truth.combination),
        "hidden": _effect_results(truth.hidden, sizer, refit),
        "alias": None if truth.alias is None else truth.alias.effect.name,
        "cosine": truth.alias.cosine if truth.alias is not None else truth.cosine,
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
    on_noise = isinstance(hidden.effect, Disturbs | Quantisation)
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
    named = [h for h in case.truth.hidden if h.name in diagnosis.combination and h.name in found]
    region = case.truth.hidden[0].region if len(case.truth.hidden) == 1 else None
    return {
        **statements_to_score(diagnosis),
        "where": [place.covariate for place in diagnosis.where],
        "overlap": None if region is None else place_overlap(region, diagnosis.where),
        "parameters": {h.name: effect_truths_and_intervals(h.parameters, found[h.name]) for h in named},
        "sensor": sensor_truths_and_intervals(case.world, diagnosis.repaired),
        "held_out": log_densities_of_scans(case, diagnosis, rng=files),
        "settled": _result_after_advice(case, diagnosis, later) if case.truth.stratum.kind == "alias" else None,
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
