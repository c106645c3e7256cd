"""Places of the effects of a repair, and of other significant residuals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.judgement.global_test import N_DRAWS, GlobalTest
from probewise.diagnosis.judgement.judged import Judged
from probewise.diagnosis.repair.best import Best
from probewise.diagnosis.residuals.locate import Place, places, places_of_effect
from probewise.diagnosis.search.searched import Searched


def locate(
    searched: Searched,
    test: GlobalTest,
    judged: Judged,
    best: Best,
    sizes: Mapping[str, float],
    *,
    rng: np.random.Generator,
) -> tuple[Place, ...]:
    """Locate the effects of the repair, the largest first; then other significant residuals.

    Parameters
    ----------
    searched, test, judged, best
        What was found.
    sizes
        Lambda of each effect.
    rng
        Random generator, for the null distribution of a second test of residuals that only outlying readings show.
    """
    prepared, problem, law = searched.prepared, test.problem, test.problem.law
    covariates, residuals = searched.screening.covariates, test.null.found.residuals
    plan, found = prepared.recording.plan.take(prepared.usable), best.fit.found
    scans = next((c for c in covariates if c.name == "scan"), None)
    named: list[Place] = []
    for effect in sorted(found.model.effects, key=lambda e: -sizes.get(e.name, 0.0)):
        change = found.change_by(effect.name, prepared.usable)
        shows_in = prepared.apparatus.covariate_of(effect, change, found.predicted - change, plan, covariates)
        if shows_in is not None:
            size = sizes.get(effect.name, 0.0)
            named += places_of_effect(
                effect, change, shows_in, scans, plan, residuals, p_value=judged.p_value, size=size, sd=problem.sd
            )
    scan_names = prepared.recording.plan.scan_names
    scanned = places(problem, covariates, scan_names, residuals, test.draws)
    if judged.verdict == "unknown" and not (named or scanned) and law.share:
        # Under heavy-tailed noise, residuals in outlying readings only are not significant.
        white = Linearised.of(test.null.found, law.plain())
        scanned = places(white, covariates, scan_names, residuals, white.draws(N_DRAWS, rng=rng))
    first: dict[str, Place] = {}
    for place in [*named, *scanned]:
        first.setdefault(place.witness, place)
    return tuple(first.values())
