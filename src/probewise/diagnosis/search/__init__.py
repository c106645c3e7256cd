"""Search for the combinations of effects that explain a recording.

Hypotheses are combinations of effects on the mean, under every noise model and several SSF orders, with or without an
unknown effect. Templates screen them; a beam of the best is refitted jointly and nonlinearly, with Laplace evidences.
A second search follows with formulas, unless noise without memory explains the readings: effects out of vocabulary that
the apparatus proposes, short expressions of a table's columns and states.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, cast

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.diagnosis.apparatus import ENOUGH_NATS, PriorOdds
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Model, Null, fit_each_start
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.noise import MAD_OF_NORMAL, NoiseLaw, white_noise_of_recording
from probewise.diagnosis.outlying import clustering_log_bayes_factors, outlier_probabilities
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.search.hypotheses import (
    EXTENDED_WITHIN,
    FAR_BEHIND,
    SAME_MODE,
    WITH_MEMORY,
    EffectNames,
    Evidences,
    HypothesisProbabilities,
    MisfitTemplates,
    NoiseModels,
    Refits,
    Searched,
    WeighedFit,
    effects_out_of_vocabulary,
    expected_log_bayes_factor,
    explains_hardly_anything,
    hypothesis_probabilities,
    require_converged_fit,
)
from probewise.diagnosis.sensors import (
    default_sensor,
    starts_of_one_gaussian,
    starts_with_more_gaussians,
    with_free_form,
)
from probewise.diagnosis.templates import TemplateBank, TemplateCache, log_bayes_factors_of_pairs, log_mean_exp
from probewise.diagnosis.unknown_bases import bank_of_unknown_effects, bases_unlike_named, without_products_like
from probewise.diagnosis.words import UNKNOWN, Names
from probewise.effects import AGAIN, PROPOSAL, Effect, Extent, NoiseEffect, is_out_of_vocabulary, name_of_first_copy
from probewise.effects.noise import lattice_step, noise_sd, sd_of_rounding
from probewise.errors import NotConvergedError
from probewise.progress import Progress, silent

# Nats behind the best so far: screening errs by as much near a fit that one effect distorts. Within three nats,
# screening misses single effects.
_REFITTED_WITHIN = 6.0
# Share of the largest gain that an effect must promise to be refitted where it is 40 nats behind: refits of a pendulum
# gain up to 1.6 times what screening sees, and what was left out is screened again beside the leader.
_OUTDONE = 0.5
_FEW = 6  # hypotheses that are refitted at once: effects alone, at other SSF orders, or late; a bound on cost
_HIDDEN = 3  # effects that noise with memory may hide, refitted beside these; a bound on cost
_BEAM = 8  # combinations that are refitted at each size above one, and formulas
# Shares of a limited budget of refits that single effects, and then pairs, may use up: without a part kept for them,
# pairs would never be refitted.
_SHARES = (0.6, 0.9)
# Nats behind the best: an SSF order so far back is not searched. An effect may look like another Gaussian, and be
# explained better by its name at fewer of them.
_ORDERS_WITHIN = 100.0
# Nats above a given null: what could be added to a candidate further above is screened by changes of its own
# predictions. Below, those of the null are near enough, and are at hand.
_FAR_FROM_NULL = 100.0
_REPEATED_FROM = 2.0  # nats of an effect alone, from which it is tried twice
# Effects that pairs are screened of, the best alone. A difference of two columns may explain what neither does, so many
# are paired: of twelve it was in none of 6 recordings with seven other columns, of sixty in all.
_PAIRED = 60
_MOST_OUT_OF_VOCABULARY = 3  # combinations of one size that are refitted with something out of vocabulary
# Share of a template that a null leaves, below which a large effect may show in another way than to first order. The
# width of the SSF takes up all but a tenth of a scale of positions, yet not of one a third off.
_FAINT = 0.35
_ABSORBED = 0.01  # of a trace; of what a null takes up all but so little no refit shows more
# Leading combinations, of which each effect is left out in turn: one that was found first may stand at a wrong place
# beside another that it makes superfluous, and the right pair may be built from the part that looked worse.
_ELIMINATED = 3
_SWAPPED = 2  # combinations that lead beside what is left, with what was left out or another


@dataclass(eq=False)
class SearchState:
    """The mutable state of a search. A candidate is a refitted combination of effects with one number of Gaussians.

    `effects`: effects on the mean, by name; `tried_always`: effects that are always refitted alone, whatever their
    score by screening; `progress`: called at every refit; `share_is_spent`: function of a share: whether that share of
    this search's budget of refits is spent; `share`: share of the budget that may be spent by now. `about_null`,
    `about_parts`: log evidence by screening about a null, and about a fit with all but one of the effects;
    `undetected`: combinations in which a refit has shown one effect to be insignificant; `pruned`: combinations out of
    vocabulary that are aliased with named ones; `optimism`: nats by which screening promises too much at least.
    """

    effects: Mapping[str, Effect]
    prior: PriorOdds
    refits: Refits
    tried_always: frozenset[str] = frozenset()
    progress: Progress = silent
    share_is_spent: Callable[[float], bool] = lambda share: False
    share: float = 1.0
    candidates: dict[tuple[int, Names], WeighedFit] = field(default_factory=dict)
    about_null: dict[EffectNames, float] = field(default_factory=dict)
    about_parts: dict[EffectNames, float] = field(default_factory=dict)
    undetected: set[Names] = field(default_factory=set)
    pruned: set[Names] = field(default_factory=set)
    optimism: float = 0.0

    @property
    def nulls(self) -> list[WeighedFit]:
        """The candidates without effects, one per number of Gaussians."""
        return self.candidates_of_combination(())

    @property
    def null(self) -> WeighedFit:
        """The candidate without effects whose number of Gaussians has the largest evidence."""
        return max(self.nulls, key=lambda c: c.log_z)

    @property
    def effects_in_vocabulary(self) -> list[Effect]:
        """The effects that are in the vocabulary."""
        return [effect for name, effect in self.effects.items() if not is_out_of_vocabulary(name)]

    @property
    def refitted_combinations(self) -> set[Names]:
        """The combinations that were refitted, with any number of Gaussians."""
        return {names for _, names in self.candidates}

    def candidates_of_combination(self, names: Names) -> list[WeighedFit]:
        """List the candidates of one combination, one per number of Gaussians."""
        return [c for (_, key), c in self.candidates.items() if key == names]

    def best_candidate(self, names: Names) -> WeighedFit | None:
        """Return the candidate of one combination with the largest evidence, if any."""
        return max(self.candidates_of_combination(names), key=lambda c: c.log_z, default=None)

    def log_posterior(self, candidate: WeighedFit) -> float:
        """Return a candidate's unnormalised log posterior: its log evidence plus the log prior of its effects."""
        return candidate.log_z + self.prior.log_prior_on_mean(candidate.names)

    def template_banks(self, about: WeighedFit) -> list[TemplateBank]:
        """Return the template banks of what a candidate lacks, about it: in the vocabulary, and out of it if any."""
        lacking = [effect for name, effect in self.effects.items() if name not in about.names]
        parts = ([e for e in lacking if is_out_of_vocabulary(e.name) == rare] for rare in (False, True))
        return [self.refits.templates.coarse_bank(about.found, effects) for effects in parts if effects]

    def log_bayes_factors_by_effect(self, of: WeighedFit, law: NoiseLaw, about: WeighedFit) -> dict[str, FloatArray]:
        """Return, by effect, the log Bayes factors of its templates about a candidate or its null, (n_templates,)."""
        out: dict[str, FloatArray] = {}
        for bank in self.template_banks(about):
            out |= bank.log_bayes_factors_by_label(of.found, law)
        return out

    def complexity_penalty(self, degrees_of_freedom: int, each: float | None = None) -> float:
        """Return the penalty in nats of effects at an SSF with fewer degrees of freedom than the null alone needs.

        `each` is the penalty per degree of freedom; by default that of the prior. It is averaged over the orders of the
        null, so that a small chance lead of one order has little effect.
        """
        log_z = np.array([c.log_z for c in self.nulls])
        spared = np.array([max(c.ssf_degrees_of_freedom - degrees_of_freedom, 0) for c in self.nulls])
        each = self.prior.complexity_penalty if each is None else each
        return float(logsumexp(log_z) - logsumexp(log_z - each * spared))

    def penalty_of_extending(self, parent: WeighedFit) -> float:
        """Return the complexity penalty of the first effect that is added to a candidate, in nats; 0 if it has some."""
        return 0.0 if parent.names else self.complexity_penalty(parent.ssf_degrees_of_freedom)

    def store_candidate(self, candidate: WeighedFit) -> WeighedFit:
        """Store a candidate in place of an earlier one of the same effects and number of Gaussians; return it."""
        self.candidates[candidate.n_gaussians, candidate.names] = candidate
        return candidate

    def refit_with_effect(self, parent: WeighedFit, added: str) -> WeighedFit | None:
        """Refit a candidate with one more effect; store the fit if the effect is significant.

        Otherwise the combination is recorded as undetected. Once the share of the budget is spent, only refits that an
        earlier search has made count.

        Returns the best candidate of the resulting combination, possibly an earlier one; None if there is none.
        """
        against, names = self.penalty_of_extending(parent), tuple(sorted((*parent.names, added)))
        is_made = self.refits.earlier_refit(parent, self.effects[added], against) is not None
        if not is_made and self.share_is_spent(self.share):
            return self.best_candidate(names)
        try:
            candidate, scores = self.refits.refit_with_effect(parent, self.effects[added], against)
        except NotConvergedError:  # its model diverges from every start
            self.about_parts |= {(names, noise): e.log_z - against for noise, e in parent.evidence.items()}
            self.undetected.add(names)
            return None
        known = self.candidates.get((candidate.n_gaussians, candidate.names))
        if candidate.is_significantly_better(parent):
            return self.store_candidate(candidate if known is None or candidate.log_z > known.log_z else known)
        if known is None:
            # Laplace fails where an effect is too small to be significant and the closed form does not; but the
            # closed form takes amplitudes of a sign that the effect cannot have, and the refit has shown that.
            for noise, evidence in parent.evidence.items():
                self.about_parts[names, noise] = evidence.log_z + min(scores.get(noise, 0.0), 0.0) - against
            self.undetected.add(names)
        return known

    def largest_refitted_part(self, names: Names) -> WeighedFit:
        """Return the candidate with most of some effects and no others, the most probable one."""
        parts = [c for (_, part), c in self.candidates.items() if set(part) < set(names)]
        return max(parts, key=lambda c: (len(c.names), c.log_z))

    def refit_stepwise(self, names: Names) -> None:
        """Refit a combination by adding its effects one by one to its largest refitted subset.

        An effect that is insignificant by itself is tried together with the next one: two may explain what neither
        does, such as the difference of two columns. If that fails, the combination is recorded as undetected.
        """
        held = self.largest_refitted_part(names)
        missing = [n for n in names if n not in held.names]
        while missing:
            added = missing.pop(0)
            extended = self.refit_with_effect(held, added)
            if extended is None and missing:
                extended = self._refit_with_both(held, added, missing.pop(0))
            if extended is None:
                self.undetected.add(names)
                for noise, evidence in held.evidence.items():
                    known = self.about_parts.get((names, noise), np.inf)
                    self.about_parts[names, noise] = min(known, evidence.log_z)
                return
            held = extended

    def _refit_with_both(self, held: WeighedFit, first: str, second: str) -> WeighedFit | None:
        """Refit a candidate with two more effects, and store the fit if it is significantly better; else None."""
        if self.share_is_spent(self.share):
            return None
        try:
            between, _ = self.refits.refit_with_effect(held, self.effects[first], self.penalty_of_extending(held))
            both, _ = self.refits.refit_with_effect(between, self.effects[second])
        except NotConvergedError:
            return None
        self.undetected.discard(both.names)
        return self.store_candidate(both) if both.is_significantly_better(between) else None

    def screened_log_evidences(self) -> dict[EffectNames, float]:
        """Return the log evidence of (mean, noise) by screening, of what was not refitted and contains nothing dropped.

        Screening about a fit with part of the effects is more accurate than about the null, which is corrected for
        refits of parts. `optimism` (nats) is subtracted, unless a refit has shown that an effect is insignificant.
        """
        refitted, pruned = self.refitted_combinations, [{*names} for names in self.pruned]
        out = {}
        for (names, noise), value in self.about_null.items():
            gains = [
                max(c.evidence[noise].log_z for c in self.candidates_of_combination(part))
                - self.about_null.get((part, noise), np.inf)
                for part in itertools.combinations(names, len(names) - 1)
                if part in refitted
            ]
            out[names, noise] = value + max(gains, key=abs, default=0.0) if np.all(np.isfinite(gains)) else value
        out |= self.about_parts
        return {
            key: value if key[0] in self.undetected else value - self.optimism
            for key, value in out.items()
            if key[0] not in refitted and not any(dropped <= {*key[0]} for dropped in pruned)
        }

    def log_evidence(self, names: Names) -> float:
        """Return a combination's largest log evidence, of refits or else by screening; minus infinity of none."""
        if (refitted := self.best_candidate(names)) is not None:
            return refitted.log_z
        screened = (value for (own, _), value in self.screened_log_evidences().items() if own == names)
        return max(screened, default=-np.inf)


