"""Sampling coordinates for calibration: moments of the SSF instead of A, B and C (entries of precision matrices)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.priors import Prior

_TAPER = 3.0
_LEAST = 1e-12
_UNIT = np.array([[1.0], [1.0], [0.0]])


class MixturePrior(Prior, Protocol):
    """A prior of a mixture's parameters with all that `MomentCoordinates` needs beside the density."""

    @property
    def n_gaussians(self) -> int:
        """Number of Gaussians, N."""
        ...

    def amplitude_at_unit_mass(self, determinant: FloatArray) -> FloatArray:
        """Return the amplitude at the prior's unit of mass, for a Gaussian's `determinant` A B - C^2, of any shape."""
        ...

    def log_prob_by_kind(self, g: FloatArray, i_min: FloatArray, i_max: FloatArray) -> FloatArray:
        """Return the log density, (n_samples,), of parameters `g` by kind (a, u, v, A, B, C), (6, N, n_samples).

        `i_min`, `i_max`: levels, (n_samples,) each.
        """
        ...


@dataclass(frozen=True)
class MomentCoordinates:
    """Moments of a mixture as sampling coordinates, each determined by few readings (`probewise.priors.Coordinates`).

    A scan across an edge determines the variance along its direction, which is a nonlinear combination of A, B and C.
    Here the coordinates of each Gaussian are its centre, the log variances along x' and y', and the inverse hyperbolic
    tangent of its correlation. The first Gaussian also has its log amplitude in the prior's unit and, instead of its
    own centre, that of the whole footprint; the others have the log ratio of their mass to the first one's. I_min and
    I_max follow.

    The Gaussians are sorted by mass, greatest first, and the prior's density is multiplied by N!: the readings do not
    depend on the labels, so N! equal modes become one and the evidence is unchanged.
    """

    prior: MixturePrior

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, both (n_samples, 6 N + 2)."""
        n = self.prior.n_gaussians
        g = theta[:, : 6 * n].reshape(len(theta), n, 6)
        det = g[..., 3] * g[..., 4] - g[..., 5] ** 2
        log_mass = np.log(g[..., 0]) - 0.5 * np.log(det)
        order = np.argsort(-log_mass, axis=1)
        g, det, log_mass = (
            np.take_along_axis(g, order[..., None], axis=1),
            np.take_along_axis(det, order, axis=1),
            np.take_along_axis(log_mass, order, axis=1),
        )
        out = np.empty_like(g)
        out[:, 0, 0] = np.log(g[:, 0, 0] / self.prior.amplitude_at_unit_mass(det[:, 0]))
        out[:, 1:, 0] = log_mass[:, 1:] - log_mass[:, :1]
        out[..., 1:3] = g[..., 1:3]
        out[..., 3] = np.log(0.5 * g[..., 4] / det)
        out[..., 4] = np.log(0.5 * g[..., 3] / det)
        out[..., 5] = np.arctanh(-g[..., 5] / np.sqrt(g[..., 3] * g[..., 4]))
        out[:, 0, 1:3] = np.einsum("nk,nkj->nj", _mass_shares(out), g[..., 1:3])
        return np.concatenate([out.reshape(len(theta), 6 * n), theta[:, 6 * n :]], axis=1)

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n_samples, 6 N + 2); also return the log prior density, (n_samples,).

        It is the density in the coordinates, -inf where the Gaussians are not sorted.
        """
        n = self.prior.n_gaussians
        # One contiguous row per kind of coordinate, for speed.
        g = np.ascontiguousarray(view_by_kind_and_gaussian(x))
        # A sampler may try extreme values, which must not overflow.
        log_variance = g[3:5].clip(-100.0, 100.0)
        log_first, log_ratio = g[0, 0].clip(-100.0, 50.0), g[0, 1:].clip(-100.0, 0.0)
        r = np.tanh(g[5])
        rest = np.maximum(1.0 - r * r, 1e-12)
        log_rest, both = np.log(rest), log_variance[0] + log_variance[1]
        out = np.empty_like(g)
        np.divide(0.5 * np.exp(-log_variance), rest, out=out[3:5])
        product = out[3] * out[4]
        np.multiply(-r, np.sqrt(product), out=out[5])
        log_a = np.log(self.prior.amplitude_at_unit_mass(product[0] * rest[0])) + log_first
        # The others' masses follow from the first one's: a = mass times the root of A B - C^2.
        half_log_det = -0.5 * (both + log_rest)
        log_a = np.concatenate([log_a[None], log_ratio + (log_a - half_log_det[0]) + half_log_det[1:]])
        np.exp(log_a, out=out[0])
        ratio = np.exp(log_ratio)
        whole = 1.0 + ratio.sum(axis=0)
        out[1:3] = g[1:3]
        out[1:3, 0] += (ratio * (g[1:3, :1] - g[1:3, 1:])).sum(axis=1)
        theta = x.copy()
        view_by_kind_and_gaussian(theta)[...] = out
        # d(A, B, C) / d(log variances, arctanh r), d a / d log a, and the first centre from that of the whole.
        jacobian = log_a - 1.5 * both - 2.0 * log_rest
        log_density = self.prior.log_prob_by_kind(out, theta[:, -2], theta[:, -1])
        log_density += jacobian.sum(axis=0)
        log_density += 2.0 * np.log(whole)
        log_density += math.lgamma(n + 1) - 3.0 * n * math.log(2.0)
        falling = (g[0, 1:2] <= 0.0).all(axis=0) & (g[0, 2:] <= g[0, 1:-1]).all(axis=0)
        usable = falling & (np.abs(g[3:5]) < 100.0).all(axis=(0, 1)) & np.isfinite(log_density)
        return theta, np.where(usable, log_density, -np.inf)


