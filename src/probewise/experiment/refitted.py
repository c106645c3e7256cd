"""Samples of a kind of hypotheses from fits to all readings that start at samples of other kinds.

The samples of a rival may have gathered where the earlier readings led them, with none where the truth is; no later
reading brings them back. Other kinds may have samples there. Starts are samples of other kinds, with the effect's
parameters drawn from their prior. Each start is fitted to all readings (Levenberg-Marquardt, all starts side by side).
Gaussians about the good fits, mixed with kernels about the rival's own samples, propose an importance sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray, IntArray
from probewise.experiment.evidence import importance_weighted_draws
from probewise.experiment.kernels import LocalKernels
from probewise.experiment.kinds import HypothesisKind
from probewise.experiment.pace import EACH_S, paced_time_s
from probewise.inference.problem import SensorProblem
from probewise.nested import Weighted
from probewise.nested.weights import resampled_rows
from probewise.priors import Prior

_STARTS = 90
_STEPS = 8
_HELD = 1e12  # stiffness of a parameter that is held, in inverse squares of its scale
_NUDGE = 1e-3  # of a parameter's scale: the finite difference
_KEPT = 45  # fits that carry a Gaussian
_WORSE = 8.0  # nats behind the best fit, from which on a fit carries none
_AS_GOOD = 0.5  # nats behind the best fit, up to which a fit is as good
_WIDER = 1.4  # factor on the width of these Gaussians
_IN_GAP = 0.4  # of the gap between two readings: sd of a change point within it
_JITTER = 1e-9
_KERNELS = 75
_FAR = 2.5  # factor on the width of some kernels, so that draws extend beyond what is found
_LEAST = 10  # possible draws from which on they are weighed


@dataclass(frozen=True, eq=False)
class Fits:
    """Fits of a kind to all readings, from several starts.

    Attributes
    ----------
    theta
        The fits, (n_starts, n_params).
    score
        Log likelihood plus log prior of each fit, (n_starts,); minus infinity if the fit failed.
    precision
        Inverse covariances about the fits, (n_starts, n_params, n_params).
    """

    theta: FloatArray
    score: FloatArray
    precision: FloatArray

    @cached_property
    def good_fit_rows(self) -> IntArray:
        """Rows of the fits whose `score` is less than 8 nats below the best, best first; empty if every fit failed."""
        order = np.argsort(-self.score)
        return (
            order[self.score[order] > self.score[order[0]] - _WORSE] if math.isfinite(self.score.max()) else order[:0]
        )

    @property
    def n_as_good_as_best(self) -> int:
        """Number of fits whose `score` is within 0.5 nats of the best, the best included."""
        return int(np.count_nonzero(self.score > self.score.max() - _AS_GOOD))

    @cached_property
    def log_z_by_fit(self) -> FloatArray:
        """Log evidence of the Gaussian about each good fit (Laplace), (n_good,), in the order of `good_fit_rows`."""
        log_det = np.linalg.slogdet(self.precision[self.good_fit_rows])[1]
        log_volume = 0.5 * self.theta.shape[1] * math.log(2 * math.pi) - 0.5 * log_det
        return np.asarray(self.score[self.good_fit_rows] + log_volume)

    @property
    def highest_log_z(self) -> float:
        """Largest of `log_z_by_fit`; minus infinity if no fit is good."""
        return float(self.log_z_by_fit.max(initial=-math.inf))


def fit_kind(
    kind: HypothesisKind,
    problem: SensorProblem,
    donors: Sequence[Weighted],
    *,
    noise_sd: float,
    rng: np.random.Generator,
) -> Fits:
    """Fit a kind with an effect on the noise-free reading to all readings, from 90 starts at samples of other kinds.

    Parameters
    ----------
    kind, problem
        The kind and its problem.
    donors
        Posteriors of other kinds, whose samples are the starts of all parameters but the effect's.
    noise_sd
        Sd of a reading's noise.
    rng
        Source of randomness.
    """
    recording = problem.recording
    usable = recording.usable
    plan, readings = recording.plan, recording.readings
    drawn = kind.prior.from_unit_cube(rng.random((2000, len(kind.prior.names))))
    low, high = np.quantile(drawn, [0.16, 0.84], axis=0)
    scale = np.maximum(0.5 * (high - low), 1e-12)
    theta = drawn[:_STARTS].copy()
    moments = [j for j, name in enumerate(kind.prior.names) if name.endswith(".at_s")]
    times_s = paced_time_s(plan)
    if moments and times_s is not None and len(times_s) > 1:
        # A change is seen by the gap between readings that it falls into, whatever the slope says.
        gap = rng.integers(1, len(times_s), len(theta))
        theta[:, moments] = (times_s[gap - 1] + rng.random(len(theta)) * (times_s[gap] - times_s[gap - 1]))[:, None]
        scale[moments] = _IN_GAP * EACH_S
    n_effect = 0 if kind.effect is None else len(kind.effect.prior.names)
    n_shape = theta.shape[1] - n_effect
    for k, donor in enumerate(donors):
        theta[k :: len(donors), :n_shape] = donor.samples(_STARTS, rng=rng)[k :: len(donors), :n_shape]

    def predict(at: FloatArray) -> FloatArray:
        return np.asarray(problem.model.predict(at, plan)[:, usable])

    def negative_log_posterior(residual: FloatArray, at: FloatArray) -> FloatArray:
        cost = 0.5 * (residual**2).sum(axis=1) - kind.prior.log_prob(at)
        return np.where(np.isfinite(cost), cost, np.inf)

    n, n_params = theta.shape
    ridge = np.eye(n_params) / scale**2
    residual = (readings[usable] - predict(theta)) / noise_sd
    cost, damping = negative_log_posterior(residual, theta), np.full(n, 1.0)
    normal = np.broadcast_to(ridge, (n, n_params, n_params)).copy()
    # Half of the starts hold their effect and fit the shape alone, so that fits lie along a ridge, not at its top only.
    of_effect = np.arange(n_params) >= n_shape
    held = (np.arange(n) >= n // 2)[:, None, None] * np.diag(_HELD * of_effect / scale**2)
    slope = np.empty((n, residual.shape[1], n_params))
    moved = np.arange(n)
    for _ in range(_STEPS):
        # A start that no step has moved keeps its slopes.
        if len(moved):
            at_theta = readings[usable] - noise_sd * residual[moved]
            own = _prediction_slopes(predict, theta[moved], at_theta, _NUDGE * scale) / noise_sd
            normal[moved] = own.transpose(0, 2, 1) @ own + ridge
            slope[moved] = own
        pull = (slope.transpose(0, 2, 1) @ residual[:, :, None])[:, :, 0]
        damped = normal + damping[:, None, None] * ridge * 10.0 + held
        tried = theta + np.linalg.solve(damped, pull[:, :, None])[:, :, 0]
        possible = np.isfinite(kind.prior.log_prob(tried))
        tried = np.where(possible[:, None], tried, theta)
        at = (readings[usable] - predict(tried)) / noise_sd
        found = negative_log_posterior(at, tried)
        better = found < cost
        theta = np.where(better[:, None], tried, theta)
        residual = np.where(better[:, None], at, residual)
        cost = np.where(better, found, cost)
        damping = np.clip(np.where(better, damping / 5.0, damping * 5.0), 1e-4, 1e8)
        moved = np.flatnonzero(better)
    score = np.full(n, -np.inf)
    alive = np.isfinite(cost)
    if alive.any():
        score[alive] = problem.log_likelihood(theta[alive]) + kind.prior.log_prob(theta[alive])
    return Fits(theta, np.where(np.isfinite(normal).all(axis=(1, 2)), score, -np.inf), normal)


def _prediction_slopes(
    predict: Callable[[FloatArray], FloatArray], theta: FloatArray, at_theta: FloatArray, nudge: FloatArray
) -> FloatArray:
    """Return the slopes of the predictions at theta, (n, n_points, n_params), by forward differences of `nudge`."""
    n_params = theta.shape[1]
    nudged = theta + (np.eye(n_params) * nudge)[:, None]
    there = predict(nudged.reshape(-1, n_params)).reshape(n_params, *at_theta.shape)
    return np.ascontiguousarray(((there - at_theta) / nudge[:, None, None]).transpose(1, 2, 0))


@dataclass(frozen=True, eq=False)
class _ShapePriorAndEffectKernels:
    """A density over a kind's parameters: the prior for the shape's parameters, kernels about fits for the effect's.

    Where the readings leave the shape open (a step of the light, and no white yet), Gaussians about fits cover little
    of the posterior.
    """

    prior: Prior
    effect_prior: Prior
    of_effect: LocalKernels

    @classmethod
    def about_fits(cls, kind: HypothesisKind, found: Fits, rows: IntArray) -> _ShapePriorAndEffectKernels | None:
        """Build from the fits `rows` of a kind; None for a kind without an effect on the noise-free reading."""
        if kind.effect is None:
            return None
        n = len(kind.effect.prior.names)
        covariance = _WIDER**2 * _inverse_precision(found.precision[rows])[:, -n:, -n:]
        return cls(kind.prior, kind.effect.prior, LocalKernels.from_moments(found.theta[rows, -n:], covariance))

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        out = self.prior.from_unit_cube(rng.random((n, len(self.prior.names))))
        out[:, -len(self.effect_prior.names) :] = self.of_effect.draw(n, rng=rng)
        return out

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the natural log of the density at possible points, (n, n_params) -> (n,)."""
        own = points[:, -len(self.effect_prior.names) :]
        of_shape = self.prior.log_prob(points) - self.effect_prior.log_prob(own)
        return np.asarray(of_shape + self.of_effect.log_density(own))


