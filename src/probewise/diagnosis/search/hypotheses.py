"""Hypotheses: combinations of effects, refitted jointly under competing noise models, and their probabilities.

`WeighedFit` is one hypothesis on the mean with its evidence under each noise model, `NoiseModels` are these models,
`Refits` makes such fits, and `Searched` is the result of a search: evidences, and the probabilities that follow.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TypeAlias, TypeVar, cast

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.diagnosis.apparatus import ENOUGH_NATS, PriorOdds
from probewise.diagnosis.evidence import (
    SCALES,
    Linearised,
    NoiseEvidence,
    laplace_evidence,
    log_probability_effects_detectable,
    refined,
)
from probewise.diagnosis.fit import FARTHEST, Fit, Model, Null, fit, fit_each_start
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.noise import HIDDEN, NoiseLaw, NoiseModel, SdPrior, rough_sd, rounding_that_hides_noise
from probewise.diagnosis.outlying import outlier_probabilities
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.templates import EffectTemplates, TemplateBank, TemplateCache, log_mean_exp
from probewise.diagnosis.words import UNKNOWN, Names
from probewise.effects import NUISANCES, PROPOSAL, Effect, NoiseEffect, is_out_of_vocabulary, name_of_first_copy
from probewise.effects.effect import ROWS_OF_A_SIDE
from probewise.effects.noise import (
    ROUNDING_SEEN_ABOVE,
    correlated_noise,
    lattice_step,
    noise_sd,
    outliers,
    quantisation,
    random_walk,
    sd_of_rounding,
)
from probewise.errors import NotConvergedError
from probewise.inference import sd_floor
from probewise.priors import SharedScalePrior
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

EXTENDED_WITHIN = 20.0  # nats behind the best of its size: nothing is added to a combination further back
SAME_MODE = 0.02  # nats by which another fit of the null must be better to be another mode; fits stop at 0.005
# Nats behind the best refit: a fit so far behind is weighed once, and one of a law that stays there is given up. Where
# an effect gains hundreds of nats, others gain some of them slowly, and most steps of a search were theirs.
FAR_BEHIND = 40.0
_MANY = 12  # nodes of one effect above which they are thinned before combination with another's

EffectNames: TypeAlias = tuple[Names, Names]
"""Names of the effects on the mean, and on the noise."""

K = TypeVar("K", bound=Hashable)


def _sums(terms: Iterable[tuple[K, float]], *, of_logs: bool = False) -> dict[K, float]:
    """Add up the values of each key; if `of_logs`, they are given and returned as logs."""
    out: dict[K, float] = {}
    for key, value in terms:
        known = out.get(key, -math.inf if of_logs else 0.0)
        out[key] = float(np.logaddexp(known, value)) if of_logs else known + value
    return out


def or_impossible(log_z: float) -> float:
    """Return a log evidence, minus infinity for one that is no number: all probabilities would be none."""
    return -math.inf if math.isnan(log_z) else log_z


@dataclass(frozen=True, eq=False)
class WeighedFit:
    """A candidate: effects on the mean refitted with an SSF of some number of Gaussians; evidence by noise effects.

    `law` is the noise distribution of the fit. In the evidence are the log prior factor of the effects' discrete
    choices (variants), `log_share`, and the log probability that all have a detectable size, `log_detectable`;
    `weights` are those of each effect's variants.
    """

    found: Fit
    law: NoiseLaw
    evidence: Mapping[Names, NoiseEvidence]
    log_share: float
    log_detectable: float
    weights: Mapping[str, FloatArray]

    @property
    def names(self) -> Names:
        """Names of its effects on the mean, sorted."""
        return tuple(sorted(self.found.model.names))

    def with_variant_factor_and_weights(self, log_share: float, weights: Mapping[str, FloatArray]) -> WeighedFit:
        """Return a copy with other log prior factor and weights of its effects' variants (discrete choices)."""
        return replace(self.with_log_evidence_shifted(log_share - self.log_share), log_share=log_share, weights=weights)

    def with_log_evidence_shifted(self, by: float) -> WeighedFit:
        """Return a copy with its log evidence shifted by these nats under every noise model."""
        shifted = {noise: replace(e, log_z=or_impossible(e.log_z + by)) for noise, e in self.evidence.items()}
        return replace(self, evidence=shifted)

    @property
    def n_gaussians(self) -> int:
        """Number of Gaussians of its SSF (SSF order)."""
        return self.found.model.sensor.n_gaussians

    @property
    def whitened_sd(self) -> float:
        """Noise sd of a whitened reading, in reading units, including rounding but not a tail."""
        return self.found.sd * self.law.sd_factor_of_rounding

    @property
    def ssf_degrees_of_freedom(self) -> int:
        """Effective degrees of freedom of its SSF, counted in Gaussians."""
        return self.found.model.sensor.effective_n_gaussians

    @property
    def log_z_by_noise(self) -> dict[Names, float]:
        """Log evidence under each noise model."""
        return {noise: evidence.log_z for noise, evidence in self.evidence.items()}

    @property
    def log_z(self) -> float:
        """Log evidence under the best noise model."""
        return max(e.log_z for e in self.evidence.values())

    def at_likelier_sd(self, noise: Names) -> NoiseEvidence:
        """Return the evidence under a noise model, with the calibration's noise sd or another, the larger one."""
        own = [self.evidence[names] for names in (noise, _changed(noise)) if names in self.evidence]
        return max(own, key=lambda e: e.log_z)

    def split_by_sd(self, changed: NoiseEffect) -> WeighedFit:
        """Return a copy with two noise models for each: with the noise sd of the calibration, and with another."""
        by_sd = {noise: evidence.by_sd(changed) for noise, evidence in self.evidence.items()}
        same = {noise: first for noise, (first, _) in by_sd.items()}
        return replace(self, evidence=same | {_changed(noise): second for noise, (_, second) in by_sd.items()})

    def possible_noise(self, noise: Names) -> Names:
        """Return a noise model or, where it is impossible about this fit, the best with part of its effects."""
        if np.isfinite(self.evidence[noise].log_z):
            return noise
        parts = [names for names in self.evidence if {*names} < {*noise}]
        return max(parts, key=lambda names: self.evidence[names].log_z, default=noise)

    def leading_noises(self) -> Iterator[tuple[Names, NoiseEvidence]]:
        """Iterate over the noise models within three nats of the best, and the simplest one: names and evidence.

        A missing effect on the mean can look like any noise effect, and be detectable under white noise only.
        """
        best, plain = self.log_z, min(self.evidence, key=len)
        return ((k, e) for k, e in self.evidence.items() if k == plain or e.log_z >= best - ENOUGH_NATS)

    def is_significantly_better(self, than: WeighedFit) -> bool:
        """Return whether its log likelihood exceeds that of another by more than 1.5 nats."""
        return _improves_fit(self.found, than.found, self.law)


