"""Evidence re-estimated from posterior samples, by bridge sampling with kernels fitted to the samples.

The sequential estimate of the evidence accumulates errors from reading to reading. Bridge sampling (Meng & Wong 1996)
between the samples and draws from a kernel density fitted to them gives an estimate independent of the history. Each
half of the samples is compared with kernels fitted to the other half, to avoid the bias of evaluating a density at its
own points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logsumexp

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.experiment.kernels import LocalKernels
from probewise.inference.problem import SensorProblem
from probewise.nested import Weighted, pareto_k
from probewise.nested.weights import n_effective, resampled_rows

_WIDE = 3.0  # factor on the width of some kernels, so that draws extend beyond the samples
_OF_WIDE = 0.15  # share of the draws from those
_STEPS = 60
_CLOSE = 1e-4
_UNKNOWN = 2.0  # nats: error of an evidence that cannot be estimated anew


@dataclass(frozen=True)
class BridgedEvidence:
    """Log evidence, its standard error, and the number of likelihood evaluations."""

    log_z: float
    error: float
    n_calls: int


def bridged_evidence(
    posterior: Weighted, problem: SensorProblem, *, rng: np.random.Generator, n_draws: int
) -> BridgedEvidence:
    """Estimate the evidence of a problem.

    Parameters
    ----------
    posterior
        Samples of the problem's posterior.
    problem
        Prior and likelihood.
    rng
        Source of randomness.
    n_draws
        Total number of draws from the kernels.

    Returns
    -------
    The mean of the evidences of two halves of the samples; its error is their standard error, or half the difference of
    their logs if larger. If too few samples are distinct: the posterior's own evidence, its error 2 nats or more.
    """
    n = len(posterior.theta) // 2 * 2
    rows = resampled_rows(posterior.weight, n, rng)
    # Copies of a sample are adjacent, and so are in the same half.
    halves = np.split(rows, 2)
    if min(len(np.unique(posterior.theta[half, 0])) for half in halves) <= 2 * posterior.theta.shape[1]:
        return BridgedEvidence(posterior.log_z, max(posterior.log_z_error, _UNKNOWN), 0)  # too few to fit kernels
    found = []
    for own, other in (halves, halves[::-1]):
        density = _KernelDensity.fitted_to(posterior.theta[other], rng=rng)
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
        found.append(_bridged_log_z_and_error(log_ratio, at_samples, n_distinct))
    (one, e1), (other_z, e2) = found
    log_z = float(logsumexp([one, other_z])) - math.log(2.0)
    error = max(0.5 * math.hypot(e1, e2), 0.5 * abs(one - other_z))
    return BridgedEvidence(log_z, error, n_draws)


def posterior_sampled_about_points(
    points: FloatArray, problem: SensorProblem, *, rng: np.random.Generator, n_draws: int
) -> Weighted:
    """Sample the posterior by importance sampling from a kernel density fitted to points.

    Parameters
    ----------
    points
        Points near the posterior, (n_points, n_params), of any origin and weight.
    problem, rng, n_draws
        As for `bridged_evidence`.

    Raises
    ------
    NotConvergedError
        If no draw could have given the readings.
    """
    density = _KernelDensity.fitted_to(points, rng=rng)
    found = importance_weighted_draws(density.draw(n_draws, rng=rng), density.log_density, problem)
    if found is None:
        raise NotConvergedError("no hypothesis near the samples could have given the readings")
    return found


def importance_weighted_draws(
    draws: FloatArray, log_density: Callable[[FloatArray], FloatArray], problem: SensorProblem, *, least: int = 1
) -> Weighted | None:
    """Weight draws from a density, (n_draws, n_params), by prior times likelihood over that density.

    Impossible draws are dropped; None if fewer than `least` remain.
    """
    theta = draws[np.isfinite(problem.prior.log_prob(draws))]
    log_likelihood = problem.log_likelihood(theta) if len(theta) else np.empty(0)
    alive = np.isfinite(log_likelihood)
    if np.count_nonzero(alive) < least:
        return None
    theta, log_likelihood, n = theta[alive], log_likelihood[alive], len(draws)
    log_ratio = problem.prior.log_prob(theta) + log_likelihood - log_density(theta)
    log_sum = float(logsumexp(log_ratio))
    log_weight, log_z = log_ratio - log_sum, log_sum - math.log(n)
    n_eff = n_effective(log_weight)
    error = math.sqrt(max(1.0 / n_eff - 1.0 / n, 0.0))
    names = problem.prior.names
    return Weighted(
        names,
        theta,
        log_likelihood=log_likelihood,
        log_weight=log_weight,
        log_z=log_z,
        log_z_error=error,
        n_eff=n_eff,
        n_calls=n,
        pareto_k=pareto_k(log_ratio),
    )


@dataclass(frozen=True, eq=False)
class _KernelDensity:
    """A density of local kernels, mixed with the same kernels three times as wide (15 %)."""

    near: LocalKernels
    far: LocalKernels

    @classmethod
    def fitted_to(cls, points: FloatArray, *, rng: np.random.Generator) -> _KernelDensity:
        return cls(LocalKernels.fitted_to(points, rng=rng), LocalKernels.fitted_to(points, rng=rng, widened=_WIDE))

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        n_far = round(_OF_WIDE * n)
        return np.concatenate([self.near.draw(n - n_far, rng=rng), self.far.draw(n_far, rng=rng)])

    def log_density(self, points: FloatArray) -> FloatArray:
        near, far = self.near.log_density(points), self.far.log_density(points)
        return np.asarray(np.logaddexp(near + math.log1p(-_OF_WIDE), far + math.log(_OF_WIDE)))


def _bridged_log_z_and_error(at_draws: FloatArray, at_samples: FloatArray, n_samples: float) -> tuple[float, float]:
    """Return log evidence and error, from log ratios (prior times likelihood over density) at draws and at samples."""
    n_draws = len(at_draws)
    if not np.isfinite(at_draws).any():
        return -math.inf, math.inf
    lean = math.log(n_samples / n_draws)
    log_z = float(logsumexp(at_draws)) - math.log(n_draws)
    for _ in range(_STEPS):
        # expit weights each point between the two ends of the bridge.
        up = _log_mean_exp(np.log(np.maximum(expit(at_draws - log_z + lean), 1e-300)))
        down = _log_mean_exp(np.log(np.maximum(expit(-(at_samples - log_z + lean)), 1e-300)))
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


def _log_mean_exp(log_values: FloatArray) -> float:
    return float(logsumexp(log_values)) - math.log(len(log_values))
