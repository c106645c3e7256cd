"""Coordinates of a mixture without an order of the Gaussians: a change of their labels leaves volumes unchanged.

Each Gaussian has the log of its light, its centre, the log variances along x' and y' and the inverse hyperbolic tangent
of its correlation; then the levels. Readings depend on ratios of light alone, so the sum of the logs is left out and
drawn from its prior: of the logs, N - 1 orthonormal contrasts are kept, and 6 N + 1 coordinates in all.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.calibration.priors import SSFPrior

_MOST_LOG = 60.0


@dataclass(frozen=True)
class LabelSymmetricCoordinates:
    """Coordinates of N Gaussians in which a permutation of the labels leaves volumes unchanged.

    `prior`: of N Gaussians with light uniform from 0 to a unit; see `has_uniform_prior_of_light`.
    """

    prior: SSFPrior

    @cached_property
    def _contrast_matrix(self) -> FloatArray:
        """Orthonormal contrasts of N logs, (N - 1, N)."""
        n = self.prior.n_gaussians
        rows = [np.r_[np.ones(k), -float(k), np.zeros(n - k - 1)] / math.sqrt(k * (k + 1)) for k in range(1, n)]
        return np.array(rows).reshape(n - 1, n)

    @cached_property
    def label_permutations(self) -> tuple[tuple[IntArray, FloatArray], ...]:
        """The N! permutations of labels, for `apply_label_permutation`.

        Each has the order of the columns of shapes and levels, (5 N + 2,), and the matrix that turns the contrasts,
        (N - 1, N - 1).
        """
        n, c = self.prior.n_gaussians, self._contrast_matrix
        found = []
        for order in itertools.permutations(range(n)):
            columns = np.concatenate([*(np.arange(5 * k, 5 * k + 5) for k in order), [5 * n, 5 * n + 1]])
            found.append((columns, c[:, np.argsort(order)] @ c.T))
        return tuple(found)

    def apply_label_permutation(self, y: FloatArray, change: tuple[IntArray, FloatArray]) -> FloatArray:
        """Relabel the Gaussians in coordinates, (n, 6 N + 1) -> (n, 6 N + 1), by one of `label_permutations`."""
        columns, matrix = change
        k = self.prior.n_gaussians - 1
        return np.concatenate([y[:, :k] @ matrix.T, y[:, k:][:, columns]], axis=1)

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters, (n, 6 N + 2), to coordinates, (n, 6 N + 1)."""
        n = self.prior.n_gaussians
        g = theta[:, :-2].reshape(len(theta), n, 6)
        det = g[..., 3] * g[..., 4] - g[..., 5] ** 2
        log_light = np.log(g[..., 0]) - 0.5 * np.log(det)
        shape = np.empty((len(theta), n, 5))
        shape[..., :2] = g[..., 1:3]
        shape[..., 2] = np.log(0.5 * g[..., 4] / det)
        shape[..., 3] = np.log(0.5 * g[..., 3] / det)
        shape[..., 4] = np.arctanh(-g[..., 5] / np.sqrt(g[..., 3] * g[..., 4]))
        return np.concatenate(
            [log_light @ self._contrast_matrix.T, shape.reshape(len(theta), 5 * n), theta[:, -2:]], axis=1
        )

    def leave(self, y: FloatArray, sum_of_logs: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters; also return the prior's log density in them, of each labelling by itself.

        `y`: coordinates, (n, 6 N + 1). `sum_of_logs`: uniform numbers, (n,), by which the light of all is drawn; by
        default the heaviest holds one unit. Return parameters, (n, 6 N + 2), and log density, (n,); -inf outside the
        prior's support.
        """
        n = self.prior.n_gaussians
        log_light = (y[:, : n - 1] @ self._contrast_matrix).clip(-_MOST_LOG, _MOST_LOG)
        most = log_light.max(axis=1)
        shape = y[:, n - 1 : -2].reshape(len(y), n, 5)
        log_variance = shape[..., 2:4].clip(-_MOST_LOG, _MOST_LOG)
        r = np.tanh(shape[..., 4])
        rest = np.maximum(1.0 - r * r, 1e-12)
        g = np.empty((len(y), n, 6))
        g[..., 1:3] = shape[..., :2]
        g[..., 3:5] = 0.5 * np.exp(-log_variance) / rest[..., None]
        g[..., 5] = -r * np.sqrt(g[..., 3] * g[..., 4])
        scale = self.prior.amplitude_at_unit_mass(g[..., 3] * g[..., 4] * rest)
        g[..., 0] = scale * np.exp(log_light - most[:, None]) * (1.0 - 1e-12)
        theta = np.concatenate([g.reshape(len(y), 6 * n), y[:, -2:]], axis=1)
        jacobian = np.log(g[..., 0]) - 1.5 * log_variance.sum(axis=-1) - 2.0 * np.log(rest) - 3.0 * math.log(2.0)
        log_density = self.prior.log_prob(theta) + jacobian.sum(axis=1) - 0.5 * math.log(n)
        if sum_of_logs is not None:
            theta[:, : 6 * n : 6] *= sum_of_logs[:, None] ** (1.0 / n)
        return theta, np.where(np.isfinite(log_density), log_density, -np.inf)