def _improves_fit(found: Fit, beyond: Fit, law: NoiseLaw) -> bool:
    whitened = law(np.stack([beyond.residuals, found.residuals], axis=1))
    before, after = law.minus_log_likelihood(whitened, law.likeliest_sigma(whitened))
    return bool(before - after > 1.5)


def expected_log_bayes_factor(first: WeighedFit, second: WeighedFit) -> float:
    """Return the expected log Bayes factor over the second if the first is true: half the squared distance in sds."""
    apart = first.law((first.found.residuals - second.found.residuals)[:, None])
    return 0.5 * float(np.sum(apart**2)) / first.whitened_sd**2


def noise_effects_in_vocabulary(noise: Names) -> Names:
    """Return the effects of a noise model without nuisances, which have no name in the vocabulary."""
    return tuple(name for name in noise if name not in NUISANCES)


def effects_out_of_vocabulary(mean: Names) -> Names:
    """Return the effects on the mean, of those named, that are out of vocabulary."""
    return tuple(name for name in mean if is_out_of_vocabulary(name))


def _changed(noise: Names) -> Names:
    return tuple(sorted((*noise, noise_sd.name)))


WITH_MEMORY = frozenset({correlated_noise.name, random_walk.name})
"""Effects on the noise of which a noise distribution can contain only one."""


