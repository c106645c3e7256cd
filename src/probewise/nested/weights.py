"""Weighted samples: effective sample size, resampling and quantiles; and the Student-t that proposals are made of."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.special import gammaln

from probewise._arrays import FloatArray, IntArray
from probewise.errors import require


def n_effective(log_weight: FloatArray) -> float:
    """Kish's effective sample size of unnormalised log weights, (n,); 0 where all weights are zero."""
    most = float(np.max(log_weight))
    if not math.isfinite(most):
        return 0.0
    weight = np.exp(log_weight - most)
    return float(weight.sum() ** 2 / (weight @ weight))


_BISECTIONS = 30


def largest_power(log_weight_at: Callable[[float], FloatArray], low: float, *, wanted: float) -> float:
    """Return, by bisection, the largest power up to 1 whose log weights have an effective size of `wanted` or more.

    The weights of the power `low` have enough, those of 1 too few; `log_weight_at` maps a power to log weights, (n,).
    """
    high = 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if n_effective(log_weight_at(middle)) >= wanted else (low, middle)
    return low


def tempering_power(log_weight: FloatArray, wanted: float) -> float:
    """Return the largest power up to 1 of weights, (n,), that leaves an effective sample size of `wanted`."""
    if n_effective(log_weight) >= wanted:
        return 1.0
    return largest_power(lambda power: power * log_weight, 0.0, wanted=wanted)


def resampled_rows(weight: FloatArray, n: int, rng: np.random.Generator) -> IntArray:
    """Draw rows by weight with systematic resampling, (n_weights,) -> (n,): counts are n w rounded up or down.

    The rows are sorted; w are the weights divided by their sum.
    """
    ladder = np.cumsum(weight)
    rows = np.searchsorted(ladder / ladder[-1], (np.arange(n) + rng.random()) / n, side="right")
    return np.asarray(np.minimum(rows, len(ladder) - 1))


def weighted_quantiles(
    values: FloatArray, weight: FloatArray, q: FloatArray | list[float] | tuple[float, ...]
) -> FloatArray:
    """Weighted quantiles of each column, (n, n_columns) with weights (n,) and levels (n_q,) -> (n_q, n_columns).

    ParameterError if a level is not between 0 and 1.
    """
    levels = np.asarray(q, dtype=np.float64)
    require(levels.ndim == 1 and ((levels >= 0) & (levels <= 1)).all(), "q", q, "a list of numbers from 0 to 1")
    out = np.empty((levels.size, values.shape[1]))
    for i in range(values.shape[1]):
        order = np.argsort(values[:, i])
        mass = weight[order]
        out[:, i] = np.interp(levels, (np.cumsum(mass) - 0.5 * mass) / mass.sum(), values[order, i])
    return out


def student_t_draws(n: int, n_params: int, degrees_of_freedom: float, *, rng: np.random.Generator) -> FloatArray:
    """Draw from the multivariate Student-t about 0 whose scale matrix is the identity, (n, n_params)."""
    white = rng.standard_normal((n, n_params))
    white *= np.sqrt(degrees_of_freedom / rng.chisquare(degrees_of_freedom, size=(n, 1)))
    return white


def student_t_log_norm(n_params: int, degrees_of_freedom: float) -> float:
    """Return the log of that density at 0; at a distance r it is (1 + r^2 / nu)^(-(nu + n_params) / 2) times that."""
    nu = degrees_of_freedom
    return float(gammaln((nu + n_params) / 2) - gammaln(nu / 2) - 0.5 * n_params * math.log(nu * math.pi))
