"""Places (ranges of covariates) of the effects of a repair and of other significant residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.judgement.global_test import N_DRAWS, GlobalTest
from probewise.diagnosis.judgement.judged import Judged
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.repair.best_repair import BestRepair
from probewise.diagnosis.residuals.locate import Place, places_of_effect, significant_places
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.thinning import rows_to_diagnose

_SAME = 0.8  # overlap from which two places hold the same rows


def locate_effects_and_residuals(
    searched: Searched,
    test: GlobalTest,
    judged: Judged,
    best: BestRepair,
    sizes: Mapping[str, float],
    *,
    rng: np.random.Generator,
) -> tuple[Place, ...]:
    """Return the places of the repair's effects, largest first, then of other significant residuals of the null.

    A place is a range of a covariate, such as time. Of several places with the same figure, only the first is kept.

    Parameters
    ----------
    searched, test, judged, best
        Result of the search; global test of the null; the verdict; the repair.
    sizes
        Lambda of each effect, by name.
    rng
        Random generator, for a second test under normal noise, if heavy-tailed noise leaves nothing significant.
    """
    prepared, problem, law = searched.prepared, test.problem, test.problem.law
    covariates, residuals = searched.misfit_templates.covariates, test.null.found.residuals
    plan, found = prepared.recording.plan.take(prepared.usable_rows), best.fit.found
    scans = next((c for c in covariates if c.name == "scan"), None)
    named: list[Place] = []
    for effect in sorted(found.model.effects, key=lambda e: -sizes.get(e.name, 0.0)):
        change = found.change_by_effect(effect.name, prepared.usable_rows)
        shows_in = prepared.apparatus.covariate_of_effect(effect, change, found.predicted - change, plan, covariates)
        if shows_in is not None:
            size = sizes.get(effect.name, 0.0)
            named += places_of_effect(
                effect, change, shows_in, scans, plan, residuals, p_value=judged.p_value, size=size, sd=problem.sd
            )
    scan_names = prepared.recording.plan.scan_names
    scanned = significant_places(problem, covariates, scan_names, residuals, test.draws)
    if judged.verdict == "unknown" and not (named or scanned) and law.share:
        # Under heavy-tailed noise, residuals in outlying readings only are not significant.
        white = Linearised.of(test.null.found, law.without_tail_or_rounding())
        scanned = significant_places(
            white, covariates, scan_names, residuals, white.draw_null_residuals(N_DRAWS, rng=rng)
        )
    first: dict[str, Place] = {}
    for place in [*named, *_controls_before_time(scanned, prepared.apparatus.controls)]:
        first.setdefault(place.figure_name, place)
    return tuple(_place_in_everything(place, prepared) if prepared.is_thinned else place for place in first.values())


def _controls_before_time(places: Sequence[Place], controls: Sequence[str]) -> list[Place]:
    """Move the place of a control before that of time if they hold the same rows: what a person moves is the cause."""
    out = list(places)
    for place in places:
        at = next((k for k, other in enumerate(out) if other is place), 0)
        before = [k for k in range(at) if out[k].covariate in ("time", "row") and place.overlap(out[k]) >= _SAME]
        if place.covariate in controls and before:
            out.insert(before[0], out.pop(at))
    return out


def _place_in_everything(place: Place, prepared: Prepared) -> Place:
    """Return a place found in some of the readings with values at all usable ones, and scans by their numbers there."""
    values, at = place.values, place.curve_at
    if values is None:
        return place
    if place.covariate == "scan":
        number = np.unique(prepared.everything.plan.scan[rows_to_diagnose(prepared.everything)])
        values, at = (number[codes.astype(np.int64)].astype(np.float64) for codes in (values, at))
    everywhere = np.full(int(prepared.everything.usable.sum()), np.nan)
    usable = np.flatnonzero(prepared.everything.usable)
    everywhere[np.searchsorted(usable, prepared.usable_rows_of_everything)] = values
    return replace(place, values=everywhere, curve_at=at)
