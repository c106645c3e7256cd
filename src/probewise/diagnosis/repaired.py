"""The model that a diagnosis ends with: a chain with its effects, as posterior samples."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray, IntArray, frozen
from probewise.calibration.fields import by_mass, choose_pixel_mm, mean_field
from probewise.calibration.noise import noise_by_scan
from probewise.calibration.sensor_file import FittedSensor
from probewise.diagnosis.annealing import anneal
from probewise.diagnosis.coordinates import FARTHEST, effect_values
from probewise.diagnosis.evidence import NoiseEvidence
from probewise.diagnosis.fit import Fit
from probewise.diagnosis.joint import JointProblem
from probewise.diagnosis.null import Predictor
from probewise.effects import NUISANCES, Extent, NamedEffect, NoiseEffect, Quantisation, lattice_step_sd
from probewise.inference import sd_ceiling, sd_floor
from probewise.recordings import fingerprint
from probewise.recordings.plan import Recording
from probewise.sensor import ACCURATE_NODES

__all__ = ["ModelSamples", "doubted", "over_orders", "sample_model"]

N_SAMPLES = 500
N_WALKERS = 250


@dataclass(frozen=True, eq=False)
class ModelSamples:
    """Equally weighted posterior samples of a chain with effects.

    `theta` (n_samples, n_params), columns as `chain.names`; `noise_sd` (n_samples,) of one reading;
    `effects` names all effects, those on the noise too, in the order of their columns; `nuisance` the
    parameters that belong to this recording alone; `exchangeable` Gaussians are told by their mass.
    """

    chain: Predictor
    theta: FloatArray
    noise_sd: FloatArray
    effects: tuple[str, ...]
    n_gaussians: int
    nuisance: tuple[str, ...] = ()
    exchangeable: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", frozen(self.theta))
        object.__setattr__(self, "noise_sd", frozen(self.noise_sd))

    def columns(self, effect: str) -> FloatArray:
        """Select samples of one effect's parameters, (n_samples, n_params of the effect)."""
        at = [i for i, name in enumerate(self.chain.names) if name.startswith(f"{effect}.")]
        return self.theta[:, at]

    def fitted_sensor(self, recording: Recording, *, rng: np.random.Generator) -> FittedSensor:
        """Make the sensor of it that predicts, drives the robot, and is written to sensor.json."""
        kept = [i for i, name in enumerate(self.chain.names) if name not in self.nuisance]
        from_chain = by_mass(self.theta, self.n_gaussians) if self.exchangeable else self.theta
        pixel_mm = choose_pixel_mm(from_chain, self.n_gaussians, step_mm=_step_mm(recording))
        field = mean_field(from_chain[:100], self.n_gaussians, pixel_mm=pixel_mm)
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
            instrumentation=recording.plan.instrumentation,
            effects=self.effects,
            patterns={e.name: e.patterns for e in cast(Iterable[NamedEffect[Any]], self.chain.effects) if e.patterns},
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
) -> ModelSamples:
    """Draw from the posterior about a fit, under the noise model it was weighed with.

    From its Laplace approximation, and on from there by tempering (`anneal`): where the SSF has several
    Gaussians the posterior is bent, and what the approximation alone draws predicts new angles worse by
    tens of nats.

    Parameters
    ----------
    found, noise
        The fit and its evidence under a noise model; the model's nodes are drawn by their weight.
    recording
        What was fitted.
    weights
        For each effect, the probability of each of its variants.
    rng
        Source of randomness.
    annealed
        Whether the samples are carried on to the posterior, or left as Laplace's approximation draws them.
    """
    law, floor, n_samples = noise.law, sd_floor(recording), N_SAMPLES
    z = np.clip(_posterior_draws(found, noise, recording, floor, annealed, rng=rng), -FARTHEST, FARTHEST)
    # What is not annealed is drawn for the effects' sake alone: the noise is then that of the fit.
    predicted = found.model.predict(z)[:, recording.usable] if annealed else found.predicted[None, :]
    residuals = recording.readings[recording.usable] - predicted
    sigma = law.scale(law(residuals.T), floor=floor)
    noise_sd = sigma * np.sqrt(law.n_points / rng.chisquare(law.n_points, n_samples))
    noise_sd = np.maximum(noise_sd, found.sd * 1e-6 + 1e-12)
    on_noise = [effect for effect in noise.noise.effects if effect.name not in NUISANCES]
    effects = (*found.model.effects, *on_noise)
    null = found.model.sensor
    chain = null.chain(recording.plan, effects, n_nodes=ACCURATE_NODES)
    own = {
        effect.name: effect.spread(
            effect_values(effect, z[:, found.model.columns_of(effect.name)]), weights[effect.name], rng=rng
        )
        for effect in found.model.effects
    }
    theta = found.model.theta_of(found.model.sensor.theta(z[:, : found.model.sensor.n_params]), own)
    nodes = rng.choice(len(noise.weights), n_samples, p=noise.weights)
    theta = np.concatenate([theta, *(_about_nodes(effect, noise, nodes, rng=rng) for effect in on_noise)], axis=1)
    names = tuple(effect.name for effect in chain.effects)
    of_lattice = [i for i, name in enumerate(chain.names) if name == f"{Quantisation.name}.step"]
    for i in of_lattice:
        sd = lattice_step_sd(recording.readings[recording.usable], float(theta[0, i]))
        theta[:, i] += sd * rng.standard_normal(n_samples)
    rounding = theta[:, of_lattice].sum(axis=1)
    noise_sd = _without_rounding(noise_sd, rounding, law.n_points)
    return ModelSamples(chain, theta, noise_sd, names, null.n_gaussians, null.nuisance, null.exchangeable)


