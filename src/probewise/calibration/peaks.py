"""The peaks of an order's likelihood: climbs to them, and draws about them.

Climbs are by least squares (Levenberg 1944, Marquardt 1963), many starts at once. Each data set's noise sd is that of
its residuals, so that the steps follow the Student-t likelihood.

Draws are importance sampling from a Student-t at each peak, shaped by weighted draws: the first densities have the
peaks' curvature (Laplace); weighted draws shape the next (population Monte Carlo, Cappé, Guillin, Marin & Robert 2004).
Gaussians have no labels, so each density is averaged over their orders.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import expit, logit

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
_N_OF_PRIOR, _N_FREE, _N_SPLIT, _N_ADDED = 1000, 10, 10, 4  # draws of the prior; starts from them and from peaks below
_N_STEPS, _N_TRIED = 30, 8  # steps of a climb; after so many the lower half of the starts is left
_EDGE, _MOST_LOGIT = 1e-6, 14.0
_CURVATURE = 0.1  # about that of a logistic prior: it limits steps where the readings say nothing
_SETTLED = 1e-3


def climb(problem: SensorProblem, alone: SensorProblem, starts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Climb to a peak of the likelihood from each start, (n_starts, 6 N + 2), the lower half for a few steps only.

    `problem`: of an `SSFPrior` and a `StudentT` likelihood; `alone`: the same of one Gaussian. Return where the climbs
    end and ln L there, (n_starts,), highest first.
    """
    prior, likelihood, recording = problem.prior, problem.likelihood, problem.recording
    assert isinstance(prior, SSFPrior)
    assert isinstance(likelihood, StudentT)
    readings = recording.readings[recording.usable]

    def residuals(z: FloatArray) -> FloatArray:
        predicted = problem.model.predict(prior.from_unit_cube(expit(z)), recording.plan)
        return np.asarray(readings - predicted[:, recording.usable])

    z = logit(prior.to_unit_cube(starts).clip(_EDGE, 1.0 - _EDGE))
    off = residuals(z)
    high = likelihood.log_prob(readings, readings - off)
    damping, going = np.full(len(z), 1e-2), np.ones(len(z), dtype=np.bool_)
    for k in range(_N_STEPS):
        if k == _N_TRIED:
            going &= high >= np.median(high)
        rows = np.flatnonzero(going)
        if not rows.size:
            break
        slope = _slopes(prior, alone, z[rows])
        weighted = slope * likelihood.inverse_noise_variance(off[rows])[:, None, :]
        curvature = weighted @ slope.transpose(0, 2, 1)
        scale = damping[rows, None] * (np.einsum("ndd->nd", curvature) + _CURVATURE) + 0.01 * _CURVATURE
        gradient = np.einsum("ndp,np->nd", weighted, off[rows])
        step = np.linalg.solve(curvature + scale[:, None, :] * np.eye(z.shape[1]), gradient[..., None])[..., 0]
        to = (z[rows] + step.clip(-2.0, 2.0)).clip(-_MOST_LOGIT, _MOST_LOGIT)
        there = residuals(to)
        gain = likelihood.log_prob(readings, readings - there) - high[rows]
        better = gain > 0.0
        up = rows[better]
        z[up], off[up], high[up] = to[better], there[better], high[up] + gain[better]
        damping[rows] = (damping[rows] * np.where(better, 0.2, 5.0)).clip(1e-9, 1e9)
        going[rows] = (gain > _SETTLED) | (~better & (damping[rows] < 1e6))
    order = np.argsort(-high)
    return prior.from_unit_cube(expit(z[order])), high[order]


