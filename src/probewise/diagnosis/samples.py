"""Posterior samples of a model with its effects: the models that a diagnosis returns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, cast

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray, read_only_floats, rounding_error
from probewise.calibration.fields import choose_pixel_mm, gaussians_sorted_by_mass, posterior_mean_ssf_field
from probewise.calibration.noise import noise_by_scan
from probewise.calibration.sensor_file import FittedSensor
from probewise.diagnosis.evidence import Linearised, NoiseEvidence
from probewise.diagnosis.fit import FARTHEST, Fit, Predictor, effect_values
from probewise.diagnosis.noise_law import NoiseLaw
from probewise.diagnosis.posterior import posterior_draws
from probewise.diagnosis.templates import TemplateBank, log_bayes_factors_by_label, templates_of_effect
from probewise.effects import NUISANCES, Extent, NamedEffect, NoiseEffect
from probewise.effects.noise import Quantisation, sd_of_estimated_lattice_step
from probewise.effects.reference import origins_of
from probewise.inference import sd_ceiling, sd_floor
from probewise.progress import Progress, silent
from probewise.recordings import fingerprint
from probewise.recordings.plan import Recording
from probewise.sensor import ACCURATE_NODES, Chain


def weights_beside_other_effects(
    found: Fit, law: NoiseLaw, usable: IntArray, weights: Mapping[str, FloatArray]
) -> Mapping[str, FloatArray]:
    """Return the probabilities of each effect's variants (discrete choices), given a fit with several effects.

    `usable`: rows of the readings, (n_usable,); `weights`: the probabilities as each effect was added, by effect,
    (n_variants,). They are returned for a single effect, and for one whose choice no parameter shows.
    """
    effects = found.model.effects
    if len(effects) < 2:
        return weights
    out = dict(weights)
    for effect in effects:
        if effect.has_change_point and len(effect.variants()) == len(weights[effect.name]) > 1:
            without = _fit_without(found, effect.name, usable)
            templates = templates_of_effect(without, effect, usable)
            bank = TemplateBank.of(templates.columns, [effect.name] * len(templates.columns), len(found.residuals))
            scores = log_bayes_factors_by_label(Linearised.of(without, law), bank)[effect.name]
            if np.isfinite(scores).all():
                out[effect.name] = templates.variant_probabilities(scores)
    return out


def _fit_without(found: Fit, name: str, usable: IntArray) -> Fit:
    """Return a fit without one of its effects: what that explains is in the residuals, the other parameters stay."""
    model, stay = found.model.model_and_mask_without(name)
    change = found.change_by_effect(name, usable)
    return Fit(
        model,
        found.z[stay],
        found.predicted - change,
        found.residuals + change,
        found.slopes[:, stay],
        sd=found.sd,
        objective=found.objective,
    )


N_SAMPLES = 500


@dataclass(frozen=True, eq=False)
class ModelSamples:
    """Equally weighted posterior samples of a model (`chain`) with effects.

    `theta` (n_samples, n_params) has columns `chain.names`; `noise_sd` (n_samples,) is that of one reading; `effects`
    names all effects, including noise effects, in the order of their columns; `n_gaussians` is that of the SSF, 0
    without; `nuisance` names parameters of this recording only; `has_exchangeable_gaussians`: whether permuting the
    Gaussians changes nothing; `absent` marks, by effect, the samples without it, (n_samples,).
    """

    chain: Predictor
    theta: FloatArray
    noise_sd: FloatArray
    effects: tuple[str, ...]
    n_gaussians: int
    nuisance: tuple[str, ...] = ()
    has_exchangeable_gaussians: bool = True
    absent: Mapping[str, BoolArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", read_only_floats(self.theta))
        object.__setattr__(self, "noise_sd", read_only_floats(self.noise_sd))

    def effect_samples(self, effect: str) -> FloatArray:
        """Return the samples of one effect's parameters, (n_samples, n_params of the effect)."""
        effects = cast(Iterable[NamedEffect[Any]], self.chain.effects)
        own = {f"{effect}.{name}" for each in effects if each.name == effect for name in each.prior.names}
        return self.theta[:, [i for i, name in enumerate(self.chain.names) if name in own]]

    def fitted_sensor(self, recording: Recording, *, rng: np.random.Generator) -> FittedSensor:
        """Convert a light sensor's samples to a FittedSensor, as in sensor.json; `recording` is what was fitted."""
        kept = [i for i, name in enumerate(self.chain.names) if name not in self.nuisance]
        from_chain = (
            gaussians_sorted_by_mass(self.theta, self.n_gaussians) if self.has_exchangeable_gaussians else self.theta
        )
        pixel_mm = choose_pixel_mm(from_chain, self.n_gaussians, step_mm=_median_step_mm(recording))
        field = posterior_mean_ssf_field(from_chain[:100], self.n_gaussians, pixel_mm=pixel_mm)
        usable = recording.usable
        residuals = recording.readings[usable] - self.chain.predict(self.theta[:50], recording.plan)[:, usable]
        scan_noise = noise_by_scan(
            residuals,
            recording.plan.scan[usable],
            recording.plan.scan_names,
            sd_floor=sd_floor(recording),
            sd_ceiling=sd_ceiling(recording),
            rng=rng,
        )
        return FittedSensor(
            names=tuple(self.chain.names[i] for i in kept),
            samples=from_chain[:, kept],
            n_gaussians=self.n_gaussians,
            noise_sd=self.noise_sd,
            field=field,
            instrumentation=cast(Chain, self.chain).plan_at_calibrated_height(recording.plan).instrumentation,
            effects=self.effects,
            patterns={e.name: e.patterns for e in cast(Iterable[NamedEffect[Any]], self.chain.effects) if e.patterns},
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
    annealed: bool = True,
    progress: Progress = silent,
) -> ModelSamples:
    """Draw 500 samples of a model from its posterior about a fit, under one noise model.

    `posterior_draws` draws their coordinates. Parameters of noise effects, variants and the noise's sd are drawn here.

    `weights`: by effect, the probability of each of its variants (discrete choices, such as of scans), (n_variants,),
    when it was added; `annealed`: whether samples are of the posterior; otherwise of Laplace's approximation, with
    `LinearAmplitudes`.
    """
    law, n_samples = noise.likeliest_law, N_SAMPLES
    weights = weights_beside_other_effects(found, law, np.flatnonzero(recording.usable), weights)
    draws = posterior_draws(found, noise, recording, N_SAMPLES, annealed=annealed, rng=rng, progress=progress)
    z = np.clip(draws, -FARTHEST, FARTHEST)
    # Samples that are not annealed serve for the effects only: their noise is that of the fit.
    predicted = found.model.predict(z)[:, recording.usable] if annealed else found.predicted[None, :]
    residuals = recording.readings[recording.usable] - predicted
    noise_sd = draw_noise_sd(law, residuals, rng=rng)
    largest = float(np.abs(recording.readings[recording.usable]).max()) or 1.0
    noise_sd = np.maximum(noise_sd, found.sd * 1e-6 + largest * 1e-12)
    on_noise = [effect for effect in noise.noise.effects if effect.name not in NUISANCES]
    effects = (*found.model.effects, *on_noise)
    null = found.model.sensor
    chain = null.chain(recording.plan, effects, n_nodes=ACCURATE_NODES)
    own = {
        effect.name: effect.redraw_by_variant(
            effect_values(effect, z[:, found.model.coordinate_slice(effect.name)]), weights[effect.name], rng=rng
        )
        for effect in found.model.effects
    }
    theta = found.model.joined_theta(found.model.sensor.theta(z[:, : found.model.sensor.n_params]), own)
    nodes = rng.choice(len(noise.weights), n_samples, p=noise.weights)
    theta = np.concatenate(
        [theta, *(_uniform_draws_about_nodes(effect, noise, nodes, rng=rng) for effect in on_noise)], axis=1
    )
    names = tuple(effect.name for effect in chain.effects)
    of_lattice = [i for i, name in enumerate(chain.names) if name == f"{Quantisation.name}.step"]
    for i in of_lattice:
        sd = sd_of_estimated_lattice_step(recording.readings[recording.usable], float(theta[0, i]))
        theta[:, i] += sd * rng.standard_normal(n_samples)
    rounding = theta[:, of_lattice].sum(axis=1)
    if law.flat:  # sd at each noise node, without rounding if that is an effect, else including it
        noise_sd = noise_sd_by_node(noise, with_rounding=not of_lattice)[nodes]
    else:
        # Without the rounding variance, but no less than the accuracy of the total.
        least = np.where(rounding > 0, math.sqrt(8 / law.n_kept), 1)
        noise_sd = np.sqrt(np.maximum(noise_sd**2 - rounding**2 / 12, noise_sd**2 * least))
    return ModelSamples(
        chain,
        theta,
        noise_sd,
        names,
        null.n_gaussians,
        nuisance=null.nuisance_names,
        has_exchangeable_gaussians=null.has_exchangeable_gaussians,
    )