def sampled_about_fits(
    found: Fits,
    kind: HypothesisKind,
    problem: SensorProblem,
    own: Weighted,
    *,
    n_draws: int,
    with_own: bool = True,
    rng: np.random.Generator,
) -> Weighted | None:
    """Sample a kind's posterior by importance sampling about fits and about its own samples.

    Parameters
    ----------
    found
        Fits of the kind, at least one of them good.
    kind, problem
        The kind and its problem.
    own
        The kind's own samples.
    n_draws
        Number of draws.
    with_own
        Whether to draw about the kind's own samples too.
    rng
        Source of randomness.

    Returns
    -------
    The samples; None if fewer than ten draws are possible.
    """
    n_params = found.theta.shape[1]
    best = found.good_fit_rows[np.argsort(-found.log_z_by_fit)][:_KEPT]
    densities: list[_Density] = [
        LocalKernels.from_moments(found.theta[best], _WIDER**2 * _inverse_precision(found.precision[best]))
    ]
    if (open_shape := _ShapePriorAndEffectKernels.about_fits(kind, found, best)) is not None:
        densities.append(open_shape)
    if with_own and len(rows := _resampled_rows_if_distinct(own, n_params, rng)):
        densities.append(LocalKernels.fitted_to(own.theta[rows], rng=rng, widened=1.2, most=_KERNELS))
    first = _importance_sampled(own, problem, densities, n_draws // 2, rng)
    if first is None or not len(rows := _resampled_rows_if_distinct(first, n_params, rng)):
        return first
    # A posterior is more curved than the Gaussians about its fits: once more, about what these have found.
    near = LocalKernels.fitted_to(first.theta[rows], rng=rng, most=_KERNELS)
    far = LocalKernels.fitted_to(first.theta[rows], rng=rng, widened=_FAR, most=_KERNELS)
    return _importance_sampled(first, problem, [near, near, far, *densities], n_draws, rng) or first


_Density = LocalKernels | _ShapePriorAndEffectKernels


def _inverse_precision(precision: FloatArray) -> FloatArray:
    """Return the inverses, (n, n_params, n_params), stably if parameters differ by many powers of ten."""
    size = 1.0 / np.sqrt(np.diagonal(precision, axis1=1, axis2=2))
    both = size[:, :, None] * size[:, None, :]
    return np.asarray(np.linalg.inv(precision * both + _JITTER * np.eye(precision.shape[1])) * both)


def _resampled_rows_if_distinct(posterior: Weighted, n_params: int, rng: np.random.Generator) -> IntArray:
    """Return resampled rows of a posterior; no rows if too few are distinct to fit kernels."""
    rows = resampled_rows(posterior.weight, len(posterior.theta), rng)
    return rows if len(np.unique(rows)) > 4 * n_params else rows[:0]


def _importance_sampled(
    own: Weighted, problem: SensorProblem, densities: Sequence[_Density], n: int, rng: np.random.Generator
) -> Weighted | None:
    """Sample by importance sampling from an even mixture of densities; None if fewer than ten draws are possible."""
    shares = np.bincount(rng.permutation(n) % len(densities), minlength=len(densities))
    draws = np.concatenate([d.draw(int(k), rng=rng) for d, k in zip(densities, shares, strict=True)])

    def log_density(points: FloatArray) -> FloatArray:
        return np.asarray(logsumexp([d.log_density(points) for d in densities], axis=0) - math.log(len(densities)))

    found = importance_weighted_draws(draws, log_density, problem, least=_LEAST)
    return None if found is None else replace(found, n_calls=own.n_calls + n)
