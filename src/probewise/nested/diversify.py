"""Make repeated posterior samples distinct by Metropolis-Hastings.

Paper, section 2.3, "The Machine Learning System".
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from probewise._arrays import FloatArray, floats, own_arithmetic
from probewise._kinds import checked_whole, require_rng
from probewise.errors import ParameterError, ShapeError
from probewise.nested.problem import Evaluator, Samplable
from probewise.priors import require_prior

_N_PRIOR_DRAWS = 200
_BLOCK = 100


@own_arithmetic
def diversify(theta: FloatArray, problem: Samplable, *, rng: np.random.Generator, n_steps: int = 1000) -> FloatArray:
    """Run a Metropolis-Hastings chain from every sample, all chains in parallel.

    Every step proposes one of three symmetric moves to each sample: a Gaussian with the samples' covariance, a
    difference of two samples (which can lead to another mode), or a change of one parameter on the scale of its prior,
    scaled by a factor drawn over orders of magnitude. The proposals depend only on the samples as given, not on the
    chains' states, so that every chain has the posterior as its stationary distribution.

    `theta` are posterior samples, possibly repeated, (n_samples, n_params); `problem` has a prior with `log_prob`.
    Return the samples after `n_steps` each; the paper takes about 1000. Raises ParameterError or ShapeError if a sample
    has zero posterior density, `n_steps` is negative, the prior has no `log_prob`, or `theta` has another shape, or no
    rows; NotConvergedError if the likelihood fails.
    """
    require_rng(rng)
    start = np.array(floats(theta, "theta"))
    evaluate = Evaluator(problem)
    require_prior("problem.prior", problem.prior, "log_prob")
    if start.ndim != 2 or start.shape[1] != len(evaluate.names) or len(start) == 0:
        raise ShapeError(f"theta has shape {start.shape}; allowed: (n_samples, {len(evaluate.names)})")
    n_steps = checked_whole("n_steps", n_steps, least=0)
    n_params = start.shape[1]
    if n_params == 0 or n_steps == 0:
        return start
    prior = problem.prior
    log_posterior = prior.log_prob(start) + evaluate.log_likelihood(start)
    if not np.isfinite(log_posterior).all():
        at = int(np.flatnonzero(~np.isfinite(log_posterior))[0])
        raise ParameterError(f"theta[{at}]", start[at].tolist(), "a sample with posterior density above zero")
    prior_sd = prior.from_unit_cube(rng.random((_N_PRIOR_DRAWS, n_params))).std(axis=0)
    now = start.copy()
    for displacement, threshold in _displacements_and_log_thresholds(start, prior_sd, n_steps, rng):
        proposed = now + displacement
        proposed_log_posterior = prior.log_prob(proposed)
        # The likelihood is not evaluated outside the prior, where a model may be undefined.
        inside = np.flatnonzero(np.isfinite(proposed_log_posterior))
        if inside.size == 0:
            continue
        proposed_log_posterior[inside] += evaluate.log_likelihood(proposed[inside])
        accept = threshold < proposed_log_posterior - log_posterior
        now[accept], log_posterior[accept] = proposed[accept], proposed_log_posterior[accept]
    return now


def _displacements_and_log_thresholds(
    cloud: FloatArray, prior_sd: FloatArray, n_steps: int, rng: np.random.Generator
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield per step the proposed displacements, (n_samples, n_params), and logs of uniform numbers, (n_samples,)."""
    n_samples, n_params = cloud.shape
    covariance = np.atleast_2d(np.cov(cloud, rowvar=False)) if n_samples > 1 else np.zeros((n_params, n_params))
    values, vectors = np.linalg.eigh(covariance / np.outer(prior_sd, prior_sd))
    root = prior_sd[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    best = 2.38 / np.sqrt(n_params)  # Roberts, Gelman & Gilks 1997, for a Gaussian of known covariance
    for first in range(0, n_steps, _BLOCK):
        n = min(_BLOCK, n_steps - first)
        scale = 10.0 ** (-2.0 * rng.random((n, n_samples)) ** 2)
        move = rng.standard_normal((n, n_samples, n_params)) @ root.T
        move *= (best * scale)[..., None]
        kind = rng.random((n, n_samples))
        follow = np.nonzero((kind > 0.4) & (kind <= 0.75))
        if n_samples > 1:
            a = rng.integers(n_samples, size=follow[0].size)
            b = (a + rng.integers(1, n_samples, size=follow[0].size)) % n_samples
            # A full difference can take a sample from one mode to another.
            length = np.where(rng.random(follow[0].size) < 0.3, 1.0, best / np.sqrt(2.0) * scale[follow])
            move[follow] = length[:, None] * (cloud[a] - cloud[b])
        single = np.nonzero(kind > 0.75)
        column = rng.integers(n_params, size=single[0].size)
        move[single] = 0.0
        change = rng.standard_normal(single[0].size) * 10.0 ** (-4.0 * rng.random(single[0].size))
        move[(*single, column)] = prior_sd[column] * change
        yield from zip(move, np.log(rng.random((n, n_samples))), strict=True)