def competitors(names: Names, among: Iterable[WeighedFit]) -> list[WeighedFit]:
    """List the candidates that compete with a combination: those in the vocabulary, or all if it is out of it."""
    return [c for c in among if effects_out_of_vocabulary(names) or not effects_out_of_vocabulary(c.names)]


def fit_nulls(state: SearchState, prepared: Prepared, *, max_order: int) -> None:
    """Fit the given null; if there is none, each form of the SSF: one Gaussian, the free form, more Gaussians.

    At most `max_order` + 1 Gaussians, and no more once a fit is three nats behind the best; one Gaussian alone if
    `max_order` is 1. The fits are stored in the state. Then pairs of noise effects are added to the noise models, if
    single ones are significant.
    """
    refits, null, noises = state.refits, prepared.null, state.refits.noises
    recording = prepared.recording
    n_forms = 1 if null is not None or max_order == 1 else max_order + 2

    def fit_and_keep(sensor: Null, starts: FloatArray, law: NoiseLaw) -> WeighedFit:
        state.progress("fitting the model without effects", len(state.nulls), n_forms)
        return state.store_candidate(refits.fit_and_weigh(Model(sensor, (), recording.plan), starts, law))

    law = white_noise_of_recording(recording, least=noises.least_sd)
    if null is not None:
        fit_and_keep(null, null.starts, law)
    else:
        extent = Extent.of(recording)
        one = default_sensor(extent, 1)
        last = fit_and_keep(one, starts_of_one_gaussian(one), law)
        if max_order > 1:
            free, z = with_free_form(one), last.found.z
            start = np.pad(z, (0, free.n_params - len(z)))[None, :]  # the weights begin at 0
            best = max(fit_and_keep(free, start, refits.likeliest_law(last)).log_z, last.log_z)
            for n in range(2, max_order + 2):
                # One more than the best is always a rival; beyond one that is far behind nothing is to be found.
                if n > 2 and last.log_z < best - ENOUGH_NATS:
                    break
                wanted = default_sensor(extent, n)
                starts = starts_with_more_gaussians(last.found.model.sensor, last.found.z, wanted)
                last = fit_and_keep(wanted, starts, refits.likeliest_law(last))
                best = max(best, last.log_z)
    if noises.add_significant_pairs(state.null.found, state.null.evidence):
        state.progress("weighing pairs of noises")
        for candidate in state.nulls:
            state.store_candidate(replace(candidate, evidence=noises.evidence_by_noise(candidate.found)))


