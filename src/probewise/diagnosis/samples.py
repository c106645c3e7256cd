"""Posterior samples of a model with its effects, of one hypothesis or averaged over several: what a diagnosis returns.

Predictions must include the uncertainty between hypotheses: for readings unlike the recorded ones, the most probable
explanation alone would be overconfident.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePath
from typing import cast

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import LAST_DIGITS, BoolArray, FloatArray, IntArray, read_only_floats, rounding_error
from probewise.calibration.fields import (
    choose_pixel_mm,
    gaussians_sorted_by_mass,
    noise_by_scan,
    posterior_mean_ssf_field,
)
from probewise.calibration.sensor_file import FittedSensor
from probewise.diagnosis.best_repair import BestRepair, predicts_far_worse
from probewise.diagnosis.evidence import Linearised, NoiseEvidence
from probewise.diagnosis.fit import FARTHEST, Fit, Null, Predictor, effect_values
from probewise.diagnosis.noise import NoiseLaw
from probewise.diagnosis.posterior import n_tried, posterior_draws
from probewise.diagnosis.search.hypotheses import Searched, WeighedFit, effects_out_of_vocabulary
from probewise.diagnosis.templates import TemplateBank, templates_of_effect
from probewise.diagnosis.verdict import GlobalTest, Judged
from probewise.diagnosis.words import Names
from probewise.effects import NUISANCES, Effect, Extent, NoiseEffect
from probewise.effects.noise import quantisation, sd_of_estimated_lattice_step
from probewise.effects.reference import origins_of
from probewise.inference import sd_ceiling, sd_floor
from probewise.progress import Progress, silent
from probewise.recordings import fingerprint
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import ACCURATE_NODES, Chain, footprint_of


def weights_beside_other_effects(
    found: Fit, law: NoiseLaw, usable: IntArray, weights: Mapping[str, FloatArray]
) -> Mapping[str, FloatArray]:
    """Return the probabilities of each effect's variants (discrete choices), given a fit with several effects.

    `usable`: rows of the readings, (n_usable,); `weights`: the probabilities as each effect was added, by effect,
    (n_variants,). They are returned for a single effect, and for one whose choice no parameter shows.
    """
    out = dict(weights)
    for effect in found.model.effects if len(found.model.effects) > 1 else ():
        if effect.has_change_point and len(effect.variants()) == len(weights[effect.name]) > 1:
            # What the effect explains is in the residuals; the other parameters stay.
            model, stay = found.model.model_and_mask_without(effect.name)
            change, slopes = found.change_by_effect(effect.name, usable), found.slopes[:, stay]
            left, predicted = found.residuals + change, found.predicted - change
            without = Fit(model, found.z[stay], predicted, left, slopes, found.sd, found.objective)
            templates = templates_of_effect(without, effect, usable)
            bank = TemplateBank.of(templates.columns, [effect.name] * len(templates.columns))
            scores = bank.log_bayes_factors(Linearised.of(without, law))[:, 0]
            if np.isfinite(scores).all():
                out[effect.name] = templates.variant_probabilities(scores)
    return out


N_SAMPLES = 500


@dataclass(frozen=True, eq=False)
class ModelSamples:
    """Equally weighted posterior samples of a model (`chain`) with effects.

    `theta` (n_samples, n_params) has columns `chain.names`; `noise_sd` (n_samples,) is that of one reading, which an
    effect of that name compares with an earlier calibration's; `n_gaussians` is that of the SSF, 0 without; `nuisance`
    names parameters of this recording only; `has_exchangeable_gaussians`: whether permuting the Gaussians changes
    nothing; `absent` marks, by effect, the samples without it, (n_samples,).
    """

    chain: Predictor
    theta: FloatArray
    noise_sd: FloatArray
    n_gaussians: int
    nuisance: tuple[str, ...] = ()
    has_exchangeable_gaussians: bool = True
    absent: Mapping[str, BoolArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", read_only_floats(self.theta))
        object.__setattr__(self, "noise_sd", read_only_floats(self.noise_sd))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of all effects, noise effects included, in the order of their columns."""
        return tuple(effect.name for effect in self.chain.effects)

    def effect_samples(self, effect: str) -> FloatArray:
        """Return the samples of one effect's parameters, (n_samples, n_params of the effect)."""
        effects = cast(Iterable[Effect], self.chain.effects)
        own = {f"{effect}.{name}" for each in effects if each.name == effect for name in each.prior.names}
        return self.theta[:, [i for i, name in enumerate(self.chain.names) if name in own]]

    def fitted_sensor(self, recording: Recording, *, rng: np.random.Generator) -> FittedSensor:
        """Convert a light sensor's samples to a FittedSensor, as in sensor.json; `recording` is what was fitted."""
        kept = [i for i, name in enumerate(self.chain.names) if name not in self.nuisance]
        theta, plan, usable = self.theta, recording.plan, recording.usable
        if self.has_exchangeable_gaussians:
            theta = gaussians_sorted_by_mass(theta, self.n_gaussians)
        moves = np.hypot(np.diff(plan.x_mm), np.diff(plan.y_mm))[np.diff(plan.scan) == 0]
        moves = moves[moves > rounding_error(np.append(plan.x_mm, plan.y_mm))]
        step_mm = float(np.median(moves)) if moves.size else max(Extent.of(recording).length_mm / 100, 1e-6)
        pixel_mm = choose_pixel_mm(theta, self.n_gaussians, step_mm=step_mm)
        residuals = recording.readings[usable] - self.chain.predict(self.theta[:50], plan)[:, usable]
        low, high = sd_floor(recording), sd_ceiling(recording)
        scans = plan.scan[usable], plan.scan_names
        scan_noise = noise_by_scan(residuals, *scans, sd_floor=low, sd_ceiling=high, rng=rng)
        return FittedSensor(
            names=tuple(self.chain.names[i] for i in kept),
            samples=theta[:, kept],
            n_gaussians=self.n_gaussians,
            noise_sd=self.noise_sd,
            field=posterior_mean_ssf_field(theta[:100], self.n_gaussians, pixel_mm=pixel_mm),
            instrumentation=cast(Chain, self.chain).plan_at_calibrated_height(plan).instrumentation,
            effects=self.effects,
            patterns={e.name: e.patterns for e in cast(Iterable[Effect], self.chain.effects) if e.patterns},
            absent=self.absent,
            origins=origins_of(self.chain.effects),
            scan_noise=scan_noise,
            fingerprint=fingerprint(recording),
            source=PurePath(recording.source).name,
        )