@dataclass(eq=False)
class NoiseModels:
    """The noise models of one recording: each noise effect alone, and pairs and triples if fewer are significant.

    `certain`: noise effects that the readings show beyond doubt, part of every model; `least_sd`: the least plausible
    sd of a reading; `sd_about_fit`: the noise sd about a first fit, infinite without one. Rounding is judged by it too,
    since successive readings tell the noise only if the signal varies little from one to the next. `sd_prior`: that of
    a given sensor's noise; each model then allows for the sd at its calibration and for another, by their prior odds.
    """

    recording: Recording
    effects: Mapping[str, NoiseEffect]
    prior: PriorOdds
    sd_about_fit: float = math.inf
    sd_prior: SdPrior | None = None
    least_sd: float = field(init=False)
    certain: Names = field(init=False)
    models: dict[Names, NoiseModel] = field(init=False)

    def __post_init__(self) -> None:
        self._step = lattice_step(self.recording.readings[self.recording.usable])
        # On a coarse lattice, a smaller sd would favour models whose levels fall on the lattice.
        self.least_sd = max(sd_floor(self.recording), HIDDEN * self._step)
        # Readings that are all multiples of a coarse step are rounded; this is an effect if it was not declared.
        sd = min(rough_sd(self.recording) or math.inf, self.sd_about_fit)
        known = {name: effect.known for name, effect in self.effects.items() if effect.known is not None}
        is_rounding_seen = ROUNDING_SEEN_ABOVE * sd < self._step
        if is_rounding_seen and quantisation.name in self.effects:
            known.setdefault(quantisation.name, np.array([self._step]))
        if is_rounding_seen and self.sd_prior is not None:
            self.sd_prior = replace(self.sd_prior, rounding=sd_of_rounding(self._step))
        self._known = {name: (values[None, :], np.zeros(1)) for name, values in known.items()}
        self._rounding = rounding_that_hides_noise(self.recording, self._step, sd)
        self.certain = tuple(sorted(known))
        apart = (quantisation.name, noise_sd.name, *self.certain)
        others = sorted(name for name in self.effects if name not in apart)
        single = [tuple(sorted({*names, *self.certain})) for names in ((), *((name,) for name in others))]
        self.models = {names: self._build_model(names) for names in single}

    def _build_model(
        self, names: Names, likely: Mapping[str, tuple[FloatArray, FloatArray]] | None = None
    ) -> NoiseModel:
        # Certain effects are not re-estimated about each fit, whose own residual may be larger.
        effects = tuple(self.effects[n] for n in names)
        rounding = self._rounding if names == self.certain else 0.0
        sd_prior = self.sd_prior
        if sd_prior is not None:
            sd_prior = replace(sd_prior, log_changed=self.log_prior(_changed(names)) - self.log_prior(names))
        return NoiseModel(effects, self.recording, {**self._known, **(likely or {})}, rounding, self.least_sd, sd_prior)

    def log_prior(self, names: Names) -> float:
        """Return the log prior probability of a noise model; certain effects do not count."""
        return self.prior.log_prior_on_noise(self._uncertain_names(names))

    def average_log_evidence(self, log_z: Mapping[Names, float]) -> float:
        """Return the log of the average of evidences by noise model, weighted by prior; minus infinity without any."""
        values = [value + self.log_prior(names) for names, value in log_z.items()]
        return float(logsumexp(values)) if values else -math.inf

    def evidence_by_noise(self, found: Fit) -> dict[Names, NoiseEvidence]:
        """Compute the evidence of a fit by noise model; with nodes about its peak if these may bring it to ten nats."""
        evidence = {names: laplace_evidence(found, model) for names, model in self.models.items()}
        best = max((e.log_z + self.log_prior(names) for names, e in evidence.items()), default=-math.inf)
        return {
            names: refined(found, own, least=best - self.log_prior(names) - 10.0) for names, own in evidence.items()
        }

    def likeliest_law(self, evidence: Mapping[Names, NoiseEvidence]) -> NoiseLaw:
        """Return the distribution of the noise model that is most probable by its evidence, priors included."""
        return evidence[max(evidence, key=lambda names: evidence[names].log_z + self.log_prior(names))].likeliest_law

    def add_significant_pairs(self, found: Fit, evidence: Mapping[Names, NoiseEvidence]) -> bool:
        """Add pairs of noise effects to the models if a single one is significant about a fit; triples if a pair is.

        Only those within three nats of the best are added. Returns whether any pair was tried.
        """
        known, singles = dict(evidence), list(evidence)
        for size in (1, 2):  # at most three faults of the noise at once
            of_size = {names: e for names, e in known.items() if len(self._uncertain_names(names)) == size}
            first = max(of_size, key=lambda names: of_size[names].log_z, default=self.certain)
            parts = [n for n in known if set(n) < set(first)]
            if not parts or known[first].log_z < max(known[n].log_z for n in parts) + ENOUGH_NATS:
                return size > 1
            # Beside another effect the likeliest values may be others: nodes about them alone would lie too close.
            likely = self._likeliest_nodes(laplace_evidence(found, self.models[first]))
            best = max(e.log_z + self.log_prior(names) for names, e in known.items())
            for other in singles:
                both = tuple(sorted({*first, *other}))
                if len(self._uncertain_names(both)) != size + 1 or set(both) >= WITH_MEMORY:
                    continue
                coarse = {}  # of effects with many nodes of one parameter, every third
                for effect in self.models[other].effects:
                    nodes = effect.entries[:, 0, :]
                    if effect.name not in self._known and len(nodes) > _MANY and nodes.shape[1] == 1:
                        coarse[effect.name] = nodes[1::3], np.full(len(nodes[1::3]), -math.log(len(nodes[1::3])))
                nearby = laplace_evidence(found, self._build_model(both, likely | coarse))
                least = best - ENOUGH_NATS - self.log_prior(both)
                own = refined(found, nearby, least=least)
                if own.log_z <= least:
                    continue
                # Of all nodes of each effect, the likeliest beside the likeliest of the others.
                best_of, recentred = self._likeliest_nodes(nearby), {}
                for name in self._uncertain_names(first):
                    beside = {k: nodes for k, nodes in best_of.items() if k != name}
                    again = laplace_evidence(found, self._build_model(both, beside))
                    recentred[name] = again.likeliest_nodes_of_effect(name)
                self.models[both], known[both] = self._build_model(both, recentred | coarse), own
        return True

    def _likeliest_nodes(self, evidence: NoiseEvidence) -> dict[str, tuple[FloatArray, FloatArray]]:
        names = self._uncertain_names(tuple(effect.name for effect in evidence.noise.effects))
        return {name: evidence.likeliest_nodes_of_effect(name) for name in names}

    def _uncertain_names(self, names: Names) -> Names:
        return tuple(n for n in names if n not in self.certain)


_FAR = 10.0  # nats; a fit stops when a step gains less than 0.005
_HARDLY = 0.9  # of the sd of the readings


def explains_hardly_anything(found: Fit) -> bool:
    """Return whether a fit's residuals are about as large as the readings vary."""
    return float(found.residuals.std()) > _HARDLY * float((found.predicted + found.residuals).std())


def require_converged_fit(found: Fit, problem: Linearised) -> None:
    """Refuse a fit that one more step would improve by over ten nats, unless it is at the bounds of its prior.

    Raises NotConvergedError with the fit as its `partial`.
    """
    shift = problem.absorbing_shift(found, np.zeros(len(found.residuals)))
    slopes = problem.whiten(found.slopes)
    left = 0.5 * float(np.sum((slopes @ shift) ** 2) + shift @ shift)
    if left > _FAR and np.abs(found.z).max() < FARTHEST - 0.1:
        cure = f"one more step would still gain about {left:.0f} nats; a narrower prior or more readings would help"
        if explains_hardly_anything(found):
            read, said = found.predicted + found.residuals, found.predicted
            cure = f"it explains hardly anything: the readings go from {read.min():.3g} to {read.max():.3g}, its "
            cure += f"predictions from {said.min():.3g} to {said.max():.3g}; are both in one unit, such as degrees or "
            cure += "radians (observe converts), and are runs named and parameters of each run declared?"
        raise NotConvergedError(f"the fit of the model did not converge: {cure}", found)