def noise_sd_about_given_null(prepared: Prepared) -> float:
    """Estimate the noise sd, rounding included, from residuals about the given null, by their median.

    Of readings with declared sds, it is that of the most exact. A null with one start is taken there: it is an earlier
    fit, or a calibration. Infinite without a given null, and where the readings lie on no lattice, since it serves to
    judge rounding alone.
    """
    null, recording, rows = prepared.null, prepared.recording, prepared.usable_rows
    readings = recording.readings[rows]
    step = lattice_step(readings)
    if null is None or not step:
        return math.inf
    model, z = Model(null, (), recording.plan), null.starts[0]
    if len(null.starts) > 1:
        fits = fit_each_start(model, recording, list(null.starts), white_noise_of_recording(recording))
        z = min(fits, key=lambda found: found.objective).z
    with np.errstate(all="ignore"):  # of a start from which the model runs away
        residuals = np.abs(readings - model.predict(z[None, :])[0, rows])
    relative_sd = recording.relative_sd[rows]
    exact = relative_sd <= np.quantile(relative_sd, 0.25)  # in the most exact ones rounding shows first
    median = float(np.median(residuals[exact])) / MAD_OF_NORMAL
    free = max(len(rows) - model.n_params, 1)
    # Readings that are all as predicted still have the sd of rounding.
    return max(median, sd_of_rounding(step)) * math.sqrt(len(rows) / free) if math.isfinite(median) else math.inf