def over_orders(parts: Sequence[ModelSamples], weights: FloatArray, *, rng: np.random.Generator) -> ModelSamples:
    """Mix samples of one hypothesis at several SSF orders by their probability.

    All are written at the largest order: a Gaussian in two equal halves is the same Gaussian.

    Parameters
    ----------
    parts
        Samples of each order, as many of each.
    weights
        Probability of each order, (n_parts,).
    rng
        Source of randomness.
    """
    largest = max(parts, key=lambda part: part.n_gaussians)
    n = len(largest.theta)
    counts = rng.multinomial(n, weights)
    order = rng.permutation(n)
    theta = [
        _halved(part.theta[:count], part.n_gaussians, largest.n_gaussians)
        for part, count in zip(parts, counts, strict=True)
    ]
    noise_sd = [part.noise_sd[:count] for part, count in zip(parts, counts, strict=True)]
    return replace(largest, theta=np.concatenate(theta)[order], noise_sd=np.concatenate(noise_sd)[order])


def doubted(
    repaired: ModelSamples,
    plain: ModelSamples,
    effects: Sequence[NamedEffect[Any]],
    share: float,
    *,
    rng: np.random.Generator,
) -> ModelSamples:
    """Let a share of the samples be those of the plain sensor, every effect's amplitudes 0 there.

    Where it is not certain what is missing, a repair may fail in scans unlike those that it comes from; then the
    plain sensor's samples are what keeps a prediction from being sure and wrong.

    Parameters
    ----------
    repaired, plain
        Samples with effects and without, `plain` of no more Gaussians, as many of each.
    effects
        Those on the mean.
    share
        Probability that it is none of these effects.
    rng
        Source of randomness.
    """
    absent = [f"{e.name}.{e.prior.names[k]}" for e in effects for k in e.amplitudes]
    if not all(effect.amplitudes for effect in effects):  # nothing says how such an effect is absent
        return repaired
    rows = np.flatnonzero(rng.random(len(repaired.theta)) < share)
    theta, n_sensor = repaired.theta.copy(), 6 * repaired.n_gaussians + 2
    theta[rows, :n_sensor] = _halved(plain.theta[rows], plain.n_gaussians, repaired.n_gaussians)[:, :n_sensor]
    for name in absent:
        theta[rows, list(repaired.chain.names).index(name)] = 0.0
    noise_sd = repaired.noise_sd.copy()
    noise_sd[rows] = plain.noise_sd[rows]
    return replace(repaired, theta=theta, noise_sd=noise_sd)


