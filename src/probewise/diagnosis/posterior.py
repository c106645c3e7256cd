"""Draws of a fit's coordinates from its posterior.

Importance resampling from the closest proposal at hand, or annealing where no proposal is close enough: the densities
between are q^(1 - beta) p^beta (Neal 2001). After each step of beta the samples are resampled by their weights and
moved: each half by differences of the other half (ter Braak 2006), which leaves the density invariant.

A quadratic surrogate of the model's predictions is cheap enough to move thousands of samples. It is fitted at steps of
the size of the approximate posterior, so that it interpolates over the relevant region instead of extrapolating from a
point. Negligible changes of the readings are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence import NoiseEvidence
from probewise.diagnosis.fit import FARTHEST, Fit, Model
from probewise.diagnosis.hypothesis_problem import HypothesisProblem, log_likelihood_marginal_over_sigma
from probewise.diagnosis.linear_posterior import ConditionallyLinearDensity, LinearAmplitudes
from probewise.diagnosis.noise_law import LEAST_SCALE, NoiseLaw
from probewise.diagnosis.simulator_posterior import draw_by_importance
from probewise.errors import NotConvergedError
from probewise.nested.weights import n_effective, power_bracket, resampled_rows
from probewise.progress import Progress, silent
from probewise.recordings.plan import Recording

_ENOUGH = 0.5  # target effective sample size, as a share of the samples wanted
_LEAST_OF_IT = 0.5  # least acceptable share of the target
_ALIKE = 0.98  # effective share of a few draws, from which means of all are off by a seventh of an sd at most
_EFFECTIVE = 0.5  # least effective share of the samples after a step of beta
_AT_LAST = 3  # factor on the number of moves at beta = 1
_LEAST_STEP = 1e-3

Density: TypeAlias = Callable[[FloatArray], FloatArray]
"""Log densities of samples, unnormalised, (n, n_params) -> (n,)."""


def importance_resample(
    first: FloatArray,
    log_q: Density,
    log_p: Density,
    *,
    n_wanted: int,
    rng: np.random.Generator,
    least: float = _LEAST_OF_IT * _ENOUGH,
    n_tried: int | None = None,
) -> FloatArray | None:
    """Draw from a density by importance resampling: (n_wanted, n_params), in random order.

    `first`: samples of the other density in random order, (n_first, n_params); only as many as needed are evaluated,
    for an effective sample size of half of `n_wanted`. `log_q`, `log_p`: unnormalised log densities of the proposal and
    the target; the latter is minus infinity outside its support. `least`: share of `n_wanted` that the effective sample
    size must reach; else None. `n_tried`: samples evaluated first; if these are fewer than wanted and nearly all
    effective, so are the others.
    """
    tried = first[: n_tried or n_wanted]
    gain = log_p(tried) - log_q(tried)
    share = _n_distinct_effective(gain, tried) / len(gain)
    if share * len(first) < least * n_wanted:
        return None
    if len(tried) < n_wanted and share > _ALIKE:
        return first[:n_wanted]
    enough = min(math.ceil(_ENOUGH * n_wanted / share), len(first))
    if enough > len(tried):
        more = first[len(tried) : enough]
        gain = np.append(gain, log_p(more) - log_q(more))
    if _n_distinct_effective(gain, first[: len(gain)]) < least * n_wanted:
        return None
    rows = resampled_rows(np.exp(gain - gain.max()), n_wanted, rng)
    return np.asarray(first[rng.permutation(rows)])


def _n_distinct_effective(log_weight: FloatArray, samples: FloatArray) -> float:
    """Return Kish's effective sample size; samples with an equal first coordinate count as one."""
    _, which = np.unique(samples[:, 0], return_inverse=True)
    if not np.isfinite(log_weight).any():
        return 0.0
    with np.errstate(divide="ignore"):
        return n_effective(np.log(np.bincount(which, np.exp(log_weight - log_weight.max()))))


