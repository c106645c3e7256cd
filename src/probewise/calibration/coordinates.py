"""Coordinates in which a scan speaks plainly of the SSF: moments instead of A, B and C."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from probewise._arrays import FloatArray

if TYPE_CHECKING:
    from probewise.calibration.priors import SSFPrior

__all__ = ["MomentCoordinates"]


@dataclass(frozen=True)
class MomentCoordinates:
    """Describe a mixture by its moments, which readings fix one by one (`probewise.priors.Coordinates`).

    A scan across an edge fixes the variance along its direction, so one combination of A, B and C
    that is bent through all three. Here the coordinates of each Gaussian are its centre, log
    variances along x' and y', and the area tangent of its correlation; then the log ratio of its mass to
    the first one's, for the first the log of its amplitude in the prior's unit. In the place of the first
    centre stands that of the whole footprint, which readings fix.

    With `of_the_whole` the whole's variances and correlation stand in the first Gaussian's place too: of
    the others readings then know little, and their mass, place and width change freely. That is how
    a posterior is wide; the prior is wide in Gaussians of their own.

    The Gaussians are sorted by mass, greatest first, and the prior's density there is N! times as
    great: readings know no labels, so N! equal modes become one and the evidence is the same.
    """

    prior: SSFPrior
    of_the_whole: bool = False

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, (n_samples, 6 N + 2) both ways."""
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
        out[:, 0, 0] = np.log(g[:, 0, 0] / self.prior.amplitude_scale(det[:, 0]))
        out[:, 1:, 0] = log_mass[:, 1:] - log_mass[:, :1]
        share, centre, moments = _shares(out), g[..., 1:3], 0.5 * g[..., [4, 3, 5]] / det[..., None] * _SIGNS
        whole = np.einsum("nk,nkj->nj", share, centre)
        out[..., 1:3] = centre
        out[:, 0, 1:3] = whole
        if self.of_the_whole:
            spread = moments + _squares(centre - whole[:, None])
            moments[:, 0] = np.einsum("nk,nkj->nj", share, spread)
        out[..., 3:5] = np.log(moments[..., :2])
        out[..., 5] = np.arctanh(moments[..., 2] / np.sqrt(moments[..., 0] * moments[..., 1]))
        return np.concatenate([out.reshape(len(theta), 6 * n), theta[:, 6 * n :]], axis=1)

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n_samples, 6 N + 2); also the prior's log density over them, (n_samples,)."""
        n = self.prior.n_gaussians
        g = x[:, : 6 * n].reshape(len(x), n, 6)
        # A sampler asks far outside too; nothing there may overflow.
        log_ratio, log_var = np.clip(g[..., 0], -100.0, 50.0), np.clip(g[..., 3:5], -100.0, 100.0)
        share, r = _shares(g), np.tanh(g[..., 5])
        centre, moments = g[..., 1:3].copy(), np.empty((len(x), n, 3))
        moments[..., :2] = np.exp(log_var)
        moments[..., 2] = r * np.exp(0.5 * log_var.sum(axis=2))
        rest = np.maximum(1.0 - r * r, _LEAST)
        # d(variances, covariance) / d(log variances, area tangent) is their product to the power 3/2, times 1 - r^2.
        log_jacobian = 1.5 * log_var[:, 0].sum(axis=1) + np.log(rest[:, 0])
        if n > 1:
            whole = centre[:, 0].copy()
            centre[:, 0] = (whole - np.einsum("nk,nkj->nj", share[:, 1:], centre[:, 1:])) / share[:, :1]
        if n > 1 and self.of_the_whole:
            apart = _squares(centre - whole[:, None])
            others = np.einsum("nk,nkj->nj", share[:, 1:], moments[:, 1:] + apart[:, 1:])
            moments[:, 0] = (moments[:, 0] - others) / share[:, :1] - apart[:, 0]
            rest[:, 0] = 1.0 - moments[:, 0, 2] ** 2 / np.maximum(moments[:, 0, 0] * moments[:, 0, 1], _LEAST)
        proper = (moments[:, 0, :2] > _LEAST).all(axis=1) & (rest[:, 0] > 0.0)
        moments[~proper, 0], rest[~proper, 0] = (1.0, 1.0, 0.0), 1.0
        rest = np.maximum(rest, _LEAST)
        out = np.empty_like(g)
        out[..., 1:3] = centre
        out[..., 3:6] = 0.5 * moments[..., [1, 0, 2]] * _SIGNS / (moments[..., 0] * moments[..., 1] * rest)[..., None]
        det = 0.25 / (moments[..., 0] * moments[..., 1] * rest)
        out[:, 0, 0] = self.prior.amplitude_scale(det[:, 0]) * np.exp(log_ratio[:, 0])
        log_mass = np.log(out[:, :1, 0]) - 0.5 * np.log(det[:, :1])
        out[:, 1:, 0] = np.exp(np.minimum(log_ratio[:, 1:], 0.0) + log_mass + 0.5 * np.log(det[:, 1:]))
        theta = np.concatenate([out.reshape(len(x), 6 * n), x[:, 6 * n :]], axis=1)
        # d(A, B, C) / d(variances, covariance) is (4 (A B - C^2))^3 / 8; the first Gaussian's own moments from the
        # whole's are shares: two for the centre, three for the variances; and d a / d log a.
        log_jacobian += (3.0 * np.log(det) + 3.0 * np.log(2.0) + np.log(out[..., 0])).sum(axis=1)
        log_jacobian -= (5.0 if self.of_the_whole else 2.0) * np.log(share[:, 0])
        log_jacobian += (1.5 * log_var[:, 1:].sum(axis=2) + np.log(rest[:, 1:])).sum(axis=1)
        log_density = self.prior.log_prob(theta) + log_jacobian + math.lgamma(n + 1)
        falling = np.diff(np.concatenate([np.zeros((len(x), 1)), g[:, 1:, 0]], axis=1), axis=1) <= 0.0
        usable = proper & falling.all(axis=1) & (np.abs(g[..., 3:5]) < 100.0).all(axis=(1, 2))
        usable &= np.isfinite(theta).all(axis=1)
        return theta, np.where(usable, log_density, -np.inf)


_LEAST = 1e-12
_SIGNS = np.array([1.0, 1.0, -1.0])  # C has the other sign than the covariance


def _squares(apart: FloatArray) -> FloatArray:
    """Squares and product of two coordinates, (..., 2) -> (..., 3)."""
    return np.concatenate([apart**2, apart[..., :1] * apart[..., 1:]], axis=-1)


def _shares(g: FloatArray) -> FloatArray:
    """Share of the light that each Gaussian holds, from coordinates (n_samples, N, 6) -> (n_samples, N)."""
    ratio = np.concatenate([np.ones((len(g), 1)), np.exp(np.clip(g[:, 1:, 0], -100.0, 0.0))], axis=1)
    return np.asarray(ratio / ratio.sum(axis=1, keepdims=True))