def sample_model(
    found: Fit,
    noise: NoiseEvidence,
    recording: Recording,
    *,
    weights: Mapping[str, FloatArray],
    rng: np.random.Generator,
    laplace_only: bool = False,
    progress: Progress = silent,
) -> ModelSamples:
    """Draw 500 samples of a model from its posterior about a fit, under one noise model.

    `posterior_draws` draws their coordinates. Parameters of noise effects, variants and the noise's sd are drawn here.

    `weights`: by effect, the probability of each of its variants (discrete choices, such as of scans), (n_variants,),
    when it was added; `laplace_only`: whether samples are of Laplace's approximation instead of the posterior, with
    `draws_of_linear_amplitudes`.
    """
    law, model, null = noise.likeliest_law, found.model, found.model.sensor
    usable = np.flatnonzero(recording.usable)
    readings = recording.readings[usable]
    weights = weights_beside_other_effects(found, law, usable, weights)
    draws = posterior_draws(found, noise, recording, N_SAMPLES, laplace_only=laplace_only, rng=rng, progress=progress)
    z = np.clip(draws, -FARTHEST, FARTHEST)
    # Laplace's samples serve for the effects only: their noise is that of the fit. Where each sample is a call, those
    # that were tried serve for all.
    predicted = found.predicted[None, :] if laplace_only else model.predict_rows(usable, z[: n_tried(model)])
    residuals = np.resize(readings - predicted, (N_SAMPLES, len(usable)))
    noise_sd = draw_noise_sd(law, residuals, rng=rng)
    largest = float(np.abs(readings).max()) or 1.0
    noise_sd = np.maximum(noise_sd, found.sd * 1e-6 + largest * LAST_DIGITS)
    on_noise = [effect for effect in noise.noise.effects if effect.name not in NUISANCES]
    chain = null.chain(recording.plan, (*model.effects, *on_noise), n_nodes=ACCURATE_NODES)
    own = {}
    for effect in model.effects:
        values = effect_values(effect, z[:, model.coordinate_slice(effect.name)])
        own[effect.name] = effect.redraw_by_variant(values, weights[effect.name], rng=rng)
    theta = model.joined_theta(null.theta(z[:, : null.n_params]), own)
    nodes = rng.choice(len(noise.weights), N_SAMPLES, p=noise.weights)
    of_noise = (noise_effect_samples(effect, noise, nodes, rng=rng) for effect in on_noise)
    theta = np.concatenate([theta, *of_noise], axis=1)
    of_lattice = [i for i, name in enumerate(chain.names) if name == f"{quantisation.name}.step"]
    for i in of_lattice:
        sd = sd_of_estimated_lattice_step(readings, float(theta[0, i]))
        theta[:, i] += sd * rng.standard_normal(N_SAMPLES)
    rounding = theta[:, of_lattice].sum(axis=1)
    if law.flat:  # sd at each noise node, without rounding if that is an effect, else including it
        noise_sd = noise_sd_by_node(noise, with_rounding=not of_lattice)[nodes]
    else:
        # Without the rounding variance, but no less than the accuracy of the total.
        least = np.where(rounding > 0, math.sqrt(8 / law.n_kept), 1)
        noise_sd = np.sqrt(np.maximum(noise_sd**2 - rounding**2 / 12, noise_sd**2 * least))
    return ModelSamples(chain, theta, noise_sd, null.n_gaussians, null.nuisance_names, null.has_exchangeable_gaussians)


