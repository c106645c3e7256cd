"""Posterior of a simulator's parameters, by adaptive importance sampling along the ridges of its density.

A few readings, or parameters that act alike, leave a posterior that is narrow and bent: Laplace's approximation at its
mode covers a part. The ridge is followed from the mode to where it is unlikely; kernels along it, each of the local
shape, are a proposal that covers all of it (after Cornuet, Marin, Mira & Robert 2012, with local covariances).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import BoolArray, FloatArray
from probewise.diagnosis.fit import FARTHEST, Fit, difference_points_and_steps
from probewise.diagnosis.hypothesis_problem import NUMBERS, HypothesisProblem
from probewise.diagnosis.noise_law import LEAST_SCALE, NoiseLaw
from probewise.diagnosis.simulator_fit import log_evidence_of
from probewise.nested import Weighted
from probewise.nested.importance import weighted_draws
from probewise.nested.weights import (
    resampled_rows,
    student_t_draws,
    student_t_log_norm,
    tempering_power,
)
from probewise.progress import Progress

# If many predictions cost little, and else: draws of a round, kernels, rounds, effective draws that suffice.
_SIZES = {True: (2000, 150, 20, 1000.0), False: (400, 20, 4, 250.0)}
_PER_PRIOR = 20  # draws of a proposal for one of the prior
_AS_IT_IS = 0.75  # effective share of the first draws from which no ridge is followed
_UNSURE_K = 0.7  # Pareto k from which the mean of the weights converges too slowly (Vehtari et al. 2024)
_UNIFORM = 0.5  # effective share from which the weights have no tail, whatever k
_SETTLED = 0.03, 0.05  # changes of the log evidence and, in their share, of the sds between two rounds
_MOST_TAILED, _LEAST_TAILED = 2.0, 8.0  # degrees of freedom of the kernels, between them those of the readings
_TEMPERED = 25  # effective draws for each parameter, to which weights are tempered for the next proposal
_STRETCHED = 1.7  # distance of every other anchor from the middle, of a draw's
_WALKERS, _STRIDES, _STARTS = 80, 60, 4
_BELOW = 8.0  # nats, and half a nat for each parameter, below the mode, at which a ridge ends
_FIRM = 9.0  # inverse square of how far, in strides, a walker is drawn back along the ridge
_RETURNS, _PROXIMAL_STEPS = 2, 3  # Gauss-Newton steps to the ridge, of a walker after a stride, and of a kernel
_ROUNDING = 1e-13


@dataclass(frozen=True, eq=False)
class _Kernels:
    """A mixture of Student-t kernels: means (k, n_params), precisions (k, n_params, n_params), shares (k,), tails."""

    mean: FloatArray
    precision: FloatArray
    share: FloatArray
    degrees_of_freedom: float

    @cached_property
    def lower(self) -> FloatArray:
        """Cholesky factors of the precisions, definite but for rounding."""
        scale = np.sqrt(np.einsum("kpp->kp", self.precision))
        unit = self.precision / scale[:, :, None] / scale[:, None] + _ROUNDING * np.eye(self.mean.shape[1])
        return np.asarray(np.linalg.cholesky(unit) * scale[:, :, None])

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        which = rng.choice(len(self.share), n, p=self.share)
        white = student_t_draws(n, self.mean.shape[1], self.degrees_of_freedom, rng=rng)
        root = np.linalg.inv(self.lower).transpose(0, 2, 1)
        return np.asarray(self.mean[which] + np.einsum("nij,nj->ni", root[which], white))

    def log_density(self, z: FloatArray) -> FloatArray:
        n_params, nu = z.shape[1], self.degrees_of_freedom
        norm = (
            student_t_log_norm(n_params, nu) + np.log(self.share) + np.log(np.einsum("kpp->kp", self.lower)).sum(axis=1)
        )
        blocks = np.array_split(z, max(len(z) * self.mean.size // NUMBERS, 1))
        squares = (np.sum(((block - self.mean[:, None]) @ self.lower) ** 2, axis=2) for block in blocks)
        each = (norm[:, None] - 0.5 * (nu + n_params) * np.log1p(square / nu) for square in squares)
        return np.concatenate([logsumexp(densities, axis=0) for densities in each])


def draw_by_importance(
    problem: HypothesisProblem,
    fits: Sequence[Fit],
    law: NoiseLaw,
    *,
    sizes: tuple[int, int, int, float] | None = None,
    rng: np.random.Generator,
    progress: Progress,
) -> tuple[Weighted, bool]:
    """Draw from a posterior by adaptive importance sampling from its modes; return the draws, and whether they settled.

    The first proposal has a kernel at each mode, the second kernels along the ridges from there. Each further one has
    kernels at draws of those before, by their weights, tempered where few have any, and beyond these. All draws count,
    over the mixture of all proposals and a share of the prior.

    `fits`: the modes, the most probable first; `sizes`: draws of a round, kernels, rounds at most, and effective draws
    that suffice; `progress`: called after each round.
    """
    ridge = _Ridge(problem, fits[0], law)
    sensor, n_params = problem.model.sensor, problem.model.n_params
    n_draws, n_kernels, n_rounds, enough = sizes or _SIZES[sensor.predicts_in_bulk]
    kernels, proposals = ridge.kernels_at_modes(fits), list[_Kernels]()
    z, (log_prior, log_likelihood, log_mixture) = np.zeros((0, n_params)), np.zeros((3, 0))
    before, log_share = (math.inf, np.zeros(n_params)), -math.log(_PER_PRIOR)
    for k in range(n_rounds):
        if k:
            log_mixture = np.logaddexp(log_mixture, np.logaddexp(kernels.log_density(z), log_prior + log_share))
        proposals.append(kernels)
        new = np.concatenate([kernels.draw(n_draws, rng=rng), rng.standard_normal((n_draws // _PER_PRIOR, n_params))])
        prior = problem.prior.log_prob(new)
        of_all = [np.logaddexp(own.log_density(new), prior + log_share) for own in proposals]
        z = np.concatenate([z, new])
        log_prior, log_likelihood = np.append(log_prior, prior), np.append(log_likelihood, problem.log_likelihood(new))
        log_mixture = np.append(log_mixture, logsumexp(of_all, axis=0))
        height = np.where((np.abs(z) < FARTHEST).all(axis=1), log_prior + log_likelihood, -np.inf)
        log_ratio = height - log_mixture + math.log((1 + 1 / _PER_PRIOR) * len(proposals))
        draws = weighted_draws(problem.prior.names, z, log_likelihood, log_ratio, len(z))
        weight, now, share = draws.weight, (draws.log_z, draws.sd()), draws.n_eff / len(z)
        is_sound = draws.n_eff >= enough and (draws.pareto_k < _UNSURE_K or share > _UNIFORM)
        is_still = abs(now[0] - before[0]) < _SETTLED[0] and np.allclose(now[1], before[1], rtol=_SETTLED[1])
        if is_sound and (is_still or (not k and share > _AS_IT_IS)):
            return draws, True
        before = now
        progress("sampling the posterior", note=f"{draws.n_eff:.0f} effective draws")
        along = not k and sensor.predicts_in_bulk and not sensor.predicts_dearly
        anchors = rng.permutation(ridge.follow(fits, rng=rng)) if along else z[:0]
        if len(anchors) > n_params:
            spread, anchors = np.cov(anchors.T), anchors[:n_kernels]
        else:  # readings that are met exactly leave a mode from which no stride is likely enough
            weight = weight ** tempering_power(log_ratio, _TEMPERED * n_params)
            anchors = z[np.unique(resampled_rows(weight, n_kernels, rng))]
            middle, spread = np.average(z, axis=0, weights=weight), np.cov(z.T, aweights=weight)
            anchors[1::2] = np.clip(middle + _STRETCHED * (anchors[1::2] - middle), -FARTHEST, FARTHEST)
        kernels = ridge.kernels_beside(anchors, spread.reshape(n_params, n_params))
    return draws, False


class _Ridge:
    """The posterior of a problem, linearised at many points at once; white noise of the sd about its best fit."""

    def __init__(self, problem: HypothesisProblem, best: Fit, law: NoiseLaw) -> None:
        self.problem, self.law, self.best = problem, law, best
        self.free = max(law.n_kept - len(best.z), 1)
        self.degrees_of_freedom = float(np.clip(self.free, _MOST_TAILED, _LEAST_TAILED))
        self.eye = np.eye(len(best.z))

    def _variance(self, found: Fit) -> float:
        return max(found.sd, LEAST_SCALE) ** 2 * self.law.n_kept / self.free / self.law.fisher_information

    def _linearise(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Return slopes (k, n_params, n), residuals (k, n), both in noise sds, precisions, and which are possible."""
        usable, (points, steps) = self.problem.recording.usable, difference_points_and_steps(z)
        predicted = self.problem.predict(points.reshape(-1, z.shape[1]))[:, usable]
        with np.errstate(all="ignore"):
            left = self.law((self.problem.recording.readings[usable] - predicted).T).T
            left = (left / self._variance(self.best) ** 0.5).reshape(*points.shape[:2], -1)
            slopes, residuals = (left[:, :1] - left[:, 1:]) / steps[:, :, None], left[:, 0]
        possible = np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(residuals).all(axis=1)
        slopes, residuals = np.where(possible[:, None, None], slopes, 0.0), np.where(possible[:, None], residuals, 0.0)
        return slopes, residuals, slopes @ slopes.transpose(0, 2, 1) + self.eye, possible

    def _drawn_to_ridge(self, anchors: FloatArray, firmness: FloatArray, n_steps: int) -> FloatArray:
        """Return points by Gauss-Newton steps towards the mode, held to anchors by a precision (k or 1, p, p)."""
        z = anchors
        for _ in range(n_steps):
            slopes, residuals, precision, _ = self._linearise(z)
            downhill = np.einsum("kpn,kn->kp", slopes, residuals) - z
            downhill += ((anchors - z)[:, None] @ firmness)[:, 0]
            z = np.clip(z + np.linalg.solve(precision + firmness, downhill[:, :, None])[:, :, 0], -FARTHEST, FARTHEST)
        return z

    def kernels_at_modes(self, fits: Sequence[Fit]) -> _Kernels:
        """Return Laplace's approximation at fits, with shares by their evidence, a tenth of the largest at least."""
        slopes = np.stack([self.law(found.slopes).T / math.sqrt(self._variance(found)) for found in fits])
        log_z = np.array([log_evidence_of(found, self.law) for found in fits])
        share = np.maximum(np.exp(log_z - log_z.max()), 0.1)
        precision = slopes @ slopes.transpose(0, 2, 1) + self.eye
        mean = np.stack([found.z for found in fits])
        return _Kernels(mean, precision, share / share.sum(), self.degrees_of_freedom)

    def kernels_beside(self, anchors: FloatArray, spread: FloatArray) -> _Kernels:
        """Return a kernel on the ridge beside each anchor, (k, n_params), with the local shape.

        Along the ridge a kernel is as wide as Silverman's rule says for draws of the covariance `spread`.
        """
        n, n_params = anchors.shape
        width = (4 / (n_params + 2) / n) ** (1 / (n_params + 4))
        squares, axes = np.linalg.eigh(spread)
        metric = (axes / np.maximum(squares, _ROUNDING * squares.max())) @ axes.T / width**2
        z = self._drawn_to_ridge(anchors, metric[None], _PROXIMAL_STEPS)
        _, _, precision, possible = self._linearise(z)
        share = np.full(int(possible.sum()), 1 / possible.sum())
        return _Kernels(z[possible], precision[possible] + metric, share, self.degrees_of_freedom)

    def follow(self, fits: Sequence[Fit], *, rng: np.random.Generator) -> FloatArray:
        """Return points (n, n_params) along the ridges from modes, to where the density is some nats lower.

        Walkers go a local sd at a time in directions of their own, and return to the ridge after each stride.
        """
        modes = np.stack([found.z for found in fits[:_STARTS]])
        z, out = np.repeat(modes, _WALKERS // len(modes), axis=0), [modes]
        way = rng.standard_normal(z.shape)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        lowest = -self._heights(self._linearise(modes)[1], modes).max() + _BELOW + 0.5 * z.shape[1]
        _, _, precision, _ = self._linearise(z)
        for _ in range(_STRIDES):
            lengths, axes = np.linalg.eigh(precision)
            stride = np.einsum("kij,kj,klj,kl->ki", axes, lengths**-0.5, axes, way)
            firmness = _FIRM / np.maximum(np.sum(stride**2, axis=1), LEAST_SCALE)[:, None, None] * self.eye
            z = self._drawn_to_ridge(np.clip(z + stride, -FARTHEST, FARTHEST), firmness, _RETURNS)
            _, residuals, precision, possible = self._linearise(z)
            goes = possible & (-self._heights(residuals, z) < lowest)
            z, way, precision = z[goes], way[goes], precision[goes]
            if not len(z):
                break
            out.append(z)
        return np.concatenate(out)

    def _heights(self, residuals: FloatArray, z: FloatArray) -> FloatArray:
        squares = np.maximum(np.sum(residuals**2, axis=1), LEAST_SCALE)
        return np.asarray(-0.5 * self.law.n_kept * np.log(squares) - 0.5 * np.sum(z**2, axis=1))
