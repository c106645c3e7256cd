"""The rival hypotheses that the next readings should separate."""

from __future__ import annotations

from collections.abc import Mapping

from probewise._arrays import FloatArray
from probewise.diagnosis.advice.next_scans import (
    NextMeasurement,
    Rival,
    measurement_at_place,
    measurement_separating_rivals,
)
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.effect_words import hypothesis_in_words
from probewise.diagnosis.evidence.laplace import covariance_root
from probewise.diagnosis.fitting.fit import residual_degrees_of_freedom
from probewise.diagnosis.names import Names
from probewise.diagnosis.residuals.locate import Place
from probewise.diagnosis.scheduling import ENOUGH_NATS, SETTLED
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit

_MOST_RIVALS = 5


def choose_next_measurement(
    searched: Searched, null: WeighedFit, *, unknown_shows_in: Place | None, is_unknown: bool
) -> NextMeasurement | None:
    """Choose the readings that answer what is open; None if nothing is, or if none answers it.

    What is open is which of the fewest hypotheses on the mean that hold .95 is true. So a leader with .95 needs no more
    readings, however well these would confirm it; nor do aliases that have .95 together, since a plan is taken only if
    it promises three nats between classes of hypotheses that it can tell apart. What has no name predicts nothing: if
    it is the verdict (`is_unknown`), or the only rival of the null, the readings go where its residuals are largest,
    `unknown_shows_in`, if anywhere.
    """
    prepared = searched.prepared
    plan, apparatus = prepared.recording.plan, prepared.apparatus
    by_mean = searched.posterior.marginal_over_noise
    unknown = by_mean.get(("unknown",), 0.0)
    # An unknown effect makes no prediction beyond the null.
    probabilities: dict[Names, float] = {(): by_mean.get((), 0.0) + unknown}
    probabilities |= {names: p for names, p in by_mean.items() if names and names != ("unknown",)}
    ranked = sorted(probabilities, key=lambda names: -probabilities[names])
    found = _fits_of_open_hypotheses(searched, null, {names: probabilities[names] for names in ranked})
    sd = found[0].whitened_sd
    if is_unknown or (len(found) == 1 and found[0] is null and unknown > 1 - SETTLED):
        if unknown_shows_in is None:
            return None
        return measurement_at_place(unknown_shows_in, null.found, prepared.everything, sd, plan, apparatus)
    if is_settled(searched) or len(found) == 1:
        return None
    as_calibrated = f"{apparatus.words.null} as calibrated"
    rivals = [_as_rival(candidate, probabilities[candidate.names], as_calibrated, apparatus) for candidate in found]
    asked = measurement_separating_rivals(rivals, sd, plan, apparatus)
    return asked if asked is not None and asked.expected_log_bayes_factor >= ENOUGH_NATS else None


def is_settled(searched: Searched) -> bool:
    """Return whether one hypothesis on the mean, other than an unknown effect, has .95, whatever the noise."""
    by_mean = searched.posterior.marginal_over_noise
    return any(p >= SETTLED and names != ("unknown",) for names, p in by_mean.items())


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


def _as_rival(candidate: WeighedFit, probability: float, as_calibrated: str, apparatus: Apparatus) -> Rival:
    label, found = hypothesis_in_words(candidate.names, nothing=as_calibrated), candidate.found
    of_run = apparatus.coordinates_of_new_run(found.model)
    return Rival(label, found.model, found.z, _covariance_root_of_fit(candidate), probability, of_run)


def _covariance_root_of_fit(candidate: WeighedFit) -> FloatArray:
    """Return a square root of the covariance of a fit's coordinates under white noise, (n_params, n_params)."""
    slopes, sd = candidate.found.slopes, candidate.whitened_sd
    return covariance_root(slopes, sd**2 * len(slopes) / residual_degrees_of_freedom(slopes, sd, len(slopes)))