class Proposal(NamedTuple):
    """A possible refit: candidate `parent` with the effect `added`; `score` is its log evidence by templates."""

    score: float
    parent: WeighedFit
    added: str


def select_forward(state: SearchState, *, depth: int) -> None:
    """Refit and store the best combinations of each size up to `depth`, extended from the best of the size before."""
    null = state.null
    state.progress("screening effects")
    if depth > 1:
        _screen_pairs(state, null)
    freedom = null.ssf_degrees_of_freedom
    within = {c: _ORDERS_WITHIN if c.ssf_degrees_of_freedom <= freedom else ENOUGH_NATS for c in state.nulls}
    parents = [c for c in state.nulls if c.log_z > null.log_z - within[c]]
    for size in range(1, min(depth, len(state.effects)) + 1):
        asked = _proposals_to_try(state, null, parents, size)
        state.share = _SHARES[size - 1] if size <= len(_SHARES) else 1.0
        refitted = []
        for k, proposal in enumerate(asked):
            state.progress(f"refitting effects, {size} at a time", k, len(asked))
            if size == 1 and _is_outdone(state, null, proposal):
                continue
            refitted.append(state.refit_with_effect(proposal.parent, proposal.added))
        if size == 2:  # and what leads about the null though neither effect alone does, as a difference of two columns
            settled, best = state.refitted_combinations | state.undetected, _largest_scores_about_null(state)
            pairs: dict[Names, float] = {k: value for k, value in best.items() if len(k) == 2 and k not in settled}
            # All against what was best before: equal pairs are refitted, or none.
            for names in promising_combinations(state, pairs, width=_BEAM, behind=ENOUGH_NATS):
                state.refit_stepwise(names)
            refitted += [c for names in pairs for c in state.candidates_of_combination(names)]
        state.share = 1.0
        kept = list({c.names: c for c in refitted if c is not None}.values())
        if not kept:
            break
        parents = [c for c in kept if c.log_z > max(r.log_z for r in competitors(c.names, kept)) - EXTENDED_WITHIN]


def _proposals_to_try(state: SearchState, null: WeighedFit, parents: Sequence[WeighedFit], size: int) -> list[Proposal]:
    """Choose the combinations of `size` effects to refit, each as a candidate (parent) with one more effect.

    Pairs of an effect that may occur twice are tried where it alone gains two nats in the simplest noise: while only
    one of two waves is fitted, the other looks like noise with memory, which may hide both.
    """
    proposals: dict[Names, Proposal] = {}
    for parent in parents:
        proposals = proposals_for(state, parent, proposals)
    if size == 1:
        alone = _singles_to_refit(state, null, proposals)
        return [*alone, *_proposals_under_simplest_noise(state, null)]
    best = _largest_scores_about_null(state) if size == 2 else {}
    scores = {names: max(own.score, best.get(names, own.score)) for names, own in proposals.items()}
    chosen, plain = promising_combinations(state, scores, width=_BEAM, behind=ENOUGH_NATS), state.refits.noises.certain
    least = null.evidence[plain].log_z + _REPEATED_FROM
    twice = [
        (first, name)
        for name in state.effects
        if (first := name_of_first_copy(name)) is not None
        and any(c.evidence[plain].log_z > least for c in state.candidates_of_combination((first,)))
    ]
    return [proposals[names] for names in dict.fromkeys([*chosen, *twice]) if names in proposals]


def _screen_pairs(state: SearchState, null: WeighedFit) -> None:
    """Store in the state the log evidence of pairs of the best effects, by templates about a null."""
    banks = state.template_banks(null)
    templates = {name: [bank[k] for k in at] for bank in banks for name, at in bank.indices_by_label.items()}
    for noise, evidence in null.leading_noises():
        singles = state.log_bayes_factors_by_effect(null, evidence.likeliest_law, null)
        alone = [name for name in singles if name_of_first_copy(name) is None]
        ranked = sorted(alone, key=lambda name: -float(singles[name].max()))[:_PAIRED]
        about = Linearised.of(null.found, evidence.likeliest_law)
        pairs = log_bayes_factors_of_pairs(about, templates, {name: singles[name] for name in ranked})
        state.about_null |= {(pair, noise): evidence.log_z + value for pair, value in pairs.items()}


