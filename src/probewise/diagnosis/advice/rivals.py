"""The rival hypotheses that the next readings should separate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.advice.next_scans import NextMeasurement, Rival, measurement_separating_rivals
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.evidence.laplace import Linearised, covariance_root
from probewise.diagnosis.fitting.fit import residual_degrees_of_freedom
from probewise.diagnosis.names import Names
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit
from probewise.effects import spoken_name

_LEAST_PROBABILITY = 0.01
_MOST_RIVALS = 5
_TRIED = 3  # insignificant effects to try as a rival, until some reading could detect one
_UNDETECTED = 3.0  # lambda of such an effect
_LEFT = 2.0  # factor by which its total change of the existing readings may exceed that, since the refit is nonlinear
_SIZES = 4  # sizes tried, each a quarter of the last


def choose_next_measurement(searched: Searched, null: WeighedFit) -> NextMeasurement | None:
    """Choose the scans that separate the most probable hypotheses about the mean readings, of those refitted.

    If only one is left, its rival is an effect too weak to be detected so far. None if no scan is informative, or only
    one is left and the budget of costly predictions is spent.
    """
    by_mean = searched.posterior.marginal_over_noise
    # An unknown effect makes no prediction beyond the null.
    probabilities: dict[tuple[str, ...], float] = {(): by_mean.get((), 0.0) + by_mean.get(("unknown",), 0.0)}
    probabilities |= {names: p for names, p in by_mean.items() if names and names != ("unknown",)}
    ranked = sorted(probabilities, key=lambda names: -probabilities[names])
    found = _leading_fits(searched, null, {names: probabilities[names] for names in ranked})
    prepared = searched.prepared
    sd, plan, apparatus = found[0].whitened_sd, prepared.recording.plan, prepared.apparatus
    as_calibrated = f"{apparatus.words.null} as calibrated"
    rivals = [_as_rival(candidate, probabilities[candidate.names], as_calibrated) for candidate in found]
    rivals = [_with_coordinates_of_new_run(rival, apparatus) for rival in rivals]
    if len(rivals) > 1:
        return measurement_separating_rivals(rivals, sd, plan, apparatus)
    if apparatus.is_refit_budget_spent():
        return None
    others = dict.fromkeys(n for names in ranked for n in names if n in prepared.effects)
    imagined = (_rival_with_undetected_effect(searched, null, name) for name in others)
    tried = islice((_with_coordinates_of_new_run(rival, apparatus) for rival in imagined if rival is not None), _TRIED)
    wanted = (measurement_separating_rivals([*rivals, rival], sd, plan, apparatus) for rival in tried)
    return next((asked for asked in wanted if asked is not None), None)


def _leading_fits(searched: Searched, null: WeighedFit, ranked: Mapping[Names, float]) -> list[WeighedFit]:
    """Return the refits of the most probable hypotheses on the mean, at most five, the most probable first."""
    found: list[WeighedFit] = []
    for names, probability in ranked.items():
        candidate = searched.best_refit_of(names, searched.certain) if names else null
        # The rival of a named effect is the next hypothesis, however improbable; that of clean, a possible weak effect.
        second = len(found) == 1 and bool(found[0].names)
        if candidate is not None and (not found or second or probability >= _LEAST_PROBABILITY):
            found.append(candidate)
        if len(found) == _MOST_RIVALS:
            break
    return found


def _as_rival(candidate: WeighedFit, probability: float, as_calibrated: str) -> Rival:
    label = " with ".join(map(spoken_name, candidate.names)) or as_calibrated
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
            return Rival(f"{spoken_name(name)} too weak to be detected so far", model, z, root, 0.0)
        setting[amplitudes] /= 4
    return None


def _covariance_root_of_fit(candidate: WeighedFit) -> FloatArray:
    """Return a square root of the covariance of a fit's coordinates under white noise, (n_params, n_params)."""
    slopes, sd = candidate.found.slopes, candidate.whitened_sd
    return covariance_root(slopes, sd**2 * len(slopes) / residual_degrees_of_freedom(slopes, sd, len(slopes)))
