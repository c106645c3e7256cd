"""Posterior samples of refitted hypotheses: of one, or averaged over several by their probability, in one model.

Predictions must include the uncertainty between hypotheses: for readings unlike the recorded ones, the most probable
explanation alone would be overconfident.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.diagnosis.best_repair import BestRepair, predicts_far_worse
from probewise.diagnosis.fit import Null
from probewise.diagnosis.prior_odds import Names
from probewise.diagnosis.samples import ModelSamples, sample_model
from probewise.diagnosis.search.refits import WeighedFit, effects_out_of_vocabulary
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.verdict import GlobalTest, Judged
from probewise.effects import NamedEffect
from probewise.progress import Progress, silent
from probewise.recordings.plan import Plan
from probewise.sensor import ACCURATE_NODES, footprint_of


def mix_over_orders(parts: Sequence[ModelSamples], weights: FloatArray, *, rng: np.random.Generator) -> ModelSamples:
    """Mix samples of one hypothesis at several SSF orders (numbers of Gaussians) by their probability.

    All are converted to the largest order, by splitting Gaussians into two equal halves.

    `weights`: probability of each order, (n_parts,).
    """
    largest = max(parts, key=lambda part: part.n_gaussians)
    n = len(largest.theta)
    counts = rng.multinomial(n, weights)
    order = rng.permutation(n)
    theta = [
        _with_more_gaussians(part.theta[:count], part.n_gaussians, largest.n_gaussians)
        for part, count in zip(parts, counts, strict=True)
    ]
    noise_sd = [part.noise_sd[:count] for part, count in zip(parts, counts, strict=True)]
    return replace(largest, theta=np.concatenate(theta)[order], noise_sd=np.concatenate(noise_sd)[order])


def can_share_one_model(first: Sequence[NamedEffect[Any]], second: Sequence[NamedEffect[Any]]) -> bool:
    """Return whether hypotheses of these effects can be combined in one model.

    Shared effects must change readings alike, bound to the same scans; all others need parameters at which they change
    nothing.
    """
    known = {effect.name: effect for effect in first}
    shared = {effect.name for effect in second if effect.name in known}
    alike = all(_change_readings_alike(known[effect.name], effect) for effect in second if effect.name in shared)
    return alike and all(effect.nothing for effect in (*first, *second) if effect.name not in shared)


def _change_readings_alike(one: NamedEffect[Any], other: NamedEffect[Any]) -> bool:
    """Return whether effects are equal, or variants of one form with the same action: these differ in priors alone."""
    act = getattr(one, "act", None)
    return one == other or (act is not None and act is getattr(other, "act", None))


def mix_over_hypotheses(
    parts: Sequence[ModelSamples], shares: FloatArray, null: Null, plan: Plan, *, rng: np.random.Generator
) -> ModelSamples:
    """Mix samples of several hypotheses by their probability, in one model with the effects of all.

    In samples of a hypothesis without an effect, the effect's parameters change nothing and `absent` marks it.

    `parts`: samples of each hypothesis, in equal numbers; they fit in one model (`can_share_one_model`); `shares`:
    probability of each, (n_parts,); `null`: the model without effects, that of the part with the most Gaussians.
    """
    largest = max(parts, key=lambda part: part.n_gaussians)
    effects = {e.name: e for part in parts for e in cast(Sequence[NamedEffect[Any]], part.chain.effects)}
    chain = null.chain(plan, tuple(effects.values()), n_nodes=ACCURATE_NODES)
    n = len(largest.theta)
    counts = rng.multinomial(n, shares / shares.sum())
    theta, noise_sd = [], []
    absent: dict[str, list[BoolArray]] = {name: [] for name in effects}
    for part, count in zip(parts, counts, strict=True):
        rows = rng.permutation(n)[:count]
        head = len(part.chain.names) - sum(part.effect_samples(name).shape[1] for name in effects)
        columns = [_with_more_gaussians(part.theta[rows, :head], part.n_gaussians, largest.n_gaussians)]
        for effect in cast(Sequence[NamedEffect[Any]], chain.effects):
            absent[effect.name].append(np.full(count, effect.name not in part.effects))
            if effect.name in part.effects:
                columns.append(part.effect_samples(effect.name)[rows])
                continue
            holder = next(other for other in parts if effect.name in other.effects)
            idle = holder.effect_samples(effect.name)[rows]
            for k, value in (effect.nothing or {}).items():
                idle[:, k] = value
            columns.append(idle)
        theta.append(np.concatenate(columns, axis=1))
        noise_sd.append(part.noise_sd[rows])
    order = rng.permutation(n)
    return replace(
        largest,
        chain=chain,
        theta=np.concatenate(theta)[order],
        noise_sd=np.concatenate(noise_sd)[order],
        effects=tuple(effect.name for effect in chain.effects),
        absent={name: marks[order] for name, own in absent.items() if (marks := np.concatenate(own)).any()},
    )


def _with_more_gaussians(theta: FloatArray, n_gaussians: int, wanted: int) -> FloatArray:
    """Convert each sample's mixture to more Gaussians, by halving the heaviest."""
    blocks = theta[:, : 6 * n_gaussians].reshape(len(theta), n_gaussians, 6)
    rows = np.arange(len(theta))
    for n in range(n_gaussians, wanted):
        heaviest = np.argmax(footprint_of(blocks.reshape(len(theta), 6 * n), n).weight[:, 0], axis=1)
        half = blocks[rows, heaviest].copy()
        half[:, 0] /= 2
        blocks = np.concatenate([blocks, half[:, None, :]], axis=1)
        blocks[rows, heaviest, 0] /= 2
    return np.concatenate([blocks.reshape(len(theta), 6 * wanted), theta[:, 6 * n_gaussians :]], axis=1)