def draw_noise_sd(law: NoiseLaw, residuals: FloatArray, *, rng: np.random.Generator) -> FloatArray:
    """Draw the sd of the noise, rounding included, for each sample: residuals (n_samples, n_usable) -> (n_samples,)."""
    sigma = law.likeliest_sigma(law(residuals.T))
    return np.asarray(sigma * np.sqrt(law.n_kept / rng.chisquare(law.n_kept, len(sigma))))


def noise_sd_by_node(noise: NoiseEvidence, *, with_rounding: bool) -> FloatArray:
    """Return the sd of the noise at each node of a rounding noise model, (n_nodes,), with the rounding or without."""
    return np.array([own.sigma * (own.sd_factor_of_rounding if with_rounding else 1.0) for own in noise.nodes.laws])


def noise_effect_samples(
    effect: NoiseEffect, noise: NoiseEvidence, nodes: IntArray | None = None, *, rng: np.random.Generator
) -> FloatArray:
    """Draw a noise effect's parameters uniformly about drawn nodes, half way to the next: (n_samples, n_params).

    `nodes` (n_samples,) are indices of nodes, by default 500 drawn by their probability; parameters that are the same
    in all nodes stay as they are. An effect with a rule of its own (`draws_about`) follows that rule.
    """
    if nodes is None:
        nodes = rng.choice(len(noise.weights), N_SAMPLES, p=noise.weights)
    settings = noise.nodes.settings[:, noise.noise.columns_of_effect(effect.name)]
    if effect.draws_about is not None:
        return effect.draws_about(settings[nodes], rng)
    values, units = settings[nodes], effect.prior.to_unit_cube(settings)
    gaps = np.array([np.diff(np.unique(np.round(column, 9))).min(initial=1.0) for column in units.T])
    spread = np.array([len(np.unique(column)) > 1 for column in settings.T])
    moved = np.clip(units[nodes] + (rng.random(values.shape) - 0.5) * gaps, 0.0, 1.0)
    return np.where(spread, effect.prior.from_unit_cube(moved), values)


def can_share_one_model(first: Sequence[Effect], second: Sequence[Effect]) -> bool:
    """Return whether hypotheses of these effects can be combined in one model.

    Shared effects must change readings alike, bound to the same scans; all others need parameters at which they change
    nothing.
    """
    known = {effect.name: effect for effect in first}
    shared = {effect.name for effect in second if effect.name in known}
    alike = all(known[effect.name].apply is effect.apply for effect in second if effect.name in shared)
    return alike and all(effect.nothing for effect in (*first, *second) if effect.name not in shared)