Extended: TypeAlias = tuple[WeighedFit, dict[Names, float]]
"""A candidate with one more effect, and the closed-form scores of the effect by noise model."""


@dataclass(frozen=True, eq=False)
class Refits:
    """The refits of one recording, each made once; a second search of the recording reuses them.

    `given_null` is there if one is given; `templates` caches the templates of effects about fits; `known` are
    candidates with their refits with one more effect, by the candidate's form and names, the effect, and the nats
    against it; `plain` are refits of the null under the simplest noise.
    """

    given_null: Null | None
    noises: NoiseModels
    templates: TemplateCache
    known: dict[tuple[int, Names, Effect, float], tuple[WeighedFit, Extended]] = field(default_factory=dict, repr=False)
    plain: list[WeighedFit] = field(default_factory=list, repr=False)

    def likeliest_law(self, candidate: WeighedFit) -> NoiseLaw:
        """Return the noise distribution of a candidate's most probable noise model."""
        return self.noises.likeliest_law(candidate.evidence)

    def fit_and_weigh(
        self, model: Model, starts: FloatArray, law: NoiseLaw, max_steps: int = 30, *, beyond: WeighedFit | None = None
    ) -> WeighedFit:
        """Fit a model from the best of `starts`, (n_starts, n_params), and compute its evidence under all noise models.

        The fit is under `law`, and is repeated if another noise distribution proves more probable. A fit that is not
        significantly better than the fit `beyond` takes over its evidence, to save the computation, unless the noise
        has memory: there the fit may still gain under white noise.
        """
        found = self._fit_from_best_start(model, starts, law, max_steps)
        if beyond is not None and not law.has_memory and not _improves_fit(found, beyond.found, law):
            plain = beyond.with_log_evidence_shifted(-(beyond.log_share + beyond.log_detectable)).evidence
            detectable = beyond.log_detectable
        else:
            for _ in range(2):
                plain = self.noises.evidence_by_noise(found)
                best = self.noises.likeliest_law(plain)
                leads = max((candidate.log_z for _, (candidate, _) in self.known.values()), default=-math.inf)
                if best.is_practically_equal(law) or max(e.log_z for e in plain.values()) < leads - FAR_BEHIND:
                    break
                law = best
                found = self._fit_from_best_start(model, found.z[None, :], law, max_steps)
            else:
                plain = self.noises.evidence_by_noise(found)
            detectable = log_probability_effects_detectable(found, law, self.templates.usable)
        return WeighedFit(found, law, plain, 0.0, detectable, {}).with_log_evidence_shifted(detectable)

    def _fit_from_best_start(self, model: Model, starts: FloatArray, law: NoiseLaw, max_steps: int) -> Fit:
        """Fit a few steps from each start, (n_starts, n_params), then to convergence from the best."""
        recording, hopeless = self.noises.recording, math.inf
        if model.sensor.predicts_dearly and self.known:
            hopeless = min(candidate.found.objective for _, (candidate, _) in self.known.values()) + FAR_BEHIND
        found, start = None, starts[0]
        if len(starts) > 1:
            fits = fit_each_start(model, recording, list(starts), law, max_steps=5, hopeless_above=hopeless)
            found = min(fits, key=lambda f: f.objective)
            start = found.z
        if found is None or not found.settled:
            found = fit(model, recording, start, law, max_steps=max_steps, hopeless_above=hopeless)
        if not np.isfinite(found.objective):
            text = "the model predicts readings that are not finite; check the model and its prior"
            raise NotConvergedError(text, found)
        return found

    def null_under_simplest_noise(self, null: WeighedFit) -> WeighedFit:
        """Refit the given null without noise effects but those beyond doubt, or return a better one made before."""
        certain = self.noises.certain
        if self.plain and self.plain[-1].evidence[certain].log_z > null.evidence[certain].log_z:
            return self.plain[-1]
        law = null.evidence[certain].likeliest_law
        starts = np.stack([null.found.z, *cast(Null, self.given_null).starts])
        found = self._fit_from_best_start(null.found.model, starts, law, 30)
        self.plain.append(WeighedFit(found, law, self.noises.evidence_by_noise(found), 0.0, 0.0, {}))
        return self.plain[-1]

    def refit_with_effect(self, parent: WeighedFit, effect: Effect, against: float = 0.0) -> Extended:
        """Refit a candidate with one more effect, in its likely variants (discrete choices, such as of scans), once.

        Returns the fit of the best variant, with the evidence averaged over all variants and reduced by `against` nats;
        and the effect's log Bayes factor by screening, by noise model.
        """
        if (before := self.earlier_refit(parent, effect, against)) is not None:
            return before
        templates = self.templates.templates_of(parent.found, effect)
        bank, odds = TemplateBank.of(templates.columns, [effect.name] * len(templates.columns)), templates.variant_odds

        @cache
        def screened(law: NoiseLaw) -> tuple[Linearised, FloatArray]:
            problem = Linearised.of(parent.found, law)
            return problem, bank.log_bayes_factors(problem)[:, 0]

        by_noise = {noise: log_mean_exp(screened(e.likeliest_law)[1]) for noise, e in parent.leading_noises()}
        own_law = self.likeliest_law(parent)
        seen = [screened(own_law)]
        # Under heavy-tailed noise, a few readings changed by an effect count as outliers: start from white noise too.
        law = parent.evidence[self.noises.certain].likeliest_law
        if not law.is_practically_equal(seen[0][0].law):
            seen.append(screened(law))
        weights = templates.variant_probabilities(seen[0][1])
        likeliest = (int(np.argmax(templates.variant_probabilities(scores))) for _, scores in seen[1:])
        tried = list(dict.fromkeys([*_variants_to_refit(templates, weights), *likeliest]))
        refitted = [self._refit_variant(parent, effect, templates, k, seen) for k in tried]
        # Evidence from refits of variants replaces that from screening.
        log_z = np.array([candidate.log_z for candidate in refitted])
        best = _variant_to_show(log_z, [templates.variants[k] for k in tried])
        if np.isfinite(log_z[best]):  # otherwise no variant could be fitted, and weights are unchanged
            weights = weights / weights[tried[0]] * odds[tried[0]] * np.exp(log_z[0] - log_z[best])
            weights[tried] = odds[tried] * np.exp(log_z - log_z[best])
            weights /= weights.sum()
        of_best = math.log(weights[tried[best]]) - math.log(odds[tried[best]])
        log_share = parent.log_share - of_best - math.log(odds.sum()) - against + math.log(effect.n_peaks)
        # Noise with memory imitates a missing effect: what it leaves of the parent may be white about the refit, where
        # a change point is far better known. To first order: only where that leads to the variant of the best refit.
        law = self.likeliest_law(refitted[best])
        if len(weights) > 1 and not law.is_practically_equal(seen[0][0].law):
            later = next((scores for about, scores in seen if law.is_practically_equal(about.law)), None)
            probabilities = templates.variant_probabilities(screened(law)[1] if later is None else later)
            weights = probabilities if int(np.argmax(probabilities)) == tried[best] else weights
        extended = refitted[best].with_variant_factor_and_weights(log_share, {**parent.weights, effect.name: weights})
        self.known[parent.n_gaussians, parent.names, effect, against] = parent, (extended, by_noise)
        return extended, by_noise

    def earlier_refit(self, parent: WeighedFit, effect: Effect, against: float = 0.0) -> Extended | None:
        """Return a refit made before, also that of a fit as good to three nats; None if there is none."""
        before = self.known.get((parent.n_gaussians, parent.names, effect, against))
        return None if before is None or parent.log_z > before[0].log_z + ENOUGH_NATS else before[1]

    def _refit_variant(
        self,
        parent: WeighedFit,
        effect: Effect,
        templates: EffectTemplates,
        variant: int,
        seen: Sequence[tuple[Linearised, FloatArray]],
    ) -> WeighedFit:
        """Refit with one variant of one more effect, from its best templates by each linearisation in `seen`."""
        own = np.flatnonzero(templates.choice == variant)
        model = parent.found.model.with_effect(templates.variants[variant])
        starts: list[FloatArray] = []
        for about, scores in seen:
            ranked = own[np.argsort(-scores[own])]
            for at in ranked[: 2 if scores[ranked[0]] > 5 else 1]:
                columns = templates.columns[at]
                amount = _amplitudes_in_residual(about.project(columns), about.residual)
                setting = effect.start(templates.settings[at], amount)
                # To first order, an effect without amplitude, present as a whole, may be fitted by another fraction.
                for taken in (amount,) if effect.amplitudes else (amount, np.ones_like(amount)):
                    z = parent.found.z + about.absorbing_shift(parent.found, columns @ taken)
                    start = np.concatenate([z, model.z_of_last_effect(setting[None, :])[0]])
                    if all(np.abs(start - other).max() > 0.1 for other in starts):  # prior sds: else a duplicate
                        starts.append(start)
        if self.given_null is not None and len(self.given_null.starts) > 1:
            # With several modes of the null, the best one may change with the effect.
            starts += [np.concatenate([z, starts[0][len(z) :]]) for z in self.given_null.starts]
        fitted = [self.fit_and_weigh(model, np.stack(starts), seen[0][0].law, beyond=parent)]
        if seen[0][0].law.has_memory:  # to a walk a slow effect is noise: its amplitude would stay at 0
            plain = self.noises.certain
            for about, scores in seen[1:]:
                promised = parent.evidence[plain].log_z + log_mean_exp(scores)
                if fitted[0].evidence[plain].log_z < promised - ENOUGH_NATS:
                    fitted.append(self.fit_and_weigh(model, np.stack(starts), about.law, beyond=parent))
        return max(fitted, key=lambda candidate: self.noises.average_log_evidence(candidate.log_z_by_noise))