_LEAST_OF_AN_ORDER = 0.2  # probability below which an SSF order is left out of the average
_LEAST_OF_A_RIVAL = 0.02  # probability below which a hypothesis is left out of the average
_MOST = 6  # hypotheses in one model
_LEAST_DOUBT = 0.1  # least weight of the null when an unknown effect is repaired by its most similar form
_DOUBT_BESIDE = 0.5  # weight of the null for a named effect with an unknown effect beside it


@dataclass(frozen=True, eq=False)
class HypothesisSamples:
    """Cached posterior samples of the hypotheses of a search under one noise model.

    Only hypotheses with SSFs of one form can be averaged: all mixtures of Gaussians, or all free forms.
    """

    searched: Searched
    noise: Names
    rng: np.random.Generator
    progress: Progress = silent
    _known: dict[tuple[Names, bool], ModelSamples] = field(default_factory=dict)

    def averaged_over_orders(self, candidate: WeighedFit) -> ModelSamples:
        """Return posterior samples of a candidate's hypothesis, averaged over its probable numbers of Gaussians."""
        key = candidate.names, candidate.found.model.sensor.has_exchangeable_gaussians
        if key not in self._known:
            alike = self._candidates_of_same_form(candidate, candidate.names)
            noises = [c.possible_noise(self.noise) for c in alike]
            log_z = np.array([c.evidence[noise].log_z for c, noise in zip(alike, noises, strict=True)])
            weights = np.exp(log_z - log_z.max())
            kept = weights > _LEAST_OF_AN_ORDER * weights.sum()
            kept &= np.array([noise == noises[int(np.argmax(log_z))] for noise in noises])
            parts = [self._draw_samples(c) for c in itertools.compress(alike, kept)]
            self._known[key] = mix_over_orders(parts, weights[kept] / weights[kept].sum(), rng=self.rng)
        return self._known[key]

    def compatible_probabilities(self, best: WeighedFit) -> dict[Names, float]:
        """Return the probability of each refitted hypothesis whose SSF has the best candidate's form; sum one.

        They are those of the verdict, over all noise models, so that samples contain what it says as often as it says.
        A user's own effects are excluded unless the best candidate has them.
        """
        prepared, by_mean = self.searched.prepared, self.searched.posterior.marginal_over_noise
        own = prepared.apparatus.user_effect_names(prepared.effects)
        out = {
            names: by_mean.get(names, 0.0)
            for names in dict.fromkeys(names for _, names in self.searched.evidences.fits)
            # A file cannot hold a user's own effect; it is kept only if it is in the best hypothesis.
            if self._candidates_of_same_form(best, names) and not own & ({*names} - {*best.names})
        }
        total = sum(out.values())
        return {names: p / total for names, p in out.items()} if total > 0 else {best.names: 1.0}

    def averaged_over_hypotheses(self, best: WeighedFit, probabilities: Mapping[Names, float]) -> ModelSamples:
        """Average the samples of the best candidate and of its most probable compatible rivals, by probability.

        At most six hypotheses; those of a probability below 0.02 are left out.
        """
        kept = [(self.averaged_over_orders(best), best, probabilities[best.names])]
        rivals = [names for names in probabilities if names != best.names]  # no set: equal ones keep their order
        for names in sorted(rivals, key=lambda names: -probabilities[names]):
            if probabilities[names] < _LEAST_OF_A_RIVAL or len(kept) == _MOST:
                break
            rival = max(self._candidates_of_same_form(best, names), key=lambda c: c.evidence[self.noise].log_z)
            if all(can_share_one_model(c.found.model.effects, rival.found.model.effects) for _, c, _ in kept):
                kept.append((self.averaged_over_orders(rival), rival, probabilities[names]))
        if len(kept) == 1:
            return kept[0][0]
        parts, shares = [part for part, _, _ in kept], np.array([p for _, _, p in kept])
        null = self.searched.nulls[max(part.n_gaussians for part in parts)]
        return mix_over_hypotheses(parts, shares, null, self.searched.prepared.recording.plan, rng=self.rng)

    def _candidates_of_same_form(self, best: WeighedFit, names: Names) -> list[WeighedFit]:
        """List the refits of a combination whose SSF has the best candidate's form, one per number of Gaussians."""
        form = best.found.model.sensor.has_exchangeable_gaussians
        return [
            c
            for (_, key), c in self.searched.evidences.fits.items()
            if key == names and c.found.model.sensor.has_exchangeable_gaussians == form
        ]

    def _draw_samples(self, candidate: WeighedFit) -> ModelSamples:
        evidence = candidate.evidence[candidate.possible_noise(self.noise)]
        recording = self.searched.prepared.recording
        return sample_model(
            candidate.found, evidence, recording, weights=candidate.weights, rng=self.rng, progress=self.progress
        )