def _halved(theta: FloatArray, n_gaussians: int, wanted: int) -> FloatArray:
    """Write each sample's mixture with more Gaussians, by halving the heaviest."""
    blocks = theta[:, : 6 * n_gaussians].reshape(len(theta), n_gaussians, 6)
    rows = np.arange(len(theta))
    for _ in range(wanted - n_gaussians):
        mass = blocks[..., 0] / np.sqrt(blocks[..., 3] * blocks[..., 4] - blocks[..., 5] ** 2)
        half = blocks[rows, np.argmax(mass, axis=1)].copy()
        half[:, 0] /= 2
        blocks = np.concatenate([blocks, half[:, None, :]], axis=1)
        blocks[rows, np.argmax(mass, axis=1), 0] /= 2
    return np.concatenate([blocks.reshape(len(theta), 6 * wanted), theta[:, 6 * n_gaussians :]], axis=1)


def _posterior_draws(
    found: Fit, noise: NoiseEvidence, recording: Recording, floor: float, annealed: bool, *, rng: np.random.Generator
) -> FloatArray:
    """Draw coordinates, (N_SAMPLES, n_params): by Laplace, then annealed."""
    law = noise.law
    whitened, turned = law(found.residuals)[:, None], law(found.slopes)
    sigma = law.scale(whitened)
    variance = max(float(sigma[0]) ** 2 / law.information, 1e-300)
    curvature = turned.T @ turned / variance + np.eye(len(found.z))
    factor = np.linalg.inv(np.linalg.cholesky(curvature))
    normal = law.as_normal(whitened, np.maximum(sigma, 1e-150))[:, 0]
    center = found.z + np.linalg.solve(curvature, turned.T @ normal / variance - found.z)
    if not annealed:
        return np.asarray(center + rng.standard_normal((N_SAMPLES, len(center))) @ factor)
    problem = JointProblem(found.model, recording, noise.at_best, floor)

    def log_p(z: FloatArray) -> FloatArray:
        inside = (np.abs(z) < FARTHEST).all(axis=1)
        return np.where(inside, problem.prior.log_prob(z) + problem.log_likelihood(z), -np.inf)

    return anneal(center, factor, log_p, n_walkers=N_WALKERS, n_harvests=N_SAMPLES // N_WALKERS, rng=rng)


def _without_rounding(sd: FloatArray, step: FloatArray, n_points: int) -> FloatArray:
    """Take out of a residual's sd what rounding to a step adds; what is left is known no better than the whole is."""
    return np.asarray(np.sqrt(np.maximum(sd**2 - step**2 / 12, sd**2 * np.where(step > 0, math.sqrt(8 / n_points), 1))))


def _about_nodes(effect: NoiseEffect, noise: NoiseEvidence, nodes: IntArray, *, rng: np.random.Generator) -> FloatArray:
    """Draw one effect's parameters about the nodes drawn, as far as half way to the next: (n_samples, n_params)."""
    settings = noise.laid_out.settings[:, noise.noise.columns_of(effect.name)]
    values, units = settings[nodes], effect.prior.to_unit_cube(settings)
    gaps = np.array([np.diff(np.unique(np.round(column, 9))).min(initial=1.0) for column in units.T])
    spread = np.array([len(np.unique(column)) > 1 for column in settings.T])
    moved = np.clip(units[nodes] + (rng.random(values.shape) - 0.5) * gaps, 0.0, 1.0)
    return np.where(spread, effect.prior.from_unit_cube(moved), values)


def _step_mm(recording: Recording) -> float:
    plan = recording.plan
    moves = np.hypot(np.diff(plan.x_mm), np.diff(plan.y_mm))[np.diff(plan.scan) == 0]
    moves = moves[moves > 0]
    return float(np.median(moves)) if moves.size else max(Extent.of(recording).length_mm / 100, 1e-6)