def _amplitudes_in_residual(projected: FloatArray, residual: FloatArray) -> FloatArray:
    """Fit the amplitudes, (n_columns,), of projected columns, (n_rows, n_columns), to a residual.

    Several columns have a normal prior. An effect of one value per run is collinear in its sum with a parameter: by
    least squares alone all runs would start far off, the parameter as far on the other side, and the fit stay there.
    """
    n = projected.shape[1]
    if n > 1:
        projected = np.concatenate([projected, np.eye(n) / SCALES[-1]])
        residual = np.append(residual, np.zeros(n))
    return np.asarray(np.linalg.lstsq(projected, residual)[0], dtype=np.float64)


def _variant_to_show(log_z: FloatArray, variants: Sequence[Effect]) -> int:
    """Return the index of the refitted variant that stands for all of them: the best, or one with a scale in common.

    Values per run that are each of their own size are pulled to zero where readings leave their sum open, so that few
    differ. If values of one size explain about as much, these stand for both: their intervals leave it open too.
    """
    best = int(np.argmax(log_z))
    shared = (k for k, variant in enumerate(variants) if isinstance(variant.prior, SharedScalePrior))
    return next((k for k in shared if log_z[k] > log_z[best] - ENOUGH_NATS), best)


def _variants_to_refit(templates: EffectTemplates, weights: FloatArray) -> list[int]:
    """List the variants to refit, by number: all of two; else the best and, if bound to scans and likely, the next."""
    ranked: list[int] = np.argsort(-weights).tolist()
    if len(weights) <= 3:  # screening is no judge of a bound
        return ranked
    # Two scans of opposite direction are aliased to first order; a refit shows which one was turned.
    first, second = ranked[:2]
    bound = templates.variants[first].scans or templates.variants[first].patterns
    return [first, second] if bound and weights[second] > 0.05 * weights[first] else [first]


