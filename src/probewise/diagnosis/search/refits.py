"""Joint nonlinear refits with Laplace evidence: of a model, or of a candidate with one more effect."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.bank import TemplateBank
from probewise.diagnosis.evidence.convergence import checked_finite_fit
from probewise.diagnosis.evidence.detectable import log_probability_effects_detectable
from probewise.diagnosis.evidence.laplace import SCALES, Linearised
from probewise.diagnosis.evidence.screening import log_bayes_factors_by_label, log_mean_exp
from probewise.diagnosis.evidence.templates import EffectTemplates, TemplateCache
from probewise.diagnosis.fitting.fit import Fit, Model, fit, fit_each_start
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.names import Names
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.search.constants import (
    ALIASED_NATS,
    FEW_VARIANTS,
    HOPELESS,
    SAME_MODE,
    STEERING,
    VARIANTS_TRIED,
)
from probewise.diagnosis.search.noises import NoiseModels
from probewise.diagnosis.search.twins import TwinSwap, are_proportional
from probewise.diagnosis.search.weighed_fit import WeighedFit
from probewise.effects import NamedEffect
from probewise.effects.priors import SharedScalePrior

Extended: TypeAlias = tuple[WeighedFit, dict[Names, float]]
"""A candidate with one more effect, and the closed-form scores of the effect by noise model."""

_SAME_START = 0.1  # in prior sds: starts that are closer together are duplicates


@dataclass(frozen=True, eq=False)
class Refits:
    """The refits of one recording, each made once; a second search of the recording reuses them.

    `sensor` is the given null, if any; `templates` caches the templates of effects about fits.
    """

    sensor: Null | None
    noises: NoiseModels
    templates: TemplateCache
    known: dict[tuple[WeighedFit, NamedEffect[Any], float], Extended] = field(default_factory=dict, repr=False)
    """Refits with one more effect, by the candidate, the effect, and the nats against it."""
    twins: dict[WeighedFit, tuple[WeighedFit, TwinSwap]] = field(default_factory=dict, repr=False)
    """Refits taken from those of twins, with the refit and the exchange of effects."""
    plain: dict[WeighedFit, WeighedFit | None] = field(default_factory=dict, repr=False)
    """Nulls as fitted under the plainest noise, where they predict otherwise."""
    scored: dict[tuple[Fit, NoiseLaw, TemplateBank], dict[str, FloatArray]] = field(default_factory=dict, repr=False)
    """Log Bayes factors of the templates of a bank, by label."""

    def log_bayes_factors_by_label(self, found: Fit, law: NoiseLaw, bank: TemplateBank) -> dict[str, FloatArray]:
        """Return the log Bayes factors of a bank's templates about a fit under noise `law`, by label; cached."""
        key = found, law, bank
        if key not in self.scored:
            self.scored[key] = log_bayes_factors_by_label(Linearised.of(found, law), bank)
        return self.scored[key]

    def likeliest_law(self, candidate: WeighedFit) -> NoiseLaw:
        """Return the noise distribution of a candidate's most probable noise model."""
        return self.noises.best_evidence(candidate.evidence).likeliest_law

    def fit_and_weigh(
        self,
        model: Model,
        starts: FloatArray,
        law: NoiseLaw,
        max_steps: int = 30,
        *,
        beyond: WeighedFit | None = None,
    ) -> WeighedFit:
        """Fit a model from the best of `starts`, (n_starts, n_params), and compute its evidence under all noise models.

        The fit is under `law`, and is repeated if another noise distribution proves more probable. A fit that is not
        significantly better than the fit `beyond` takes over its evidence, to save the computation, unless the noise
        has memory: there the fit may still gain under white noise.
        """
        found = self._fit_from_best_start(model, starts, law, max_steps)
        if beyond is not None and not law.has_memory and not _improves_fit(found, beyond.found, law):
            plain = beyond.with_log_evidence_shifted(-beyond.log_prior_factor).evidence
            return WeighedFit.of(found, law, plain, beyond.log_detectable)
        for _ in range(2):
            evidence = self.noises.evidence_by_noise(found)
            best = self.noises.best_evidence(evidence).likeliest_law
            if best.is_practically_equal(law):
                break
            law = best
            found = self._fit_from_best_start(model, found.z[None, :], law, max_steps)
        else:
            evidence = self.noises.evidence_by_noise(found)
        return WeighedFit.of(
            found, law, evidence, log_probability_effects_detectable(found, law, self.templates.usable)
        )

    def fits_better_at_z(self, model: Model, z: FloatArray, candidate: WeighedFit) -> bool:
        """Return whether a candidate's model, its effects in any order, fits better at z (n_params,) than its fit."""
        found, law = candidate.found, candidate.law
        readings = found.predicted + found.residuals
        predicted = model.predict(z[None, :])[0, self.templates.usable]
        with np.errstate(all="ignore"):  # of predictions that ran away: no number is less
            whitened = law(readings - predicted)[:, None]
            there = float(law.minus_log_likelihood(whitened, law.likeliest_sigma(whitened))[0]) + 0.5 * float(z @ z)
        return there < found.objective - SAME_MODE

    def null_under_simplest_noise(self, null: WeighedFit) -> WeighedFit | None:
        """Return the given null refitted under the simplest noise, with no effects but those beyond doubt.

        None if that predicts the same, if the most probable noise has no memory, or if no null is given.
        """
        if self.sensor is None or not self.likeliest_law(null).has_memory:
            return None
        if null not in self.plain:
            law = null.evidence[self.noises.certain].likeliest_law
            found = self._fit_from_best_start(null.found.model, np.stack([null.found.z, *self.sensor.starts]), law, 30)
            apart = float(np.sum(law(found.residuals - null.found.residuals) ** 2))
            alike = apart < 2 * ALIASED_NATS * found.sd**2
            self.plain[null] = None if alike else WeighedFit.of(found, law, self.noises.evidence_by_noise(found), 0.0)
        return self.plain[null]

    def refit_with_effect(self, parent: WeighedFit, effect: NamedEffect[Any], against: float = 0.0) -> Extended:
        """Refit a candidate with one more effect, in its likely variants (discrete choices, such as of scans).

        A refit made before is returned as it was; an effect that changes the readings exactly as one refitted before
        takes over that fit and evidence.

        Returns
        -------
        The fit of the best variant, with the evidence averaged over all variants and reduced by `against` nats; and the
        effect's log Bayes factor by screening, by noise model.
        """
        key = parent, effect, against
        if key not in self.known:
            twin = self._refit_taken_from_twin(parent, effect, against) or self._refit_taken_from_parents_twin(
                parent, effect, against
            )
            self.known[key] = twin or self._refit_with_likely_variants(parent, effect, against)
        return self.known[key]

    def replace_fit(self, held: WeighedFit, better: WeighedFit) -> None:
        """Use the fit `better` in place of `held`, of the same combination, in later calls of `refit_with_effect`."""
        self.known.update({key: (better, scores) for key, (fit, scores) in self.known.items() if fit is held})

    def _refit_taken_from_twin(self, parent: WeighedFit, effect: NamedEffect[Any], against: float) -> Extended | None:
        """Take over an earlier refit of the parent with an effect of proportional templates (a twin); None: no twin."""
        own = self.templates.templates_of(parent.found, effect)
        for (held, other, less), (candidate, scores) in list(self.known.items()):
            if (
                held is parent
                and less == against
                and are_proportional(own, self.templates.templates_of(held.found, other))
            ):
                swap = TwinSwap(other.name, self.templates.templates_of(held.found, other), effect.name, own)
                twin = swap.candidate_with_twin(candidate, self.templates.usable)
                if twin is not None:
                    self.twins[twin] = candidate, swap
                    return twin, scores
        return None

    def _refit_taken_from_parents_twin(
        self, parent: WeighedFit, effect: NamedEffect[Any], against: float
    ) -> Extended | None:
        """Take over a refit of this effect where the parent's last effect is replaced by its twin; None: no twin."""
        first, swap = self.twins.get(parent, (None, None))
        known = None if first is None else self.known.get((first, effect, against))
        if known is None or swap is None:
            return None
        twin = swap.candidate_with_twin(known[0], self.templates.usable)
        return None if twin is None else (twin, known[1])

    def _refit_with_likely_variants(self, parent: WeighedFit, effect: NamedEffect[Any], against: float) -> Extended:
        templates = self.templates.templates_of(parent.found, effect)
        own = TemplateBank.of(templates.columns, [effect.name] * len(templates.columns), len(parent.found.residuals))

        def log_bayes_factors_about(problem: Linearised) -> FloatArray:
            return log_bayes_factors_by_label(problem, own)[effect.name]

        by_noise = {
            noise: log_mean_exp(log_bayes_factors_about(Linearised.of(parent.found, evidence.likeliest_law)))
            for noise, evidence in parent.leading_noises()
        }
        problem = Linearised.of(parent.found, self.likeliest_law(parent))
        scores = log_bayes_factors_about(problem)
        weights = templates.variant_probabilities(scores)
        # Under heavy-tailed noise, a few readings changed by an effect count as outliers; so start from white noise
        # too.
        plain = self._linearised_under_simplest_noise(parent, problem)
        seen = [(problem, scores), *((about, log_bayes_factors_about(about)) for about in plain)]
        likeliest = (int(np.argmax(templates.variant_probabilities(own_scores))) for _, own_scores in seen[1:])
        tried = list(dict.fromkeys([*_variants_to_refit(templates, weights), *likeliest]))
        refitted = [self._refit_variant(parent, effect, templates, k, seen) for k in tried]
        odds = templates.variant_odds
        # Evidence from refits of variants replaces that from screening.
        log_z = np.array([candidate.log_z for candidate in refitted])
        best = _variant_to_show(log_z, [templates.variants[k] for k in tried])
        if np.isfinite(log_z[best]):  # otherwise no variant could be fitted, and weights are unchanged
            weights = weights / weights[tried[0]] * odds[tried[0]] * np.exp(log_z[0] - log_z[best])
            weights[tried] = odds[tried] * np.exp(log_z - log_z[best])
            weights /= weights.sum()
        of_best = math.log(weights[tried[best]]) - math.log(odds[tried[best]])
        log_share = parent.log_share - of_best - math.log(odds.sum()) - against
        log_share += math.log(effect.n_peaks)
        # Noise with memory imitates a missing effect: what it leaves of the parent may be white about the refit, where
        # a change point is far better known. To first order: only where that leads to the variant of the best refit.
        law = self.likeliest_law(refitted[best])
        if len(weights) > 1 and not law.is_practically_equal(problem.law):
            later = next((own_scores for about, own_scores in seen if law.is_practically_equal(about.law)), None)
            later = templates.variant_probabilities(
                log_bayes_factors_about(Linearised.of(parent.found, law)) if later is None else later
            )
            weights = later if int(np.argmax(later)) == tried[best] else weights
        return refitted[best].with_variant_factor_and_weights(
            log_share, {**parent.weights, effect.name: weights}
        ), by_noise

    def _fit_from_best_start(self, model: Model, starts: FloatArray, law: NoiseLaw, max_steps: int) -> Fit:
        """Fit a few steps from each start, (n_starts, n_params), then to convergence from the best."""
        recording = self.noises.recording
        if len(starts) > 1:
            best = min(fit_each_start(model, recording, list(starts), law, max_steps=5), key=lambda f: f.objective)
            if best.settled:
                return checked_finite_fit(best)
            starts = best.z[None, :]
        return checked_finite_fit(
            fit(model, recording, starts[0], law, max_steps=max_steps, hopeless_above=self._hopeless_above(model))
        )

    def _hopeless_above(self, model: Model) -> float:
        """Return the objective above which a fit is too far behind the best refit to matter; infinite without a law.

        A law is integrated at every step of a fit. Elsewhere a fit costs too little to be worth giving up.
        """
        if not model.sensor.predicts_cheaply_nearby:
            return math.inf
        return min((candidate.found.objective for candidate, _ in self.known.values()), default=math.inf) + HOPELESS

    def _refit_variant(
        self,
        parent: WeighedFit,
        effect: NamedEffect[Any],
        templates: EffectTemplates,
        variant: int,
        seen: Sequence[tuple[Linearised, FloatArray]],
    ) -> WeighedFit:
        """Refit with one variant of one more effect, from its best templates by each linearisation in `seen`."""
        own = np.flatnonzero(templates.choice == variant)
        model = parent.found.model.with_effect(templates.variants[variant])
        ranked = [(about, scores, own[np.argsort(-scores[own])]) for about, scores in seen]
        chosen = [(about, at) for about, scores, best in ranked for at in best[: 2 if scores[best[0]] > 5 else 1]]
        starts: list[FloatArray] = []
        for about, at in chosen:
            columns = templates.columns[at]
            amount = _amplitudes_in_residual(about.project(columns), about.residual)
            setting = effect.start(templates.settings[at], amount)
            # An effect without amplitude is present as a whole; to first order, its fitted fraction may differ from
            # one.
            for taken in (amount,) if effect.amplitudes else (amount, np.ones_like(amount)):
                z = parent.found.z + about.absorbing_shift(parent.found, columns @ taken)
                start = np.concatenate([z, model.z_of_last_effect(setting[None, :])[0]])
                if all(np.abs(start - other).max() > _SAME_START for other in starts):
                    starts.append(start)
        if self.sensor is not None and len(self.sensor.starts) > 1:
            # With several modes of the null, the best one may change with the effect.
            starts += [np.concatenate([z, starts[0][len(z) :]]) for z in self.sensor.starts]
        fitted = [self.fit_and_weigh(model, np.stack(starts), seen[0][0].law, beyond=parent)]
        if seen[0][0].law.has_memory:  # to a walk a slow effect is noise: its amplitude would stay at 0
            plain = self.noises.certain
            for about, scores in seen[1:]:
                promised = parent.evidence[plain].log_z + log_mean_exp(scores)
                if fitted[0].evidence[plain].log_z < promised - STEERING:
                    fitted.append(self.fit_and_weigh(model, np.stack(starts), about.law, beyond=parent))
        return max(fitted, key=lambda candidate: self.noises.average_log_evidence(_log_z_by_noise(candidate)))

    def _linearised_under_simplest_noise(self, parent: WeighedFit, problem: Linearised) -> list[Linearised]:
        """Linearise a fit under the simplest noise: one problem; none if `problem` is under the same noise."""
        plain = parent.evidence[self.noises.certain].likeliest_law
        return [] if plain.is_practically_equal(problem.law) else [Linearised.of(parent.found, plain)]


