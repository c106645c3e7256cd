"""Draws of a fit's coordinates from its posterior.

Importance resampling from the closest proposal at hand, or annealing where no proposal is close enough.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.hypothesis_problem import HypothesisProblem
from probewise.diagnosis.evidence.laplace import NoiseEvidence
from probewise.diagnosis.fitting.coordinates import FARTHEST
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.repair.annealing import Density, draw_by_annealing, importance_resample
from probewise.diagnosis.repair.conditionally_linear import ConditionallyLinearDensity
from probewise.diagnosis.repair.linear_amplitudes import LinearAmplitudes
from probewise.diagnosis.repair.profiled import ProfiledDensity
from probewise.diagnosis.repair.quadratic import QuadraticPredictions
from probewise.diagnosis.repair.surrogate import SurrogatePosterior
from probewise.progress import Progress, silent
from probewise.recordings.plan import Recording

_N_WALKERS = 250
_MOVES = 6  # of each walker after a step of beta
_N_FIRST = 1000  # draws of a proposal
_LEAST = 0.25  # least effective share of draws by a linear view of the simulation,
_NEARLY_ALL = 0.8  # and where slices of the simulation itself cost little
# The surrogate costs next to nothing.
_N_NEAR = 2000
_MOVES_NEAR = 20


def posterior_draws(
    found: Fit,
    noise: NoiseEvidence,
    recording: Recording,
    n_samples: int,
    *,
    annealed: bool = True,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> FloatArray:
    """Draw coordinates, (n_samples, n_params), from the posterior about a fit, under one noise model.

    Unless `annealed`, they are draws of Laplace's approximation, or of `LinearAmplitudes` where it applies. Otherwise:
    If an effect on the readings has a nonlinear coordinate, they are resampled from a `ConditionallyLinearDensity`;
    where many samples cost little more than one, from a `ProfiledDensity` if an effect has a nonlinear coordinate, or
    else from `LinearAmplitudes`. Without any of these, samples of Laplace's approximation are moved to the posterior in
    two stages, the first through a quadratic surrogate: with several Gaussians the posterior is curved, and Laplace's
    samples predict new angles far worse.

    `n_samples` is their number; the other parameters are those of `sample_model`.
    """
    laplace = _Laplace.of(found, noise, recording)
    if not annealed:
        linear = laplace.linear_amplitudes
        return laplace.draw(n_samples, rng=rng) if linear is None else linear.draw(n_samples, rng=rng)
    steps = rng.standard_normal((_N_NEAR, len(found.z)))
    problem = HypothesisProblem(found.model, recording, noise.with_likeliest_node_alone)

    def log_posterior(z: FloatArray) -> FloatArray:
        height = problem.prior.log_prob(z) + problem.log_likelihood(z)
        return np.where((np.abs(z) < FARTHEST).all(axis=1), height, -np.inf)

    for weighed in _resampled_from_proposals(laplace, log_posterior, n_samples, rng=rng):
        if weighed is not None:
            return weighed
    return _annealed(laplace, steps, log_posterior, n_samples, rng=rng, progress=progress)


@dataclass(frozen=True, eq=False)
class _Laplace:
    """Laplace's approximation to the posterior about a fit: normal about `center`, covariance `steps.T @ steps`.

    `sd` is that of a whitened reading; `slopes` (n_points, n_params) and `residual` (n_points,) are whitened, in sds.
    """

    found: Fit
    recording: Recording
    law: NoiseLaw
    sd: float
    slopes: FloatArray
    residual: FloatArray
    steps: FloatArray

    @classmethod
    def of(cls, found: Fit, noise: NoiseEvidence, recording: Recording) -> Self:
        law = noise.likeliest_law
        whitened, turned = law(found.residuals)[:, None], law(found.slopes)
        sigma = law.likeliest_sigma(whitened)
        sd = max(float(sigma[0]) / math.sqrt(law.fisher_information), 1e-150)
        curvature = turned.T @ turned / sd**2 + np.eye(len(found.z))
        # A step in one coordinate also moves the later ones. With the effects first and the sensor last, most steps
        # leave the SSF's geometry unchanged, which speeds up vectorised predictions.
        order = np.roll(np.arange(len(found.z)), -found.model.sensor.n_params)
        at, steps = np.ix_(order, order), np.empty_like(curvature)
        steps[at] = np.linalg.inv(np.linalg.cholesky(curvature[at][::-1, ::-1]))[::-1, ::-1]
        normal = law.normal_pseudo_residuals(whitened, np.maximum(sigma, 1e-150))[:, 0]
        return cls(found, recording, law, sd, turned / sd, normal / sd, steps)

    @cached_property
    def center(self) -> FloatArray:
        """The mode, one Newton step from the fit, (n_params,)."""
        found, curvature = self.found, self.slopes.T @ self.slopes + np.eye(len(self.found.z))
        center = found.z + np.linalg.solve(curvature, self.slopes.T @ self.residual - found.z)
        center = np.asarray(np.clip(center, -FARTHEST, FARTHEST))
        if np.isfinite(found.model.predict(center[None, :])[0, self.recording.usable]).all():
            return center
        return found.z  # the step left the domain of the formula

    @cached_property
    def linear_amplitudes(self) -> LinearAmplitudes | None:
        """The same with amplitudes that are linear in their value; None if all are as good as linear already."""
        return LinearAmplitudes.of(self.found, self.slopes, self.residual)

    def draw(self, n_samples: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates, (n_samples, n_params)."""
        return np.asarray(self.center + rng.standard_normal((n_samples, len(self.center))) @ self.steps)


