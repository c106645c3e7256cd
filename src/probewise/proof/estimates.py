"""Estimates with 95 % intervals or standard errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.stats import binom, binomtest, t

from probewise._arrays import FloatArray

LEAST_FOR_MEDIAN = 6
"""Smallest number of values whose range covers the median with 95 %: 1 - 2 / 2^6 is 97 %."""

_DRAWS = 400
K = TypeVar("K")
V = TypeVar("V")


@dataclass(frozen=True)
class Estimate:
    """An estimate, the ends of its 95 % interval (or one standard error to either side), and the sample size if known.

    NaN for an empty sample.
    """

    value: float
    low: float
    high: float
    n: int = 0

    @property
    def half_width(self) -> float:
        """Half the length of the interval."""
        return 0.5 * (self.high - self.low)

    def __str__(self) -> str:
        return f"{self.value:.3g} ± {self.half_width:.2g}"


_NOTHING = Estimate(math.nan, math.nan, math.nan)


def grouped(pairs: Iterable[tuple[K, V]]) -> dict[K, list[V]]:
    """Return the values of each key, in order."""
    out: dict[K, list[V]] = {}
    for key, value in pairs:
        out.setdefault(key, []).append(value)
    return out


def estimated_share(hits: Iterable[bool]) -> Estimate:
    """Estimate a proportion, with Wilson's interval."""
    n_hits, n = sum(each := list(hits)), len(each)
    if not n:
        return _NOTHING
    found = binomtest(n_hits, n).proportion_ci(method="wilson")
    return Estimate(n_hits / n, float(found.low), float(found.high), n)


def estimated_mean(values: Iterable[float]) -> Estimate:
    """Estimate a mean, with Student's interval (infinite for one value)."""
    each = list(values)
    if not each:
        return _NOTHING
    center, n = float(np.mean(each)), len(each)
    half = float(t.ppf(0.975, n - 1) * np.std(each, ddof=1) / math.sqrt(n)) if n > 1 else math.inf
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


def mean_with_error(values: Iterable[float]) -> Estimate:
    """Estimate a mean with its standard error to either side; NaN for fewer than two values."""
    each = np.array([*values], dtype=np.float64)
    if each.size < 2:
        return _NOTHING
    mean, error = float(each.mean()), float(each.std(ddof=1)) / math.sqrt(each.size)
    return Estimate(mean, mean - error, mean + error, each.size)


def median_with_interval(values: FloatArray) -> Estimate:
    """Estimate a median with a distribution-free 95 % interval of order statistics, NaN bounds below six values."""
    ordered, n = np.sort(values), len(values)
    if n < LEAST_FOR_MEDIAN:
        return Estimate(float(np.median(ordered)), math.nan, math.nan, n)
    below = max(int(binom.ppf(0.025, n, 0.5)) - 1, 0)
    return Estimate(float(np.median(ordered)), float(ordered[below]), float(ordered[n - 1 - below]), n)