def _amplitudes_in_residual(projected: FloatArray, residual: FloatArray) -> FloatArray:
    """Fit the amplitudes, (n_columns,), of projected columns, (n_rows, n_columns), to a residual.

    Several columns have a normal prior. An effect of one value per run is collinear in its sum with a parameter: by
    least squares alone all runs would start far off, the parameter as far on the other side, and the fit stay there.
    """
    n = projected.shape[1]
    if n == 1:
        return np.asarray(np.linalg.lstsq(projected, residual)[0], dtype=np.float64)
    prior = np.eye(n) / SCALES[-1]
    return np.asarray(np.linalg.lstsq(np.concatenate([projected, prior]), np.append(residual, np.zeros(n)))[0])


def _log_z_by_noise(candidate: WeighedFit) -> dict[Names, float]:
    return {noise: evidence.log_z for noise, evidence in candidate.evidence.items()}


def is_significantly_better(candidate: WeighedFit, parent: WeighedFit) -> bool:
    """Return whether a candidate's log likelihood exceeds that of `parent` by more than 1.5 nats."""
    return _improves_fit(candidate.found, parent.found, candidate.law)


def _improves_fit(found: Fit, beyond: Fit, law: NoiseLaw) -> bool:
    def minus_log_likelihood(fitted: Fit) -> float:
        whitened = law(fitted.residuals)[:, None]
        return float(law.minus_log_likelihood(whitened, law.likeliest_sigma(whitened))[0])

    return 2 * (minus_log_likelihood(beyond) - minus_log_likelihood(found)) > 3.0


