"""Coordinates of a mixture with mean and covariance of the whole in place of those of its heaviest Gaussian.

Readings tell the moments of the whole, and little of how the Gaussians share them. Where a lighter Gaussian grows or
moves, these coordinates let the heaviest give way, so that the whole stays: a sampler's step from one Gaussian that
holds all of the light to two that share it needs no luck.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.calibration.coordinates import MomentCoordinates, kinds_of
from probewise.calibration.gaussian_responses import light_of
from probewise.calibration.priors import SSFPrior

# A Gaussian is faint where it holds at most this share of the light of the heaviest; the others are bright.
FAINT = 0.1
_TAPER = 3.0
_LEAST = 1e-12
_UNIT = np.array([[1.0], [1.0], [0.0]])


@dataclass(frozen=True)
class WholeCoordinates:
    """`MomentCoordinates` but for the first Gaussian's centre, log variances and correlation: those of the whole.

    The readings see nothing of light far out, so a Gaussian that is k times as wide, or as far out, as the sensor
    counts as 1 / (1 + (k / 3)^4) of its light.

    Parameters
    ----------
    prior
        Of N Gaussians.
    centre_mm
        About where the sensor is, (x', y').
    size_mm2
        About the trace of its covariance.
    n_bright
        Number of bright Gaussians to which the prior is restricted; see `count_bright`. None: any.
    """

    prior: SSFPrior
    centre_mm: tuple[float, float]
    size_mm2: float
    n_bright: int | None = None

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, both (n, 6 N + 2)."""
        x = self._moments.enter(theta)
        g = kinds_of(x)
        ratio = np.exp(g[0, 1:])
        g[1:3, 0] += (ratio * (g[1:3, :1] - g[1:3, 1:])).sum(axis=1)
        mean, first = self._others(g)
        covariance = _covariance(g[3:6, 0])
        whole_mean = mean + first * g[1:3, 0]
        off = g[1:3, 0] - whole_mean
        whole = first * (covariance + _products(off)) + self._spread(g, whole_mean)
        g[1:3, 0] = whole_mean
        g[3:6, 0] = _logs(whole)
        return x

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n, 6 N + 2); also return the prior's log density, (n,)."""
        y = x.copy()
        g = kinds_of(y)
        # Sorted by mass; a clipped ratio must not pass for one that is.
        sorted_by_mass = (g[0, 1:2] <= 0.0).all(axis=0) & (g[0, 2:] <= g[0, 1:-1]).all(axis=0)
        g[0, 1:] = g[0, 1:].clip(-100.0, 0.0)
        g[3:5] = g[3:5].clip(-100.0, 100.0)
        ratio = np.exp(g[0, 1:])
        mean, first = self._others(g)
        whole_mean, whole = g[1:3, 0].copy(), _covariance(g[3:6, 0])
        # An extreme correlation is one in its last digit.
        real = _is_covariance(whole)
        whole[:, ~real] = _UNIT
        g[1:3, 0] = (whole_mean - mean) / first
        off = g[1:3, 0] - whole_mean
        own = (whole - self._spread(g, whole_mean)) / first - _products(off)
        real &= _is_covariance(own)
        own[:, ~real] = _UNIT
        g[3:6, 0] = _logs(own)
        heaviest = 1.0 / (1.0 + ratio.sum(axis=0))
        g[1:3, 0] = heaviest * (g[1:3, 0] + (ratio * g[1:3, 1:]).sum(axis=1))
        theta, log_density = self._moments.leave(y)
        log_density += 2.0 * np.log(heaviest) - 5.0 * np.log(first) + _log_volume(whole) - _log_volume(own)
        real &= sorted_by_mass & np.isfinite(log_density)
        if self.n_bright is not None:
            real &= 1 + (ratio > FAINT).sum(axis=0) == self.n_bright
        return theta, np.where(real, log_density, -np.inf)

    @property
    def _moments(self) -> MomentCoordinates:
        return MomentCoordinates(self.prior)

    def _light(self, g: FloatArray) -> FloatArray:
        """Tapered share of the light of each Gaussian but the first, (N - 1, n)."""
        x, y = self.centre_mm
        variance = np.exp(g[3:5, 1:].clip(-100.0, 100.0))
        reach = ((g[1, 1:] - x) ** 2 + (g[2, 1:] - y) ** 2 + variance[0] + variance[1]) / self.size_mm2
        light = np.exp(g[0, 1:]) / (1.0 + (reach / _TAPER**2) ** 2)
        return np.asarray(light / (1.0 + light.sum(axis=0)))

    def _others(self, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sum the others' centres by their tapered shares, (2, n); and the share of the first, (n,)."""
        light = self._light(g)
        return (light * g[1:3, 1:]).sum(axis=1), 1.0 - light.sum(axis=0)

    def _spread(self, g: FloatArray, mean: FloatArray) -> FloatArray:
        """Sum what all but the first add to the covariance of the whole, (3, n)."""
        off = g[1:3, 1:] - mean[:, None]
        return np.asarray((self._light(g) * (_covariance(g[3:6, 1:]) + _products(off))).sum(axis=1))


def count_bright(theta: FloatArray) -> IntArray:
    """Count the Gaussians that hold more than `FAINT` of the heaviest one's light, (n, 6 N + 2) -> (n,)."""
    light = light_of(theta)
    return np.asarray((light > FAINT * light.max(axis=1, keepdims=True)).sum(axis=1))


def _covariance(logs: FloatArray) -> FloatArray:
    """Variances and covariance of log variances and inverse hyperbolic tangent of the correlation, (3, ...)."""
    variance = np.exp(logs[:2])
    return np.stack([*variance, np.tanh(logs[2]) * np.sqrt(variance[0] * variance[1])])


def _is_covariance(covariance: FloatArray) -> BoolArray:
    xx, yy, xy = covariance
    return np.asarray((xx > 0.0) & (yy > 0.0) & (xy**2 < (1.0 - _LEAST) * xx * yy))


def _logs(covariance: FloatArray) -> FloatArray:
    """Undo `_covariance`."""
    xx, yy, xy = covariance
    return np.stack([np.log(xx), np.log(yy), np.arctanh(xy / np.sqrt(xx * yy))])


def _products(off: FloatArray) -> FloatArray:
    return np.stack([off[0] ** 2, off[1] ** 2, off[0] * off[1]])


def _log_volume(covariance: FloatArray) -> FloatArray:
    """Log of the volume that `_covariance` stretches, up to a constant."""
    xx, yy, xy = covariance
    product = xx * yy
    return np.asarray(0.5 * np.log(product) + np.log(product - xy**2))
