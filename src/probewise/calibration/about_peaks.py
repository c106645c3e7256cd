"""Importance sampling about the peaks of an order's likelihood: a Student-t at each, shaped by weighted draws.

The first densities have the peaks' curvature (Laplace); weighted draws shape the next (population Monte Carlo, Cappé,
Guillin, Marin & Robert 2004). Gaussians have no labels, so each density is averaged over their orders.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray, logsumexp
from probewise.calibration.priors import SSFPrior
from probewise.inference import SensorProblem, StudentT
from probewise.nested import Weighted
from probewise.nested.importance import weighted_draws
from probewise.nested.weights import n_effective, student_t_draws, student_t_log_norm, tempering_power
from probewise.priors import Coordinates

MOST_RELABELLED = 5
"""Number of Gaussians up to which labels are permuted: 120 labellings."""

_MOST_LOG, _DIFFERENCE = 60.0, 1e-5
_MOST_PEAKS, _SAME = 6, 3.0  # peaks, and mean square distance per coordinate, in sds, up to which two are one
_DEGREES_OF_FREEDOM, _WIDENED = 8.0, 1.1
_N_ROUNDS, _N_PILOTS, _N_DRAWS = 4, 500, 4000
_LEAST_PER_COORDINATE = 6.0  # effective draws per coordinate to which the weights of pilots are tempered
_BY_EVIDENCE = 0.8  # share of the draws that follow the peaks' evidences; the others are even


@dataclass(frozen=True)
class LightContrasts:
    """Coordinates of N Gaussians in which a permutation of labels leaves volumes unchanged, 6 N + 1 numbers.

    Contrasts of the logs of light, then for each Gaussian its centre, log variances along x' and y' and the inverse
    hyperbolic tangent of its correlation; then the levels. Readings depend on ratios of light alone, so the sum of the
    logs is left out, and drawn from its prior. `prior`: with light uniform from 0.
    """

    prior: SSFPrior

    @cached_property
    def _contrasts(self) -> FloatArray:
        """Orthonormal contrasts of N logs, (N - 1, N)."""
        n = self.prior.n_gaussians
        rows = [np.r_[np.ones(k), -float(k), np.zeros(n - k - 1)] / math.sqrt(k * (k + 1)) for k in range(1, n)]
        return np.array(rows).reshape(n - 1, n)

    @cached_property
    def _permutations(self) -> list[tuple[IntArray, FloatArray]]:
        """Per permutation of labels, the order of shapes and levels, (5 N + 2,), and the matrix of the contrasts."""
        n, c = self.prior.n_gaussians, self._contrasts
        found = []
        for order in itertools.permutations(range(n)) if n <= MOST_RELABELLED else [range(n)]:
            shapes = (5 * np.array(order)[:, None] + np.arange(5)).ravel()
            found.append((np.r_[shapes, 5 * n, 5 * n + 1], c[:, np.argsort(order)] @ c.T))
        return found

    def relabelled(self, y: FloatArray) -> FloatArray:
        """Return points, (n, 6 N + 1), under every permutation of labels, (N!, n, 6 N + 1)."""
        k = self.prior.n_gaussians - 1
        return np.stack([np.concatenate([y[:, :k] @ m.T, y[:, k:][:, cols]], axis=1) for cols, m in self._permutations])

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters, (n, 6 N + 2), to coordinates, (n, 6 N + 1)."""
        n = self.prior.n_gaussians
        _, u, v, a, b, c = g = np.moveaxis(theta[:, :-2].reshape(len(theta), n, 6), 2, 0)
        det = a * b - c * c
        shape = np.stack([u, v, np.log(0.5 * b / det), np.log(0.5 * a / det), np.arctanh(-c / np.sqrt(a * b))], axis=-1)
        light = (np.log(g[0]) - 0.5 * np.log(det)) @ self._contrasts.T
        return np.concatenate([light, shape.reshape(len(theta), 5 * n), theta[:, -2:]], axis=1)

    def leave(self, y: FloatArray, u: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters; also return the log prior density of each labelling, -inf outside, (n,).

        `u`: uniform numbers, (n,), by which the light of all is drawn; by default the heaviest holds one unit.
        """
        n = self.prior.n_gaussians
        log_light = (y[:, : n - 1] @ self._contrasts).clip(-_MOST_LOG, _MOST_LOG)
        shape = y[:, n - 1 : -2].reshape(len(y), n, 5)
        log_variance, r = shape[..., 2:4].clip(-_MOST_LOG, _MOST_LOG), np.tanh(shape[..., 4])
        rest = np.maximum(1.0 - r * r, 1e-12)
        g = np.empty((len(y), n, 6))
        g[..., 1:3] = shape[..., :2]
        g[..., 3:5] = 0.5 * np.exp(-log_variance) / rest[..., None]
        g[..., 5] = -r * np.sqrt(g[..., 3] * g[..., 4])
        scale = self.prior.amplitude_at_unit_mass(g[..., 3] * g[..., 4] * rest)
        g[..., 0] = scale * np.exp(log_light - log_light.max(axis=1, keepdims=True)) * (1.0 - 1e-12)
        theta = np.concatenate([g.reshape(len(y), 6 * n), y[:, -2:]], axis=1)
        jacobian = np.log(g[..., 0]) - 1.5 * log_variance.sum(axis=-1) - 2.0 * np.log(rest) - 3.0 * math.log(2.0)
        log_density = self.prior.log_prob(theta) + jacobian.sum(axis=1) - 0.5 * math.log(n)
        if u is not None:
            theta[:, : 6 * n : 6] *= u[:, None] ** (1.0 / n)
        return theta, np.where(np.isfinite(log_density), log_density, -np.inf)


@dataclass(frozen=True, eq=False)
class _StudentTDensity:
    """A multivariate Student-t of 8 degrees of freedom: mean, (d,), and Cholesky root of its scale matrix, (d, d)."""

    mean: FloatArray
    root: FloatArray

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        return np.asarray(self.mean + student_t_draws(n, len(self.mean), _DEGREES_OF_FREEDOM, rng=rng) @ self.root.T)

    def square_distance(self, y: FloatArray) -> FloatArray:
        """Squared distance from the mean in units of the root, (..., d) -> (...)."""
        white = np.linalg.solve(self.root, (y - self.mean).reshape(-1, len(self.mean)).T)
        return np.asarray((white**2).sum(axis=0).reshape(y.shape[:-1]))

    def log_density(self, y: FloatArray) -> FloatArray:
        """Natural log of the density, (..., d) -> (...)."""
        nu, d = _DEGREES_OF_FREEDOM, len(self.mean)
        norm = student_t_log_norm(d, nu) - float(np.log(np.diag(self.root)).sum())
        return np.asarray(norm - 0.5 * (nu + d) * np.log1p(self.square_distance(y) / nu))

    def refitted(self, y: FloatArray, log_weight: FloatArray) -> _StudentTDensity:
        """Fit to weighted draws; the fewer are effective, the more of the present covariance is kept."""
        least = _LEAST_PER_COORDINATE * y.shape[1]
        log_weight = tempering_power(log_weight, least) * log_weight
        weight = np.exp(log_weight - logsumexp(log_weight))
        mean = weight @ y
        off = y - mean
        kept = min(1.0, y.shape[1] / n_effective(log_weight))
        covariance = (1.0 - kept) * (off * weight[:, None]).T @ off + kept * self.root @ self.root.T
        return _StudentTDensity(mean, np.asarray(np.linalg.cholesky(_WIDENED**2 * covariance)))


@dataclass(frozen=True, eq=False)
class _MixtureAboutPeaks:
    """Densities about peaks, each averaged over the labels, in the coordinates `space`, with shares that sum to 1."""

    space: LightContrasts
    densities: list[_StudentTDensity]
    share: FloatArray

    def log_density(self, y: FloatArray) -> FloatArray:
        """Natural log of the density, (n, 6 N + 1) -> (n,)."""
        labelled = self.space.relabelled(y)
        log_share = np.log(self.share / len(labelled))
        each = [d.log_density(labelled) + s for d, s in zip(self.densities, log_share, strict=True)]
        return np.asarray(logsumexp(np.concatenate(each), axis=0))

    def draw(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Make `n` draws; of those within the prior return coordinates, parameters, log density over the prior's."""
        counts = rng.multinomial(n, self.share)
        y = np.concatenate([d.draw(count, rng) for d, count in zip(self.densities, counts, strict=True)])
        theta, log_prior = self.space.leave(y, rng.random(n))
        inside = np.isfinite(log_prior)
        return y[inside], theta[inside], self.log_density(y[inside]) - log_prior[inside]


def distinct_peaks(problem: SensorProblem, peaks: FloatArray) -> FloatArray:
    """Leave out peaks near an earlier one under any labels, (n_peaks, 6 N + 2), and all but the first six distinct."""
    assert isinstance(problem.prior, SSFPrior)
    space = LightContrasts(problem.prior)
    kept: list[FloatArray] = []
    densities: list[_StudentTDensity] = []
    for peak in peaks:
        labelled = space.relabelled(space.enter(peak[None]))
        distance = min((density.square_distance(labelled).min() for density in densities), default=math.inf)
        if len(kept) < _MOST_PEAKS and distance > _SAME * labelled.shape[-1]:
            densities.append(_laplace(problem, space, peak))
            kept.append(peak)
    return np.array(kept)


def weigh_draws_about_peaks(
    problem: SensorProblem, peaks: FloatArray, *, rng: np.random.Generator
) -> tuple[Weighted, Callable[[FloatArray], FloatArray]]:
    """Estimate evidence and posterior from draws about distinct peaks, (n_peaks, 6 N + 2).

    `problem`: with an `SSFPrior` of uniform light. Also return the log weight as a function of parameters: of prior
    times likelihood over the density of the draws.
    """
    assert isinstance(problem.prior, SSFPrior)
    space, densities, log_z, n_calls = LightContrasts(problem.prior), [], [], 0
    for peak in peaks:
        density, own = _laplace(problem, space, peak), -math.inf
        for _ in range(_N_ROUNDS):
            y, theta, log_density = _MixtureAboutPeaks(space, [density], np.ones(1)).draw(_N_PILOTS, rng)
            if len(y) < 2 * y.shape[1]:
                density = _StudentTDensity(density.mean, 0.5 * density.root)
                continue
            log_weight = problem.log_likelihood(theta) - log_density
            n_calls += len(y)
            own = float(logsumexp(log_weight)) - math.log(_N_PILOTS)
            density = density.refitted(y, log_weight)
        densities.append(density)
        log_z.append(own)
    by_evidence = np.exp(np.array(log_z) - logsumexp(log_z)) if max(log_z) > -math.inf else np.ones(1)
    share = _BY_EVIDENCE * by_evidence + (1.0 - _BY_EVIDENCE) / len(peaks)
    mixture = _MixtureAboutPeaks(space, densities, share / share.sum())
    _, theta, log_density = mixture.draw(_N_DRAWS, rng)
    log_likelihood = problem.log_likelihood(theta)
    found = weighted_draws(problem.prior.names, theta, log_likelihood, log_likelihood - log_density, _N_DRAWS)
    # The mean of weights of infinite variance converges as n^(k - 1) instead of n^(-1/2) (Vehtari et al. 2024).
    error = found.log_z_error * _N_DRAWS ** min(max(found.pareto_k - 0.5, 0.0), 1.0)

    def log_weight_at(theta: FloatArray) -> FloatArray:
        y = space.enter(theta)
        return problem.log_likelihood(theta) + space.leave(y)[1] - mixture.log_density(y)

    return replace(found, log_z_error=error, n_calls=n_calls + len(theta)), log_weight_at


def _laplace(problem: SensorProblem, space: LightContrasts, peak: FloatArray) -> _StudentTDensity:
    at, covariance = laplace(problem, space, peak)
    return _StudentTDensity(at, np.asarray(np.linalg.cholesky(_WIDENED**2 * covariance)))


def laplace(
    problem: SensorProblem, space: Coordinates | LightContrasts, peak: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a peak, (6 N + 2,), in the coordinates, (d,), and the covariance by the curvature there, (d, d).

    Along coordinates of little information it has the prior's width.
    """
    prior, recording, likelihood = problem.prior, problem.recording, problem.likelihood
    assert isinstance(likelihood, StudentT)
    at = space.enter(peak[None])[0]
    wide = space.enter(prior.from_unit_cube(np.random.default_rng(0).random((500, len(prior.names))))).var(axis=0)
    theta, _ = space.leave(at + _DIFFERENCE * np.concatenate([np.zeros((1, len(at))), np.eye(len(at))]))
    predicted = problem.model.predict(theta, recording.plan)[:, recording.usable]
    slope = (predicted[1:] - predicted[0]) / _DIFFERENCE
    weight = likelihood.inverse_noise_variance(recording.readings[recording.usable] - predicted[:1])[0]
    return at, np.linalg.inv((slope * weight) @ slope.T + np.diag(1.0 / wide))
