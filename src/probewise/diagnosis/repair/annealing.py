"""Transform samples of one density to a nearby one: by importance resampling, or tempered sequential Monte Carlo.

The densities between are q^(1 - beta) p^beta (Neal 2001). After each step of beta the samples are resampled by their
weights and moved: each half by differences of the other half (ter Braak 2006), which leaves the density invariant.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.nested.weights import n_effective, power_bracket, resampled_rows
from probewise.progress import Progress, silent

_ENOUGH = 0.5  # target effective sample size, as a share of the samples wanted
_LEAST_OF_IT = 0.5  # least acceptable share of the target
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
) -> FloatArray | None:
    """Draw from a density by importance resampling, if the effective sample size suffices.

    Parameters
    ----------
    first
        Samples of the other density in random order, (n_first, n_params); only as many as needed are evaluated.
    log_q, log_p
        Unnormalised log densities of the proposal and the target, (n, n_params) -> (n,); `log_p` is minus infinity
        outside its support.
    n_wanted
        Number of samples to draw; the effective sample size should be half of it.
    rng
        Source of randomness.
    least
        Least acceptable effective sample size, as a share of `n_wanted`.

    Returns
    -------
    Samples in random order, (n_wanted, n_params); None if the effective sample size is too small.
    """
    gain = log_p(first[:n_wanted]) - log_q(first[:n_wanted])
    share = _n_distinct_effective(gain, first[:n_wanted]) / len(gain)
    if share * len(first) < least * n_wanted:
        return None
    enough = min(math.ceil(_ENOUGH * n_wanted / share), len(first))
    if enough > n_wanted:
        more = first[n_wanted:enough]
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
    """Draw from a density by sequential Monte Carlo, starting from samples of another one.

    Parameters
    ----------
    first
        Samples of the other density, (n_walkers, n_params), an even number.
    log_q, log_p, n_wanted, rng
        As in `importance_resample`.
    n_moves
        Moves of each sample after a step of beta, and between collections of samples.
    progress
        Called at each step of beta, and then with the number of collected samples.

    Returns
    -------
    Samples in random order, (n_wanted, n_params), collected from the walkers every `n_moves` moves.

    Raises
    ------
    NotConvergedError
        If no initial sample is in the support of the target.
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
