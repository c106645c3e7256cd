"""Search for the combinations of effects that explain a recording.

Hypotheses are combinations of effects on the mean, under every noise model and several SSF orders, with or without an
unknown effect. Templates screen them; a beam of the best is refitted jointly and nonlinearly, with Laplace evidences.
A second search follows with formulas, unless noise without memory explains the readings: effects out of vocabulary that
the apparatus proposes, short expressions of a table's columns and states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from scipy.special import logsumexp

from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.outlying import clustering_log_bayes_factors, outlier_probabilities
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.prior_odds import Names, PriorOdds
from probewise.diagnosis.search.refits import (
    ALIASED_NATS,
    EXTENDED_WITHIN,
    SAME_MODE,
    WITH_MEMORY,
    NoiseModels,
    Refits,
    WeighedFit,
    effects_out_of_vocabulary,
    expected_log_bayes_factor,
)
from probewise.diagnosis.search.searched import Evidences, MisfitTemplates, Posterior, Searched, posterior_of
from probewise.diagnosis.search.stepwise import (
    SearchState,
    eliminate_backward,
    fit_nulls,
    noise_sd_about_given_null,
    proposals_for,
    refit_at_other_orders,
    select_forward,
)
from probewise.diagnosis.templates import TemplateBank, TemplateCache, log_bayes_factors_by_label, log_mean_exp
from probewise.diagnosis.unknown_bases import bank_of_unknown_effects, bases_unlike_named, without_products_like
from probewise.effects import PROPOSAL, NamedEffect, NoiseEffect
from probewise.progress import Progress, silent

MAX_ORDER = 3
"""Gaussians of the SSF that are tried; one more where that is not far behind."""

_FEW_READINGS = 40  # usable readings below which one Gaussian is tried, and no free form
_NULL_TRIED_AGAIN = 2  # fits of one effect from which a given null is fitted once more
_REFITTED_LATE = 0.02  # probability by screening alone, from which on a combination is refitted
_MOST_REFITTED_LATE = 6  # such combinations
_WITH_UNKNOWN = 4  # refitted combinations that something unknown is weighed beside

Key = tuple[int, Names]


def prune_out_of_vocabulary(
    candidates: Mapping[Key, WeighedFit], noises: NoiseModels
) -> tuple[dict[Key, WeighedFit], set[Names]]:
    """Drop or penalise combinations out of vocabulary that compete with named ones of no more effects.

    A combination is dropped if it predicts so much the same as a named one that its expected lead is below three nats.
    If its observed lead is below three nats, its evidence is reduced to that of the best named one.

    Returns the candidates that stay, and the combinations that were dropped.
    """

    def average_log_evidence(candidate: WeighedFit) -> float:
        return noises.average_log_evidence(candidate.log_z_by_noise)

    leading = {c.names: c for c in sorted(candidates.values(), key=average_log_evidence) if c.names}
    stay, pruned = dict(candidates), set()
    for names, candidate in leading.items():
        if not effects_out_of_vocabulary(names):
            continue
        rivals = [c for c in leading.values() if not effects_out_of_vocabulary(c.names) and len(c.names) <= len(names)]
        if any(expected_log_bayes_factor(candidate, c) < ALIASED_NATS for c in rivals):
            pruned.add(names)
        ahead = average_log_evidence(candidate) - max((average_log_evidence(c) for c in rivals), default=-np.inf)
        if 0 < ahead < ALIASED_NATS:
            for key in [key for key in stay if key[1] == names]:
                stay[key] = stay[key].with_variant_factor_and_weights(stay[key].log_share - ahead, stay[key].weights)
    return {key: c for key, c in stay.items() if key[1] not in pruned}, pruned


@dataclass(eq=False)
class UnknownEffects:
    """Evidence of an unknown effect, by basis functions, added to candidates, under each of their leading noise models.

    `bases`: bank of the basis functions; `covariates`: covariates in which outlying readings may cluster; `log_z`: log
    evidence by (order, mean, noise); `shares`: share of each family of bases, beside the null with the largest evidence
    of an unknown effect.
    """

    state: SearchState
    bases: TemplateBank
    covariates: tuple[Covariate, ...]
    log_z: dict[tuple[int, Names, Names], float] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)

    def weigh_beside(self, candidates: Iterable[WeighedFit]) -> None:
        """Compute and store (`log_z`) the log evidence of each candidate with an unknown effect added."""
        best = -np.inf
        for candidate in candidates:
            for noise, evidence in candidate.leading_noises():
                scores = self.state.refits.log_bayes_factors_by_label(
                    candidate.found, evidence.likeliest_law, self.bases
                )
                by_family = {family: log_mean_exp(own) for family, own in scores.items()}
                if evidence.likeliest_law.share > 0:
                    far_out = outlier_probabilities(candidate.found.residuals, evidence.likeliest_law)
                    by_family |= clustering_log_bayes_factors(far_out, self.covariates)
                if not by_family:
                    continue
                value = evidence.log_z + log_mean_exp(np.array(list(by_family.values())))
                if not candidate.names:
                    each = self.state.prior.unknown_complexity_penalty
                    value -= self.state.complexity_penalty(candidate.ssf_degrees_of_freedom, each)
                self.log_z[candidate.n_gaussians, candidate.names, noise] = value
                if value > best and not candidate.names:
                    best = value
                    total = logsumexp(list(by_family.values()))
                    self.shares = {k: math.exp(v - total) for k, v in by_family.items()}

    def drop_superfluous(self, candidates: Collection[WeighedFit]) -> None:
        """Drop an unknown effect, alone or with one named effect, if one or two more named effects explain as much.

        An unknown effect added to the named ones must then be insignificant. A basis of many columns, such as one value
        per scan, can imitate named effects. Two names are chosen from many more combinations than one, so they must
        explain correspondingly more.
        """
        named = [c for c in candidates if not effects_out_of_vocabulary(c.names)]
        for known in dict.fromkeys(c.names for c in named if len(c.names) <= 1):
            rivals = [c for c in named if set(c.names) > set(known) and len(c.names) <= 2]
            if any(key[1] == known for key in self.log_z) and self._is_superfluous(known, rivals, candidates):
                self.log_z = {key: value for key, value in self.log_z.items() if key[1] != known}

    def _is_superfluous(self, known: Names, rivals: Collection[WeighedFit], candidates: Collection[WeighedFit]) -> bool:
        """Return whether one of the `rivals` makes an unknown effect added to `known` superfluous.

        The rival's evidence is at most three nats lower, and an unknown effect adds less than three to it.
        """
        most = max((self._log_evidence_with_unknown(c) for c in candidates if c.names == known), default=-np.inf)
        n_named = len(self.state.effects_in_vocabulary)

        def believed(rival: WeighedFit) -> float:
            alone = self._log_evidence_without_unknown(rival)
            n = len(rival.names)  # two names are chosen from many more combinations
            return alone - (math.log(math.comb(n_named, n) / n_named) if n - len(known) > 1 else 0.0)

        for candidate in sorted(rivals, key=believed, reverse=True):
            if believed(candidate) < most - ALIASED_NATS:
                return False
            if self._log_evidence_with_unknown(candidate) == -np.inf:
                self.weigh_beside([candidate])
            more = self._log_evidence_with_unknown(candidate) - self._log_evidence_without_unknown(candidate)
            if more < ALIASED_NATS:
                return True
        return False

    def _log_evidence_without_unknown(self, candidate: WeighedFit) -> float:
        return self.state.refits.noises.average_log_evidence(candidate.log_z_by_noise)

    def _log_evidence_with_unknown(self, candidate: WeighedFit) -> float:
        own = candidate.n_gaussians, candidate.names
        return self.state.refits.noises.average_log_evidence(
            {key[2]: value for key, value in self.log_z.items() if key[:2] == own}
        )


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

    `prepared`: the readings, the effects, and the null if one is given; `max_order`: largest number of Gaussians of the
    SSF if no null is given; one more is tried if this is not far behind. Default: three, or one for fewer than 40
    readings. `after`: an earlier search of the same recording with a given null, with fewer effects: its fits are not
    made again. Returns `Searched`: evidences and probabilities of all hypotheses, and the refits.
    """
    recording, effects = prepared.recording, prepared.effects
    if max_order is None:
        max_order = 1 if len(prepared.usable_rows) < _FEW_READINGS else MAX_ORDER
    prior = prior or prepared.apparatus.prior_odds(effects)
    on_mean = {name: effect for name, effect in effects.items() if name not in prepared.noise_effect_names}
    on_noise = {name: cast(NoiseEffect, effect) for name, effect in effects.items() if name not in on_mean}
    if after is None:
        models = NoiseModels(recording, on_noise, prior, noise_sd_about_given_null(prepared))
        refits = Refits(prepared.null, models, TemplateCache(prepared.usable_rows))
    else:
        refits = after.refits
    noises, own = refits.noises, prepared.apparatus.user_effect_names(on_mean)
    if prepared.null is not None and prepared.null.may_be_far_off:
        own = frozenset(on_mean)
    spent = prepared.apparatus.refit_budget_share_spent()

    def share_is_spent(share: float) -> bool:
        return prepared.apparatus.is_refit_budget_spent(spent + share * max(1.0 - spent, 0.0))

    state = SearchState(on_mean, prior, refits, own, progress, share_is_spent)
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
    unknown.weigh_beside(sorted(refitted, key=lambda c: -c.log_z)[:_WITH_UNKNOWN])
    unknown.drop_superfluous(state.candidates.values())
    return Searched(prepared, prior, state.sensors, misfit_templates, refits, evidences(), posterior())