def draw_noise_sd(law: NoiseLaw, residuals: FloatArray, *, rng: np.random.Generator) -> FloatArray:
    """Draw the sd of the noise, rounding included, for each sample: residuals (n_samples, n_usable) -> (n_samples,).

    One row of residuals serves 500 samples.
    """
    sigma = law.likeliest_sigma(law(residuals.T))
    n_samples = N_SAMPLES if len(sigma) == 1 else len(sigma)
    return np.asarray(sigma * np.sqrt(law.n_kept / rng.chisquare(law.n_kept, n_samples)))


def noise_sd_by_node(noise: NoiseEvidence, *, with_rounding: bool) -> FloatArray:
    """Return the sd of the noise at each node of a rounding noise model, (n_nodes,), with the rounding or without."""
    return np.array([own.sigma * (own.sd_factor_of_rounding if with_rounding else 1.0) for own in noise.nodes.laws])


def noise_effect_samples(effect: NoiseEffect, noise: NoiseEvidence, *, rng: np.random.Generator) -> FloatArray:
    """Draw the parameters of an effect in a noise model from its posterior, (N_SAMPLES, n_params)."""
    nodes = rng.choice(len(noise.weights), N_SAMPLES, p=noise.weights)
    return _uniform_draws_about_nodes(effect, noise, nodes, rng=rng)


