"""Take an evidence anew from the samples of its posterior, by a bridge to kernels fitted about them.

What a run carries from reading to reading grows uncertain by what every step adds. Kernels about the
samples are a density that can be drawn from; the samples and those draws are two ends of a bridge whose
length is the evidence (Meng & Wong 1996), absolute, whatever has been carried. Each half of the
samples is held against kernels fitted to the other half: about themselves they would seem denser than they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logsumexp

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.experiment.kernels import LocalKernels
from probewise.inference.problem import SensorProblem
from probewise.nested.importance import Weighted, pareto_k
from probewise.nested.weights import n_effective, resampled

__all__ = ["Bridged", "bridged", "redrawn"]

_WIDE = 3.0  # times as wide as the samples around are some kernels, so that the draws reach past them
_OF_WIDE = 0.15  # share of the draws that comes from those
_STEPS = 60
_CLOSE = 1e-4


@dataclass(frozen=True)
class Bridged:
    """The log evidence, its standard error, and the likelihood evaluations that it cost."""

    log_z: float
    error: float
    n_calls: int


def bridged(posterior: Weighted, problem: SensorProblem, *, rng: np.random.Generator, n_draws: int) -> Bridged:
    """Estimate the evidence of a problem.

    Parameters
    ----------
    posterior
        Samples of its posterior.
    problem
        Prior and likelihood.
    rng
        Source of randomness.
    n_draws
        Draws from the kernels, in all.

    Returns
    -------
    Bridged
        The mean of the two halves' estimates; the error is their own, or their difference where that is more.
    """
    n = len(posterior.theta) // 2 * 2
    rows = resampled(posterior.weight, n, rng)
    # Copies of one sample are in one half: their rows stand together.
    halves = np.split(rows, 2)
    found = []
    for own, other in (halves, halves[::-1]):
        density = _Density.about(posterior.theta[other], rng=rng)
        drawn = density.draw(n_draws // 2, rng=rng)
        log_prior = problem.prior.log_prob(drawn)
        possible = np.isfinite(log_prior)
        log_ratio = np.full(len(drawn), -np.inf)
        if possible.any():
            likely = problem.log_likelihood(drawn[possible])
            log_ratio[possible] = log_prior[possible] + likely - density.log_density(drawn[possible])
        theta = posterior.theta[own]
        at_samples = problem.prior.log_prob(theta) + posterior.log_likelihood[own] - density.log_density(theta)
        n_distinct = len(np.unique(own))
        found.append(_bridge(log_ratio, at_samples, n_distinct))
    (one, e1), (other_z, e2) = found
    log_z = float(logsumexp([one, other_z])) - math.log(2.0)
    error = max(0.5 * math.hypot(e1, e2), 0.5 * abs(one - other_z))
    return Bridged(log_z, error, n_draws)


def redrawn(
    points: FloatArray, names: tuple[str, ...], problem: SensorProblem, *, rng: np.random.Generator, n_draws: int
) -> Weighted:
    """Draw from kernels about points and weigh: the posterior wherever they reach, whatever their own shares are.

    Parameters
    ----------
    points
        Where the posterior may be, (n_points, n_params); of several origins.
    names
        Of the parameters.
    problem, rng, n_draws
        As for `bridged`.

    Raises
    ------
    NotConvergedError
        If no draw could have given the readings.
    """
    density = _Density.about(points, rng=rng)
    theta = density.draw(n_draws, rng=rng)
    theta = theta[np.isfinite(problem.prior.log_prob(theta))]
    log_likelihood = problem.log_likelihood(theta) if len(theta) else np.empty(0)
    alive = np.isfinite(log_likelihood)
    if not alive.any():
        raise NotConvergedError("no hypothesis near the samples could have given the readings")
    theta, log_likelihood = theta[alive], log_likelihood[alive]
    log_ratio = problem.prior.log_prob(theta) + log_likelihood - density.log_density(theta)
    log_weight = log_ratio - float(logsumexp(log_ratio))
    log_z, n_eff = float(logsumexp(log_ratio)) - math.log(n_draws), n_effective(log_weight)
    error = math.sqrt(max(1.0 / n_eff - 1.0 / n_draws, 0.0))
    return Weighted(names, theta, log_likelihood, log_weight, log_z, error, n_eff, n_draws, pareto_k(log_ratio))


@dataclass(frozen=True, eq=False)
class _Density:
    """Kernels as wide as the samples around, and some that are wider."""

    near: LocalKernels
    far: LocalKernels

    @classmethod
    def about(cls, points: FloatArray, *, rng: np.random.Generator) -> _Density:
        return cls(LocalKernels.about(points, rng=rng), LocalKernels.about(points, rng=rng, widened=_WIDE))

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        n_far = round(_OF_WIDE * n)
        return np.concatenate([self.near.draw(n - n_far, rng=rng), self.far.draw(n_far, rng=rng)])

    def log_density(self, points: FloatArray) -> FloatArray:
        near, far = self.near.log_density(points), self.far.log_density(points)
        return np.asarray(np.logaddexp(near + math.log1p(-_OF_WIDE), far + math.log(_OF_WIDE)))


def _bridge(at_draws: FloatArray, at_samples: FloatArray, n_samples: float) -> tuple[float, float]:
    """Log evidence and its error from log ratios of target to density at draws and at `n_samples` samples' worth."""
    n_draws = len(at_draws)
    if not np.isfinite(at_draws).any():
        return -math.inf, math.inf
    lean = math.log(n_samples / n_draws)
    log_z = float(logsumexp(at_draws)) - math.log(n_draws)
    for _ in range(_STEPS):
        # expit weighs each point by which end it belongs to.
        up = _log_mean(np.log(np.maximum(expit(at_draws - log_z + lean), 1e-300)))
        down = _log_mean(np.log(np.maximum(expit(-(at_samples - log_z + lean)), 1e-300)))
        step = up - down - lean
        log_z += step
        if abs(step) < _CLOSE:
            break
    of_draws, of_samples = expit(at_draws - log_z + lean), expit(-(at_samples - log_z + lean))
    variance = sum(
        float(v.var()) / max(float(v.mean()) ** 2, 1e-300) / n
        for v, n in ((of_draws, n_draws), (of_samples, n_samples))
    )
    return log_z, math.sqrt(variance)


def _log_mean(log_values: FloatArray) -> float:
    return float(logsumexp(log_values)) - math.log(len(log_values))
