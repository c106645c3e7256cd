"""Importance sampling: draws from a density fitted to posterior samples, weighted against prior and likelihood.

From such draws evidence and posterior are estimated independently of prior volumes, often with a hundredth of a run's
error for a few thousand evaluations (Cameron & Pettitt 2014; Lange 2023 with neural networks); the error of a run is
sqrt(H / n_live), with H the information in nats. The Pareto k of the weights' tail tells whether they are reliable
(Vehtari, Simpson, Gelman, Yao & Gabry 2024). `probewise.nested.refine` uses them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.special import expit

from probewise._arrays import FloatArray, logsumexp
from probewise.nested.clusters import Clusters, find_disconnected_clusters
from probewise.nested.problem import Evaluator, Space
from probewise.nested.result import NestedResult, Samples
from probewise.nested.weights import n_effective, student_t_draws, student_t_log_norm

# Pareto k above which the mean of the weights converges too slowly for a reliable error (Vehtari et al. 2024).
MOST_K = 0.7
_FEW_EFFECTIVE = 100.0
MOST_LOST = 0.2  # of a posterior, from which on the error is not to be trusted
_BRIDGE_STEPS = 20
# Heavier tails than a Gaussian's keep the weights bounded where the fit is too narrow.
_DEGREES_OF_FREEDOM = 8.0
_MOST_KERNELS = 400
_FEW = 40
_SCALES = (1.0, 0.5, 0.2, 0.05, 0.01)
_BLOCK = 2048


@dataclass(frozen=True, eq=False)
class Weighted(Samples):
    """Weighted posterior samples and the evidence, from importance sampling; see also `Samples`.

    `theta` are the draws with nonzero likelihood, (n, n_params). `pareto_k` is the shape of the weights' tail; above
    0.7 the error is unreliable. `run` is the fallback run, made where the weights were, else None; `n_calls` includes
    its own. `warnings` are reasons not to trust the error, in words; empty if there are none.
    """

    pareto_k: float
    run: NestedResult | None = None
    warnings: tuple[str, ...] = ()

    @property
    def sound(self) -> bool:
        """Whether there are no `warnings` about the error."""
        return not self.warnings

    def summary(self) -> str:
        """Describe evidence and posterior in plain text."""
        lines = [
            f"log Z        {self.log_z:.3f} ± {self.log_z_error:.3f}",
            f"samples      {len(self.theta)}, effective sample size {self.n_eff:.0f}",
            f"cost         {self.n_calls} likelihood evaluations",
            f"weights      Pareto k = {self.pareto_k:.2f}",
        ]
        lines += [
            f"{name:<9}  {mean:>11.5g} ± {sd:.3g}"
            for name, mean, sd in zip(self.names, self.mean(), self.sd(), strict=True)
        ]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.warnings)])


def _warnings_of_weights(k: float, n_eff: float, missed: float = 0.0) -> tuple[str, ...]:
    """Return warnings of a heavy tail, of few effective samples, and of a share `missed` of the posterior."""
    reasons = (
        (not k < MOST_K, f"Pareto k of the weights is {k:.2f}, not below {MOST_K}"),
        (not n_eff >= _FEW_EFFECTIVE, f"only {n_eff:.0f} effective samples, not {_FEW_EFFECTIVE:.0f}"),
        (not missed < MOST_LOST, f"the draws miss {100 * missed:.0f} % of the posterior"),
    )
    return tuple(words for so, words in reasons if so)


def evenly_weighted(
    names: tuple[str, ...],
    theta: FloatArray,
    log_likelihood: FloatArray,
    *,
    log_z: float = 0.0,
    log_z_error: float = 0.0,
    n_calls: int = 0,
    run: NestedResult | None = None,
) -> Weighted:
    """Return equally weighted samples, theta (n, n_params) and log_likelihood (n,), and an evidence, by default one."""
    n = len(theta)
    even = np.full(n, -math.log(n))
    return Weighted(
        names, theta, log_likelihood, even, log_z, log_z_error, float(n), n_calls, pareto_k=-math.inf, run=run
    )


def weighted_draws(
    names: tuple[str, ...], theta: FloatArray, log_likelihood: FloatArray, log_ratio: FloatArray, n_draws: int
) -> Weighted:
    """Return draws, (n, n_params), weighted by the log of target over proposal density, (n,), as plain samples.

    The evidence is the mean weight of the `n_draws` that were made, those left out as impossible included.
    """
    total, n_eff = float(logsumexp(log_ratio)), n_effective(log_ratio)
    error = math.sqrt(max(1.0 / max(n_eff, 1.0) - 1.0 / n_draws, 0.0))
    there, evidence = log_ratio[np.isfinite(log_ratio)], (total - math.log(n_draws), error, n_eff)
    k = pareto_k(there) if len(there) > 1 else math.inf
    told = _warnings_of_weights(k, n_eff)
    return Weighted(names, theta, log_likelihood, log_ratio - total, *evidence, n_draws, k, warnings=told)


@dataclass(frozen=True, eq=False)
class Proposal:
    """A mixture of Student-t kernels, of one shape within each cluster.

    `centres` in each cluster's whitened frame, one array (n_kernels, n_params) per cluster; `width` of the kernels in
    that frame; `share` of the draws for each cluster, (n_clusters,).
    """

    clusters: Clusters
    centres: tuple[FloatArray, ...]
    width: tuple[float, ...]
    share: FloatArray

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, n_params)."""
        n_params = self.clusters.mean.shape[1]
        which = rng.choice(len(self.share), size=n, p=self.share)
        white = student_t_draws(n, n_params, _DEGREES_OF_FREEDOM, rng=rng)
        out = np.empty((n, n_params))
        for k, (centres, width) in enumerate(zip(self.centres, self.width, strict=True)):
            rows = np.flatnonzero(which == k)
            place = centres[rng.integers(len(centres), size=rows.size)] + width * white[rows]
            out[rows] = self.clusters.mean[k] + place @ self.clusters.root[k].T
        return out

    def log_density(self, x: FloatArray) -> FloatArray:
        """Natural log of the density, (n, n_params) -> (n,)."""
        blocks = np.array_split(x, max(1, -(-len(x) // _BLOCK)))
        return np.concatenate([self._log_density_of_block(block) for block in blocks])

    def _log_density_of_block(self, x: FloatArray) -> FloatArray:
        n_params, nu = x.shape[1], _DEGREES_OF_FREEDOM
        constant, parts = student_t_log_norm(n_params, nu), []
        for k, (centres, width) in enumerate(zip(self.centres, self.width, strict=True)):
            white = (x - self.clusters.mean[k]) @ self.clusters.inverse_root[k].T
            square = (white**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2.0 * white @ centres.T
            kernel = -0.5 * (nu + n_params) * np.log1p(np.maximum(square, 0.0) / (nu * width**2))
            norm = constant - self.clusters.log_det[k] - n_params * math.log(width) - math.log(len(centres))
            parts.append(logsumexp(kernel, axis=1) + norm + math.log(self.share[k]))
        return np.asarray(logsumexp(parts, axis=0))


def mixture_of_proposals(proposals: Sequence[Proposal], share: Sequence[float]) -> Proposal:
    """Combine proposals into one mixture with the shares `share`, which need not be normalised."""
    total = math.fsum(share)
    return Proposal(
        Clusters.join(*(p.clusters for p in proposals)),
        tuple(centres for p in proposals for centres in p.centres),
        tuple(width for p in proposals for width in p.width),
        np.concatenate([s / total * p.share for p, s in zip(proposals, share, strict=True)]),
    )


def fit_wide_and_narrow_proposals(x: FloatArray, *, rng: np.random.Generator) -> tuple[Proposal, ...]:
    """Fit two proposals to samples, (n_samples, n_params): the best wide form, then the best narrow form.

    Wide: one kernel per cluster, as wide as the cluster. Narrow: kernels at the samples, of Silverman's width or less.
    Of each form the variant, with or without clusters, with the greatest held-out likelihood is fitted to all samples.
    That favours a close fit, weights of draws a wide one. Fewer than 80 samples give one wide kernel only.
    """
    x = x[rng.permutation(len(x))]
    half = len(x) // 2
    if half < _FEW:
        return (_fit_kernels(x, False, None),)

    def held_out_score(form: tuple[bool, float | None]) -> float:
        return float(_fit_kernels(x[:half], *form).log_density(x[half:]).mean())

    wide: list[tuple[bool, float | None]] = [(False, None), (True, None)]
    narrow: list[tuple[bool, float | None]] = [(split, scale) for split in (False, True) for scale in _SCALES]
    return tuple(_fit_kernels(x, *max(forms, key=held_out_score)) for forms in (wide, narrow))


def _fit_kernels(x: FloatArray, split: bool, scale: float | None) -> Proposal:
    """Fit one form of proposal: by cluster if `split`; one kernel per cluster if `scale` is None, else at samples.

    `scale`: width of the kernels in units of Silverman's.
    """
    clusters = find_disconnected_clusters(x) if split else Clusters.from_groups([x])
    home = clusters.assign(x)
    n_params = x.shape[1]
    centres, width = [], []
    for k in range(len(clusters)):
        part = x[home == k]
        if scale is None or len(part) < 2:
            centres.append(np.zeros((1, n_params)))
            width.append(1.0)
        else:
            kept = part[:_MOST_KERNELS]
            centres.append((kept - clusters.mean[k]) @ clusters.inverse_root[k].T)
            width.append(scale * (4 / (n_params + 2) / len(kept)) ** (1 / (n_params + 4)))
    size = np.maximum(np.bincount(home, minlength=len(clusters)), 1)
    return Proposal(clusters, tuple(centres), tuple(width), size / size.sum())


HeldOut: TypeAlias = tuple[FloatArray, FloatArray, float]
"""Posterior samples held out from a fit: in unbounded coordinates (n, n_params), log target (n,), effective number."""


def draw_and_weigh(
    proposal: Proposal,
    held: HeldOut | None,
    space: Space,
    evaluate: Evaluator,
    *,
    n_draws: int,
    rng: np.random.Generator,
) -> Weighted:
    """Make `n_draws` from a proposal, evaluate, and weight them.

    `held`: posterior samples that correct the evidence by bridge sampling, or None. If no draw is possible, log Z is
    -inf.
    """
    x = proposal.draw(n_draws, rng=rng)
    theta, log_density = space.leave(x)
    possible = np.flatnonzero(np.isfinite(log_density))
    theta, log_density = theta[possible], log_density[possible]
    log_likelihood = evaluate.log_likelihood(theta) if possible.size else np.empty(0)
    log_ratio = log_density + log_likelihood - proposal.log_density(x[possible])
    alive = np.isfinite(log_ratio)
    if not alive.any():
        nothing = np.empty(0)
        n_calls = evaluate.n_calls
        none, told = (-math.inf, math.inf, 0.0, n_calls, math.inf), _warnings_of_weights(math.inf, 0.0)
        return Weighted(evaluate.names, theta[:0], nothing, nothing, *none, warnings=told)
    theta, log_likelihood, log_ratio = theta[alive], log_likelihood[alive], log_ratio[alive]
    k = pareto_k(log_ratio)
    held_ratio, n_held = np.empty(0), 0.0
    if held is not None and len(held[0]):
        held_ratio, n_held = held[1] - proposal.log_density(held[0]), held[2]
    log_z, error, missed, log_weight = _bridge_sampling_estimate(log_ratio, n_draws, held_ratio, n_held)
    # The mean of weights of infinite variance converges as n^(k - 1) instead of n^(-1/2) (Vehtari et al. 2024).
    error *= len(log_ratio) ** min(max(k - 0.5, 0.0), 1.0)
    n_eff, n_calls = n_effective(log_weight), evaluate.n_calls
    told = _warnings_of_weights(k, n_eff, missed)
    return Weighted(evaluate.names, theta, log_likelihood, log_weight, log_z, error, n_eff, n_calls, k, warnings=told)


def _bridge_sampling_estimate(
    log_ratio: FloatArray, n_draws: int, held_ratio: FloatArray, n_held: float
) -> tuple[float, float, float, FloatArray]:
    """Estimate the evidence from draws and posterior samples by bridge sampling (Meng & Wong 1996).

    `log_ratio`: log of target over proposal density at the draws with nonzero target, (n_alive,), of `n_draws` in all.
    `held_ratio`: the same log at held-out posterior samples, (n_samples,), of effective number `n_held`; empty for
    plain importance sampling. Return log Z, its error, the share of the posterior that the draws miss, and the draws'
    log weights, (n_alive,).
    """
    log_z = float(logsumexp(log_ratio)) - math.log(n_draws)
    missed, kept_error, cut = 0.0, 0.0, log_ratio
    if len(held_ratio):
        # The optimal bridge tapers weights above n_draws / n_held times their mean; the samples correct for it.
        for _ in range(_BRIDGE_STEPS):
            limit = log_z + math.log(n_draws / n_held)
            cut = log_ratio - np.logaddexp(0.0, log_ratio - limit)
            share = expit(limit - held_ratio)
            kept = max(float(share.mean()), 1e-9)
            log_z = float(logsumexp(cut)) - math.log(n_draws) - math.log(kept)
        missed = float((held_ratio > limit).mean())
        kept_error = float(share.std()) / math.sqrt(n_held) / kept
    # Draws with zero target count as weights of zero.
    spread = max(1.0 / n_effective(cut) - 1.0 / n_draws, 0.0)
    return log_z, math.sqrt(spread + kept_error**2), missed, cut - float(logsumexp(cut))


def pareto_k(log_weight: FloatArray) -> float:
    """Estimate the Pareto shape k of the tail of importance weights, from log weights of any scale, (n,).

    A generalised Pareto distribution is fitted to the largest weights, 3 sqrt(n) of them but at most a fifth, with the
    estimator of Zhang & Stephens (2009), as in Vehtari et al. (2024). Below 0.5 the weights have a finite variance;
    above 0.7 their mean converges too slowly to be used. k is infinite for fewer than 25 weights, and minus infinity
    where fewer than five of the tail exceed the rest.
    """
    n = len(log_weight)
    n_tail = int(min(0.2 * n, 3.0 * math.sqrt(n)))
    if n_tail < 5:
        return math.inf
    weight = np.sort(np.exp(log_weight - log_weight.max()))
    excess = weight[-n_tail:] - weight[-n_tail - 1]
    # The shape does not depend on the scale; below 1e-100 of the greatest, one over an excess would overflow.
    excess = excess[excess > 1e-100 * excess[-1]] / max(excess[-1], 1e-300)
    if excess.size < 5:
        return -math.inf
    n_grid = 30 + int(math.sqrt(excess.size))
    quartile = excess[int(excess.size / 4 + 0.5) - 1]
    b = 1.0 / excess[-1] + (1.0 - np.sqrt(n_grid / (np.arange(1, n_grid + 1) - 0.5))) / (3.0 * quartile)
    b[b == 0.0] = 1e-12 / quartile  # the exponential tail, k = 0, approximated by its neighbour
    k = np.log1p(-b[:, None] * excess).mean(axis=1)
    log_profile = excess.size * (np.log(-b / k) - k - 1.0)
    mean_b = float(np.exp(log_profile - logsumexp(log_profile)) @ b)
    shape = float(np.log1p(-mean_b * excess).mean())
    # Shrunk towards 0.5 by ten prior observations, to reduce the noise of short tails.
    return float((excess.size * shape + 10 * 0.5) / (excess.size + 10))