def proposals_for(state: SearchState, parent: WeighedFit, proposals: Mapping[Names, Proposal]) -> dict[Names, Proposal]:
    """Screen every effect that a candidate lacks, by its templates about the null with the same number of Gaussians.

    Where the candidate is far from a given null, whose fits are comparable, the templates are those about the
    candidate: a null that slides on behind an end stop says nothing of a drag before it. The log evidence of each
    resulting combination, by noise model, is stored in the state.

    Returns `proposals` with the new ones added, the best for each combination.
    """
    null = state.candidates[parent.n_gaussians, ()]
    is_far = state.refits.given_null is not None and parent.log_z > null.log_z + _FAR_FROM_NULL
    against = state.penalty_of_extending(parent)
    known = state.about_parts if parent.names else state.about_null
    out = dict(proposals)
    for noise, evidence in parent.leading_noises():
        scores = state.log_bayes_factors_by_effect(parent, evidence.likeliest_law, parent if is_far else null)
        for name, own in scores.items():
            if name in parent.names or name_of_first_copy(name) not in (None, *parent.names):
                continue
            names = tuple(sorted((*parent.names, name)))
            score = evidence.log_z + log_mean_exp(own) - against
            if names not in state.undetected:  # a refit has said more
                known[names, noise] = max(score, known.get((names, noise), score))
            if names not in out or score > out[names].score:
                out[names] = Proposal(score, parent, name)
    return out


def promising_combinations(
    state: SearchState, scores: Mapping[Names, float], *, width: int, behind: float
) -> list[Names]:
    """Choose the combinations that are most probable by their `scores`, log evidences, at most `width` in vocabulary.

    At most three more are out of vocabulary. Combinations more than `behind` nats behind the best refitted one that
    they compete with are left out.
    """
    odds = {names: score + state.prior.log_prior_on_mean(names) for names, score in scores.items()}
    ranked = sorted(odds, key=lambda names: -odds[names])
    named, rest = ([n for n in ranked if bool(effects_out_of_vocabulary(n)) == rare] for rare in (False, True))
    return [
        names
        for names in [*named[:width], *rest[:_MOST_OUT_OF_VOCABULARY]]
        if odds[names] >= max(state.log_posterior(c) for c in competitors(names, state.candidates.values())) - behind
    ]


def _is_outdone(state: SearchState, null: WeighedFit, proposal: Proposal) -> bool:
    """Return whether screening sees an effect gain half of what another has gained at most, and 40 nats less."""
    least = state.log_posterior(null)
    best = max(map(state.log_posterior, state.candidates.values())) - least
    gain = proposal.score + state.prior.log_prior_on_mean((proposal.added,)) - least
    return gain < min(_OUTDONE * best, best - FAR_BEHIND)


def _singles_to_refit(state: SearchState, null: WeighedFit, proposals: Mapping[Names, Proposal]) -> list[Proposal]:
    """Choose the effects to refit alone: the leader, those not far behind, and those that screening cannot judge.

    Screening is linear: it cannot judge a user's own effect with a large, nonlinear change, nor an effect that the
    null absorbs nearly completely to first order, nor one of two copies of an effect. Their score is infinite.
    """
    scores = {names: proposal.score for names, proposal in proposals.items()}
    ranked = sorted(scores, key=lambda names: -(scores[names] + state.prior.log_prior_on_mean(names)))
    faint, about = set[str](), Linearised.of(null.found, null.law)
    for bank in state.template_banks(null):
        left = bank.unabsorbed_shares(about)
        faint |= {name for name, of in bank.indices_by_label.items() if _ABSORBED < left[of].max() < _FAINT}
    # One of two waves alone explains little: the other is noise to it.
    twice = {name for name in state.effects if name + AGAIN in state.effects}
    always = state.tried_always | faint | twice
    chosen = promising_combinations(state, scores, width=_FEW, behind=_REFITTED_WITHIN)
    wanted = dict.fromkeys([*ranked[:1], *chosen, *(names for names in ranked if names[0] in always)])
    return [proposals[n]._replace(score=math.inf) if n[0] in always else proposals[n] for n in wanted]


def _proposals_under_simplest_noise(state: SearchState, null: WeighedFit) -> list[Proposal]:
    """Propose the effects that lead about the given null refitted under the simplest noise.

    Noise with memory absorbs an effect where it leads, and the null that was fitted under it may be far from where the
    effect acts: beside a random walk, a tank that runs over need not be full. Otherwise there are no proposals. Their
    score is infinite, as of others that screening about the null cannot judge.
    """
    if state.refits.given_null is None or not state.refits.likeliest_law(null).has_memory:
        return []
    plain = state.refits.null_under_simplest_noise(null)
    scores = state.log_bayes_factors_by_effect(plain, plain.law, plain)
    odds = {
        name: log_mean_exp(own) + state.prior.log_prior_on_mean((name,)) - state.prior.log_prior_on_mean(())
        for name, own in scores.items()
        if name_of_first_copy(name) is None
    }
    ranked = sorted(odds, key=lambda name: -odds[name])[:_HIDDEN]
    return [Proposal(math.inf, plain, name) for name in ranked if odds[name] > 0]


def _largest_scores_about_null(state: SearchState) -> dict[Names, float]:
    best: dict[Names, float] = {}
    for (names, _), value in state.about_null.items():
        best[names] = max(value, best.get(names, value))
    return best


