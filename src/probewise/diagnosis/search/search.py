"""Search for the combinations of effects that explain a recording.

Hypotheses are combinations of effects on the mean, under every noise model and several SSF orders, with or without an
unknown effect. Templates screen them; a beam of the best is refitted jointly and nonlinearly, with Laplace evidences.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.templates import TemplateCache
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.residuals.bases import bank_of_unknown_effects, bases_unlike_named, without_products_like
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
from probewise.diagnosis.search.forward_selection import proposals_for, select_forward
from probewise.diagnosis.search.noises import NoiseModels
from probewise.diagnosis.search.nulls import fit_nulls, noise_sd_about_given_null
from probewise.diagnosis.search.orders import refit_at_other_orders
from probewise.diagnosis.search.pruning import prune_out_of_vocabulary
from probewise.diagnosis.search.refits import Refits
from probewise.diagnosis.search.searched import Evidences, MisfitTemplates, Posterior, Searched, posterior_of
from probewise.diagnosis.search.state import SearchState
from probewise.diagnosis.search.unknown import UnknownEffects
from probewise.diagnosis.search.weighed_fit import WeighedFit, effects_out_of_vocabulary
from probewise.effects import PROPOSAL, NamedEffect, NoiseEffect
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
    """Compute evidence and probability of combinations of effects, with and without an unknown effect.

    Parameters
    ----------
    prepared
        The readings, the effects, and the null if one is given.
    prior
        Prior odds; by default those of the apparatus.
    max_order
        Largest number of Gaussians of the SSF if no null is given; one more is tried if this is not far behind.
        Default: three, or one for fewer than 40 readings.
    depth
        Largest number of effects of a combination.
    after
        An earlier search of the same recording with a given null, with fewer effects: its fits are not made again.
    progress
        Called at every refit.

    Returns
    -------
    Searched
        Evidences and probabilities of all hypotheses, and the refits.
    """
    recording, effects = prepared.recording, prepared.effects
    if max_order is None:
        max_order = 1 if len(prepared.usable_rows) < FEW_READINGS else MAX_ORDER
    prior = prior or prepared.apparatus.prior_odds(effects)
    on_mean, on_noise = _effects_on_mean_and_noise(prepared)
    refits = (
        Refits(
            prepared.null,
            NoiseModels(recording, on_noise, prior, noise_sd_about_given_null(prepared)),
            TemplateCache(prepared.usable_rows),
        )
        if after is None
        else after.refits
    )
    noises, templates, own = refits.noises, refits.templates, prepared.apparatus.user_effect_names(on_mean)
    if prepared.null is not None and prepared.null.may_be_far_off:
        own = frozenset(on_mean)
    spent = prepared.apparatus.refit_budget_share_spent()

    def share_is_spent(share: float) -> bool:
        """Return whether this share is spent of the budget of refits that an earlier search left."""
        return prepared.apparatus.is_refit_budget_spent(spent + share * max(1.0 - spent, 0.0))

    state = SearchState(
        on_mean,
        prior,
        noises=noises,
        templates=templates,
        refits=refits,
        tried_always=own,
        progress=progress,
        share_is_spent=share_is_spent,
    )
    if after is None:
        fit_nulls(state, prepared, max_order=max_order)
    else:
        state.sensors |= after.nulls
        state.candidates |= {key: fit for key, fit in after.evidences.fits.items() if not fit.names}
    misfit_templates = (
        _build_misfit_templates(state, prepared)
        if after is None
        else replace(after.misfit_templates, about=state.null.found)
    )
    unknown = _build_unknown_effects(state, misfit_templates)

    def evidences() -> Evidences:
        return Evidences(state.candidates, state.screened_log_evidences(), unknown.log_z, unknown.shares)

    def posterior() -> Posterior:
        return posterior_of(evidences(), prior, certain=noises.certain, n_forms=len(state.sensors))

    select_forward(state, depth=depth)
    if prepared.null is not None:
        _refit_null_from_effects(state)
    eliminate_backward(state)
    # With a form of the SSF that the readings reject, an unknown effect would only stand in for the form.
    unknown.weigh_beside([c for c in state.nulls if c.log_z > state.null.log_z - EXTENDED_WITHIN])
    _refit_favoured_by_screening(state, posterior, progress)
    if prepared.null is None:
        refit_at_other_orders(state, posterior().marginal_over_noise)
    state.candidates, state.pruned = prune_out_of_vocabulary(state.candidates, noises)
    progress("weighing what has no name")
    refitted = [c for c in state.candidates.values() if c.names]
    unknown.weigh_beside(sorted(refitted, key=lambda c: -c.log_z)[:WITH_UNKNOWN])
    unknown.drop_superfluous(state.candidates.values())
    return Searched(
        prepared,
        prior,
        noise_models=noises.models,
        certain=noises.certain,
        nulls=state.sensors,
        misfit_templates=misfit_templates,
        refits=refits,
        evidences=evidences(),
        posterior=posterior(),
    )


def _effects_on_mean_and_noise(prepared: Prepared) -> tuple[dict[str, NamedEffect[Any]], dict[str, NoiseEffect]]:
    effects, on_noise = prepared.effects, prepared.noise_effect_names
    on_mean = {name: effect for name, effect in effects.items() if name not in on_noise}
    return on_mean, {name: cast(NoiseEffect, effects[name]) for name in effects if name in on_noise}


def _refit_favoured_by_screening(state: SearchState, posterior: Callable[[], Posterior], progress: Progress) -> None:
    """Refit the combinations that are probable by screening alone, until none is or six were refitted.

    After six, all other screened evidences are reduced (`state.optimism`) by the least amount by which a refit fell
    short of its screened evidence. Screening is linear: where an effect gains hundreds of nats, the gain of another one
    beside it may be wrong by a hundred. About a given null, whose fits are comparable, such a combination is first
    screened again about its largest refitted part.
    """
    shortfalls: list[float] = []
    screened = set[WeighedFit]()
    while len(shortfalls) < MOST_REFITTED_LATE:
        progress("refitting what screening believes in", len(shortfalls), MOST_REFITTED_LATE)
        by_mean = posterior().marginal_over_noise
        settled = {(), ("unknown",)} | state.undetected | state.refitted_combinations
        names = max((key for key in by_mean if key not in settled), key=lambda key: by_mean[key], default=())
        if by_mean.get(names, 0.0) <= REFITTED_LATE or not names:
            return
        part = state.largest_refitted_part(names)
        if state.null_is_given and part.names and part not in screened:
            screened.add(part)
            proposals_for(state, part, {})
            continue
        promised = state.log_evidence(names)
        state.refit_stepwise(names)
        shortfalls.append(promised - state.log_evidence(names))
    state.optimism = max(min(shortfalls), 0.0)


def _refit_null_from_effects(state: SearchState) -> None:
    """Refit the null from the best fits with one effect, whose gain may be due to a better mode of the null.

    A better fit replaces the null in the state.
    """
    null = state.null
    single = [c for c in state.candidates.values() if len(c.names) == 1 and c.log_z > null.log_z]
    for candidate in sorted(single, key=lambda c: -c.log_z)[:NULL_TRIED_AGAIN]:
        start = candidate.found.z[: null.found.model.sensor.n_params]
        again = state.refits.fit_and_weigh(null.found.model, start[None, :], candidate.law)
        if again.log_z > state.null.log_z + SAME_MODE:
            state.store_candidate(again)


def _build_unknown_effects(state: SearchState, misfit_templates: MisfitTemplates) -> UnknownEffects:
    """Build the evidence of unknown effects, without the products of columns that are among the state's formulas.

    As a formula and as a basis a product would be the same hypothesis twice, and the less specific one, the basis,
    might lead. The test of the residuals keeps all bases, since the formulas were chosen by these readings.
    """
    null, bases = state.null, misfit_templates.unknown_bases
    formulas = [effect for name, effect in state.effects.items() if name.startswith(PROPOSAL)]
    if formulas:
        problem = Linearised.of(null.found, state.refits.likeliest_law(null))
        bases = without_products_like(bases, state.templates.coarse_bank(null.found, formulas), problem)
    n_named = len(_effects_in_vocabulary(state))
    each = state.prior.unknown_complexity_penalty
    return UnknownEffects(
        state.refits.log_bayes_factors_by_label,
        bases,
        misfit_templates.covariates,
        state.noises,
        lambda degrees_of_freedom: state.complexity_penalty(degrees_of_freedom, each),
        log_n_choices=lambda names: math.log(math.comb(n_named, len(names)) / n_named) if len(names) > 1 else 0.0,
    )


def _effects_in_vocabulary(state: SearchState) -> list[NamedEffect[Any]]:
    return [effect for name, effect in state.effects.items() if not effects_out_of_vocabulary((name,))]


def _build_misfit_templates(state: SearchState, prepared: Prepared) -> MisfitTemplates:
    """Build the templates about the best null, with bases of the covariates of the readings."""
    null, recording, apparatus = state.null, prepared.recording, prepared.apparatus
    covariates, slope = apparatus.covariates_and_predicted_slope(null.found, recording)
    level = null.found.predicted
    scan = recording.plan.scan[recording.usable] if apparatus.rows_are_in_order else None
    multiplied = apparatus.multiplied_covariates(covariates)
    bases = bank_of_unknown_effects(covariates, level - level.min(), slope, scan, multiplied=multiplied)
    problem = Linearised.of(null.found, state.refits.likeliest_law(null))
    named = state.templates.coarse_bank(null.found, _effects_in_vocabulary(state))
    unlike = bases_unlike_named(bases, named, problem)
    return MisfitTemplates(state.templates, null.found, unlike, tuple(covariates))
