"""Find the mismatch, name the physics, model it, show the gain: from recordings to a Diagnosis, step by step.

prepared -> searched -> tested -> judged -> repaired -> located -> advised -> said. Each step takes the values of those
before it and gives one of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from probewise._kinds import require_like, require_progress, require_rng
from probewise.diagnosis.advice.next_scans import NextMeasurement
from probewise.diagnosis.advice.rivals import next_readings
from probewise.diagnosis.fitting.earlier import SensorPrior
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.judgement.global_test import GlobalTest, run_global_test
from probewise.diagnosis.judgement.judged import judge
from probewise.diagnosis.light_sensor.sensor import LightSensor
from probewise.diagnosis.prepared import Prepared, prepare
from probewise.diagnosis.repair.best import Best, best_repair
from probewise.diagnosis.repair.correction import corrected
from probewise.diagnosis.repair.ensemble import Drawn, draw_models
from probewise.diagnosis.repair.located import locate
from probewise.diagnosis.repair.repair import repair_of
from probewise.diagnosis.residuals.locate import Place
from probewise.diagnosis.search.search import search
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import out_of_vocabulary
from probewise.diagnosis.search.weighed_twice import Weighing, with_agreement
from probewise.diagnosis.verdict_report.beyond import formula_of, remainder_of
from probewise.diagnosis.verdict_report.diagnosis import Diagnosis, VerdictReport
from probewise.diagnosis.verdict_report.findings import EffectFound, effects_found, noise_found
from probewise.diagnosis.verdict_report.reason import Grounds, reason_of
from probewise.effects import VOCABULARY, NamedEffect
from probewise.effects.vocabulary import require_effects
from probewise.progress import Progress, silent
from probewise.recordings.plan import Recording

__all__ = ["Thorough", "diagnose", "diagnose_prepared"]

_PROPOSED_FROM = 0.1  # probability of something unknown, from which formulas are proposed for it

Thorough: TypeAlias = Callable[[Searched], tuple[Searched, tuple[Weighing, ...]]]
"""Weighs again what a search has weighed: gives it with better probabilities, and what was weighed twice."""


def diagnose(
    recordings: Recording | Sequence[Recording],
    *,
    sensor: SensorPrior | None = None,
    null: Null | None = None,
    effects: Mapping[str, type[NamedEffect[Any]]] = VOCABULARY,
    thorough: Thorough | None = None,
    hands: bool = True,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Diagnosis:
    """Tell what physics the sensor model leaves out of these recordings.

    Parameters
    ----------
    recordings
        One, or the first and those that it asked for. Of more than 2,400 readings as many are diagnosed, in
        scans spread over all of them; residuals and predictions are given for every row.
    sensor
        An earlier posterior of the sensor, taken as the prior; without it the null is calibrated here.
    null
        What is to be diagnosed instead of a calibrated sensor: `SensorAndShape`, where what lies under it
        is not known, or `OwnModel`, any simulator.
    effects
        The vocabulary to choose from, by name. What is out of vocabulary counts as unknown, also where it has a
        formula (`UNNAMED`).
    thorough
        Weighs what leads a second time: `weigh_thoroughly`, by nested sampling.
    hands
        Whether somebody can lay or turn a sheet for the next readings; without, they are taken over what lies there.
    rng
        Source of randomness, for the null laws of the tests and the posterior samples.
    progress
        Told of every step, and of the refits within.

    Returns
    -------
    Diagnosis
        Verdict, probabilities, places, gain, aliases, the repaired model and the next measurement.

    Raises
    ------
    ParameterError
        If there is no usable reading, or units differ, or two recordings are the same, or both a sensor and a null are
        given.
    NotConvergedError
        If the fit of the null did not arrive anywhere.
    """
    require_rng(rng)
    require_progress(progress)
    require_effects(effects)
    if null is not None:
        allowed = (
            "a null model: OwnModel(simulate, prior) or SensorAndShape, of probewise.diagnosis; a sensor is sensor="
        )
        require_like("null", null, ("admits", "starts", "n_params"), allowed)
    prepared = prepare(recordings, sensor=sensor, null=null, apparatus=LightSensor(dict(effects), hands))
    return diagnose_prepared(prepared, thorough=thorough, progress=progress, rng=rng)


def diagnose_prepared(
    prepared: Prepared, *, thorough: Thorough | None = None, progress: Progress = silent, rng: np.random.Generator
) -> Diagnosis:
    """Go the road of `diagnose` for any apparatus; what is returned and raised is as there."""
    searched, weighings = search(prepared, progress=progress), tuple[Weighing, ...]()
    if searched.posterior.by_mean.get(("unknown",), 0.0) > _PROPOSED_FROM:
        searched = _with_proposals(searched, progress=progress)
        prepared = searched.prepared
    if prepared.too_little:
        searched = searched.by_prior_alone()
    elif thorough is not None:
        searched, weighings = thorough(searched)
    progress("testing what the model leaves")
    test = run_global_test(searched, rng=rng)
    progress("judging the repair on readings kept back")
    judged, best = best_repair(searched, test, judge(searched, test), rng=rng)
    drawn = draw_models(searched, test, judged, best, rng=rng, progress=progress)
    found = effects_found(searched, judged.hypotheses, best, drawn.best, rng=rng)
    progress("locating what is missing")
    where = locate(searched, test, judged, best, {e.name: e.size_lambda for e in found}, rng=rng)
    change = np.zeros(len(prepared.usable))
    if judged.verdict == "unknown" and not best.out_of_vocabulary:
        improvement, change = corrected(searched, test, best, rng=rng)
        best = replace(best, improvement=improvement)
    progress("choosing the next readings")
    asked = next_readings(searched, test.null)
    noise = noise_found(searched, best, drawn.best, rng=rng)
    remainder = remainder_of(searched, judged, best, rng=rng)
    formula = formula_of(searched, judged, best, drawn.best)
    grounds = _grounds(searched, test, best, drawn=drawn, found=found, where=where, asked=asked)
    reason = with_agreement(reason_of(judged, grounds), weighings)
    if prepared.thinned:
        reason += f" (From {len(prepared.recording)} of {len(prepared.everything)} readings, spread over all.)"
    return Diagnosis(
        recording=prepared.everything,
        judged=judged,
        repair=repair_of(prepared, test, best, drawn, change),
        where=where,
        next_measurement=asked,
        report=VerdictReport(reason, found, noise, weighings, remainder, formula),
        apparatus=prepared.apparatus,
    )


def _with_proposals(searched: Searched, *, progress: Progress) -> Searched:
    """Search again, formulas proposed for what has no name; as it was where there are none, or no time for them."""
    prepared = searched.prepared
    proposals = {} if prepared.apparatus.refits_are_over() else prepared.apparatus.proposals()
    if not proposals:
        return searched
    again = search(replace(prepared, effects={**prepared.effects, **proposals}), progress=progress)
    return searched if prepared.apparatus.refits_are_over() else again


def _grounds(
    searched: Searched,
    test: GlobalTest,
    best: Best,
    *,
    drawn: Drawn,
    found: Sequence[EffectFound],
    where: Sequence[Place],
    asked: NextMeasurement | None,
) -> Grounds:
    """Gather what the sentence is made of."""
    prepared, shares = searched.prepared, searched.evidences.unknown_shares
    orders = searched.posterior.order_probabilities
    beside = searched.beside(test.noise)
    formulas = [effect for effect in best.fit.found.model.effects if out_of_vocabulary((effect.name,))]
    columns = [drawn.best.columns(effect.name) for effect in formulas]
    return Grounds(
        words=prepared.apparatus.words,
        n_readings=len(prepared.usable),
        least_readings=prepared.least_readings,
        form=searched.nulls[max(orders, key=lambda n: orders[n])].form,
        sentences={effect.name: effect.sentence for effect in found},
        like=tuple(e.sentence(own.mean(axis=0), own.std(axis=0)) for e, own in zip(formulas, columns, strict=True)),
        family=max(shares, key=lambda family: shares[family], default=""),
        beside=beside.names if beside else (),
        shows_in=tuple(place.covariate for place in where),
        p_value_after=best.improvement.p_value_after,
        settles=None if asked is None else asked.description,
    )