def eliminate_backward(state: SearchState) -> None:
    """Refit the leading combinations without each of their effects in turn, and extend what remains by other effects.

    An effect selected first may be superfluous. Or it stood in for two effects, and its variant (scans or parameters)
    suits neither. Candidates are stored in the state.
    """
    several = sorted((c for c in state.candidates.values() if len(c.names) > 1), key=lambda c: -state.log_posterior(c))
    named, rest = ([c for c in several if bool(effects_out_of_vocabulary(c.names)) == rare] for rare in (False, True))
    # Of an effect that is there twice either may go; what stays is the first of its name.
    dropped = [(c.names, n) for c in [*named[:_ELIMINATED], *rest[:1]] for n in c.names if n + AGAIN not in c.names]
    for k, (names, left_out) in enumerate(dropped):
        state.progress("leaving effects out in turn", k, len(dropped))
        others = tuple(name for name in names if name != left_out)
        if others not in state.refitted_combinations | state.undetected:
            state.refit_stepwise(others)
        held = state.best_candidate(others)
        if held is None:
            continue
        proposals = proposals_for(state, held, {})
        scores = {key: proposal.score for key, proposal in proposals.items()}
        chosen = [names, *promising_combinations(state, scores, width=_SWAPPED, behind=ENOUGH_NATS)[:_SWAPPED]]
        for added in [proposals[key].added for key in chosen if key in proposals]:
            state.refit_with_effect(held, added)


def refit_at_other_orders(state: SearchState, by_mean: Mapping[Names, float]) -> None:
    """Refit the most probable combinations of effects on the mean at other numbers of Gaussians (SSF orders).

    `by_mean` is the probability of each. An unknown effect may lead at an order at which no named effect was tried;
    named ones must then be tried there.
    """
    known = sum(p for names, p in by_mean.items() if names != UNKNOWN)
    leaders = sorted((names for names in by_mean if names not in ((), UNKNOWN)), key=lambda n: -by_mean[n])
    for k, names in enumerate(leaders[:_FEW]):
        state.progress("refitting at other numbers of Gaussians", k, min(len(leaders), _FEW))
        source = state.best_candidate(names)
        if source is None or by_mean[names] < 1e-4 * known:
            continue
        own, fitted = state.candidates[source.n_gaussians, ()].log_z, source.found
        law = state.refits.likeliest_law(source)
        for null in state.nulls:
            # A freer SSF that the evidence rejects by itself is also rejected with an effect.
            ahead, more = null.log_z - own, null.ssf_degrees_of_freedom
            is_freer, is_much_freer = (more >= source.ssf_degrees_of_freedom + k for k in (0, 2))
            rejected = (is_freer and ahead <= -_REFITTED_WITHIN) or (is_much_freer and ahead <= 0)
            if (null.n_gaussians, names) in state.candidates or rejected:
                continue
            model = replace(fitted.model, sensor=null.found.model.sensor)
            start = np.concatenate([null.found.z, fitted.z[fitted.model.sensor.n_params :]])
            candidate = state.refits.fit_and_weigh(model, start[None, :], law, max_steps=15)
            before, after = (state.complexity_penalty(fit.ssf_degrees_of_freedom) for fit in (source, null))
            candidate = candidate.with_variant_factor_and_weights(source.log_share + before - after, source.weights)
            if candidate.is_significantly_better(null):
                state.store_candidate(candidate)


MAX_ORDER = 3  # Gaussians of the SSF that are tried; one more where that is not far behind
_FEW_READINGS = 40  # usable readings below which one Gaussian is tried, and no free form


def prune_out_of_vocabulary(
    candidates: Mapping[tuple[int, Names], WeighedFit], noises: NoiseModels
) -> tuple[dict[tuple[int, Names], WeighedFit], set[Names]]:
    """Drop or penalise combinations out of vocabulary that compete with named ones of no more effects.

    A combination is dropped if it predicts so much the same as a named one that its expected lead is below three nats,
    or if one that is dropped so, of no more effects, is ahead of it by three: a log that a curve follows is that curve,
    and the exponential that comes next is not. If its observed lead over the best named one is below three nats, its
    evidence is reduced to that of this one.

    Returns the candidates that stay, and the combinations that were dropped.
    """

    def average_log_evidence(candidate: WeighedFit) -> float:
        return noises.average_log_evidence(candidate.log_z_by_noise)

    leading = {c.names: c for c in sorted(candidates.values(), key=average_log_evidence) if c.names}
    stay, pruned, best_dropped = dict(candidates), set[Names](), dict[int, float]()
    for names, candidate in reversed(leading.items()):
        if not effects_out_of_vocabulary(names):
            continue
        own, n = average_log_evidence(candidate), len(names)
        rivals = [c for c in leading.values() if not effects_out_of_vocabulary(c.names) and len(c.names) <= n]
        if any(expected_log_bayes_factor(candidate, c) < ENOUGH_NATS for c in rivals):
            pruned.add(names)
            best_dropped.setdefault(n, own)
        elif any(m <= n and value > own + ENOUGH_NATS for m, value in best_dropped.items()):
            pruned.add(names)
        ahead = own - max((average_log_evidence(c) for c in rivals), default=-np.inf)
        if 0 < ahead < ENOUGH_NATS:
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
                law = evidence.likeliest_law
                scores = self.bases.log_bayes_factors_by_label(candidate.found, law)
                by_family = {family: log_mean_exp(own) for family, own in scores.items()}
                if law.share > 0:
                    far_out = outlier_probabilities(candidate.found.residuals, law)
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
        """Return whether a rival is at most three nats behind, and an unknown effect adds less than three to it."""
        average, n_named = self.state.refits.noises.average_log_evidence, len(self.state.effects_in_vocabulary)

        def with_unknown(candidate: WeighedFit) -> float:
            own = candidate.n_gaussians, candidate.names
            return average({key[2]: value for key, value in self.log_z.items() if key[:2] == own})

        def believed(rival: WeighedFit) -> float:
            n = len(rival.names)  # two names are chosen from many more combinations
            several = math.log(math.comb(n_named, n) / n_named) if n - len(known) > 1 else 0.0
            return average(rival.log_z_by_noise) - several

        most = max((with_unknown(c) for c in candidates if c.names == known), default=-np.inf)
        for candidate in sorted(rivals, key=believed, reverse=True):
            if believed(candidate) < most - ENOUGH_NATS:
                return False
            if with_unknown(candidate) == -np.inf:
                self.weigh_beside([candidate])
            if with_unknown(candidate) - average(candidate.log_z_by_noise) < ENOUGH_NATS:
                return True
        return False


