"""Forward beam selection: screen the effects that could be added to a fit, refit the best combinations of each size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.screening import log_bayes_factors_of_pairs, log_mean_exp
from probewise.diagnosis.names import Names
from probewise.diagnosis.search.constants import (
    ABSORBED,
    BEAM,
    EXTENDED_WITHIN,
    FAINT,
    FAR_FROM_NULL,
    LEADING_PLAINLY,
    MOST_OUT_OF_VOCABULARY,
    ORDERS_WITHIN,
    PAIRED,
    REFITTED_WITHIN,
    REPEATED_FROM,
    SHARES,
    SINGLES,
    STEERING,
)
from probewise.diagnosis.search.state import SearchState, competing_candidates
from probewise.diagnosis.search.weighed_fit import WeighedFit, effects_out_of_vocabulary
from probewise.effects import AGAIN, name_of_first_copy


@dataclass(frozen=True, eq=False)
class Proposal:
    """A possible refit: candidate `parent` with the effect `added`; `score` is its log evidence by templates."""

    score: float
    parent: WeighedFit
    added: str


def select_forward(state: SearchState, *, depth: int) -> None:
    """Refit the best combinations of each size up to `depth`, extended from the best of the size before.

    Fits with significant effects are stored in the state as candidates.
    """
    null = state.null
    state.progress("screening effects")
    if depth > 1:
        _screen_pairs(state, null)
    freedom = null.ssf_degrees_of_freedom
    within = {c: ORDERS_WITHIN if c.ssf_degrees_of_freedom <= freedom else STEERING for c in state.nulls}
    parents = [c for c in state.nulls if c.log_z > null.log_z - within[c]]
    for size in range(1, min(depth, len(state.effects)) + 1):
        asked = _proposals_to_refit(state, null, parents, size)
        state.share = SHARES[size - 1] if size <= len(SHARES) else 1.0
        refitted = []
        for k, proposal in enumerate(asked):
            state.progress(f"refitting effects, {size} at a time", k, len(asked))
            parent = state.candidates[proposal.parent.n_gaussians, ()] if proposal.parent is null else proposal.parent
            found = state.refit_with_effect(parent, proposal.added)
            refitted.append(found)
            if size == 1 and found is not None and state.null_is_given:
                state.refit_subset_from(found, proposal.added)
        if size == 2:
            refitted += _refit_leading_pairs(state)
        state.share = 1.0
        kept = list({c.names: c for c in refitted if c is not None}.values())
        if not kept:
            break
        parents = [
            c for c in kept if c.log_z > max(r.log_z for r in competing_candidates(c.names, kept)) - EXTENDED_WITHIN
        ]


def _proposals_to_refit(
    state: SearchState, null: WeighedFit, parents: Sequence[WeighedFit], size: int
) -> list[Proposal]:
    """Choose the combinations of `size` effects to refit, each as a candidate (parent) with one more effect."""
    proposals: dict[Names, Proposal] = {}
    for parent in parents:
        proposals = proposals_for(state, parent, proposals)
    if size == 1:
        alone = [proposals[names] for names in _single_effects_to_refit(state, null, proposals)]
        return [*alone[:1], *_proposals_under_simplest_noise(state, null), *alone[1:]]
    if size == 2:
        proposals = _with_larger_pair_scores(state, proposals)
    chosen = promising_combinations(state, proposals, width=BEAM, behind=STEERING)
    more = [*_leading_under_simplest_noise(state, proposals), *_pairs_of_repeatable_effects(state, null)]
    return [proposals[names] for names in dict.fromkeys([*chosen, *more]) if names in proposals]


def _screen_pairs(state: SearchState, null: WeighedFit) -> None:
    """Store in the state the log evidence of pairs of the best effects, by templates about a null."""
    for noise, evidence in null.leading_noises():
        singles = state.log_bayes_factors_by_effect(null, evidence.likeliest_law, null)
        alone = [name for name in singles if name_of_first_copy(name) is None]
        ranked = sorted(alone, key=lambda name: -float(singles[name].max()))[:PAIRED]
        singles = {name: singles[name] for name in ranked}
        templates = {name: state.templates.templates_of(null.found, state.effects[name]) for name in ranked}
        for pair, value in log_bayes_factors_of_pairs(
            Linearised.of(null.found, evidence.likeliest_law), templates, singles
        ).items():
            state.about_null[pair, noise] = evidence.log_z + value


def proposals_for(state: SearchState, parent: WeighedFit, proposals: Mapping[Names, Proposal]) -> dict[Names, Proposal]:
    """Screen every effect that a candidate lacks, by its templates about the null with the same number of Gaussians.

    Where the candidate is far from a given null, the templates are those about the candidate: a null that slides on
    behind an end stop says nothing of a drag before it. The log evidence of each resulting combination, by noise model,
    is stored in the state.

    Returns
    -------
    `proposals` with the new ones added, the best for each combination.
    """
    null = state.candidates[parent.n_gaussians, ()]
    about = parent if state.null_is_given and parent.log_z > null.log_z + FAR_FROM_NULL else null
    against = state.penalty_of_extending(parent)
    known = state.about_parts if parent.names else state.about_null
    out = dict(proposals)
    for noise, evidence in parent.leading_noises():
        for name, own in state.log_bayes_factors_by_effect(parent, evidence.likeliest_law, about).items():
            first = name_of_first_copy(name)
            if name in parent.names or (first is not None and first not in parent.names):
                continue
            names = tuple(sorted((*parent.names, name)))
            score = evidence.log_z + log_mean_exp(own) - against
            if names not in state.undetected:  # a refit has said more
                known[names, noise] = max(score, known.get((names, noise), score))
            if names not in out or score > out[names].score:
                out[names] = Proposal(score, parent, name)
    return out


def promising_combinations(
    state: SearchState, proposals: Mapping[Names, Proposal], *, width: int, behind: float
) -> list[Names]:
    """Choose the proposed combinations that are most probable by screening, at most `width` in the vocabulary.

    At most three more are out of vocabulary. Combinations more than `behind` nats behind the best refitted one that
    they compete with are left out.
    """
    odds = {names: proposal.score + state.prior.log_prior_on_mean(names) for names, proposal in proposals.items()}
    return _leading_and_not_far_behind(state, odds, width=width, behind=behind)


def _leading_and_not_far_behind(
    state: SearchState, odds: Mapping[Names, float], *, width: int, behind: float
) -> list[Names]:
    """Choose combinations by their log posterior `odds`, as `promising_combinations` does."""
    ranked = sorted(odds, key=lambda names: -odds[names])
    named, rest = (
        [n for n in ranked if not effects_out_of_vocabulary(n)],
        [n for n in ranked if effects_out_of_vocabulary(n)],
    )
    return [
        names
        for names in [*named[:width], *rest[:MOST_OUT_OF_VOCABULARY]]
        if odds[names]
        >= max(state.log_posterior(c) for c in competing_candidates(names, state.candidates.values())) - behind
    ]


def _single_effects_to_refit(state: SearchState, null: WeighedFit, proposals: Mapping[Names, Proposal]) -> list[Names]:
    """Choose the effects to refit alone: the leader, those not far behind, and those that screening cannot judge.

    Screening is linear: it cannot judge a user's own effect with a large, nonlinear change, nor an effect that the
    null absorbs nearly completely to first order, nor one of two copies of an effect. Each is a tuple of one name.
    """
    ranked = sorted(proposals, key=lambda names: -(proposals[names].score + state.prior.log_prior_on_mean(names)))
    faint, about = set[str](), Linearised.of(null.found, null.law)
    for bank in state.template_banks(null):
        left = bank.unabsorbed_shares(about)
        faint |= {name for name, of in bank.indices_by_label.items() if ABSORBED < left[of].max() < FAINT}
    # One of two waves alone explains little: the other is noise to it.
    twice = {name for name in state.effects if name + AGAIN in state.effects}
    always = state.tried_always | faint | twice
    chosen = promising_combinations(state, proposals, width=SINGLES, behind=REFITTED_WITHIN)
    return list(dict.fromkeys([*ranked[:1], *chosen, *(names for names in ranked if names[0] in always)]))


def _pairs_of_repeatable_effects(state: SearchState, null: WeighedFit) -> list[Names]:
    """Return the pairs (effect, its copy) of effects that may occur twice and, alone, gain two nats in simplest noise.

    While only one of two waves is fitted, the other looks like noise with memory, which may hide both.
    """
    plain = state.noises.certain
    pairs = [(first, name) for name in state.effects if (first := name_of_first_copy(name)) is not None]
    return [
        (first, again)
        for first, again in pairs
        if any(
            c.evidence[plain].log_z > null.evidence[plain].log_z + REPEATED_FROM
            for c in state.candidates_of_combination((first,))
        )
    ]


def _proposals_under_simplest_noise(state: SearchState, null: WeighedFit) -> list[Proposal]:
    """Propose the effects that lead about the given null, refitted under the simplest noise.

    Where noise with memory (a random walk, a correlation) leads, it absorbs a missing effect, and the effect may be
    undetectable about the null that was fitted under it. Otherwise, or if the refit predicts the same: no proposals.
    """
    plain = state.refits.null_under_simplest_noise(null)
    if plain is None:
        return []
    scores = state.log_bayes_factors_by_effect(plain, plain.law, plain)
    odds = {
        name: log_mean_exp(own) + state.prior.log_prior_on_mean((name,))
        for name, own in scores.items()
        if name_of_first_copy(name) is None
    }
    ranked = sorted(odds, key=lambda name: -odds[name])[:LEADING_PLAINLY]
    return [Proposal(odds[name], plain, name) for name in ranked if odds[name] > state.prior.log_prior_on_mean(())]


def _refit_leading_pairs(state: SearchState) -> list[WeighedFit]:
    """Refit the pairs that lead by screening about the null and extend no refitted effect; return their candidates.

    Of a difference of two columns, neither column alone need explain anything.
    """
    settled = state.refitted_combinations | state.undetected
    odds: dict[Names, float] = {
        names: value + state.prior.log_prior_on_mean(names)
        for names, value in _largest_scores_about_null(state).items()
        if len(names) == 2 and names not in settled
    }
    # All against what was best before: equal pairs are refitted, or none.
    for names in _leading_and_not_far_behind(state, odds, width=BEAM, behind=STEERING):
        state.refit_stepwise(names)
    return [c for names in odds for c in state.candidates_of_combination(names)]


def _leading_under_simplest_noise(state: SearchState, proposals: Mapping[Names, Proposal]) -> list[Names]:
    """Choose the proposed combinations that lead under the simplest noise, where noise with memory leads; else none.

    Beside a first effect, noise with memory absorbs the second one, and screening sees no gain in it.
    """
    best = max(state.candidates.values(), key=state.log_posterior)
    if not state.refits.likeliest_law(best).has_memory:
        return []
    plain = state.noises.certain
    odds = {
        names: max(known.get((names, plain), -np.inf) for known in (state.about_null, state.about_parts))
        + state.prior.log_prior_on_mean(names)
        for names in proposals
        if not effects_out_of_vocabulary(names)
    }
    return sorted(odds, key=lambda names: -odds[names])[:LEADING_PLAINLY]


def _with_larger_pair_scores(state: SearchState, proposals: Mapping[Names, Proposal]) -> dict[Names, Proposal]:
    """Replace each proposal's score by the log evidence of the pair about the null, where that is larger."""
    best = _largest_scores_about_null(state)
    return {
        names: replace(proposal, score=best[names]) if best.get(names, proposal.score) > proposal.score else proposal
        for names, proposal in proposals.items()
    }


def _largest_scores_about_null(state: SearchState) -> dict[Names, float]:
    """Return the largest log evidence of each combination by screening about a null, over the noise models."""
    best: dict[Names, float] = {}
    for (names, _), value in state.about_null.items():
        best[names] = max(value, best.get(names, value))
    return best