def mix(
    parts: Sequence[ModelSamples], shares: FloatArray, null: Null, plan: Plan, *, rng: np.random.Generator
) -> ModelSamples:
    """Mix samples of several hypotheses, or numbers of Gaussians, by their probability, in one model with all effects.

    All are converted to the largest number of Gaussians, by splitting Gaussians into two equal halves. In samples of a
    hypothesis without an effect, the effect's parameters change nothing and `absent` marks it.

    `parts`: samples of each, in equal numbers; they fit in one model (`can_share_one_model`); `shares`: probability of
    each, (n_parts,); `null`: the model without effects, that of the part with the most Gaussians.
    """
    largest = max(parts, key=lambda part: part.n_gaussians)
    effects = {e.name: e for part in parts for e in cast(Sequence[Effect], part.chain.effects)}
    chain = null.chain(plan, tuple(effects.values()), n_nodes=ACCURATE_NODES)
    n, names = len(largest.theta), [effect.name for effect in chain.effects]
    samples = []
    for part, count in zip(parts, rng.multinomial(n, shares / shares.sum()), strict=True):
        rows = rng.permutation(n)[:count]
        head = len(part.chain.names) - sum(part.effect_samples(name).shape[1] for name in names)
        columns = [_with_more_gaussians(part.theta[rows, :head], part.n_gaussians, largest.n_gaussians)]
        for name in names:
            holder = next(other for other in (part, *parts) if name in other.effects)
            own = holder.effect_samples(name)[rows]
            if holder is not part:
                for k, value in (effects[name].nothing or {}).items():
                    own[:, k] = value
            columns.append(own)
        absent = np.tile([name not in part.effects for name in names], (count, 1))
        samples.append((np.concatenate(columns, axis=1), part.noise_sd[rows], absent))
    order = rng.permutation(n)
    theta, noise_sd, absent = (np.concatenate(column)[order] for column in zip(*samples, strict=True))
    marks = {name: absent[:, k] for k, name in enumerate(names) if absent[:, k].any()}
    return replace(largest, chain=chain, theta=theta, noise_sd=noise_sd, absent=marks)


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


