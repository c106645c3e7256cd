"""Heavy-tailed priors of an effect's size: highest density at zero, large values never ruled out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import erfc, gammainc, gammaincc, gammainccinv, gammaincinv, logsumexp, ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.priors import checked_columns

_N_SCALES = 9  # over that range; a wider one has as many to a decade
_N_SIZES = 1500  # in the table of quantiles
_LEAST_TAIL = 1e-250  # of both tails of the table
_FARTHEST_SD = 1e-16  # distance from the ends of the unit cube, 8.2 standard deviations


SMALLEST_AND_LARGEST = (0.05, 25.0)
"""Smallest and largest sd of the mixture, in typical sizes: with a narrower range large effects are misnamed."""


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


if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class SharedScalePrior:
    """Values that are normal about zero with the same sd, log-uniform over the sds of `each`.

    Independent heavy-tailed priors ask of every value anew how large it is. Where one has told, here the others are
    expected to be as large. The distribution depends on the root of the sum of squares alone, so that standard-normal
    coordinates have the direction of the values, and their length is that of equal probability.

    `names`: names of the values, two or more; `each`: the prior of one value, about: a heavy-tailed prior with sds over
    the same range.
    """

    names: tuple[str, ...]
    each: HeavyTailedPrior

    @property
    def typical(self) -> float:
        """Typical size of a value."""
        return self.each.typical

    @cached_property
    def component_sds(self) -> FloatArray:
        """Sds of the normal distributions of equal weight that it mixes, (n_components,)."""
        return self.typical * _sds(len(self.names), self.each.smallest, self.each.largest)

    @cached_property
    def _radii(self) -> _Radii:
        return _tabulated_radii(len(self.names), self.each.smallest, self.each.largest)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map the unit cube to values, (n_samples, n_values) -> same shape."""
        z = ndtri(np.clip(checked_columns(u, self.names), _FARTHEST_SD, 1 - _FARTHEST_SD))
        length = np.linalg.norm(z, axis=1, keepdims=True)
        return np.asarray(self.typical * z * self._radii.ratio(length))

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map values to the unit cube, (n_samples, n_values) -> same shape."""
        values = checked_columns(theta, self.names) / self.typical
        size = np.linalg.norm(values, axis=1, keepdims=True)
        return np.asarray(ndtr(values / self._radii.ratio_at_size(size)))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the log density of values, (n_samples, n_values) -> (n_samples,)."""
        values = checked_columns(theta, self.names)
        n, sds = len(self.names), self.component_sds
        squares = np.sum(values**2, axis=1)[:, None]
        terms = -0.5 * squares / sds**2 - n * np.log(sds)
        return np.asarray(logsumexp(terms, axis=1) - math.log(len(sds)) - 0.5 * n * math.log(2 * math.pi))


@dataclass(frozen=True, eq=False)
class _Radii:
    """Lengths of standard-normal vectors and of vectors of values (typical size one), with the same probability.

    Both are increasing, (n_sizes,), and their logarithms rise alike beyond the ends.
    """

    normal: FloatArray
    values: FloatArray

    @cached_property
    def _at_log_normal(self) -> CubicSpline:
        return _spline(np.log(self.normal), np.log(self.values))

    @cached_property
    def _at_log_values(self) -> CubicSpline:
        return _spline(np.log(self.values), np.log(self.normal))

    def ratio(self, length: FloatArray) -> FloatArray:
        """Return values per standard-normal coordinate at a length of the latter, in its shape."""
        at = np.log(np.clip(length, self.normal[0], self.normal[-1]))
        return np.asarray(np.exp(self._at_log_normal(at) - at))

    def ratio_at_size(self, size: FloatArray) -> FloatArray:
        """Return values per standard-normal coordinate at a length of the values, in its shape."""
        at = np.log(np.clip(size, self.values[0], self.values[-1]))
        return np.asarray(np.exp(at - self._at_log_values(at)))


def _spline(x: FloatArray, y: FloatArray) -> CubicSpline:
    from scipy.interpolate import CubicSpline  # a third of a second, which few diagnoses need

    return CubicSpline(x, y)


def _sds(n_values: int, smallest: float, largest: float) -> FloatArray:
    """Return sds, evenly spaced in their logarithm, so close that lengths of vectors of neighbouring ones overlap."""
    spread_of_log_length = 1 / math.sqrt(2 * n_values)
    return np.geomspace(smallest, largest, 2 + math.ceil(math.log(largest / smallest) / spread_of_log_length))


@lru_cache(maxsize=64)
def _tabulated_radii(n_values: int, smallest: float, largest: float) -> _Radii:
    sds, half = _sds(n_values, smallest, largest), 0.5 * n_values
    near, far = (math.sqrt(2 * inverse(half, _LEAST_TAIL)) for inverse in (gammaincinv, gammainccinv))
    values = np.geomspace(sds[0] * max(near, 1e-6), sds[-1] * far, _N_SIZES)
    squares = 0.5 * (values[:, None] / sds) ** 2
    below, above = gammainc(half, squares).mean(axis=1), gammaincc(half, squares).mean(axis=1)
    near_zero = below < 0.5
    normal = np.sqrt(
        2
        * np.where(
            near_zero,
            gammaincinv(half, np.where(near_zero, below, 0.5)),
            gammainccinv(half, np.where(near_zero, 0.5, above)),
        )
    )
    kept = (below > _LEAST_TAIL) & (above > _LEAST_TAIL) & (np.diff(normal, prepend=0.0) > 0)
    return _Radii(normal[kept], values[kept])
