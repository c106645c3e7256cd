"""Search for the set of effects that explains the recording.

Hypotheses are subsets of effects on the mean, under every noise model and several SSF orders, with or without an
unknown effect. Templates screen them; a beam of the best is refitted jointly and nonlinearly, with Laplace evidences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from probewise.diagnosis.evidence.bank import Bank
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.templates import TemplateMemory
from probewise.diagnosis.noise.law import steps_within_scans
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.residuals.bases import unknown_templates, unlike_named
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.diagnosis.search.backward_elimination import eliminate_backward
from probewise.diagnosis.search.constants import (
    EXTENDED_WITHIN,
    FEW_READINGS,
    MAX_ORDER,
    MOST_REFITTED_LATE,
    NULL_TRIED_AGAIN,
    REFITTED_LATE,
    SAME_MODE,
    WITH_UNKNOWN,
)
from probewise.diagnosis.search.forward_selection import select_forward
from probewise.diagnosis.search.noises import Noises
from probewise.diagnosis.search.nulls import fit_nulls
from probewise.diagnosis.search.orders import at_other_orders
from probewise.diagnosis.search.pruning import prune
from probewise.diagnosis.search.refits import Refits
from probewise.diagnosis.search.searched import Evidences, Posterior, Screening, Searched, posterior_of
from probewise.diagnosis.search.state import SearchState
from probewise.diagnosis.search.unknown import Unknown
from probewise.diagnosis.search.weighed_fit import out_of_vocabulary
from probewise.effects import NamedEffect, NoiseEffect
from probewise.progress import Progress, silent


def search(
    prepared: Prepared,
    *,
    prior: PriorOdds | None = None,
    max_order: int | None = None,
    depth: int = 3,
    after: Searched | None = None,
    progress: Progress = silent,
) -> Searched:
    """Compute the evidence of combinations of effects.

    Parameters
    ----------
    prepared
        Input of the diagnosis.
    prior
        Prior odds; by default those of the apparatus.
    max_order
        Largest number of Gaussians tried without a given null, plus one if it is not far behind. Default: three, or one
        for few readings.
    depth
        Largest size of a combination.
    after
        An earlier search of the same recording with a given null, with fewer effects: its fits are not made again.
    progress
        Called at every refit.
    """
    recording, effects = prepared.recording, prepared.effects
    if max_order is None:
        max_order = 1 if len(prepared.usable) < FEW_READINGS else MAX_ORDER
    prior = prior or prepared.apparatus.prior_odds(effects)
    on_mean, on_noise = _effects_on_mean_and_noise(prepared)
    refits = (
        Refits(prepared.null, Noises(recording, on_noise, prior), TemplateMemory(prepared.usable))
        if after is None
        else after.refits
    )
    noises, templates, own = refits.noises, refits.templates, prepared.apparatus.own_effects(on_mean)
    if prepared.null is not None and prepared.null.nuisance:
        own = frozenset(on_mean)  # about a shape that is far off without the right effect, screening is no guide
    spent = prepared.apparatus.spent_refit_budget()

    def is_over(share: float) -> bool:
        """Return whether a share of the budget that an earlier search left is spent."""
        return prepared.apparatus.refit_budget_is_spent(spent + share * max(1.0 - spent, 0.0))

    state = SearchState(on_mean, prior, noises, templates, refits, own, progress, is_over)
    if after is None:
        fit_nulls(state, prepared, max_order=max_order)
    else:
        state.sensors |= after.nulls
        state.candidates |= {key: fit for key, fit in after.evidences.fits.items() if not fit.names}
    unknown = _unknown_effects_of(state, prepared, after)
    screening = Screening(templates, state.null.found, unknown.bases, unknown.covariates)

    def evidences() -> Evidences:
        return Evidences(state.candidates, state.screened(), unknown.log_z, unknown.shares)

    def posterior() -> Posterior:
        return posterior_of(evidences(), prior, certain=noises.certain, n_forms=len(state.sensors))

    select_forward(state, depth=depth)
    if prepared.null is not None:
        _refit_null(state)
    eliminate_backward(state)
    # With a form of the SSF that the readings reject, an unknown effect would only stand in for the form.
    unknown.weigh([c for c in state.nulls if c.log_z > state.null.log_z - EXTENDED_WITHIN])
    _refit_late(state, posterior, progress)
    if prepared.null is None:
        at_other_orders(state, posterior().by_mean)
    state.candidates, state.pruned = prune(state.candidates, noises)
    progress("weighing what has no name")
    refitted = [c for c in state.candidates.values() if c.names]
    unknown.weigh(sorted(refitted, key=lambda c: -c.log_z)[:WITH_UNKNOWN])
    unknown.prune(state.candidates.values())
    return Searched(
        prepared,
        prior,
        noise_models=noises.models,
        certain=noises.certain,
        nulls=state.sensors,
        screening=screening,
        refits=refits,
        evidences=evidences(),
        posterior=posterior(),
    )


def _effects_on_mean_and_noise(prepared: Prepared) -> tuple[dict[str, NamedEffect[Any]], dict[str, NoiseEffect]]:
    """Divide the effects into those on the mean and those on the noise."""
    effects, on_noise = prepared.effects, prepared.on_noise
    on_mean = {name: effect for name, effect in effects.items() if name not in on_noise}
    return on_mean, {name: cast(NoiseEffect, effects[name]) for name in effects if name in on_noise}


def _refit_late(state: SearchState, posterior: Callable[[], Posterior], progress: Progress) -> None:
    """Refit what screening believes in; if it is still ahead then, correct it by the least that the refits fell short.

    Screening is linear: where an effect gains hundreds of nats, the gain of another one beside it may be wrong by a
    hundred.
    """
    shortfalls: list[float] = []
    for k in range(MOST_REFITTED_LATE):
        progress("refitting what screening believes in", k, MOST_REFITTED_LATE)
        by_mean = posterior().by_mean
        settled = {(), ("unknown",)} | state.undetected | state.refitted
        names = max((key for key in by_mean if key not in settled), key=lambda key: by_mean[key], default=())
        if by_mean.get(names, 0.0) <= REFITTED_LATE or not names:
            return
        promised = state.log_evidence(names)
        state.reach(names)
        shortfalls.append(promised - state.log_evidence(names))
    state.optimism = max(min(shortfalls), 0.0)


def _refit_null(state: SearchState) -> None:
    """Refit the null from the best fits of one effect, whose gain may be due to a better mode of the null."""
    null = state.null
    single = [c for c in state.candidates.values() if len(c.names) == 1 and c.log_z > null.log_z]
    for candidate in sorted(single, key=lambda c: -c.log_z)[:NULL_TRIED_AGAIN]:
        start = candidate.found.z[: null.found.model.sensor.n_params]
        again = state.refits.weighed(null.found.model, start[None, :], candidate.law)
        if again.log_z > state.null.log_z + SAME_MODE:
            state.keep(again)


def _unknown_effects_of(state: SearchState, prepared: Prepared, after: Searched | None) -> Unknown:
    """Build the basis functions of unknown effects about the best null; those of an earlier search serve again."""
    named = [effect for name, effect in state.effects.items() if not out_of_vocabulary((name,))]
    if after is None:
        bases, covariates = _unknown_bases(state, prepared, named)
    else:
        bases, covariates = after.screening.unknown_bases, after.screening.covariates
    each = state.prior.unknown_complexity_penalty
    return Unknown(
        state.refits.scores,
        bases,
        covariates,
        state.noises,
        lambda degrees_of_freedom: state.complexity_penalty(degrees_of_freedom, each),
        n_choices=lambda names: math.log(math.comb(len(named), len(names)) / len(named)) if len(names) > 1 else 0.0,
    )


def _unknown_bases(
    state: SearchState, prepared: Prepared, named: Sequence[NamedEffect[Any]]
) -> tuple[Bank, tuple[Covariate, ...]]:
    null, recording = state.null, prepared.recording
    covariates, slope = prepared.apparatus.covariates(null.found, recording)
    level = null.found.predicted
    starts = np.flatnonzero(steps_within_scans(recording) == 0)
    bases = unknown_templates(covariates, level - level.min(), slope, starts)
    problem = Linearised.of(null.found, state.refits.law_of(null))
    return unlike_named(bases, state.templates.bank(null.found, named), problem), tuple(covariates)