def _uniform_draws_about_nodes(
    effect: NoiseEffect, noise: NoiseEvidence, nodes: IntArray, *, rng: np.random.Generator
) -> FloatArray:
    """Draw a noise effect's parameters uniformly about drawn nodes, half way to the next: (n_samples, n_params).

    `nodes` (n_samples,) are indices of nodes; parameters that are the same in all nodes stay as they are. An effect
    with a rule of its own (`draws_about`) follows that rule.
    """
    settings = noise.nodes.settings[:, noise.noise.columns_of_effect(effect.name)]
    own = effect.draws_about(settings[nodes], rng=rng)
    if own is not None:
        return own
    values, units = settings[nodes], effect.prior.to_unit_cube(settings)
    gaps = np.array([np.diff(np.unique(np.round(column, 9))).min(initial=1.0) for column in units.T])
    spread = np.array([len(np.unique(column)) > 1 for column in settings.T])
    moved = np.clip(units[nodes] + (rng.random(values.shape) - 0.5) * gaps, 0.0, 1.0)
    return np.where(spread, effect.prior.from_unit_cube(moved), values)


def _median_step_mm(recording: Recording) -> float:
    plan = recording.plan
    moves = np.hypot(np.diff(plan.x_mm), np.diff(plan.y_mm))[np.diff(plan.scan) == 0]
    moves = moves[moves > rounding_error(np.append(plan.x_mm, plan.y_mm))]
    return float(np.median(moves)) if moves.size else max(Extent.of(recording).length_mm / 100, 1e-6)
