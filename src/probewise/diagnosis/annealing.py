"""Carry samples from Laplace's approximation to the posterior, by tempered sequential Monte Carlo.

The densities between are q^(1 - beta) p^beta (Neal 2001). After each step of beta the samples are resampled by their
weights and moved: each half by differences of the other half (ter Braak 2006), which leaves the density invariant.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from probewise._arrays import FloatArray
from probewise.nested.weights import n_effective, resampled

__all__ = ["anneal"]

_NEAR = 0.7  # share of the first samples that count, from which weights do and no move is needed
_EFFECTIVE = 0.5  # share of the samples that still count after a step of beta
_MOVES = 6  # of each sample after a step
_LAST_MOVES = 12
_BETWEEN = 6  # moves from one harvest to the next
_LEAST_STEP = 1e-3


def anneal(
    center: FloatArray,
    factor: FloatArray,
    log_p: Callable[[FloatArray], FloatArray],
    *,
    n_walkers: int,
    n_harvests: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw from a density near a normal one.

    Parameters
    ----------
    center, factor
        The normal approximation: its mean (n_params,), and the transpose of a square root of its covariance.
    log_p
        Log density, unnormalised, (n, n_params) -> (n,); minus infinity where it cannot be.
    n_walkers, n_harvests
        Samples carried, even; and how often they are taken, some moves apart.
    rng
        Source of randomness.

    Returns
    -------
    Samples, (n_walkers n_harvests, n_params).
    """
    inverse = np.linalg.inv(factor)

    def log_q(z: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.sum(((z - center) @ inverse) ** 2, axis=1))

    z = center + rng.standard_normal((n_walkers, len(center))) @ factor
    heights = log_q(z), log_p(z)
    wanted = n_walkers * n_harvests
    if n_effective(heights[1] - heights[0]) >= _NEAR * n_walkers:
        # The approximation is the posterior but for weights.
        more = center + rng.standard_normal((2 * wanted - n_walkers, len(center))) @ factor
        gain = np.concatenate([heights[1] - heights[0], log_p(more) - log_q(more)])
        return np.asarray(np.concatenate([z, more])[resampled(np.exp(gain - gain.max()), wanted, rng)])
    beta, scale = 0.0, 1.0
    while beta < 1.0:
        gain = heights[1] - heights[0]
        after = _next_beta(gain, beta)
        kept = resampled(np.exp((after - beta) * (gain - gain.max())), n_walkers, rng)
        beta, z, heights = after, z[kept], (heights[0][kept], heights[1][kept])
        for _ in range(_MOVES if beta < 1.0 else _LAST_MOVES):
            z, heights, scale = _moved(z, heights, beta, scale, log_q, log_p, rng)
    harvest = [z]
    for _ in range(n_harvests - 1):
        for _ in range(_BETWEEN):
            z, heights, scale = _moved(z, heights, beta, scale, log_q, log_p, rng)
        harvest.append(z)
    return np.concatenate(harvest)


def _next_beta(gain: FloatArray, beta: float) -> float:
    """Find the largest beta, by halving, at which enough samples still count."""
    enough = _EFFECTIVE * len(gain)
    if n_effective((1.0 - beta) * gain) >= enough:
        return 1.0
    low, high = beta, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if n_effective((middle - beta) * gain) >= enough else (low, middle)
    return min(max(low, beta + _LEAST_STEP), 1.0)


def _moved(
    z: FloatArray,
    heights: tuple[FloatArray, FloatArray],
    beta: float,
    scale: float,
    log_q: Callable[[FloatArray], FloatArray],
    log_p: Callable[[FloatArray], FloatArray],
    rng: np.random.Generator,
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], float]:
    """Move one half by differences of the other, then the other by the first's; adapt the step's length."""
    z, q, p = z.copy(), heights[0].copy(), heights[1].copy()
    order, n = rng.permutation(len(z)), len(z) // 2
    accepted = 0
    for own, other in ((order[:n], order[n:]), (order[n:], order[:n])):
        first, second = (z[rng.choice(other, len(own))] for _ in range(2))
        length = scale * 2.38 / math.sqrt(2 * z.shape[1]) * rng.choice([1.0, 0.3], (len(own), 1))
        to = z[own] + length * (first - second)
        to_q, to_p = log_q(to), log_p(to)
        rise = (1 - beta) * (to_q - q[own]) + beta * (to_p - p[own])
        taken = np.log(rng.random(len(own))) < rise
        z[own[taken]], q[own[taken]], p[own[taken]] = to[taken], to_q[taken], to_p[taken]
        accepted += int(taken.sum())
    rate = accepted / len(z)
    return z, (q, p), min(max(scale * (1.3 if rate > 0.35 else 0.75 if rate < 0.15 else 1.0), 0.05), 2.0)