def _slopes(prior: SSFPrior, alone: SensorProblem, z: FloatArray) -> FloatArray:
    """Differentiate the predictions by the logits `z` of the prior's cube, (n, d) -> (n, d, n_used).

    A change of one Gaussian leaves the responses to the others unchanged, so one kind of parameter is changed for all
    Gaussians at once; a change of light needs no new response.
    """
    n, n_gaussians = len(z), prior.n_gaussians
    changed = np.repeat(z[None], 7, axis=0)
    for kind in range(6):
        changed[1 + kind, :, kind:-2:6] += _DIFFERENCE
    theta = prior.from_unit_cube(expit(changed.reshape(7 * n, -1)))
    # The light is the first kind, with the responses of no change.
    each = np.concatenate([theta[:n], theta[2 * n :]])[:, :-2].reshape(-1, 6)
    lone = np.column_stack([np.ones(len(each)), each[:, 1:], np.zeros(len(each)), np.ones(len(each))])
    seen = alone.model.predict(lone, alone.recording.plan)[:, alone.recording.usable].reshape(6, n, n_gaussians, -1)
    g = theta[:, :-2].reshape(7, n, n_gaussians, 6)
    light = g[..., 0] / np.sqrt(g[..., 3] * g[..., 4] - g[..., 5] ** 2)
    whole = light[0].sum(axis=1)
    lit = light[0][..., None] * seen[0]
    mixed = lit.sum(axis=1) / whole[:, None]
    span = (theta[:n, -1] - theta[:n, -2])[:, None, None] / _DIFFERENCE
    slope = np.empty((*z.shape, seen.shape[-1]))
    for kind in range(6):
        more = light[1 + kind] - light[0]
        change = light[1 + kind][..., None] * seen[kind] - lit - more[..., None] * mixed[:, None]
        slope[:, kind:-2:6] = change * span / (whole[:, None] + more)[..., None]
    levels = (prior.from_unit_cube(expit(z + _DIFFERENCE))[:, -2:] - theta[:n, -2:]) / _DIFFERENCE
    slope[:, -2], slope[:, -1] = levels[:, :1] * (1.0 - mixed), levels[:, 1:] * mixed
    return slope


def starts_of_climbs(problem: SensorProblem, below: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw starts of N Gaussians: the best draws of the prior, and peaks of N - 1 with one split or added.

    `below`: peaks of N - 1, (n_peaks, 6 N - 4), none for N = 1. Return (n_starts, 6 N + 2).
    """
    prior = problem.prior
    assert isinstance(prior, SSFPrior)
    drawn = prior.from_unit_cube(rng.random((_N_OF_PRIOR, len(prior.names))))
    best = drawn[np.argsort(-problem.log_likelihood(drawn))[:_N_FREE]]
    if prior.n_gaussians == 1:
        return best
    theta = np.resize(below, (_N_SPLIT + _N_ADDED, below.shape[1]))
    return np.concatenate([best, _split(theta[:_N_SPLIT], rng), _added(prior, theta[_N_SPLIT:], drawn, rng)])


def _split(theta: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Split a random Gaussian per row into two of its light, centre and covariance, (n, 6 N - 4) -> (n, 6 N + 2)."""
    m = len(theta)
    g = theta[:, :-2].reshape(m, -1, 6)
    rows, which = np.arange(m), rng.integers(g.shape[1], size=m)
    whole = g[rows, which]
    covariance = 0.5 * np.linalg.inv(whole[:, [3, 5, 5, 4]].reshape(m, 2, 2))
    share, angle, reach = rng.uniform(0.2, 0.8, m), rng.uniform(0.0, 2.0 * np.pi, m), rng.uniform(0.4, 0.97, m)
    towards = reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    apart = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), towards)
    left = 0.5 * np.linalg.inv(covariance - apart[:, :, None] * apart[:, None, :])
    scale = np.sqrt(np.linalg.det(left) / (whole[:, 3] * whole[:, 4] - whole[:, 5] ** 2))
    parts = []
    for own, side in ((share, np.sqrt((1.0 - share) / share)), (1.0 - share, -np.sqrt(share / (1.0 - share)))):
        centre = whole[:, 1:3] + side[:, None] * apart
        parts.append(np.column_stack([whole[:, 0] * own * scale, centre, left.reshape(m, 4)[:, [0, 3, 1]]]))
    out = theta.copy()
    out[:, :-2].reshape(m, -1, 6)[rows, which] = parts[0]
    return np.concatenate([out[:, :-2], parts[1], out[:, -2:]], axis=1)