def draw_by_annealing(
    first: FloatArray,
    log_q: Density,
    log_p: Density,
    *,
    n_moves: int,
    n_wanted: int,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> FloatArray:
    """Draw from a density by sequential Monte Carlo, starting from samples of another one, an even number.

    `n_moves`: moves of each sample after a step of beta, and between collections of samples. The rest, and what is
    returned, is as in `importance_resample`. Raises NotConvergedError if no initial sample is in the support of the
    target.
    """
    n_walkers = len(first)
    z, heights = first, (log_q(first), log_p(first))
    if not np.isfinite(heights[1]).any():
        raise NotConvergedError("no sample of the approximate posterior is within the bounds of the prior")
    beta, scale = 0.0, 1.0
    while beta < 1.0:
        gain = heights[1] - heights[0]
        after = _next_beta(gain, beta)
        kept = resampled_rows(np.exp((after - beta) * (gain - gain.max())), n_walkers, rng)
        beta, z, heights = after, z[kept], (heights[0][kept], heights[1][kept])
        progress("annealing samples to the posterior", note=f"beta {beta:.2f} of 1")
        for _ in range(n_moves if beta < 1.0 else _AT_LAST * n_moves):
            z, heights, scale = _ensemble_step(z, heights, beta, scale, log_q, log_p, rng=rng)
    harvest = [z]
    while len(harvest) * n_walkers < n_wanted:
        progress("sampling the posterior", len(harvest) * n_walkers, n_wanted)
        for _ in range(n_moves):
            z, heights, scale = _ensemble_step(z, heights, beta, scale, log_q, log_p, rng=rng)
        harvest.append(z)
    return np.asarray(rng.permutation(np.concatenate(harvest))[:n_wanted])


def _next_beta(gain: FloatArray, beta: float) -> float:
    """Find the largest beta, by bisection, at which half of the finite weights are effective samples."""
    enough = _EFFECTIVE * np.count_nonzero(np.isfinite(gain))
    if n_effective((1.0 - beta) * gain) >= enough:
        return 1.0
    low, _ = power_bracket(lambda power: (power - beta) * gain, beta, 1.0, wanted=enough, n_steps=30)
    return min(max(low, beta + _LEAST_STEP), 1.0)


def _ensemble_step(
    z: FloatArray,
    heights: tuple[FloatArray, FloatArray],
    beta: float,
    scale: float,
    log_q: Density,
    log_p: Density,
    *,
    rng: np.random.Generator,
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], float]:
    """Move one half of the walkers by differences of the other half, then vice versa; adapt the step size."""
    z, q, p = z.copy(), heights[0].copy(), heights[1].copy()
    order, n = rng.permutation(len(z)), len(z) // 2
    accepted = 0
    for own, other in ((order[:n], order[n:]), (order[n:], order[:n])):
        first, second = (z[rng.choice(other, len(own))] for _ in range(2))
        length = scale * 2.38 / math.sqrt(2 * z.shape[1]) * rng.choice([1.0, 0.3], (len(own), 1))
        to = z[own] + length * (first - second)
        to_q, to_p = log_q(to), log_p(to)
        inside = np.isfinite(to_q) & np.isfinite(to_p)
        rise = (1 - beta) * (to_q[inside] - q[own][inside]) + beta * (to_p[inside] - p[own][inside])
        taken = inside.copy()
        taken[inside] = np.log(rng.random(len(own)))[inside] < rise
        z[own[taken]], q[own[taken]], p[own[taken]] = to[taken], to_q[taken], to_p[taken]
        accepted += int(taken.sum())
    rate = accepted / len(z)
    return z, (q, p), min(max(scale * (1.3 if rate > 0.35 else 0.75 if rate < 0.15 else 1.0), 0.05), 2.0)


_NEGLIGIBLE = 0.02  # noise sds, over all readings together: smaller changes at one step are neglected
_RUNS_AWAY = 1e100  # of a prediction, whose square overflows: it counts as impossible