def _begin(
    prepared: Prepared, prior: PriorOdds | None, max_order: int | None, after: Searched | None, progress: Progress
) -> tuple[SearchState, MisfitTemplates]:
    """Fit the nulls, or take those of an earlier search; return the state, and the templates of misfits."""
    recording, effects, apparatus = prepared.recording, prepared.effects, prepared.apparatus
    if max_order is None:
        max_order = 1 if len(prepared.usable_rows) < _FEW_READINGS else MAX_ORDER
    prior = prior or apparatus.prior_odds(effects)
    on_noise = {name: cast(NoiseEffect, effects[name]) for name in effects if name in prepared.noise_effect_names}
    on_mean = {
        name: effect
        for name, effect in effects.items()
        if name not in on_noise and (prepared.sought is None or name in prepared.sought or is_out_of_vocabulary(name))
    }
    if after is None:
        sd_prior = getattr(prepared.null, "sd_prior", None) if noise_sd.name in on_noise else None
        models = NoiseModels(recording, on_noise, prior, noise_sd_about_given_null(prepared), sd_prior)
        refits = Refits(prepared.null, models, TemplateCache(prepared.usable_rows))
    else:
        refits = after.refits
    always = apparatus.user_effect_names(on_mean)
    if prepared.null is not None and prepared.null.may_be_far_off:
        always = frozenset(on_mean)
    spent = apparatus.refit_budget_share_spent()

    def share_is_spent(share: float) -> bool:
        return prepared.is_refit_budget_spent(spent + share * max(1.0 - spent, 0.0))

    state = SearchState(on_mean, prior, refits, always, progress, share_is_spent)
    if after is None:
        fit_nulls(state, prepared, max_order=max_order)
        null = state.null
        if prepared.null is not None and not prepared.has_too_little_data and explains_hardly_anything(null.found):
            require_converged_fit(null.found, Linearised.of(null.found, null.law))  # before minutes of search
        misfit_templates = _build_misfit_templates(state, prepared)
    else:
        state.candidates |= {key: fit for key, fit in after.evidences.fits.items() if not fit.names}
        misfit_templates = replace(after.misfit_templates, about=state.null.found)
    return state, misfit_templates


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
    state, misfit_templates = _begin(prepared, prior, max_order, after, progress)
    bases, noises = misfit_templates.unknown_bases, state.refits.noises
    if formulas := [effect for name, effect in state.effects.items() if name.startswith(PROPOSAL)]:
        # As a formula and as a basis a product of columns would be the same hypothesis twice, and the less specific
        # one, the basis, might lead. The test of the residuals keeps all, since these readings chose the formulas.
        problem = Linearised.of(state.null.found, state.refits.likeliest_law(state.null))
        bases = without_products_like(bases, state.refits.templates.coarse_bank(state.null.found, formulas), problem)
    unknown = UnknownEffects(state, bases, misfit_templates.covariates)

    def found() -> Searched:
        own = Evidences(state.candidates, state.screened_log_evidences(), unknown.log_z, unknown.shares)
        posterior = hypothesis_probabilities(own, state.prior, certain=noises.certain)
        return Searched(prepared, state.prior, misfit_templates, state.refits, own, posterior)

    select_forward(state, depth=depth)
    if prepared.null is not None:
        _refit_null_from_effects(state)
    eliminate_backward(state)
    # With a form of the SSF that the readings reject, an unknown effect would only stand in for the form.
    unknown.weigh_beside([c for c in state.nulls if c.log_z > state.null.log_z - EXTENDED_WITHIN])
    _refit_favoured_by_screening(state, lambda: found().posterior)
    if prepared.null is None:
        refit_at_other_orders(state, found().posterior.marginal_over_noise)
    state.candidates, state.pruned = prune_out_of_vocabulary(state.candidates, noises)
    progress("comparing unknown effects")
    refitted = [c for c in state.candidates.values() if c.names]
    unknown.weigh_beside(sorted(refitted, key=lambda c: -c.log_z)[:4])
    unknown.drop_superfluous(state.candidates.values())
    out = found()
    if noises.sd_prior is None:
        return out
    return out.with_evidences(out.evidences.split_by_sd(noises.effects[noise_sd.name]))