def _added(prior: SSFPrior, theta: FloatArray, drawn: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Add a Gaussian of the prior's draws, of 0.01 to 0.2 of the first one's light: (n, 6 N - 4) -> (n, 6 N + 2)."""
    new, first = drawn[: len(theta), :6].copy(), theta[:, :6]
    unit = [prior.amplitude_at_unit_mass(g[:, 3] * g[:, 4] - g[:, 5] ** 2) for g in (new, first)]
    new[:, 0] = first[:, 0] / unit[1] * rng.uniform(0.01, 0.2, len(new)) * unit[0]
    return np.concatenate([theta[:, :-2], new, theta[:, -2:]], axis=1)


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
class StudentTDensity:
    """A multivariate Student-t of 8 degrees of freedom: mean, (d,), and Cholesky root of its scale matrix, (d, d)."""

    mean: FloatArray
    root: FloatArray

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, d)."""
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

    def refitted(self, y: FloatArray, log_weight: FloatArray) -> StudentTDensity:
        """Fit to weighted draws; the fewer are effective, the more of the present covariance is kept."""
        least = _LEAST_PER_COORDINATE * y.shape[1]
        log_weight = tempering_power(log_weight, least) * log_weight
        weight = np.exp(log_weight - logsumexp(log_weight))
        mean = weight @ y
        off = y - mean
        kept = min(1.0, y.shape[1] / n_effective(log_weight))
        covariance = (1.0 - kept) * (off * weight[:, None]).T @ off + kept * self.root @ self.root.T
        return StudentTDensity(mean, np.asarray(np.linalg.cholesky(_WIDENED**2 * covariance)))


@dataclass(frozen=True, eq=False)
class _MixtureAboutPeaks:
    """Densities about peaks, each averaged over the labels, in the coordinates `space`, with shares that sum to 1."""

    space: LightContrasts
    densities: list[StudentTDensity]
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


def weigh_draws_about_peaks(
    problem: SensorProblem, peaks: FloatArray, *, rng: np.random.Generator
) -> tuple[Weighted, Callable[[FloatArray], FloatArray]]:
    """Estimate evidence and posterior from draws about peaks, (n_peaks, 6 N + 2): the first six distinct ones.

    A peak near an earlier one under any labels is none of its own. `problem`: with an `SSFPrior` of uniform light. Also
    return the log weight as a function of parameters: of prior times likelihood over the density of the draws.
    """
    assert isinstance(problem.prior, SSFPrior)
    space, densities, log_z, n_calls = LightContrasts(problem.prior), list[StudentTDensity](), list[float](), 0
    for peak in peaks:
        labelled = space.relabelled(space.enter(peak[None]))
        distance = min((density.square_distance(labelled).min() for density in densities), default=math.inf)
        if len(densities) < _MOST_PEAKS and distance > _SAME * labelled.shape[-1]:
            densities.append(laplace(problem, space, peak))
    for k, density in enumerate(densities):
        own = -math.inf
        for _ in range(_N_ROUNDS):
            y, theta, log_density = _MixtureAboutPeaks(space, [density], np.ones(1)).draw(_N_PILOTS, rng)
            if len(y) < 2 * y.shape[1]:
                density = StudentTDensity(density.mean, 0.5 * density.root)
                continue
            log_weight = problem.log_likelihood(theta) - log_density
            n_calls += len(y)
            own = float(logsumexp(log_weight)) - math.log(_N_PILOTS)
            density = density.refitted(y, log_weight)
        densities[k] = density
        log_z.append(own)
    by_evidence = np.exp(np.array(log_z) - logsumexp(log_z)) if max(log_z) > -math.inf else np.ones(1)
    share = _BY_EVIDENCE * by_evidence + (1.0 - _BY_EVIDENCE) / len(densities)
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


def laplace(problem: SensorProblem, space: Coordinates | LightContrasts, peak: FloatArray) -> StudentTDensity:
    """Return the density about a peak, (6 N + 2,), by the curvature there.

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
    covariance = np.linalg.inv((slope * weight) @ slope.T + np.diag(1.0 / wide))
    return StudentTDensity(at, np.asarray(np.linalg.cholesky(_WIDENED**2 * covariance)))