_MOST = 6  # hypotheses in one model
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
    _known: dict[WeighedFit, ModelSamples] = field(default_factory=dict)

    def compatible_probabilities(self, best: WeighedFit) -> dict[Names, float]:
        """Return the probability of each refitted hypothesis whose SSF has the best candidate's form; sum one.

        They are those of the verdict, over all noise models, so that samples contain what it says as often as it says.
        A user's own effects are excluded unless the best candidate has them, since a file cannot hold them.
        """
        prepared, by_mean = self.searched.prepared, self.searched.posterior.marginal_over_noise
        own = prepared.apparatus.user_effect_names(prepared.effects)
        out = {
            names: by_mean.get(names, 0.0)
            for names in dict.fromkeys(names for _, names in self.searched.evidences.fits)
            if self._candidates_of_same_form(best, names) and not own & ({*names} - {*best.names})
        }
        total = sum(out.values())
        return {names: p / total for names, p in out.items()} if total > 0 else {best.names: 1.0}

    def averaged(self, best: WeighedFit, probabilities: Mapping[Names, float] | None = None) -> ModelSamples:
        """Average samples of a candidate's hypothesis over its numbers of Gaussians, and over its most probable rivals.

        Without `probabilities` there are no rivals. At most six hypotheses; those of a probability below 0.02 are left
        out.
        """
        probabilities = probabilities or {best.names: 1.0}
        kept = [(best, probabilities[best.names])]
        rivals = [names for names in probabilities if names != best.names]  # no set: equal ones keep their order
        for names in sorted(rivals, key=lambda names: -probabilities[names]):
            if probabilities[names] < 0.02 or len(kept) == _MOST:
                break
            rival = max(self._candidates_of_same_form(best, names), key=lambda c: c.evidence[self.noise].log_z)
            if all(can_share_one_model(c.found.model.effects, rival.found.model.effects) for c, _ in kept):
                kept.append((rival, probabilities[names]))
        parts = [(self._samples_of(c), p * share) for own, p in kept for c, share in self._orders(own)]
        if len(parts) == 1:
            return parts[0][0]
        order = max(part.n_gaussians for part, _ in parts)
        null = self.searched.evidences.fits[order, ()].found.model.sensor
        plan = self.searched.prepared.recording.plan
        return mix([part for part, _ in parts], np.array([share for _, share in parts]), null, plan, rng=self.rng)

    def _orders(self, candidate: WeighedFit) -> list[tuple[WeighedFit, float]]:
        """List a hypothesis's fits with a number of Gaussians whose probability is above 0.2, and the share of each."""
        alike = self._candidates_of_same_form(candidate, candidate.names)
        noises = [c.possible_noise(self.noise) for c in alike]
        log_z = np.array([c.evidence[noise].log_z for c, noise in zip(alike, noises, strict=True)])
        shares = np.exp(log_z - logsumexp(log_z))
        kept = (shares > 0.2) & np.array([noise == noises[int(np.argmax(log_z))] for noise in noises])
        return [(alike[k], float(shares[k] / shares[kept].sum())) for k in np.flatnonzero(kept)]

    def _candidates_of_same_form(self, best: WeighedFit, names: Names) -> list[WeighedFit]:
        """List the refits of a combination whose SSF has the best candidate's form, one per number of Gaussians."""
        form = best.found.model.sensor.has_exchangeable_gaussians
        return [
            c
            for (_, key), c in self.searched.evidences.fits.items()
            if key == names and c.found.model.sensor.has_exchangeable_gaussians == form
        ]

    def _samples_of(self, candidate: WeighedFit) -> ModelSamples:
        if candidate not in self._known:
            evidence = candidate.evidence[candidate.possible_noise(self.noise)]
            self._known[candidate] = sample_model(
                candidate.found, evidence, self.searched.prepared.recording,
                weights=candidate.weights, rng=self.rng, progress=self.progress,
            )  # fmt: skip
        return self._known[candidate]


def draw_models(
    searched: Searched,
    test: GlobalTest,
    judged: Judged,
    best: BestRepair,
    *,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> tuple[ModelSamples, ModelSamples, ModelSamples]:
    """Draw from the posteriors of the null, of the best hypothesis, and of the repaired model, an average of several.

    It is over those that the verdict leaves open: the best one alone would be overconfident if the effect is unknown,
    or if it leads by little.
    """
    cached, fit, null = HypothesisSamples(searched, best.noise, rng, progress), best.fit, test.null
    by_mean = searched.posterior.marginal_over_noise

    def with_null_for_the_rest(lead: WeighedFit) -> ModelSamples:
        shares = {names: by_mean.get(names, 0.0) for names in cached.compatible_probabilities(lead) if names}
        return cached.averaged(lead, {**shares, (): max(1 - sum(shares.values()), 0.0)})

    model = samples = cached.averaged(fit)
    if judged.verdict == "unknown":
        if effects_out_of_vocabulary(fit.names):
            model = with_null_for_the_rest(fit)
        else:
            model = cached.averaged(fit, {fit.names: 1 - _DOUBT_BESIDE, (): _DOUBT_BESIDE})
    elif judged.verdict in ("named", "cannot_tell") and fit.names:
        model = cached.averaged(fit, cached.compatible_probabilities(fit))
    elif not (judged.too_little or judged.withdrawn):  # no effect is named: the null is what named ones leave
        named = [names for _, names in searched.evidences.fits if not effects_out_of_vocabulary(names)]
        lead = searched.best_refit_of(max(named, key=lambda names: by_mean.get(names, 0.0)), best.noise) or null
        if lead.names and predicts_far_worse(BestRepair.of(searched, test, lead, best.noise, rng=rng).improvement):
            model = cached.averaged(null)
        else:
            model = with_null_for_the_rest(lead)
    return samples if fit is null else cached.averaged(null), samples, model
