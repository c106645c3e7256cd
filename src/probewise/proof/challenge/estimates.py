"""Estimates with 95 % intervals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest, t

from probewise._arrays import FloatArray

_DRAWS = 400


@dataclass(frozen=True)
class Estimate:
    """An estimate, the ends of its 95 % interval, and the sample size; NaN and 0 for an empty sample."""

    value: float
    low: float
    high: float
    n: int


_NOTHING = Estimate(math.nan, math.nan, math.nan, 0)


def estimated_share(hits: list[bool]) -> Estimate:
    """Estimate the share of True values, with Wilson's interval (Wilson 1927)."""
    if not hits:
        return _NOTHING
    found = binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
    return Estimate(sum(hits) / len(hits), float(found.low), float(found.high), len(hits))


def estimated_mean(values: list[float]) -> Estimate:
    """Estimate a mean, with Student's interval (infinite for one value)."""
    if not values:
        return _NOTHING
    center, n = float(np.mean(values)), len(values)
    if n == 1:
        return Estimate(center, -math.inf, math.inf, n)
    half = float(t.ppf(0.975, n - 1) * np.std(values, ddof=1) / math.sqrt(n))
    return Estimate(center, center - half, center + half, n)


def estimated_statistic(rows: FloatArray, statistic: Callable[[FloatArray], float]) -> Estimate:
    """Estimate a statistic of rows (n, ...), with the basic bootstrap interval from random draws with a fixed seed.

    The basic interval reflects the draws about the estimate, which corrects the bias of small samples (Davison and
    Hinkley 1997, section 5.2). It is infinite for one row.
    """
    if not len(rows):
        return _NOTHING
    if len(rows) == 1:
        return Estimate(statistic(rows), -math.inf, math.inf, 1)
    rng = np.random.default_rng(len(rows))
    draws = [statistic(rows[rng.integers(len(rows), size=len(rows))]) for _ in range(_DRAWS)]
    value, (low, high) = statistic(rows), np.quantile(draws, [0.025, 0.975])
    return Estimate(value, float(2 * value - high), float(2 * value - low), len(rows))
