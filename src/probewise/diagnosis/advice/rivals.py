"""The rival hypotheses that the next readings should separate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.advice.next_scans import (
    NextMeasurement,
    Rival,
    measurement_at_place,
    measurement_separating_rivals,
)
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.effect_words import effect_in_words, hypothesis_in_words
from probewise.diagnosis.evidence.laplace import Linearised, covariance_root
from probewise.diagnosis.fitting.fit import residual_degrees_of_freedom
from probewise.diagnosis.names import Names
from probewise.diagnosis.residuals.locate import Place
from probewise.diagnosis.scheduling import ENOUGH_NATS, SETTLED
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit

_MOST_RIVALS = 5
_TRIED = 3  # insignificant effects to try as a rival, until some reading could detect one
_UNDETECTED = 3.0  # lambda of such an effect
_LEFT = 2.0  # factor by which its total change of the existing readings may exceed that, since the refit is nonlinear
_SIZES = 4  # sizes tried, each a quarter of the last


def choose_next_measurement(
    searched: Searched, null: WeighedFit, *, unknown_shows_in: Place | None
) -> NextMeasurement | None:
    """Choose the readings that answer what is open; None if nothing is, or if none answers it.

    What is open is which of the fewest hypotheses on the mean that hold .95 is true. So a leader with .95 needs no more
    readings, however well these would confirm it; nor do aliases that have .95 together, since a plan is taken only if
    it promises three nats between classes of hypotheses that it can tell apart. If the null has less but no rival is
    fitted, its rival is an effect too weak to be detected so far. What has no name predicts nothing: if it is the
    verdict, `unknown_shows_in` is the place of its largest residuals, or None, and the readings go there.
    """
    prepared = searched.prepared
    plan, apparatus = prepared.recording.plan, prepared.apparatus
    by_mean = searched.posterior.marginal_over_noise
    # An unknown effect makes no prediction beyond the null.
    probabilities: dict[Names, float] = {(): by_mean.get((), 0.0) + by_mean.get(("unknown",), 0.0)}
    probabilities |= {names: p for names, p in by_mean.items() if names and names != ("unknown",)}
    ranked = sorted(probabilities, key=lambda names: -probabilities[names])
    found = _fits_of_open_hypotheses(searched, null, {names: probabilities[names] for names in ranked})
    sd = found[0].whitened_sd
    if unknown_shows_in is not None:
        return measurement_at_place(unknown_shows_in, null.found, prepared.everything, sd, plan, apparatus)
    if is_settled(searched):
        return None
    as_calibrated = f"{apparatus.words.null} as calibrated"
    rivals = [_as_rival(candidate, probabilities[candidate.names], as_calibrated) for candidate in found]
    rivals = [_with_coordinates_of_new_run(rival, apparatus) for rival in rivals]
    if len(rivals) > 1:
        return _if_enough(measurement_separating_rivals(rivals, sd, plan, apparatus))
    if found[0].names or apparatus.is_refit_budget_spent():
        return None
    others = dict.fromkeys(n for names in ranked for n in names if n in prepared.effects)
    imagined = (_rival_with_undetected_effect(searched, null, name) for name in others)
    tried = islice((_with_coordinates_of_new_run(rival, apparatus) for rival in imagined if rival is not None), _TRIED)
    wanted = (measurement_separating_rivals([*rivals, rival], sd, plan, apparatus) for rival in tried)
    return next((asked for asked in map(_if_enough, wanted) if asked is not None), None)


def is_settled(searched: Searched) -> bool:
    """Return whether one hypothesis on the mean, other than an unknown effect, has .95, whatever the noise."""
    by_mean = searched.posterior.marginal_over_noise
    return any(p >= SETTLED and names != ("unknown",) for names, p in by_mean.items())


def _if_enough(asked: NextMeasurement | None) -> NextMeasurement | None:
    """Return the readings, or None if they promise less than three nats."""
    return asked if asked is not None and asked.expected_log_bayes_factor >= ENOUGH_NATS else None


def _fits_of_open_hypotheses(searched: Searched, null: WeighedFit, ranked: Mapping[Names, float]) -> list[WeighedFit]:
    """Return the refits of the fewest hypotheses on the mean that hold .95, at most five, the most probable first."""
    found: list[WeighedFit] = []
    held = 0.0
    for names, probability in ranked.items():
        candidate = searched.best_refit_of(names, searched.certain) if names else null
        if candidate is not None:
            found.append(candidate)
        held += probability
        if found and (held >= SETTLED or len(found) == _MOST_RIVALS):
            break
    return found


def _as_rival(candidate: WeighedFit, probability: float, as_calibrated: str) -> Rival:
    label = hypothesis_in_words(candidate.names, nothing=as_calibrated)
    return Rival(label, candidate.found.model, candidate.found.z, _covariance_root_of_fit(candidate), probability)


def _with_coordinates_of_new_run(rival: Rival, apparatus: Apparatus) -> Rival:
    return replace(rival, of_run=apparatus.coordinates_of_new_run(rival.model))


def _rival_with_undetected_effect(searched: Searched, null: WeighedFit, name: str) -> Rival | None:
    """Return a rival with an effect of lambda 3, undetected so far; None if it changes readings by much more."""
    effect, found = searched.prepared.effects[name], null.found
    best = max(null.evidence.values(), key=lambda e: e.log_z)
    problem = Linearised.of(found, best.likeliest_law)
    templates = searched.misfit_templates.templates.templates_of(found, effect)
    sizes = [float(np.linalg.norm(problem.project(c[:, :1]))) for c in templates.columns]
    at = int(np.argmin(np.abs(np.log(np.maximum(sizes, 1e-9) / _UNDETECTED))))
    setting = templates.settings[at][0].copy()
    amplitudes = list(effect.amplitudes)
    setting[amplitudes] *= min(_UNDETECTED / max(sizes[at], 1e-9), 50.0)
    model = found.model.with_effect(templates.variant_of_entry(at))

    def prediction_change(z: FloatArray) -> FloatArray:
        return np.asarray(model.predict(z[None, :])[0, searched.prepared.usable_rows] - found.predicted)

    for _ in range(_SIZES if amplitudes else 1):
        z = np.concatenate([found.z, model.z_of_last_effect(setting[None, :])[0]])
        # The sensor is refitted to readings with the effect.
        z[: len(found.z)] += problem.absorbing_shift(found, prediction_change(z))
        if np.linalg.norm(prediction_change(z)) <= _LEFT * _UNDETECTED * null.whitened_sd:
            root = np.zeros((len(z), len(z)))  # its size is fixed
            root[: len(found.z), : len(found.z)] = _covariance_root_of_fit(null)
            return Rival(f"{effect_in_words(name)}, too weak to be detected so far", model, z, root, 0.0)
        setting[amplitudes] /= 4
    return None


def _covariance_root_of_fit(candidate: WeighedFit) -> FloatArray:
    """Return a square root of the covariance of a fit's coordinates under white noise, (n_params, n_params)."""
    slopes, sd = candidate.found.slopes, candidate.whitened_sd
    return covariance_root(slopes, sd**2 * len(slopes) / residual_degrees_of_freedom(slopes, sd, len(slopes)))
