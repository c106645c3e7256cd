"""Posterior samples of a sensor model with its effects: the models that a diagnosis returns."""

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
from probewise.diagnosis.evidence.hypothesis_problem import HypothesisProblem
from probewise.diagnosis.evidence.laplace import NoiseEvidence
from probewise.diagnosis.fitting.coordinates import FARTHEST, effect_values
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.fitting.null import Predictor
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.repair.annealing import Density, draw_by_annealing, importance_resample
from probewise.diagnosis.repair.conditionally_linear import ConditionallyLinearDensity
from probewise.diagnosis.repair.linear_amplitudes import LinearAmplitudes
from probewise.diagnosis.repair.profiled import ProfiledDensity
from probewise.diagnosis.repair.quadratic import QuadraticPredictions
from probewise.diagnosis.repair.surrogate import SurrogatePosterior
from probewise.diagnosis.repair.variant_weights import weights_beside_other_effects
from probewise.effects import (
    NUISANCES,
    Extent,
    NamedEffect,
    NoiseEffect,
    Quantisation,
    origins_of,
    sd_of_estimated_lattice_step,
)
from probewise.inference import sd_ceiling, sd_floor
from probewise.progress import Progress, silent
from probewise.recordings import fingerprint
from probewise.recordings.plan import Recording
from probewise.sensor import ACCURATE_NODES, Chain