_TIE = 0.01  # nats between hypotheses that are one: a fit stops when a step gains less than half of it


@dataclass(frozen=True, eq=False)
class Evidences:
    """Log evidences of hypotheses: pairs of the effects on the mean, and on the noise.

    The mean UNKNOWN stands for an unknown effect, alone or with others; the SSF order is the number of Gaussians.
    `fits`: refits by (SSF order, mean), with their evidence by noise; `screened`: combinations not refitted, by
    templates: (mean, noise) -> log evidence; `unknown`: unknown effects added to fits: (SSF order, mean, noise) -> log
    evidence; `unknown_shares`: share of each family of bases, such as "time", in the evidence of an unknown effect.
    """

    fits: Mapping[tuple[int, Names], WeighedFit]
    screened: Mapping[EffectNames, float] = field(default_factory=dict)
    unknown: Mapping[tuple[int, Names, Names], float] = field(default_factory=dict)
    unknown_shares: Mapping[str, float] = field(default_factory=dict)

    def named_outweigh_unknown(self, order: int, names: Names, noise: Names) -> bool:
        """Return whether the named effects gain more evidence over the null than everything without a name over them.

        Without a name are the unknown effect, and the effects of `names` that are out of vocabulary; if all of `names`
        are, only the unknown effect counts. The comparison is at one SSF order, under one noise model.
        """
        named = tuple(name for name in names if not is_out_of_vocabulary(name)) or names
        if not names or not {(order, ()), (order, named)} <= self.fits.keys():
            return False
        nothing, own = (self.fits[order, key].evidence[noise].log_z for key in ((), named))
        return own - nothing > self.unknown[order, names, noise] - own

    def reported_as(self, mean: Names) -> Names:
        """Return the names by which a combination is reported: UNKNOWN if any of its effects has no name.

        Its named part is reported instead if that alone has over half of the gain over the null.
        """
        named = tuple(name for name in mean if not is_out_of_vocabulary(name))
        if mean == UNKNOWN or named == mean:
            return mean
        nothing, own, whole = (
            max((fit.log_z for (_, key), fit in self.fits.items() if key == names), default=-math.inf)
            for names in ((), named, mean)
        )
        return named if named and own - nothing > 0.5 * (whole - nothing) else UNKNOWN

    def best_formula_beside(self, fit: WeighedFit, noise: Names) -> WeighedFit | None:
        """Return the refit of largest evidence that adds formulas alone to the effects of another fit, if any."""
        options = [
            more
            for (n, names), more in self.fits.items()
            if n == fit.n_gaussians
            and {*fit.names} < {*names}
            and all(name.startswith(PROPOSAL) for name in {*names} - {*fit.names})
        ]
        return max(options, key=lambda more: more.evidence[noise].log_z, default=None)

    def only_outlying_readings_differ(self, prior: PriorOdds, certain: Names) -> bool:
        """Return whether effects on the mean that beat outlying readings change no other readings than those.

        Outlying readings are beyond doubt then without an effect, at odds of 1000. Jumps before the last reading, or
        delays past the first, are many ways to say the same of fewer than five rows; the others differ by less than the
        three nats that tell aliases apart.
        """
        noise = tuple(sorted({outliers.name, *certain}))
        nulls = [fit for (_, names), fit in self.fits.items() if not names and {noise, certain} <= fit.evidence.keys()]
        if not nulls:
            return False
        null = max(nulls, key=lambda fit: fit.at_likelier_sd(noise).log_z)
        evidence = null.at_likelier_sd(noise)
        least, law = evidence.log_z, evidence.likeliest_law
        odds = prior.log_prior_on_noise((outliers.name,)) - prior.log_prior_on_noise(())
        rivals = [fit for (_, names), fit in self.fits.items() if names and fit.log_z > least]
        if not rivals or not least - max(fit.at_likelier_sd(certain).log_z for fit in nulls) + odds > math.log(1000):
            return False
        narrow = 1 - outlier_probabilities(null.found.residuals, law)
        sd = law.likeliest_sigma_of(null.found.residuals)
        apart = (law(fit.found.predicted - null.found.predicted) / sd for fit in rivals)
        return all(
            0.5 * float(narrow @ change**2) < ENOUGH_NATS and np.count_nonzero(np.abs(change) > 1) < ROWS_OF_A_SIDE
            for change in apart
        )

    def split_by_sd(self, changed: NoiseEffect) -> Evidences:
        """Return a copy with two noise models for each: with the noise sd of the calibration, and with another.

        Beside an effect that was not refitted, or an unknown one, the sd is that of the largest part that was.
        """
        fits = {key: fit.split_by_sd(changed) for key, fit in self.fits.items()}

        @cache
        def part_of(mean: Names) -> tuple[int, Names]:
            parts = [key for key in fits if {*key[1]} <= {*mean}]
            return max(parts, key=lambda key: (len(key[1]), self.fits[key].log_z))

        def shares(key: tuple[int, Names], noise: Names) -> Iterator[tuple[Names, float]]:
            whole = self.fits[key].evidence[noise].log_z
            return ((own, fits[key].evidence[own].log_z - whole) for own in (noise, _changed(noise)))

        screened = {
            (mean, own): value + share
            for (mean, noise), value in self.screened.items()
            for own, share in shares(part_of(mean), noise)
        }
        unknown = {
            (n, mean, own): value + share
            for (n, mean, noise), value in self.unknown.items()
            for own, share in shares((n, mean), noise)
        }
        return Evidences(fits, screened, unknown, self.unknown_shares)

    def with_log_evidence_shifted(self, gaps: Mapping[tuple[int, Names], float]) -> Evidences:
        """Return a copy with fits, with and without an unknown effect, shifted by `gaps`, nats by (order, mean)."""
        fits = {key: fit.with_log_evidence_shifted(gaps[key]) if key in gaps else fit for key, fit in self.fits.items()}
        unknown = {(n, mean, noise): v + gaps.get((n, mean), 0.0) for (n, mean, noise), v in self.unknown.items()}
        return replace(self, fits=fits, unknown=unknown)