def view_by_kind_and_gaussian(columns: FloatArray) -> FloatArray:
    """View the Gaussians' columns, in (n_samples, 6 N + 2), as (6 kinds, N, n_samples), without a copy."""
    return columns[:, :-2].reshape(len(columns), columns.shape[1] // 6, 6).transpose(2, 1, 0)


def _mass_shares(g: FloatArray) -> FloatArray:
    """Each Gaussian's share of the mass, from coordinates (n_samples, N, 6) -> (n_samples, N)."""
    ratio = np.concatenate([np.ones((len(g), 1)), np.exp(np.clip(g[:, 1:, 0], -100.0, 0.0))], axis=1)
    return np.asarray(ratio / ratio.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class WholeFootprintCoordinates:
    """`MomentCoordinates`, with the whole's centre, log variances and correlation in place of the first Gaussian's.

    The readings do not depend on light far out. So a Gaussian that is k times as wide, or as far out, as the footprint
    (`size_mm2`) counts with 1 / (1 + (k / 3)^4) of its light.

    Parameters
    ----------
    prior
        Prior of N Gaussians.
    centre_mm
        Approximate centre of the footprint, (x', y').
    size_mm2
        Approximate trace of its covariance.
    """

    prior: MixturePrior
    centre_mm: tuple[float, float]
    size_mm2: float

    @classmethod
    def about(cls, prior: MixturePrior, one: FloatArray) -> WholeFootprintCoordinates:
        """Take centre and size from the parameters of an SSF of one Gaussian, (8,)."""
        _, u, v, a, b, c = one[:6]
        return cls(prior, (float(u), float(v)), float(0.5 * (a + b) / (a * b - c * c)))

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, both (n, 6 N + 2)."""
        x = self._moment_coordinates.enter(theta)
        g = view_by_kind_and_gaussian(x)
        ratio = np.exp(g[0, 1:])
        g[1:3, 0] += (ratio * (g[1:3, :1] - g[1:3, 1:])).sum(axis=1)
        mean, first = self._centre_contribution_of_others_and_first_share(g)
        covariance = _covariance_from_logs(g[3:6, 0])
        whole_mean = mean + first * g[1:3, 0]
        off = g[1:3, 0] - whole_mean
        whole = first * (covariance + _squares_and_product(off)) + self._covariance_contribution_of_others(
            g, whole_mean
        )
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
        theta, log_density = self._moment_coordinates.leave(y)
        log_density += 2.0 * np.log(heaviest) - 5.0 * np.log(first) + _log_volume_ratio(whole) - _log_volume_ratio(own)
        real &= sorted_by_mass & np.isfinite(log_density)
        return theta, np.where(real, log_density, -np.inf)

    @property
    def _moment_coordinates(self) -> MomentCoordinates:
        return MomentCoordinates(self.prior)

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
        off = g[1:3, 1:] - mean[:, None]
        return np.asarray(
            (self._tapered_light_shares(g) * (_covariance_from_logs(g[3:6, 1:]) + _squares_and_product(off))).sum(
                axis=1
            )
        )


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