def _refit_favoured_by_screening(state: SearchState, posterior: Callable[[], Posterior], progress: Progress) -> None:
    """Refit the combinations that are probable by screening alone, until none is or six were refitted.

    After six, all other screened evidences are reduced (`state.optimism`) by the least amount by which a refit fell
    short of its screened evidence. Screening is linear: where an effect gains hundreds of nats, the gain of another one
    beside it may be wrong by a hundred. About a given null, whose fits are comparable, such a combination is first
    screened again about its largest refitted part.
    """
    shortfalls: list[float] = []
    screened = set[WeighedFit]()
    while len(shortfalls) < _MOST_REFITTED_LATE:
        progress("refitting what screening believes in", len(shortfalls), _MOST_REFITTED_LATE)
        by_mean = posterior().marginal_over_noise
        settled = {(), ("unknown",)} | state.undetected | state.refitted_combinations
        names = max((key for key in by_mean if key not in settled), key=lambda key: by_mean[key], default=())
        if by_mean.get(names, 0.0) <= _REFITTED_LATE or not names:
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
    for candidate in sorted(single, key=lambda c: -c.log_z)[:_NULL_TRIED_AGAIN]:
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
        bases = without_products_like(bases, state.refits.templates.coarse_bank(null.found, formulas), problem)
    return UnknownEffects(state, bases, misfit_templates.covariates)


