"""Heavy-tailed priors of an effect's size: highest density at zero, large values never ruled out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import erfc

from probewise._arrays import FloatArray
from probewise.errors import ParameterError

SMALLEST_AND_LARGEST = (0.05, 25.0)
"""Smallest and largest sd of the mixture, in typical sizes: with a narrower range large effects are misnamed."""

_N_SCALES = 9  # over that range; a wider one has as many to a decade


@dataclass(frozen=True)
class HeavyTailedPrior:
    """Scale mixture of normal distributions about zero, by default with sds from 0.05 to 25 times a typical size.

    The weights are equal, so the density falls about as 1/abs(x) between the smallest and the largest sd and is
    proper. With `positive` the distribution is folded onto x >= 0. `smallest` and `largest` are the smallest and the
    largest sd, in typical sizes.
    """

    typical: float
    positive: bool = False
    smallest: float = SMALLEST_AND_LARGEST[0]
    largest: float = SMALLEST_AND_LARGEST[1]

    def __post_init__(self) -> None:
        if not 0 < self.typical < math.inf:
            raise ParameterError("HeavyTailedPrior(typical)", self.typical, "greater than 0, finite")
        if not 0 < self.smallest < self.largest:
            raise ParameterError("HeavyTailedPrior(smallest)", self.smallest, f"0 < smallest < {self.largest:g}")

    @cached_property
    def component_sds(self) -> FloatArray:
        """Sds of the normal distributions of equal weight that it mixes, (n_components,)."""
        return self.typical * _relative_component_sds(self.smallest, self.largest)

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape."""
        x = np.asarray(value, dtype=np.float64)[..., None] / self.component_sds
        terms = np.exp(-0.5 * x * x) / (self.component_sds * math.sqrt(2 * math.pi))
        with np.errstate(divide="ignore"):
            density = np.log(terms.mean(axis=-1))
        if not self.positive:
            return np.asarray(density)
        return np.where(np.asarray(value) >= 0, density + math.log(2.0), -np.inf)

    def _upper_tail_probability(self, x: FloatArray) -> FloatArray:
        """Return the probability above x of the two-sided mixture."""
        return np.asarray(0.5 * erfc(x[..., None] / (self.component_sds * math.sqrt(2))).mean(axis=-1))

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function, any shape."""
        u = np.asarray(u, dtype=np.float64)
        if self.positive:
            tail, sign = (1.0 - u) / 2, np.ones_like(u)
        else:
            tail, sign = np.minimum(u, 1.0 - u), np.where(u < 0.5, -1.0, 1.0)
        goal = -np.log(2 * np.clip(tail, 1e-15, 0.5))
        return np.asarray(
            sign * self.typical * _tabulate_quantiles(self.smallest, self.largest).sizes_at_log_tail(goal)
        )

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, any shape."""
        value = np.asarray(value, dtype=np.float64)
        tail = self._upper_tail_probability(np.abs(value))
        if self.positive:
            return np.where(value > 0, 1.0 - 2.0 * tail, 0.0)
        return np.where(value < 0, tail, 1.0 - tail)

    def __str__(self) -> str:
        kind = "positive heavy-tailed" if self.positive else "heavy-tailed about 0"
        return f"{kind}, typical {self.typical:g}"


@dataclass(frozen=True, eq=False)
class _QuantileTable:
    """Quantiles of the mixture of typical size one: `depth` is -log(2 x upper tail) at each `size`."""

    sds: FloatArray
    depth: FloatArray
    size: FloatArray

    def sizes_at_log_tail(self, goal: FloatArray) -> FloatArray:
        """Return the sizes at which -log(2 x upper tail) equals `goal`, in its shape: a look-up, then Newton steps."""
        x = np.interp(goal, self.depth, self.size)
        for _ in range(3):
            scaled = x[..., None] / (self.sds * math.sqrt(2))
            upper = np.maximum(0.5 * erfc(scaled).mean(axis=-1), 1e-300)
            density = (np.exp(-(scaled**2)) / (self.sds * math.sqrt(2 * math.pi))).mean(axis=-1)
            x = np.clip(x + (np.log(2 * upper) + goal) * upper / density, 0.0, self.size[-1])
        return np.asarray(x)


def _relative_component_sds(smallest: float, largest: float) -> FloatArray:
    """Return the sds of the mixture's components, in typical sizes: evenly spaced in their logarithm."""
    decades = math.log(largest / SMALLEST_AND_LARGEST[1]) / math.log(SMALLEST_AND_LARGEST[1] / SMALLEST_AND_LARGEST[0])
    return np.asarray(np.geomspace(smallest, largest, _N_SCALES + max(math.ceil((_N_SCALES - 1) * decades), 0)))


@lru_cache(maxsize=16)
def _tabulate_quantiles(smallest: float, largest: float) -> _QuantileTable:
    """Tabulate the quantiles of the mixture of typical size one, from size 0 upwards."""
    sds = _relative_component_sds(smallest, largest)
    size = np.concatenate([[0.0], np.geomspace(1e-5, 12.0 * largest, 600)])
    upper = 0.5 * erfc(size[:, None] / (sds * math.sqrt(2))).mean(axis=-1)
    return _QuantileTable(sds, -np.log(2 * upper), size)


@dataclass(frozen=True)
class LogHeavyTailedPrior:
    """Prior of a positive factor or exponent about one: its logarithm has a heavy-tailed prior about zero."""

    typical_log: float
    smallest: float = SMALLEST_AND_LARGEST[0]

    @cached_property
    def _prior_of_log(self) -> HeavyTailedPrior:
        return HeavyTailedPrior(self.typical_log, smallest=self.smallest)

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function, any shape."""
        return np.exp(self._prior_of_log.from_unit(u))

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, any shape; 0 at and below zero."""
        value = np.asarray(value, dtype=np.float64)
        return np.where(value > 0, self._prior_of_log.to_unit(np.log(np.where(value > 0, value, 1.0))), 0.0)

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape; -inf at and below zero."""
        value = np.asarray(value, dtype=np.float64)
        safe = np.where(value > 0, value, 1.0)
        return np.where(value > 0, self._prior_of_log.log_prob(np.log(safe)) - np.log(safe), -np.inf)

    def __str__(self) -> str:
        return f"logarithm {self._prior_of_log}"
