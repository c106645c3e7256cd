"""The state of a search: candidates by SSF order and names, screened evidences of others, and further refits."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.bank import TemplateBank
from probewise.diagnosis.evidence.templates import TemplateCache
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.names import Names
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.search.constants import SAME_MODE
from probewise.diagnosis.search.noises import NoiseModels
from probewise.diagnosis.search.refits import Refits, is_significantly_better
from probewise.diagnosis.search.weighed_fit import WeighedFit, effects_out_of_vocabulary
from probewise.effects import NamedEffect
from probewise.errors import NotConvergedError
from probewise.progress import Progress, silent


@dataclass(eq=False)
class SearchState:
    """The mutable state of a search. A candidate is a refitted combination of effects with one number of Gaussians.

    Parameters
    ----------
    effects
        Effects on the mean, by name.
    prior
        Prior odds.
    noises
        The noise models.
    templates
        Cache of templates of effects about fits.
    refits
        Fits of the recording.
    tried_always
        Effects that are always refitted alone, whatever their score by screening.
    progress
        Called at every refit.
    share_is_spent
        Function of a share: whether that share of this search's budget of refits is spent.
    share
        Share of the budget that may be spent by now.
    """

    effects: Mapping[str, NamedEffect[Any]]
    prior: PriorOdds
    noises: NoiseModels
    templates: TemplateCache
    refits: Refits
    tried_always: frozenset[str] = frozenset()
    progress: Progress = silent
    share_is_spent: Callable[[float], bool] = lambda share: False
    share: float = 1.0
    candidates: dict[tuple[int, Names], WeighedFit] = field(default_factory=dict)
    sensors: dict[int, Null] = field(default_factory=dict)
    """By SSF order."""
    about_null: dict[tuple[Names, Names], float] = field(default_factory=dict)
    """Log evidence of (mean, noise), by screening about a null."""
    about_parts: dict[tuple[Names, Names], float] = field(default_factory=dict)
    """The same, about a fit with all but one of the effects."""
    undetected: set[Names] = field(default_factory=set)
    """Combinations in which a refit has shown one effect to be insignificant."""
    extended: set[tuple[WeighedFit, str]] = field(default_factory=set)
    """Refits done: candidate and added effect."""
    pruned: set[Names] = field(default_factory=set)
    """Combinations out of vocabulary that are aliased with named ones."""
    optimism: float = 0.0
    """Nats by which screening promises too much at least."""

    @property
    def nulls(self) -> list[WeighedFit]:
        """The candidates without effects, one per number of Gaussians."""
        return [c for (_, names), c in self.candidates.items() if not names]

    @property
    def null(self) -> WeighedFit:
        """The candidate without effects whose number of Gaussians has the largest evidence."""
        return max(self.nulls, key=lambda c: c.log_z)

    @property
    def null_is_given(self) -> bool:
        """Whether the null is a given one, whose fits are comparable, and not one of several forms of the SSF."""
        return self.refits.sensor is not None

    @property
    def refitted_combinations(self) -> set[Names]:
        """The combinations that were refitted, with any number of Gaussians."""
        return {names for _, names in self.candidates}

    def candidates_of_combination(self, names: Names) -> list[WeighedFit]:
        """List the candidates of one combination, one per number of Gaussians."""
        return [c for (_, key), c in self.candidates.items() if key == names]

    def log_posterior(self, candidate: WeighedFit) -> float:
        """Return a candidate's unnormalised log posterior: its log evidence plus the log prior of its effects."""
        return candidate.log_z + self.prior.log_prior_on_mean(candidate.names)

    def template_banks(self, about: WeighedFit) -> list[TemplateBank]:
        """Return the template banks of what a candidate lacks, about it: in the vocabulary, and out of it if any."""
        lacking = {name: effect for name, effect in self.effects.items() if name not in about.names}
        named = [effect for name, effect in lacking.items() if not effects_out_of_vocabulary((name,))]
        rest = [effect for name, effect in lacking.items() if effects_out_of_vocabulary((name,))]
        return [self.templates.coarse_bank(about.found, effects) for effects in (named, rest) if effects]

    def log_bayes_factors_by_effect(
        self, parent: WeighedFit, law: NoiseLaw, about: WeighedFit
    ) -> dict[str, FloatArray]:
        """Return, by effect, the log Bayes factors of adding its templates to a candidate, (n_templates,) each.

        The templates are those about `about`: the candidate, or its null.
        """
        of_banks = [
            self.refits.log_bayes_factors_by_label(parent.found, law, bank) for bank in self.template_banks(about)
        ]
        return {name: own for scores in of_banks for name, own in scores.items()}

    def complexity_penalty(self, degrees_of_freedom: int, each: float | None = None) -> float:
        """Return the penalty in nats of effects at an SSF with fewer degrees of freedom than the null alone needs.

        `each` is the penalty per degree of freedom; by default that of the prior. It is averaged over the orders of the
        null, so that a small chance lead of one order has little effect.
        """
        nulls = self.nulls
        log_z = np.array([c.log_z for c in nulls])
        spared = np.array([max(c.ssf_degrees_of_freedom - degrees_of_freedom, 0) for c in nulls])
        return float(
            logsumexp(log_z) - logsumexp(log_z - (self.prior.complexity_penalty if each is None else each) * spared)
        )

    def penalty_of_extending(self, parent: WeighedFit) -> float:
        """Return the complexity penalty of the first effect that is added to a candidate, in nats; 0 if it has some."""
        return 0.0 if parent.names else self.complexity_penalty(parent.ssf_degrees_of_freedom)

    def store_candidate(self, candidate: WeighedFit) -> WeighedFit:
        """Store a candidate in place of an earlier one of the same effects and number of Gaussians; return it."""
        self.candidates[candidate.n_gaussians, candidate.names] = candidate
        return candidate

    def refit_with_effect(self, parent: WeighedFit, added: str) -> WeighedFit | None:
        """Refit a candidate with one more effect; store the fit if the effect is significant.

        Otherwise the combination is recorded as undetected. Nothing is refitted once the share of the budget is spent.

        Returns
        -------
        The best candidate of the resulting combination, possibly an earlier one; None if there is none.
        """
        against = self.penalty_of_extending(parent)
        if self.share_is_spent(self.share):
            return max(
                self.candidates_of_combination(tuple(sorted((*parent.names, added)))),
                key=lambda c: c.log_z,
                default=None,
            )
        self.extended.add((parent, added))
        try:
            candidate, scores = self.refits.refit_with_effect(parent, self.effects[added], against)
        except NotConvergedError:  # its model diverges from every start
            names = tuple(sorted((*parent.names, added)))
            self.about_parts |= {(names, noise): e.log_z - against for noise, e in parent.evidence.items()}
            self.undetected.add(names)
            return None
        known = self.candidates.get((candidate.n_gaussians, candidate.names), candidate)
        if is_significantly_better(candidate, parent):
            return self.store_candidate(max(known, candidate, key=lambda c: c.log_z))
        if known is not candidate:
            return known
        # Laplace fails where an effect is too small to be significant and the closed form does not; but the
        # closed form takes amplitudes of a sign that the effect cannot have, and the refit has shown that.
        names = tuple(sorted((*parent.names, added)))
        for noise, value in scores.items():
            self.about_parts[names, noise] = parent.evidence[noise].log_z + min(value, 0.0) - against
        self.undetected.add(names)
        return None

    def refit_subset_from(self, candidate: WeighedFit, left_out: str) -> None:
        """Refit the combination without `left_out` from its coordinates in `candidate`, if it fits better there.

        A better fit replaces the candidate of that combination. Where an effect changes the meaning of other parameters
        (a stiffness that hardens, and a frequency), a fit from their values without it may stop at a local optimum.
        """
        model, stay = candidate.found.model.model_and_mask_without(left_out)
        start = candidate.found.z[stay]
        for held in self.candidates_of_combination(tuple(name for name in candidate.names if name != left_out)):
            alike = held.n_gaussians == candidate.n_gaussians and set(model.effects) == set(held.found.model.effects)
            if alike and self.refits.fits_better_at_z(model, start, held):
                again = self.refits.fit_and_weigh(model, start[None, :], candidate.law).with_variant_factor_and_weights(
                    held.log_share, held.weights
                )
                if again.log_z > held.log_z + SAME_MODE:
                    self.store_candidate(again)
                    self.refits.replace_fit(held, again)

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
        return self.store_candidate(both) if is_significantly_better(both, between) else None

    def screened_log_evidences(self) -> dict[tuple[Names, Names], float]:
        """Return the log evidence of (mean, noise) by screening, for combinations that were not refitted.

        Screening about a fit with part of the effects is more accurate than about the null, which is corrected for
        refits of parts. `optimism` (nats) is subtracted, unless a refit has shown that an effect is insignificant.
        """
        refitted = self.refitted_combinations
        out = {}
        for (names, noise), value in self.about_null.items():
            parts = [p for p in itertools.combinations(names, len(names) - 1) if p in refitted]
            gains = [
                max(c.evidence[noise].log_z for c in self.candidates_of_combination(part))
                - self.about_null.get((part, noise), np.inf)
                for part in parts
            ]
            out[names, noise] = value + max(gains, key=abs, default=0.0) if np.all(np.isfinite(gains)) else value
        out |= self.about_parts
        return {
            key: value if key[0] in self.undetected else value - self.optimism
            for key, value in out.items()
            if key[0] not in refitted | self.pruned
        }

    def log_evidence(self, names: Names) -> float:
        """Return a combination's largest log evidence over noise models and numbers of Gaussians.

        It is that of refits or, if there are none, that by screening; minus infinity if there is neither.
        """
        screened = (value for (own, _), value in self.screened_log_evidences().items() if own == names)
        return max([c.log_z for c in self.candidates_of_combination(names)] or screened, default=-np.inf)


def competing_candidates(names: Names, among: Iterable[WeighedFit]) -> list[WeighedFit]:
    """List the candidates that compete with a combination: those in the vocabulary, or all if it is out of it."""
    return [c for c in among if effects_out_of_vocabulary(names) or not effects_out_of_vocabulary(c.names)]