def _build_misfit_templates(state: SearchState, prepared: Prepared) -> MisfitTemplates:
    """Build the templates about the best null, with bases of the covariates of the readings."""
    null, recording, apparatus = state.null, prepared.recording, prepared.apparatus
    covariates, slope = apparatus.covariates_and_predicted_slope(null.found, recording)
    level = null.found.predicted
    scan = recording.plan.scan[recording.usable] if apparatus.rows_are_in_order else None
    multiplied = apparatus.multiplied_covariates(covariates)
    bases = bank_of_unknown_effects(covariates, level - level.min(), slope, scan, multiplied=multiplied)
    problem = Linearised.of(null.found, state.refits.likeliest_law(null))
    named = state.refits.templates.coarse_bank(null.found, state.effects_in_vocabulary)
    unlike = bases_unlike_named(bases, named, problem)
    return MisfitTemplates(state.refits.templates, null.found, unlike, tuple(covariates))


_LEFT_FROM = 0.1  # probability that more is left than noise without a memory, from which formulas are proposed
_MOST = 8  # formulas that are refitted
# Nats behind the best of what was refitted, within which screening must see a formula: alone, where an effect of
# hundreds of nats is seen wrongly by a dozen, and beside the best single effect or the leader, whose fits are near.
_WITHIN_ALONE = 12.0
_WITHIN_BESIDE = 3.0


