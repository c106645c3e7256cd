"""Rounded normal noise: the sum of a normal and a uniform part, with a flat-topped density.

A rounded reading means that the unrounded one was within half a step, and its likelihood is this density of the
residual. Within the flat top a residual carries no information. The density never exceeds one over the (known) step,
however small the noise.

All readings are rounded to one step, so the flat top of a reading with a smaller noise sd is wider in units of that sd.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.noise_distribution import log_gaussian_mass_between

_LOG_ROOT_2_PI = 0.5 * math.log(2 * math.pi)
_LOG_HALVES = np.linspace(math.log(0.01), math.log(1000.0), 116)  # at which the information is tabulated


@dataclass(frozen=True, eq=False)
class RoundedNormal:
    """Normal noise of known sd `sigma` plus a uniform part of half width `half` sigma; scalars, or k of both (k,).

    The methods are those of `Tail`, with residuals (n_points, k) or (n_points, 1); pass this `sigma` to each.

    Parameters
    ----------
    half, sigma
        The noise of a reading of relative sd 1.
    sd
        Sds of the readings relative to that one, (n_points, 1), 1 for lost readings; 1.0 if all are equal. Residuals
        are whitened by `whitening_sd`, so that each tells as much of the mean as one of relative sd 1.
    """

    half: float | FloatArray
    sigma: float | FloatArray
    sd: float | FloatArray = 1.0

    is_normal = False

    @cached_property
    def normal_sd(self) -> float | FloatArray:
        """Sd of the normal part of each whitened residual, in sigma, (n_points, k); 1.0 if all sds are equal."""
        if np.ndim(self.sd) == 0:
            return 1.0
        log_information = _log_fisher_information(self._half_by_reading) - _log_fisher_information(self.half)
        return np.asarray(np.exp(0.5 * log_information))

    @property
    def whitening_sd(self) -> float | FloatArray:
        """Relative sd by which the residual of each reading is divided, (n_points, k); 1.0 if all are equal."""
        return self.sd / self.normal_sd

    @cached_property
    def _half_by_reading(self) -> FloatArray:
        """Half width of each reading's flat top, in sds of its normal part, (n_points, k) or as `half`."""
        return np.asarray(self.half / self.sd)

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
        """Return minus the log likelihood of `n_points` readings at sigma (k,), without n/2 log 2 pi: (k,).

        It is that of the readings over their relative sds, whatever the whitening.
        """
        density = _log_density(whitened / sigma / self.normal_sd, self._half_by_reading) + _LOG_ROOT_2_PI
        at_zero = _log_density(np.zeros((1, 1)), np.asarray(self.half))[0] + _LOG_ROOT_2_PI
        of_kept = density.sum(axis=0) - (len(whitened) - n_points) * at_zero
        return np.asarray(n_points * np.log(sigma) - of_kept)

    def normal_pseudo_residuals(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """Convert residuals to equally informative normal ones, of sd sigma / sqrt(information) and the same shape."""
        score = _score(whitened / sigma / self.normal_sd, self._half_by_reading) / self.normal_sd
        return np.asarray(sigma * score / self.fisher_information)

    def add_rounding(self, normal: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Turn standard normal noise into that of whitened readings in units of sigma, (n_points, n_draws) both."""
        return np.asarray(
            normal * self.normal_sd + self.half / self.whitening_sd * rng.uniform(-1.0, 1.0, normal.shape)
        )

    def log_sigma_curvature(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return 2 pi, (k,): Laplace's integral over log sigma is then 1, since sigma is known."""
        return np.full(sigma.shape, 2 * math.pi)


def _log_density(x: FloatArray, half: FloatArray) -> FloatArray:
    """Return the log density of a standard normal plus a uniform part of this half width; arrays broadcast."""
    away = np.abs(x)
    return np.asarray(log_gaussian_mass_between(-half - away, half - away) - np.log(2 * half))


def _score(x: FloatArray, half: FloatArray) -> FloatArray:
    """Return minus the derivative of that log density."""
    log_mass = _log_density(x, half) + np.log(2 * half) + _LOG_ROOT_2_PI
    return np.asarray(np.exp(-0.5 * (x - half) ** 2 - log_mass) - np.exp(-0.5 * (x + half) ** 2 - log_mass))


@lru_cache(maxsize=64)
def _fisher_information(half: float) -> float:
    width, x = np.asarray(half), np.linspace(-half - 8, half + 8, 8001)[:, None]
    density = np.exp(_log_density(x, width))
    return float(np.sum(_score(x, width) ** 2 * density) * (x[1, 0] - x[0, 0]))


def _log_fisher_information(half: float | FloatArray) -> FloatArray:
    """Return the log of the information at many half widths, of any shape; wide flat tops inform by their edges."""
    log_half = np.log(half)
    beyond = np.maximum(log_half - _LOG_HALVES[-1], 0.0)
    return np.asarray(np.interp(log_half, _LOG_HALVES, _tabulated_log_information()) - beyond)


@cache
def _tabulated_log_information() -> FloatArray:
    return np.log([_fisher_information(half) for half in np.exp(_LOG_HALVES).tolist()])
