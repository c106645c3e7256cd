"""Sampling coordinates of the whole footprint: what readings determine, however many Gaussians make it up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.calibration.priors import SSFPrior, view_by_kind_and_gaussian

_TAPER = 3.0
_LEAST = 1e-12
_UNIT = np.array([[1.0], [1.0], [0.0]])


@dataclass(frozen=True)
class WholeFootprintCoordinates:
    """`MomentCoordinates`, with the whole's centre, log variances and correlation in place of the first Gaussian's.

    The readings do not depend on light far out. So a Gaussian that is k times as wide, or as far out, as the footprint
    (`size_mm2`) counts with 1 / (1 + (k / 3)^4) of its light.

    `centre_mm`: approximate centre of the footprint, (x', y'); `size_mm2`: approximate trace of its covariance.
    """

    prior: SSFPrior
    centre_mm: tuple[float, float]
    size_mm2: float

    @classmethod
    def about(cls, prior: SSFPrior, one: FloatArray) -> WholeFootprintCoordinates:
        """Take centre and size from the parameters of an SSF of one Gaussian, (8,)."""
        _, u, v, a, b, c = one[:6]
        return cls(prior, (float(u), float(v)), float(0.5 * (a + b) / (a * b - c * c)))

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, both (n, 6 N + 2)."""
        x = self.prior.coordinates.enter(theta)
        g = view_by_kind_and_gaussian(x)
        ratio = np.exp(g[0, 1:])
        g[1:3, 0] += (ratio * (g[1:3, :1] - g[1:3, 1:])).sum(axis=1)
        mean, first = self._centre_contribution_of_others_and_first_share(g)
        covariance = _covariance_from_logs(g[3:6, 0])
        whole_mean = mean + first * g[1:3, 0]
        off = g[1:3, 0] - whole_mean
        others = self._covariance_contribution_of_others(g, whole_mean)
        whole = first * (covariance + _squares_and_product(off)) + others
        g[1:3, 0] = whole_mean
        g[3:6, 0] = _logs_from_covariance(whole)
        return x

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n, 6 N + 2); also return the log prior density in the coordinates, (n,).

        It is -inf where the Gaussians are not sorted, or no parameters have these coordinates.
        """
        y = x.copy()
        g = view_by_kind_and_gaussian(y)
        # Sorted by mass; a clipped ratio must not pass for one that is.
        sorted_by_mass = (g[0, 1:2] <= 0.0).all(axis=0) & (g[0, 2:] <= g[0, 1:-1]).all(axis=0)
        g[0, 1:] = g[0, 1:].clip(-100.0, 0.0)
        g[3:5] = g[3:5].clip(-100.0, 100.0)
        ratio = np.exp(g[0, 1:])
        mean, first = self._centre_contribution_of_others_and_first_share(g)
        whole_mean, whole = g[1:3, 0].copy(), _covariance_from_logs(g[3:6, 0])
        # An extreme correlation is one in its last digit.
        real = _positive_definite_mask(whole)
        whole[:, ~real] = _UNIT
        g[1:3, 0] = (whole_mean - mean) / first
        off = g[1:3, 0] - whole_mean
        own = (whole - self._covariance_contribution_of_others(g, whole_mean)) / first - _squares_and_product(off)
        real &= _positive_definite_mask(own)
        own[:, ~real] = _UNIT
        g[3:6, 0] = _logs_from_covariance(own)
        heaviest = 1.0 / (1.0 + ratio.sum(axis=0))
        g[1:3, 0] = heaviest * (g[1:3, 0] + (ratio * g[1:3, 1:]).sum(axis=1))
        theta, log_density = self.prior.coordinates.leave(y)
        log_density += 2.0 * np.log(heaviest) - 5.0 * np.log(first) + _log_volume_ratio(whole) - _log_volume_ratio(own)
        real &= sorted_by_mass & np.isfinite(log_density)
        return theta, np.where(real, log_density, -np.inf)

    def _tapered_light_shares(self, g: FloatArray) -> FloatArray:
        """Share of the light of each Gaussian but the first, reduced for wide or distant Gaussians, (N - 1, n)."""
        x, y = self.centre_mm
        variance = np.exp(g[3:5, 1:].clip(-100.0, 100.0))
        reach = ((g[1, 1:] - x) ** 2 + (g[2, 1:] - y) ** 2 + variance[0] + variance[1]) / self.size_mm2
        light = np.exp(g[0, 1:]) / (1.0 + (reach / _TAPER**2) ** 2)
        return np.asarray(light / (1.0 + light.sum(axis=0)))

    def _centre_contribution_of_others_and_first_share(self, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sum over all but the first of centre times tapered share, (2, n); and the first's share, (n,)."""
        light = self._tapered_light_shares(g)
        return (light * g[1:3, 1:]).sum(axis=1), 1.0 - light.sum(axis=0)

    def _covariance_contribution_of_others(self, g: FloatArray, mean: FloatArray) -> FloatArray:
        """Return the contribution of all but the first to the covariance of the whole: xx, yy, xy, (3, n)."""
        own = _covariance_from_logs(g[3:6, 1:]) + _squares_and_product(g[1:3, 1:] - mean[:, None])
        return np.asarray((self._tapered_light_shares(g) * own).sum(axis=1))


def _covariance_from_logs(logs: FloatArray) -> FloatArray:
    """Compute variances and covariance from log variances and arctanh of the correlation, (3, ...) -> (3, ...)."""
    variance = np.exp(logs[:2])
    return np.stack([*variance, np.tanh(logs[2]) * np.sqrt(variance[0] * variance[1])])


def _positive_definite_mask(covariance: FloatArray) -> BoolArray:
    """Return a mask of variances and covariance that are positive definite, (3, ...) -> (...)."""
    xx, yy, xy = covariance
    return np.asarray((xx > 0.0) & (yy > 0.0) & (xy**2 < (1.0 - _LEAST) * xx * yy))


def _logs_from_covariance(covariance: FloatArray) -> FloatArray:
    """Compute log variances and arctanh of the correlation, the inverse of `_covariance_from_logs`."""
    xx, yy, xy = covariance
    return np.stack([np.log(xx), np.log(yy), np.arctanh(xy / np.sqrt(xx * yy))])


def _squares_and_product(off: FloatArray) -> FloatArray:
    """Compute x^2, y^2 and x y, (2, ...) -> (3, ...)."""
    return np.stack([off[0] ** 2, off[1] ** 2, off[0] * off[1]])


def _log_volume_ratio(covariance: FloatArray) -> FloatArray:
    """Log of the volume ratio of `_covariance_from_logs`, up to a constant, (3, ...) -> (...)."""
    xx, yy, xy = covariance
    product = xx * yy
    return np.asarray(0.5 * np.log(product) + np.log(product - xy**2))