def _refit_favoured_by_screening(state: SearchState, posterior: Callable[[], HypothesisProbabilities]) -> None:
    """Refit the combinations that are probable by screening alone, until none is or six were refitted.

    After six, all other screened evidences are reduced (`state.optimism`) by the least amount by which a refit fell
    short of its screened evidence. Screening is linear: where an effect gains hundreds of nats, the gain of another one
    beside it may be wrong by a hundred. About a given null, whose fits are comparable, such a combination is first
    screened again about its largest refitted part.
    """
    shortfalls: list[float] = []
    screened = set[WeighedFit]()
    while len(shortfalls) < _FEW:
        state.progress("refitting combinations favoured by screening", len(shortfalls), _FEW)
        by_mean = posterior().marginal_over_noise
        settled = {(), UNKNOWN} | state.undetected | state.refitted_combinations
        names = max((key for key in by_mean if key not in settled), key=lambda key: by_mean[key], default=())
        if by_mean.get(names, 0.0) <= 0.02 or not names:  # too improbable to be worth a refit
            return
        part = state.largest_refitted_part(names)
        if state.refits.given_null is not None and part.names and part not in screened:
            screened.add(part)
            proposals_for(state, part, {})
            continue
        promised = state.log_evidence(names)
        state.refit_stepwise(names)
        shortfalls.append(promised - state.log_evidence(names))
    state.optimism = max(min(shortfalls), 0.0)


def _refit_null_from_effects(state: SearchState) -> None:
    """Refit the null from the best fits with one effect, whose gain may be due to a better mode of the null."""
    null = state.null
    single = [c for c in state.candidates.values() if len(c.names) == 1 and c.log_z > null.log_z]
    for candidate in sorted(single, key=lambda c: -c.log_z)[:2]:
        start = candidate.found.z[: null.found.model.sensor.n_params]
        again = state.refits.fit_and_weigh(null.found.model, start[None, :], candidate.law)
        if again.log_z > state.null.log_z + SAME_MODE:
            state.store_candidate(again)


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
    return MisfitTemplates(null.found, unlike, tuple(covariates))


# Nats behind the best of what was refitted, within which screening must see a formula: alone, where an effect of
# hundreds of nats is seen wrongly by a dozen, and beside the best single effect or the leader, whose fits are near.
_WITHIN_ALONE, _WITHIN_BESIDE = 12.0, 3.0


def search_with_formulas(searched: Searched, *, progress: Progress = silent) -> Searched:
    """Return a second search that includes the formulas favoured by screening; the given one if there are none.

    The given search is also returned if noise without memory explains the readings, to a probability of .9, or the
    budget of refits is spent. Named effects can partly explain what one formula explains, and then predict other runs
    badly: a square law an exponential leak, a step and a sensitivity together a product. Noise with memory absorbs slow
    changes.
    """
    prepared, apparatus = searched.prepared, searched.prepared.apparatus
    plain = (p for (mean, noise), p in searched.posterior.probabilities.items() if not (mean or WITH_MEMORY & {*noise}))
    if not 1.0 - sum(plain) > 0.1 or prepared.is_refit_budget_spent():
        return searched
    proposals = apparatus.proposed_formulas()
    if prepared.sought is not None:
        proposals = {name: proposals[name] for name in proposals if name in prepared.sought}
    if not proposals:
        return searched
    progress("weighing formulas")
    prior = apparatus.prior_odds({**prepared.effects, **proposals})
    odds = {
        name: value + (prior.log_prior_on_mean((name,)) - prior.log_prior_on_mean(()))
        for name, value in _promise_by_formula(searched, proposals).items()
    }
    best = max(map(searched.log_posterior, searched.evidences.fits.values()))
    ranked = sorted(odds, key=lambda name: -odds[name])[:_BEAM]
    kept = {name: proposals[name] for name in ranked if odds[name] > best}
    if not kept:
        return searched
    more = replace(prepared, effects={**prepared.effects, **kept})
    again = search(more, prior=prior, after=searched, progress=progress)
    return searched if prepared.is_refit_budget_spent() else again


def _promise_by_formula(searched: Searched, proposals: Mapping[str, Effect]) -> dict[str, float]:
    """Return for each formula its largest screened log evidence beside the null, the best single effect or the leader.

    The leader is the most probable combination. The log prior of what the formula stands beside is included, that of
    the formula is not. The nats by which a formula may trail there are added.
    """
    null, fits = searched.null, list(searched.evidences.fits.values())
    single = max((fit for fit in fits if len(fit.names) == 1), key=lambda f: f.log_z, default=None)
    leader = max(fits, key=searched.log_posterior)
    parents = [(null, _WITHIN_ALONE), *([(single, _WITHIN_BESIDE)] if single is not None else [])]
    parents += [(leader, _WITHIN_BESIDE)] if len(leader.names) > 1 else []
    out: dict[str, float] = {}
    for bank in TemplateCache(searched.prepared.usable_rows).passing_banks(null.found, list(proposals.values())):
        for parent, within, evidence in ((*each, noise) for each in parents for _, noise in each[0].leading_noises()):
            least = evidence.log_z + searched.prior.log_prior_on_mean(parent.names) + within
            for name, own in bank.log_bayes_factors_by_label(parent.found, evidence.likeliest_law).items():
                out[name] = max(least + log_mean_exp(own), out.get(name, -math.inf))
    return out