@dataclass(frozen=True, eq=False)
class QuadraticPredictions:
    """Quadratic predictions at steps `e` from a point: `center` + `change_coefficients(e)` @ `changes`.

    `center` (n_points,) are the predictions at the point; `changes` (n_changes, n_points) are orthonormal. Their
    coefficients are linear in n_terms terms, the steps and products of `pairs` of steps, by `shares` (n_terms,
    n_changes).
    """

    center: FloatArray
    pairs: tuple[IntArray, IntArray]
    shares: FloatArray
    changes: FloatArray

    @classmethod
    def of(cls, predict: Callable[[FloatArray], FloatArray], n_params: int, sd: float) -> QuadraticPredictions:
        """Build the surrogate; it is exact, but for negligible changes, at every step, its reverse, and sums of two.

        `predict`: the model as a function of steps, (n_samples, n_params) -> (n_samples, n_points); finite at step 0;
        `sd`: noise sd of a reading: changes by less than 0.02 sd over all readings together are neglected.
        """
        first, second = np.triu_indices(n_params)
        apart = first != second
        one = np.eye(n_params)
        y = predict(np.concatenate([np.zeros((1, n_params)), one, -one, one[first[apart]] + one[second[apart]]]))
        y = np.where(np.abs(y) < _RUNS_AWAY, y, np.nan)
        up, down, both = y[1 : n_params + 1] - y[0], y[n_params + 1 : 2 * n_params + 1] - y[0], y[2 * n_params + 1 :]
        # Readings impossible on one side are as on the other; on both, they say nothing.
        up, down = (np.nan_to_num(np.where(np.isnan(a), -b, a)) for a, b in ((up, down), (down, up)))
        squares = np.empty((len(first), y.shape[1]))
        squares[~apart] = 0.5 * (up + down)
        squares[apart] = np.nan_to_num(both - y[0] - up[first[apart]] - up[second[apart]])
        terms = np.concatenate([0.5 * (up - down), squares])
        lengths, axes = np.linalg.eigh(terms @ terms.T)
        kept = lengths > (_NEGLIGIBLE * sd) ** 2
        root = np.sqrt(lengths[kept])
        return cls(y[0], (first, second), axes[:, kept] * root, (axes[:, kept] / root).T @ terms)

    def change_coefficients(self, e: FloatArray) -> FloatArray:
        """Return the coefficient of each change at steps `e`, (n_samples, n_params) -> (n_samples, n_changes)."""
        first, second = self.pairs
        return np.asarray(np.concatenate([e, e[:, first] * e[:, second]], axis=1) @ self.shares)


def surrogate_log_density(
    quadratic: QuadraticPredictions, center: FloatArray, steps: FloatArray, readings: FloatArray, law: NoiseLaw
) -> Density:
    """Return the unnormalised log posterior, as a function of e, of coordinates z = center + e @ steps, approximately.

    It is that of quadratic predictions at `steps` from `center` for the readings (n_usable,) under normal noise: for
    heavy-tailed noise, residuals are replaced by pseudo-residuals. Minus infinity beyond six prior sds.
    """
    residual = law(readings - quadratic.center)[:, None]
    residual = law.normal_pseudo_residuals(residual, np.maximum(law.likeliest_sigma(residual), LEAST_SCALE))
    # In orthonormal axes of the space that residual and changes span, or of all readings if these are fewer.
    _, turned = np.linalg.qr(np.concatenate([law(quadratic.changes.T), residual], axis=1))
    normal = law.without_tail_or_rounding()

    def log_density(e: FloatArray) -> FloatArray:
        z = center + e @ steps
        whitened = turned[:, -1][:, None] - turned[:, :-1] @ quadratic.change_coefficients(e).T
        height = log_likelihood_marginal_over_sigma(normal, whitened) - 0.5 * np.sum(z**2, axis=1)
        return np.where((np.abs(z) < FARTHEST).all(axis=1), height, -np.inf)

    return log_density


_N_WALKERS = 250
_MOVES = 6  # of each walker after a step of beta
_N_FIRST = 1000  # draws of a proposal
_LEAST = 0.25  # least effective share of draws by a linear view of the simulation,
_NEARLY_ALL = 0.8  # and where adaptive importance sampling costs little
_SIZES = 1000, 60, 8, 250.0  # of that: draws of a round, kernels, rounds, effective draws that suffice
# The surrogate costs next to nothing.
_N_NEAR = 2000
_MOVES_NEAR = 20


