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
    variances along x' and y', and the area tangent of its correlation; for the first its amplitude
    in the prior's unit (log) and, in place of its own centre, that of the whole footprint; for the
    others the log ratio of their mass to the first one's. Then I_min and I_max.

    The Gaussians are sorted by mass, greatest first, and the prior's density there is N! times as
    great: readings know no labels, so N! equal modes become one and the evidence is the same.
    """

    prior: SSFPrior

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
        out[..., 1:3] = g[..., 1:3]
        out[..., 3] = np.log(0.5 * g[..., 4] / det)
        out[..., 4] = np.log(0.5 * g[..., 3] / det)
        out[..., 5] = np.arctanh(-g[..., 5] / np.sqrt(g[..., 3] * g[..., 4]))
        out[:, 0, 1:3] = np.einsum("nk,nkj->nj", _shares(out), g[..., 1:3])
        return np.concatenate([out.reshape(len(theta), 6 * n), theta[:, 6 * n :]], axis=1)

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n_samples, 6 N + 2); also the prior's log density over them, (n_samples,)."""
        n = self.prior.n_gaussians
        g = x[:, : 6 * n].reshape(len(x), n, 6)
        # A sampler asks far outside too; nothing there may overflow.
        log_mass, log_x, log_y = (np.clip(g[..., k], -100.0, 100.0) for k in (0, 3, 4))
        r = np.tanh(g[..., 5])
        rest = np.maximum(1.0 - r * r, 1e-12)
        out = np.empty_like(g)
        a, b = 0.5 * np.exp(-log_x) / rest, 0.5 * np.exp(-log_y) / rest
        out[..., 3], out[..., 4], out[..., 5] = a, b, -r * np.sqrt(a * b)
        det = a * b * rest
        scale = self.prior.amplitude_scale(det[:, 0])
        out[:, 0, 0] = scale * np.exp(np.minimum(log_mass[:, 0], 50.0))
        first = np.log(out[:, 0, 0]) - 0.5 * np.log(det[:, 0])
        out[:, 1:, 0] = np.exp(np.minimum(log_mass[:, 1:], 0.0) + first[:, None] + 0.5 * np.log(det[:, 1:]))
        share = _shares(g)
        out[..., 1:3] = g[..., 1:3]
        others = np.einsum("nk,nkj->nj", share[:, 1:], g[:, 1:, 1:3])
        out[:, 0, 1:3] = (g[:, 0, 1:3] - others) / share[:, :1]
        theta = np.concatenate([out.reshape(len(x), 6 * n), x[:, 6 * n :]], axis=1)
        # d(A, B, C) / d(log variances, area tangent), d a / d log a, and the first centre from the whole's.
        jacobian = np.log(out[..., 0]) - 3.0 * np.log(2.0) - 1.5 * (log_x + log_y) - 2.0 * np.log(rest)
        log_density = self.prior.log_prob(theta) + jacobian.sum(axis=1) - 2.0 * np.log(share[:, 0]) + math.lgamma(n + 1)
        falling = np.diff(np.concatenate([np.zeros((len(x), 1)), g[:, 1:, 0]], axis=1), axis=1) <= 0.0
        usable = falling.all(axis=1) & (np.abs(g[..., 3:5]) < 100.0).all(axis=(1, 2)) & np.isfinite(theta).all(axis=1)
        return theta, np.where(usable, log_density, -np.inf)


def _shares(g: FloatArray) -> FloatArray:
    """Share of the light that each Gaussian holds, from coordinates (n_samples, N, 6) -> (n_samples, N)."""
    ratio = np.concatenate([np.ones((len(g), 1)), np.exp(np.clip(g[:, 1:, 0], -100.0, 0.0))], axis=1)
    return np.asarray(ratio / ratio.sum(axis=1, keepdims=True))