def _resampled_from_proposals(
    laplace: _Laplace, log_posterior: Density, n_samples: int, *, rng: np.random.Generator
) -> Iterator[FloatArray | None]:
    """Yield samples by importance from one proposal after another, None for one that is too far from the posterior."""
    found, law, recording = laplace.found, laplace.law, laplace.recording
    in_bulk = found.model.sensor.predicts_in_bulk
    grid = ConditionallyLinearDensity.of(found, law, recording, laplace.steps.T @ laplace.steps, laplace.sd)
    if grid is not None:
        first, least = grid.draw(n_samples if in_bulk else _N_FIRST, rng=rng), _NEARLY_ALL if in_bulk else _LEAST
        yield importance_resample(first, grid.log_density, log_posterior, n_wanted=n_samples, rng=rng, least=least)
    if not in_bulk:
        return
    profiled = ProfiledDensity.of(found, law, recording)
    if profiled is not None:
        yield profiled.importance_resample(log_posterior, n_first=_N_FIRST, n_wanted=n_samples, rng=rng)
    linear = laplace.linear_amplitudes
    if linear is not None:
        first = linear.draw(_N_FIRST, rng=rng)
        yield importance_resample(first, linear.log_density, log_posterior, n_wanted=n_samples, rng=rng)


def _annealed(
    laplace: _Laplace,
    draws: FloatArray,
    log_posterior: Density,
    n_samples: int,
    *,
    rng: np.random.Generator,
    progress: Progress,
) -> FloatArray:
    """Move standard normal draws, (n, n_params), to the surrogate of the posterior, then to the posterior itself."""
    model, usable, center, steps = laplace.found.model, laplace.recording.usable, laplace.center, laplace.steps
    quadratic = QuadraticPredictions.of(lambda e: model.predict(center + e @ steps)[:, usable], len(center), laplace.sd)
    near = SurrogatePosterior.of(quadratic, center, steps, laplace.recording.readings[usable], laplace.law)

    def log_laplace(e: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.sum(e**2, axis=1))

    def log_posterior_of_steps(e: FloatArray) -> FloatArray:
        return log_posterior(center + e @ steps)

    def resampled_or_annealed(first: FloatArray, log_q: Density, log_p: Density, n_moves: int, n: int) -> FloatArray:
        weighed = importance_resample(first, log_q, log_p, n_wanted=n, rng=rng)
        if weighed is not None:
            return weighed
        return draw_by_annealing(
            first[:_N_WALKERS], log_q, log_p, n_moves=n_moves, n_wanted=n, rng=rng, progress=progress
        )

    e = resampled_or_annealed(draws, log_laplace, near.log_density, _MOVES_NEAR, _N_NEAR)
    return center + resampled_or_annealed(e, near.log_density, log_posterior_of_steps, _MOVES, n_samples) @ steps