def n_tried(model: Model) -> int | None:
    """Return the number of draws that are tried first, 100 where each is a call; None: as many as wanted."""
    return 100 if model.sensor.predicts_dearly and not model.sensor.predicts_in_bulk else None


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
    else, where many samples cost little more than one, they are drawn by adaptive importance sampling. Without either,
    samples of Laplace's approximation are moved to the posterior in two stages, the first through a quadratic
    surrogate: with several Gaussians the posterior is curved, and Laplace's samples predict new angles far worse.

    `n_samples` is their number; the other parameters are those of `sample_model`.
    """
    laplace = _Laplace.of(found, noise, recording)
    if not annealed:
        linear = LinearAmplitudes.of(found, laplace.slopes, laplace.residual) or laplace
        return linear.draw(n_samples, rng=rng)
    normal = rng.standard_normal((_N_NEAR, len(found.z)))
    problem = HypothesisProblem(found.model, recording, noise.with_likeliest_node_alone)

    def log_posterior(z: FloatArray) -> FloatArray:
        height = problem.prior.log_prob(z) + problem.log_likelihood(z)
        return np.where((np.abs(z) < FARTHEST).all(axis=1), height, -np.inf)

    in_bulk = found.model.sensor.predicts_in_bulk
    grid = ConditionallyLinearDensity.of(found, laplace.law, recording, laplace.steps.T @ laplace.steps, laplace.sd)
    if grid is not None:
        first, least = grid.draw(n_samples if in_bulk else _N_FIRST, rng=rng), _NEARLY_ALL if in_bulk else _LEAST
        tried = n_tried(found.model)
        drawn = importance_resample(
            first, grid.log_density, log_posterior, n_wanted=n_samples, rng=rng, least=least, n_tried=tried
        )
        if drawn is not None:
            return drawn
    if in_bulk:
        draws, _ = draw_by_importance(problem, [found], laplace.law, sizes=_SIZES, rng=rng, progress=progress)
        if draws.n_eff >= _LEAST_OF_IT * _ENOUGH * n_samples:
            return draws.samples(n_samples, rng=rng)
    model, usable, center, steps = found.model, recording.usable, laplace.center, laplace.steps
    quadratic = QuadraticPredictions.of(lambda e: model.predict(center + e @ steps)[:, usable], len(center), laplace.sd)
    near = surrogate_log_density(quadratic, center, steps, recording.readings[usable], laplace.law)

    def resampled_or_annealed(
        first: FloatArray, log_q: Density, log_p: Density, n_moves: int, n: int, tried: int | None = None
    ) -> FloatArray:
        weighed = importance_resample(first, log_q, log_p, n_wanted=n, rng=rng, n_tried=tried)
        if weighed is not None:
            return weighed
        some = first[:_N_WALKERS]
        return draw_by_annealing(some, log_q, log_p, n_moves=n_moves, n_wanted=n, rng=rng, progress=progress)

    e = resampled_or_annealed(normal, lambda e: -0.5 * np.sum(e**2, axis=1), near, _MOVES_NEAR, _N_NEAR)
    e = resampled_or_annealed(e, near, lambda e: log_posterior(center + e @ steps), _MOVES, n_samples, n_tried(model))
    return center + e @ steps


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
        sd = max(float(sigma[0]) / math.sqrt(law.fisher_information), LEAST_SCALE)
        curvature = turned.T @ turned / sd**2 + np.eye(len(found.z))
        # A step in one coordinate also moves the later ones. With the effects first and the sensor last, most steps
        # leave the SSF's geometry unchanged, which speeds up vectorised predictions.
        order = np.roll(np.arange(len(found.z)), -found.model.sensor.n_params)
        at, steps = np.ix_(order, order), np.empty_like(curvature)
        steps[at] = np.linalg.inv(np.linalg.cholesky(curvature[at][::-1, ::-1]))[::-1, ::-1]
        normal = law.normal_pseudo_residuals(whitened, np.maximum(sigma, LEAST_SCALE))[:, 0]
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

    def draw(self, n_samples: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates, (n_samples, n_params)."""
        return np.asarray(self.center + rng.standard_normal((n_samples, len(self.center))) @ self.steps)
