"""Rounded normal noise: the sum of a normal and a uniform part, with a flat-topped density.

A rounded reading means that the unrounded one was within half a step, and its likelihood is this density of the
residual. Within the flat top a residual carries no information. The density never exceeds one over the (known) step,
however small the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.density import log_gaussian_mass_between

_LOG_ROOT_2_PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True, eq=False)
class RoundedNormal:
    """Normal noise of known sd `sigma` plus a uniform part of half width `half` sigma; scalars, or k of both (k,).

    The methods are those of `Tail`, with residuals (n_points, k) or (n_points, 1); pass this `sigma` to each.
    """

    half: float | FloatArray
    sigma: float | FloatArray

    is_normal = False

    @cached_property
    def fisher_information(self) -> FloatArray:
        """Fisher information about the mean, in units of 1 / sigma^2, (k,) or a number."""
        return np.asarray(np.vectorize(_fisher_information, otypes=[np.float64])(self.half))

    def likeliest_sigma(
        self, whitened: FloatArray, n_points: int, *, floor: float = 0.0, start: FloatArray | None = None
    ) -> FloatArray:
        """Return the known sigma, (k,)."""
        k = max(whitened.shape[1], np.size(self.sigma))
        return np.broadcast_to(np.asarray(self.sigma, dtype=np.float64), (k,)).copy()

    def minus_log_likelihood(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return minus the log likelihood of `n_points` readings at sigma (k,), without n/2 log 2 pi: (k,)."""
        density = self._log_density(whitened / sigma) + _LOG_ROOT_2_PI
        at_zero = self._log_density(np.zeros((1, 1)))[0] + _LOG_ROOT_2_PI
        of_kept = density.sum(axis=0) - (len(whitened) - n_points) * at_zero
        return np.asarray(n_points * np.log(sigma) - of_kept)

    def normal_pseudo_residuals(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """Convert residuals to equally informative normal ones, of sd sigma / sqrt(information) and the same shape."""
        return np.asarray(sigma * self._score(whitened / sigma) / self.fisher_information)

    def log_sigma_curvature(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return 2 pi, (k,): Laplace's integral over log sigma is then 1, since sigma is known."""
        return np.full(sigma.shape, 2 * math.pi)

    def _log_density(self, x: FloatArray) -> FloatArray:
        half, away = np.asarray(self.half), np.abs(x)
        return np.asarray(log_gaussian_mass_between(-half - away, half - away) - np.log(2 * half))

    def _score(self, x: FloatArray) -> FloatArray:
        half = np.asarray(self.half)
        log_mass = self._log_density(x) + np.log(2 * half) + _LOG_ROOT_2_PI
        return np.asarray(np.exp(-0.5 * (x - half) ** 2 - log_mass) - np.exp(-0.5 * (x + half) ** 2 - log_mass))


@lru_cache(maxsize=64)
def _fisher_information(half: float) -> float:
    one = RoundedNormal(half, 1.0)
    x = np.linspace(-half - 8, half + 8, 8001)[:, None]
    density = np.exp(one._log_density(x))
    return float(np.sum(one._score(x) ** 2 * density) * (x[1, 0] - x[0, 0]))