@dataclass(frozen=True, eq=False)
class HypothesisProbabilities:
    """Probabilities of hypotheses by (names on the mean, names on the noise)."""

    probabilities: Mapping[EffectNames, float]

    @property
    def marginal_over_noise(self) -> dict[Names, float]:
        """Probability of each hypothesis on the mean, marginalised over noise models."""
        return _sums((mean, p) for (mean, _), p in self.probabilities.items())

    def likeliest_noise(self, stated: Names | None = None) -> Names:
        """Return the names of the most probable noise model, of all or of those with just the `stated` effects."""
        marginal = _sums(
            (noise, p)
            for (_, noise), p in self.probabilities.items()
            if stated is None or noise_effects_in_vocabulary(noise) == stated
        )
        return max(marginal, key=lambda noise: marginal[noise])


def hypothesis_probabilities(evidences: Evidences, prior: PriorOdds, *, certain: Names) -> HypothesisProbabilities:
    """Convert evidences to probabilities of hypotheses, summed over SSF orders (numbers of Gaussians)."""
    outlying = evidences.only_outlying_readings_differ(prior, certain)
    of_fits = (
        ((names, noise), or_impossible(evidence.log_z))
        for (_, names), candidate in evidences.fits.items()
        if not (names and outlying)
        for noise, evidence in candidate.evidence.items()
    )
    log_p = {k: value + prior.log_prior_on_mean(k[0]) for k, value in _sums(of_fits, of_logs=True).items()}
    for (n, names, noise), value in evidences.unknown.items():
        if names and outlying:
            continue
        # A named effect remains named if a smaller unknown one is left.
        key = (names if evidences.named_outweigh_unknown(n, names, noise) else UNKNOWN), noise
        value = or_impossible(value) + prior.log_prior_with_unknown(names)
        log_p[key] = float(np.logaddexp(log_p.get(key, -np.inf), value))
    for (names, noise), value in evidences.screened.items() if not outlying else ():
        log_p[names, noise] = or_impossible(value) + prior.log_prior_on_mean(names)
    n_forms = sum(not names for _, names in evidences.fits)
    for names, noise in log_p:
        log_p[names, noise] += prior.log_prior_on_noise(tuple(n for n in noise if n not in certain)) - math.log(n_forms)
    # Exact aliases differ by how far their fits went: within a hundredth of a nat they tie. Of those that tie the one
    # with fewer effects, on a reading before a parameter or a rate, comes first.
    level = math.inf
    for key in sorted(log_p, key=lambda key: -log_p[key]):
        level = level if level - log_p[key] < _TIE else log_p[key]
        log_p[key] = level
    plainness = {names: (len(names), sum(name.count(":") for name in names), names) for key in log_p for names in key}
    log_p = dict(sorted(log_p.items(), key=lambda item: (-item[1], *(plainness[names] for names in item[0]))))
    total = float(logsumexp(list(log_p.values())))
    return HypothesisProbabilities({key: math.exp(value - total) for key, value in log_p.items()})


@dataclass(frozen=True, eq=False)
class MisfitTemplates:
    """Templates by which a fit is tested for misfits: of effects, and of the basis functions of unknown effects.

    All are built about one fit (`about`), since fits to a recording predict much the same, and a test is valid with any
    templates. `covariates` are those of the basis functions.
    """

    about: Fit
    unknown_bases: TemplateBank
    covariates: tuple[Covariate, ...]