@dataclass(frozen=True, eq=False)
class NullBestAndRepairedSamples:
    """Posterior samples: of the null, of the best hypothesis, and of the repaired model, an average of hypotheses."""

    null: ModelSamples
    best: ModelSamples
    repaired: ModelSamples


def draw_models(
    searched: Searched,
    test: GlobalTest,
    judged: Judged,
    best: BestRepair,
    *,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> NullBestAndRepairedSamples:
    """Draw from the posterior of the repaired model, averaged over hypotheses that the verdict leaves open.

    The best hypothesis alone would be overconfident if the effect is unknown, or if it leads by little.
    """
    cached, fit, null = HypothesisSamples(searched, best.noise, rng, progress), best.fit, test.null
    model = samples = cached.averaged_over_orders(fit)
    if judged.verdict == "unknown":
        doubt = _DOUBT_BESIDE
        if best.out_of_vocabulary:
            doubt = max(1 - searched.posterior.marginal_over_noise[best.out_of_vocabulary], _LEAST_DOUBT)
        model = cached.averaged_over_hypotheses(fit, {fit.names: 1 - doubt, (): doubt})
    elif judged.verdict in ("named", "cannot_tell") and fit.names:
        model = cached.averaged_over_hypotheses(fit, cached.compatible_probabilities(fit))
    elif not (judged.too_little or judged.withdrawn):
        model = _average_of_named_and_null(cached, searched, test, best.noise)
    return NullBestAndRepairedSamples(samples if fit is null else cached.averaged_over_orders(null), samples, model)


def _average_of_named_and_null(
    cached: HypothesisSamples, searched: Searched, test: GlobalTest, noise: Names
) -> ModelSamples:
    """Average over named hypotheses by probability, and the null for the rest, where the verdict names no effect."""
    by_mean = searched.posterior.marginal_over_noise
    named = [names for _, names in searched.evidences.fits if not effects_out_of_vocabulary(names)]
    fit = searched.best_refit_of(max(named, key=lambda names: by_mean.get(names, 0.0)), noise) or test.null
    if fit.names and predicts_far_worse(BestRepair.of(searched, test, fit, noise, rng=cached.rng).improvement):
        return cached.averaged_over_orders(test.null)
    shares = {names: by_mean.get(names, 0.0) for names in cached.compatible_probabilities(fit) if names}
    return cached.averaged_over_hypotheses(fit, {**shares, (): max(1 - sum(shares.values()), 0.0)})