def search_with_formulas(searched: Searched, *, progress: Progress = silent) -> Searched:
    """Return a second search that includes the formulas favoured by screening; the given one if there are none.

    The given search is also returned if noise without memory explains the readings, or the budget of refits is spent.
    Named effects can partly explain what one formula explains, and then predict other runs badly: a square law an
    exponential leak, a step and a sensitivity together a product. Noise with memory absorbs slow changes.
    """
    prepared = searched.prepared
    if not needs_more_than_memoryless_noise(searched) or prepared.apparatus.is_refit_budget_spent():
        return searched
    proposals = prepared.apparatus.proposed_formulas()
    if not proposals:
        return searched
    progress("weighing formulas")
    every = {**prepared.effects, **proposals}
    prior = prepared.apparatus.prior_odds(every)
    promises = _promise_by_formula(searched, proposals)
    own = {name: prior.log_prior_on_mean((name,)) - prior.log_prior_on_mean(()) for name in promises}
    odds = {name: value + own[name] for name, value in promises.items()}
    best = max(
        fit.log_z + searched.prior.log_prior_on_mean(names) for (_, names), fit in searched.evidences.fits.items()
    )
    ranked = sorted(odds, key=lambda name: -odds[name])[:_MOST]
    kept = {name: proposals[name] for name in ranked if odds[name] > best}
    if not kept:
        return searched
    more = replace(prepared, effects={**prepared.effects, **kept})
    again = search(more, prior=prior, after=searched, progress=progress)
    return searched if prepared.apparatus.is_refit_budget_spent() else again


def needs_more_than_memoryless_noise(searched: Searched) -> bool:
    """Return whether effects on the mean, or noise with memory, together have a probability above 0.1."""
    plain = (p for (mean, noise), p in searched.posterior.probabilities.items() if not (mean or WITH_MEMORY & {*noise}))
    return 1.0 - sum(plain) > _LEFT_FROM


def _promise_by_formula(searched: Searched, proposals: Mapping[str, NamedEffect[Any]]) -> dict[str, float]:
    """Return for each formula its largest screened log evidence beside the null, the best single effect or the leader.

    The leader is the most probable combination. The log prior of what the formula stands beside is included, that of
    the formula is not. The nats by which a formula may trail there are added.
    """
    usable, null = searched.prepared.usable_rows, searched.null
    singles = [fit for (_, names), fit in searched.evidences.fits.items() if len(names) == 1]
    fits = sorted(singles, key=lambda f: -f.log_z)[:1]
    leader = max(searched.evidences.fits.values(), key=lambda f: f.log_z + searched.prior.log_prior_on_mean(f.names))
    if len(leader.names) > 1:
        fits.append(leader)
    parents = [(null, _WITHIN_ALONE), *((fit, _WITHIN_BESIDE) for fit in fits)]
    memory, out = TemplateCache(usable), dict[str, float]()
    bank: TemplateBank = memory.coarse_bank(null.found, list(proposals.values()))
    for parent, within in parents:
        for _, evidence in parent.leading_noises():
            scores = log_bayes_factors_by_label(Linearised.of(parent.found, evidence.likeliest_law), bank)
            for name, own in scores.items():
                value = evidence.log_z + searched.prior.log_prior_on_mean(parent.names) + log_mean_exp(own) + within
                out[name] = max(value, out.get(name, value))
    return out
