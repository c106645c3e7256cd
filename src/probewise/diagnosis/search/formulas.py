"""A second search, with formulas, unless noise without memory explains the readings.

Formulas are effects out of vocabulary that the apparatus proposes: short expressions of a table's columns and states.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from probewise.diagnosis.evidence.bank import TemplateBank
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.screening import log_bayes_factors_by_label, log_mean_exp
from probewise.diagnosis.evidence.templates import TemplateCache
from probewise.diagnosis.search.noises import WITH_MEMORY
from probewise.diagnosis.search.search import search
from probewise.diagnosis.search.searched import Searched
from probewise.effects import NamedEffect
from probewise.progress import Progress, silent

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