@dataclass(frozen=True, eq=False)
class Searched:
    """Result of a search; `refits` are all refits, for another search of the same recording."""

    prepared: Prepared
    prior: PriorOdds
    misfit_templates: MisfitTemplates
    refits: Refits
    evidences: Evidences
    posterior: HypothesisProbabilities

    @property
    def certain(self) -> Names:
        """Names of the noise effects beyond doubt, which are part of every noise model."""
        return self.refits.noises.certain

    def log_posterior(self, fit: WeighedFit) -> float:
        """Return a fit's unnormalised log posterior: its log evidence plus the log prior of its effects."""
        return fit.log_z + self.prior.log_prior_on_mean(fit.names)

    def with_evidences(self, evidences: Evidences) -> Searched:
        """Return the result with other evidences, and the probabilities that follow from them."""
        posterior = hypothesis_probabilities(evidences, self.prior, certain=self.certain)
        return replace(self, evidences=evidences, posterior=posterior)

    def with_prior_probabilities(self) -> Searched:
        """Return the result with prior instead of posterior probabilities, for readings without information."""
        on_mean = [
            name
            for name in self.prepared.effects
            if name not in self.prepared.noise_effect_names
            and not is_out_of_vocabulary(name)
            and name_of_first_copy(name) is None
        ]
        return replace(self, posterior=HypothesisProbabilities(self.prior.single_effect_priors(on_mean, self.certain)))

    def best_refit_of(self, names: Names, noise: Names) -> WeighedFit | None:
        """Return the refit of these effects with the number of Gaussians of largest evidence under a noise, if any."""
        options = [fit for (_, key), fit in self.evidences.fits.items() if key == names]
        return max(options, key=lambda fit: fit.evidence[noise].log_z, default=None)

    def combinations_aliased_with(self, names: Names) -> frozenset[Names]:
        """Return the combinations aliased with one at some SSF order: expected to be below three nats apart."""
        fits = self.evidences.fits
        return frozenset(
            key
            for (n, key), other in fits.items()
            if names and key and key != names and (n, names) in fits
            if expected_log_bayes_factor(fits[n, names], other) < ENOUGH_NATS
        )

    def likeliest_fit_beside_unknown(self, noise: Names) -> WeighedFit | None:
        """Return the fit by names alone that, with an unknown effect added, is most probable under a noise, if any."""
        scores = {
            (n, names): value + self.prior.log_prior_with_unknown(names)
            for (n, names, own), value in self.evidences.unknown.items()
            if own == noise and not effects_out_of_vocabulary(names)
        }
        return self.evidences.fits[max(scores, key=lambda key: scores[key])] if scores else None

    def effect_probabilities_given_unknown(self) -> dict[str, float]:
        """Return, by effect, the probability that it acts too, given that an unknown effect acts."""
        scores = {
            (order, names, noise): value
            + self.prior.log_prior_with_unknown(names)
            + self.prior.log_prior_on_noise(tuple(n for n in noise if n not in self.certain))
            for (order, names, noise), value in self.evidences.unknown.items()
            if not self.evidences.named_outweigh_unknown(order, names, noise)
        }
        top = max(scores.values(), default=0.0)
        weights = {key: math.exp(score - top) for key, score in scores.items()}
        total = sum(weights.values())
        return _sums((name, weight / total) for (_, names, _), weight in weights.items() for name in names)

    def noise_probabilities_given_unknown(self) -> dict[str, float]:
        """Return, by effect on the noise, the probability that it acts, given that what acts on the mean is unknown."""
        unknown = _sums(
            (noise, p)
            for (mean, noise), p in self.posterior.probabilities.items()
            if self.evidences.reported_as(mean) == UNKNOWN
        )
        total = sum(unknown.values()) or 1.0
        return _sums((name, p / total) for noise, p in unknown.items() for name in noise)

    def template_banks_for_global_test(self, found: Fit) -> list[TemplateBank]:
        """Return the two banks by which a fit is tested: of the effects that it lacks, and of unknown effects.

        Formulas are left out: of hundreds, the search keeps those that these readings favour, and draws under the null
        would favour others. With them a p-value would be too small.
        """
        missing = [
            effect
            for name, effect in self.prepared.effects.items()
            if effect.stage is not Stage.NOISE and not name.startswith(PROPOSAL) and name not in found.model.names
        ]
        own = self.misfit_templates
        return [self.refits.templates.coarse_bank(own.about, missing), own.unknown_bases]

    @property
    def likeliest_order(self) -> int:
        """The most probable number of Gaussians (SSF order), over all refits, with and without an unknown effect."""
        terms = [(n, self.log_posterior(fit)) for (n, _), fit in self.evidences.fits.items()]
        for (n, names, _), value in self.evidences.unknown.items():
            terms.append((n, value + self.prior.log_prior_with_unknown(names)))
        by_order = _sums(terms, of_logs=True)
        return max(by_order, key=lambda n: by_order[n])

    @property
    def null(self) -> WeighedFit:
        """The fit of the null with the likeliest number of Gaussians."""
        return self.evidences.fits[self.likeliest_order, ()]

    def leading_combination_out_of_vocabulary(self) -> Names:
        """Return the most probable combination with a formula out of vocabulary, if it beats one without; else ()."""
        by_mean = self.posterior.marginal_over_noise
        own = {names: p for names, p in by_mean.items() if effects_out_of_vocabulary(names)}
        refitted = {names for _, names in self.evidences.fits}
        leader = max(own, key=lambda names: own[names], default=())
        return leader if leader in refitted and own.get(leader, 0.0) > by_mean.get(UNKNOWN, 0.0) else ()

    def probabilities_of_unknown_forms(self, *, besides: Names = ()) -> dict[str, float]:
        """Return the share of each form of an unknown effect: effects out of vocabulary, families of bases.

        `besides`: effects out of vocabulary that do not count as unknown.
        """
        by_mean = self.posterior.marginal_over_noise
        unknown = by_mean.get(UNKNOWN, 0.0)
        terms = [(family, unknown * p) for family, p in self.evidences.unknown_shares.items()]
        rare = [(effects_out_of_vocabulary(names), p) for names, p in by_mean.items()]
        shares = _sums([*terms, *((name, p) for names, p in rare if names != besides for name in names)])
        total = sum(shares.values()) or 1.0
        return {name: p / total for name, p in shares.items()}
