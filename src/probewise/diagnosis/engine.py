"""The pipeline of a diagnosis, from recordings to a `Diagnosis`.

prepared -> searched -> tested -> judged -> repaired -> located -> advised -> reported. Each step takes the values of
the steps before it and returns a new one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from probewise._arrays import own_arithmetic
from probewise._kinds import checked_texts, require_like, require_one_of, require_progress, require_rng
from probewise.diagnosis.advice import NextMeasurement, choose_next_measurement, is_settled
from probewise.diagnosis.best_repair import improvement_and_correction, judged_and_best_repair
from probewise.diagnosis.diagnosis import Diagnosis, locate_effects_and_residuals, predictions_before_and_after
from probewise.diagnosis.findings import effects_found, formula_of, noise_found, remainder_of
from probewise.diagnosis.fit import Null
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.prepared import Prepared, prepare
from probewise.diagnosis.prior_odds import Names
from probewise.diagnosis.reason import (
    ALL,
    NOTHING,
    NOTHING_MORE,
    Grounds,
    combinations_in_reason,
    reason_of,
)
from probewise.diagnosis.samples import ModelSamples, draw_models, sample_model
from probewise.diagnosis.search.refits import effects_out_of_vocabulary
from probewise.diagnosis.search.search import MAX_ORDER, search, search_with_formulas
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.thorough import Weighing, sentence_with_agreement
from probewise.diagnosis.sensors import SensorPrior
from probewise.diagnosis.verdict import Judged, judge, run_global_test
from probewise.diagnosis.words import hypothesis_in_words
from probewise.effects import EFFECTS, VOCABULARY, Effect, Extent, LightEffect
from probewise.effects.effect import require_effect_kinds, sentence_from_samples
from probewise.errors import ParameterError
from probewise.progress import Progress, silent
from probewise.recordings.plan import Recording, require_recording
from probewise.sensor import Stage

Thorough: TypeAlias = Callable[[Searched], tuple[Searched, tuple[Weighing, ...]]]
"""Function that recomputes the evidence of a search; returns it with better probabilities, and both evidences."""


@own_arithmetic
def diagnose(
    recordings: Recording | Sequence[Recording],
    *,
    sensor: SensorPrior | None = None,
    null: Null | None = None,
    effects: Mapping[str, LightEffect] = VOCABULARY,
    thorough: Thorough | None = None,
    hands: bool = True,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Diagnosis:
    """Diagnose what physics the sensor model leaves out of these recordings, as `probewise.diagnose` does.

    Of more than 2,400 readings, about that many are used, in scans spread over all of them; residuals and predictions
    cover every row. Arguments, result and errors are those of `probewise.diagnose`, and:

    Parameters
    ----------
    null
        Another null model instead of a calibrated sensor: `SensorAndShape` for an unknown shape.
    effects
        The vocabulary of effects, by name. `RARE_EFFECTS` are tried too; they are named where hardly anything
        else out of vocabulary explains the readings.
    thorough
        Function that computes the evidence of the leading hypotheses a second time, such as
        `partial(weigh_thoroughly, rng=rng)`, by nested sampling.
    hands
        Whether a person can exchange or turn sheets for the next readings; if not, the next scans are over the sheet in
        place.

    Raises
    ------
    ParameterError
        As `probewise.diagnose`, and if both a sensor and a null are given.
    """
    require_rng(rng)
    require_progress(progress)
    require_effect_kinds(effects)
    if null is not None:
        allowed = "a null model: SensorAndShape, of probewise.diagnosis; a sensor is sensor="
        require_like("null", null, ("admits", "starts", "n_params"), allowed)
    prepared = prepare(recordings, sensor=sensor, null=null, apparatus=LightSensorApparatus(dict(effects), hands))
    return diagnose_prepared(prepared, thorough=thorough, progress=progress, rng=rng)


def diagnose_prepared(
    prepared: Prepared, *, thorough: Thorough | None = None, progress: Progress = silent, rng: np.random.Generator
) -> Diagnosis:
    """Run the pipeline of `diagnose` on the input of any apparatus, with the same returns and errors."""
    searched = search_with_formulas(search(prepared, progress=progress), progress=progress)
    return diagnosis_of_search(searched, thorough=thorough, progress=progress, rng=rng)


def diagnosis_of_search(
    searched: Searched, *, thorough: Thorough | None = None, progress: Progress = silent, rng: np.random.Generator
) -> Diagnosis:
    """Run the rest of the pipeline on the result of a search, with the arguments and returns of `diagnose`."""
    prepared, weighings = searched.prepared, tuple[Weighing, ...]()
    if prepared.has_too_little_data:
        searched = searched.with_prior_probabilities()
    elif thorough is not None:
        searched, weighings = thorough(searched)
    progress("testing the residuals")
    test = run_global_test(searched, rng=rng)
    progress("testing the repair on held-out readings")
    judged, best = judged_and_best_repair(searched, test, judge(searched, test), rng=rng)
    null_samples, best_samples, repaired = draw_models(searched, test, judged, best, rng=rng, progress=progress)
    found = effects_found(searched, judged.hypotheses, best, best_samples, rng=rng)
    progress("locating the residuals")
    where = locate_effects_and_residuals(searched, test, judged, best, {e.name: e.size_lambda for e in found}, rng=rng)
    change = np.zeros(len(prepared.usable_rows))
    if judged.verdict == "unknown" and not best.out_of_vocabulary:
        improvement, change = improvement_and_correction(searched, test, best, rng=rng)
        best = replace(best, improvement=improvement)
    progress("choosing the next readings")
    asked = choose_next_measurement(
        searched, test.null, unknown_shows_in=next(iter(where), None), is_unknown=judged.verdict == "unknown"
    )
    noise = noise_found(searched, best, best_samples, rng=rng)
    remainder = remainder_of(searched, judged, best, rng=rng)
    formula = formula_of(searched, judged, best, best_samples)
    shares, orders = searched.evidences.unknown_shares, searched.posterior.order_probabilities
    beside = searched.likeliest_fit_beside_unknown(test.noise)
    formulas = [effect for effect in best.fit.found.model.effects if effects_out_of_vocabulary((effect.name,))]
    settles, apart = _separating_readings_in_words(searched, judged, asked)
    grounds = Grounds(
        words=prepared.apparatus.words,
        n_readings=len(prepared.usable_rows),
        least_readings=prepared.least_readings,
        form=searched.nulls[max(orders, key=lambda n: orders[n])].ssf_in_words,
        sentences={effect.name: effect.sentence for effect in found},
        like=tuple(sentence_from_samples(each, best_samples.effect_samples(each.name)) for each in formulas),
        family=max(shares, key=lambda family: shares[family], default=""),
        beside=beside.names if beside else (),
        shows_in=tuple(place.covariate for place in where),
        p_value_after=best.improvement.p_value_after,
        nuisances=noise.nuisances,
        settles=settles,
        apart=apart,
    )
    reason = sentence_with_agreement(reason_of(judged, grounds), weighings)
    if prepared.is_thinned:
        n_usable = int(prepared.everything.usable.sum())
        reason += f" (From {len(prepared.usable_rows)} of {n_usable} readings, evenly spread.)"
    before, after = predictions_before_and_after(prepared, best, change)
    return Diagnosis(
        recording=prepared.everything,
        apparatus=prepared.apparatus,
        judged=judged,
        reason=reason,
        effects=found,
        noise=noise,
        null=null_samples,
        repaired=repaired,
        improvement=best.improvement,
        before=before,
        after=after,
        by_rows=bool(np.any(change)),
        where=where,
        next_measurement=asked,
        is_settled=is_settled(searched),
        weighings=weighings,
        remainder=remainder,
        formula=formula,
    )


def _separating_readings_in_words(
    searched: Searched, judged: Judged, asked: NextMeasurement | None
) -> tuple[str | None, str]:
    """Return `settles` and `apart` of `Grounds`: the next readings, and which hypotheses of the reason they separate.

    Nothing is known of hypotheses that differ in their noise alone, or that are not among those compared.
    """
    told = combinations_in_reason(judged)
    named: dict[Names, str] = {}
    on_mean = {tuple(sorted({*names} - searched.prepared.noise_effect_names)) for names in told}
    formulas = {names for names in asked.effects if effects_out_of_vocabulary(names)} - on_mean if asked else set()
    for names in told:
        if names == ("unknown",):  # without a formula it predicts what the null does
            named |= dict.fromkeys(formulas or {()}, hypothesis_in_words(names))
        else:
            beside = tuple(sorted({*names} - {*judged.shared}))
            label = hypothesis_in_words(beside, nothing=NOTHING_MORE if judged.shared else NOTHING)
            named.setdefault(tuple(sorted({*names} - searched.prepared.noise_effect_names)), label)
    if len(named) < 2:
        return None, ""
    classes = asked.classes_among(named) if asked is not None else []
    if asked is None or len(classes) == 1 < len(classes[0]):
        return "", ""
    if sum(map(len, classes)) < 2:
        return None, ""
    labels = list(dict.fromkeys(" or ".join(dict.fromkeys(named[asked.effects[k]] for k in own)) for own in classes))
    if len(labels) < 2:  # formulas for one unknown effect
        return None, ""
    return asked.description, ALL if set(labels) == set(named.values()) else " from ".join(labels)


def model_with(recording: Recording, names: Sequence[str], *, rng: np.random.Generator) -> ModelSamples:
    """Fit the sensor with these effects, at the SSF order (number of Gaussians) with the largest evidence.

    Parameters
    ----------
    recording
        What was read.
    names
        Names of `EFFECTS`, in the vocabulary or out of it; empty for the calibrated sensor alone.
    rng
        Source of randomness, for the posterior samples.

    Returns
    -------
    ModelSamples
        The samples; without any effect on the mean if the search kept no refit with all of them, and without the noise
        effects (but those beyond doubt) if it kept no noise model of just these.

    Raises
    ------
    ParameterError
        If there is no effect of a name, or it cannot act in this recording.
    """
    require_recording(recording)
    require_rng(rng)
    names = checked_texts("names", names, "names of effects")
    extent = Extent.of(recording)
    effects: dict[str, Effect] = {}
    for name in names:
        require_one_of("names", name, list(EFFECTS))
        effect = EFFECTS[name].for_extent(extent)
        if effect is None:
            raise ParameterError("names", name, "effects of the vocabulary that this recording can show")
        effects[name] = effect
    prepared = Prepared(recording, effects, None, LightSensorApparatus(), recording)
    found = search(prepared, max_order=MAX_ORDER, depth=max(len(names), 1))
    on_mean = tuple(sorted(name for name, effect in effects.items() if effect.stage is not Stage.NOISE))
    on_noise = tuple(sorted(set(names) - set(on_mean)))
    noise = on_noise if on_noise in found.refits.noises.models else found.certain
    best = found.best_refit_of(on_mean, noise) or found.best_refit_of((), noise)
    assert best is not None  # the calibrated sensor is always fitted
    if not np.isfinite(best.evidence[noise].log_z):
        raise ParameterError("names", ", ".join(noise), "effects of the vocabulary that this recording can show")
    return sample_model(best.found, best.evidence[noise], recording, weights=best.weights, rng=rng)
