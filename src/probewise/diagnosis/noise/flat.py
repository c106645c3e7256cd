"""What rounding makes of normal noise: the sum of a normal and a uniform part, flat at the top.

A reading that was rounded to a lattice says of what was there that it lay within half a step, and the likelihood of
that is this density of the residual, for any lattice. Inside its flat top a residual says nothing. The step is known,
so that no density is above one over it, however small the noise beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import log_ndtr

from probewise._arrays import FloatArray

__all__ = ["Flat"]

_LOG_ROOT_2_PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True, eq=False)
class Flat:
    """Add to normal noise of a known sd `sigma` a uniform part of `half` sigma either way; one, or k of both (k,).

    All methods take residuals, (n_points, k) or (n_points, 1), and are those of `Tail`; their `sigma` is this one.
    """

    half: float | FloatArray
    sigma: float | FloatArray

    is_normal = False

    @cached_property
    def information(self) -> FloatArray:
        """Fisher information about the mean, in units of 1 / sigma^2, (k,) or a number."""
        return np.asarray(np.vectorize(_information, otypes=[np.float64])(self.half))

    def scale(
        self, whitened: FloatArray, n_points: int, *, floor: float = 0.0, start: FloatArray | None = None
    ) -> FloatArray:
        """Give the known sigma, (k,)."""
        k = max(whitened.shape[1], np.size(self.sigma))
        return np.broadcast_to(np.asarray(self.sigma, dtype=np.float64), (k,)).copy()

    def misfit(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Minus log likelihood at sigma (k,), without n/2 log 2 pi: (k,)."""
        density = self._log_density(whitened / sigma) + _LOG_ROOT_2_PI
        at_zero = self._log_density(np.zeros((1, 1)))[0] + _LOG_ROOT_2_PI
        of_kept = density.sum(axis=0) - (len(whitened) - n_points) * at_zero
        return np.asarray(n_points * np.log(sigma) - of_kept)

    def as_normal(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """Turn residuals into those of normal noise that say as much about the mean, as `Tail.as_normal` does."""
        return np.asarray(sigma * self._score(whitened / sigma) / self.information)

    def scale_curvature(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Give the curvature by which an integral over log sigma is worth 1, (k,): nothing is left to integrate."""
        return np.full(sigma.shape, 2 * math.pi)

    def _log_density(self, x: FloatArray) -> FloatArray:
        half = np.asarray(self.half)
        upper, lower = log_ndtr(half - np.abs(x)), log_ndtr(-half - np.abs(x))
        return np.asarray(upper + np.log1p(-np.exp(lower - upper)) - np.log(2 * half))

    def _score(self, x: FloatArray) -> FloatArray:
        """Minus the slope of the log density: what the normal part has at either end of the flat top, over it."""
        half = np.asarray(self.half)
        log_mass = self._log_density(x) + np.log(2 * half) + _LOG_ROOT_2_PI
        return np.asarray(np.exp(-0.5 * (x - half) ** 2 - log_mass) - np.exp(-0.5 * (x + half) ** 2 - log_mass))


@lru_cache(maxsize=64)
def _information(half: float) -> float:
    one = Flat(half, 1.0)
    x = np.linspace(-half - 8, half + 8, 8001)[:, None]
    density = np.exp(one._log_density(x))
    return float(np.sum(one._score(x) ** 2 * density) * (x[1, 0] - x[0, 0]))
