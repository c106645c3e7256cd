"""Prior of several values that are about as large as each other: normal about zero, with one sd that is not known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammainc, gammaincc, gammainccinv, gammaincinv, logsumexp, ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.priors import checked_columns

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_N_SIZES = 1500  # in the table of quantiles
_LEAST_TAIL = 1e-250  # of both tails of the table
_FARTHEST_SD = 1e-16  # distance from the ends of the unit cube, 8.2 standard deviations


@dataclass(frozen=True)
class SharedScalePrior:
    """Values that are normal about zero with the same sd, log-uniform over the sds of `each`.

    Independent heavy-tailed priors ask of every value anew how large it is. Where one has told, here the others are
    expected to be as large. The distribution depends on the root of the sum of squares alone, so that standard-normal
    coordinates have the direction of the values, and their length is that of equal probability.

    Parameters
    ----------
    names
        Names of the values, two or more.
    each
        The prior of one value, about: a heavy-tailed prior with sds over the same range.
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