N_SAMPLES = 500
N_WALKERS = 250
_MOVES = 6  # moves of posterior samples after a step
_N_FIRST = 1000  # draws of which posterior samples are chosen by weight
_LEAST = 0.25  # least effective share of draws by a linear view of the simulation,
_NEARLY_ALL = 0.8  # and where slices of the simulation itself cost little
# The surrogate costs next to nothing.
_N_NEAR = 2000
_MOVES_NEAR = 20


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

    columns = effect_samples
    """The old name of `effect_samples`."""

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

    Samples of the Laplace approximation are moved to the posterior in two stages, the first through a quadratic
    surrogate: with several Gaussians the posterior is curved, and Laplace's samples predict new angles far worse.
    If an effect on the readings has a nonlinear coordinate, they are drawn by importance instead, from a
    `ConditionallyLinearDensity`; where many samples cost little more than one, from a `ProfiledDensity` if an effect
    has a nonlinear coordinate, or else from `LinearAmplitudes`.

    Parameters
    ----------
    found, noise
        The fit and its evidence under a noise model; parameters of noise effects are drawn about its nodes, by weight.
    recording
        What was fitted.
    weights
        By effect, the probability of each of its variants (discrete choices, such as of scans), (n_variants,), when it
        was added.
    rng
        Source of randomness.
    annealed
        Whether samples are moved to the posterior; otherwise they stay those of the Laplace approximation, with
        `LinearAmplitudes`.
    progress
        Called with the progress of annealing.
    """
    law, n_samples = noise.likeliest_law, N_SAMPLES
    weights = weights_beside_other_effects(found, law, np.flatnonzero(recording.usable), weights)
    z = np.clip(_posterior_draws(found, noise, recording, annealed, progress, rng=rng), -FARTHEST, FARTHEST)
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
        noise_sd = _sd_without_rounding(noise_sd, rounding, law.n_kept)
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
    """Draw the sd of the noise, rounding included, for each sample: residuals (1 or 500, n_usable) -> (500,)."""
    sigma = law.likeliest_sigma(law(residuals.T))
    return np.asarray(sigma * np.sqrt(law.n_kept / rng.chisquare(law.n_kept, N_SAMPLES)))


def noise_sd_by_node(noise: NoiseEvidence, *, with_rounding: bool) -> FloatArray:
    """Return the sd of the noise at each node of a rounding noise model, (n_nodes,), with the rounding or without."""
    return np.array([own.sigma * (own.sd_factor_of_rounding if with_rounding else 1.0) for own in noise.nodes.laws])


def _posterior_draws(
    found: Fit,
    noise: NoiseEvidence,
    recording: Recording,
    annealed: bool,
    progress: Progress,
    *,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw coordinates, (N_SAMPLES, n_params), from the posterior; from Laplace's approximation unless `annealed`."""
    law, model = noise.likeliest_law, found.model
    whitened, turned = law(found.residuals)[:, None], law(found.slopes)
    sigma = law.likeliest_sigma(whitened)
    sd = max(float(sigma[0]) / math.sqrt(law.fisher_information), 1e-150)
    curvature = turned.T @ turned / sd**2 + np.eye(len(found.z))
    # A step in one coordinate also moves the later ones. With the effects first and the sensor last, most steps leave
    # the SSF's geometry unchanged, which speeds up vectorised predictions.
    order = np.roll(np.arange(len(found.z)), -model.sensor.n_params)
    at, steps = np.ix_(order, order), np.empty_like(curvature)
    steps[at] = np.linalg.inv(np.linalg.cholesky(curvature[at][::-1, ::-1]))[::-1, ::-1]
    normal = law.normal_pseudo_residuals(whitened, np.maximum(sigma, 1e-150))[:, 0]
    if not annealed:
        linear = LinearAmplitudes.of(found, turned / sd, normal / sd)
        if linear is not None:
            return linear.draw(N_SAMPLES, rng=rng)
    center = found.z + np.linalg.solve(curvature, turned.T @ normal / sd**2 - found.z)
    center = np.clip(center, -FARTHEST, FARTHEST)
    if not np.isfinite(model.predict(center[None, :])[0, recording.usable]).all():
        center = found.z  # the step left the domain of the formula
    draws = rng.standard_normal((_N_NEAR if annealed else N_SAMPLES, len(center)))
    if not annealed:
        return np.asarray(center + draws @ steps)
    problem, usable = HypothesisProblem(model, recording, noise.with_likeliest_node_alone), recording.usable

    def log_posterior(z: FloatArray) -> FloatArray:
        height = problem.prior.log_prob(z) + problem.log_likelihood(z)
        return np.where((np.abs(z) < FARTHEST).all(axis=1), height, -np.inf)

    in_bulk = model.sensor.predicts_in_bulk
    given = ConditionallyLinearDensity.of(found, law, recording, steps.T @ steps, sd)
    if given is not None:
        first, least = given.draw(N_SAMPLES if in_bulk else _N_FIRST, rng=rng), _NEARLY_ALL if in_bulk else _LEAST
        weighed = importance_resample(first, given.log_density, log_posterior, n_wanted=N_SAMPLES, rng=rng, least=least)
        if weighed is not None:
            return weighed
    if in_bulk:
        profiled = ProfiledDensity.of(found, law, recording)
        if profiled is not None:
            weighed = profiled.importance_resample(log_posterior, n_first=_N_FIRST, n_wanted=N_SAMPLES, rng=rng)
            if weighed is not None:
                return weighed
        linear = LinearAmplitudes.of(found, turned / sd, normal / sd)
        if linear is not None:
            first = linear.draw(_N_FIRST, rng=rng)
            weighed = importance_resample(first, linear.log_density, log_posterior, n_wanted=N_SAMPLES, rng=rng)
            if weighed is not None:
                return weighed
    quadratic = QuadraticPredictions.of(lambda e: model.predict(center + e @ steps)[:, usable], len(center), sd)
    near = SurrogatePosterior.of(quadratic, center, steps, recording.readings[usable], law)

    def log_laplace(e: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.sum(e**2, axis=1))

    def log_posterior_of_steps(e: FloatArray) -> FloatArray:
        return log_posterior(center + e @ steps)

    def resampled_or_annealed(first: FloatArray, log_q: Density, log_p: Density, n_moves: int, n: int) -> FloatArray:
        weighed = importance_resample(first, log_q, log_p, n_wanted=n, rng=rng)
        if weighed is not None:
            return weighed
        return draw_by_annealing(
            first[:N_WALKERS], log_q, log_p, n_moves=n_moves, n_wanted=n, rng=rng, progress=progress
        )

    e = resampled_or_annealed(draws, log_laplace, near.log_density, _MOVES_NEAR, _N_NEAR)
    return center + resampled_or_annealed(e, near.log_density, log_posterior_of_steps, _MOVES, N_SAMPLES) @ steps


def _sd_without_rounding(sd: FloatArray, step: FloatArray, n_points: int) -> FloatArray:
    """Return the noise sd without the rounding variance, but no less than the accuracy of the total; (n_samples,)."""
    return np.asarray(np.sqrt(np.maximum(sd**2 - step**2 / 12, sd**2 * np.where(step > 0, math.sqrt(8 / n_points), 1))))


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