def _variant_to_show(log_z: FloatArray, variants: Sequence[NamedEffect[Any]]) -> int:
    """Return the index of the refitted variant that stands for all of them: the best, or one with a scale in common.

    Values per run that are each of their own size are pulled to zero where readings leave their sum open, so that few
    differ. If values of one size explain about as much, these stand for both: their intervals leave it open too.
    """
    best = int(np.argmax(log_z))
    for k, variant in enumerate(variants):
        if isinstance(variant.prior, SharedScalePrior) and log_z[k] > log_z[best] - ALIASED_NATS:
            return k
    return best


def _variants_to_refit(templates: EffectTemplates, weights: FloatArray) -> list[int]:
    """List the numbers of an effect's variants (discrete choices, such as of scans) to refit, best first.

    All of one or two; of more, the best, and the next too if bound to scans and of a twentieth of the best's weight.
    """
    if len(weights) <= FEW_VARIANTS:
        return [int(k) for k in np.argsort(-weights)]
    # Two scans of opposite direction are aliased to first order; a refit shows which one was turned.
    first, *others = np.argsort(-weights)[:2].tolist()
    bound = templates.variants[first].scans or templates.variants[first].patterns
    return [first, *(k for k in others if bound and weights[k] > VARIANTS_TRIED * weights[first])]
