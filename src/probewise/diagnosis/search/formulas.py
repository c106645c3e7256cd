"""Search again with formulas, unless noise without memory explains the readings: a name may replace a formula."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from probewise.diagnosis.evidence.bank import Bank
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.screening import log_mean, score_effects
from probewise.diagnosis.evidence.templates import TemplateMemory
from probewise.diagnosis.search.noises import WITH_MEMORY
from probewise.diagnosis.search.search import search
from probewise.diagnosis.search.searched import Searched
from probewise.effects import NamedEffect
from probewise.progress import Progress, silent

_LEFT_FROM = 0.1  # probability that more is left than noise without a memory, from which formulas are proposed
_MOST = 8  # formulas that are refitted
_WITHIN = 12.0  # nats behind the best of what was refitted, within which screening must see a formula


def with_proposals(searched: Searched, *, progress: Progress = silent) -> Searched:
    """Search again with the formulas that screening favours; return the search unchanged if there are none.

    Named effects can partly explain what one formula explains, and then predict other runs badly: a square law an
    exponential leak, a step and a sensitivity together a product. Noise with memory absorbs slow changes.
    """
    prepared = searched.prepared
    if not may_be_incomplete(searched) or prepared.apparatus.refit_budget_is_spent():
        return searched
    proposals = prepared.apparatus.proposals()
    if not proposals:
        return searched
    progress("weighing formulas")
    every = {**prepared.effects, **proposals}
    prior = prepared.apparatus.prior_odds(every)
    score = _log_evidences(searched, proposals)
    odds = {name: value + prior.log_mean((name,)) - prior.log_mean(()) for name, value in score.items()}
    best = max(fit.log_z + searched.prior.log_mean(names) for (_, names), fit in searched.evidences.fits.items())
    ranked = sorted(odds, key=lambda name: -odds[name])[:_MOST]
    kept = {name: proposals[name] for name in ranked if odds[name] > best - _WITHIN}
    if not kept:
        return searched
    more = replace(prepared, effects={**prepared.effects, **kept})
    again = search(more, prior=prior, after=searched, progress=progress)
    return searched if prepared.apparatus.refit_budget_is_spent() else again


def may_be_incomplete(searched: Searched) -> bool:
    """Return whether effects on the mean or noise with memory have together a probability above 0.1."""
    plain = (p for (mean, noise), p in searched.posterior.probabilities.items() if not (mean or WITH_MEMORY & {*noise}))
    return 1.0 - sum(plain) > _LEFT_FROM


def _log_evidences(searched: Searched, proposals: Mapping[str, NamedEffect[Any]]) -> dict[str, float]:
    """Return the largest log evidence of each formula with its prior, beside the null or the best single name."""
    usable, null = searched.prepared.usable, searched.null
    singles = [fit for (_, names), fit in searched.evidences.fits.items() if len(names) == 1]
    parents = [null, *sorted(singles, key=lambda fit: -fit.log_z)[:1]]
    memory, out = TemplateMemory(usable), dict[str, float]()
    bank: Bank = memory.bank(null.found, list(proposals.values()))
    for parent in parents:
        for _, evidence in parent.steering():
            scores = score_effects(Linearised.of(parent.found, evidence.law), bank)
            for name, own in scores.items():
                value = evidence.log_z + searched.prior.log_mean(parent.names) + log_mean(own)
                out[name] = max(value, out.get(name, value))
    return out
