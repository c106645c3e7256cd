"""Proposals from a mixture of Gaussians about posterior samples, with local covariances.

The posterior after a few readings is a thin curved shell (all circles whose edge passes under one grey reading), for
which a global covariance is useless. The neighbours of a sample give the local direction of the shell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from probewise._arrays import FloatArray, IntArray

MOST_KERNELS = 250
_NEIGHBOURS = 10  # neighbours per parameter, enough for a covariance
_RIDGE = 1e-6  # of the overall covariance, to avoid singular ones
_RESOLUTION = 1e-9  # of a coordinate's mean, below which a spread is rounding error
_SMALLEST = 1e-100  # spread of a coordinate that is zero in all points, whose square is still a number
_BLOCK = 256  # points per batch, to fit the cache
_FEW = 600  # points up to which all distances are faster than a tree


@dataclass(frozen=True, eq=False)
class LocalKernels:
    """A mixture of equally weighted Gaussians.

    `centre` (n_kernels, n_params) are the means relative to `origin`, `root` (n_kernels, n_params, n_params) the
    Cholesky factors of the covariances. A point's features (1, its coordinates relative to `origin`, the products of
    two coordinates) times `form` (n_features, n_kernels) are the log densities of the kernels there.
    """

    origin: FloatArray
    centre: FloatArray
    root: FloatArray
    form: FloatArray

    @classmethod
    def fitted_to(
        cls, points: FloatArray, *, rng: np.random.Generator, widened: float = 1.0, most: int = MOST_KERNELS
    ) -> Self:
        """Fit at most `most` kernels to equally weighted samples, (n_samples, n_params), `widened` times as wide."""
        n_samples, n_params = points.shape
        origin = points.mean(axis=0)
        away = points - origin
        scale = np.maximum(points.std(axis=0), np.maximum(_RESOLUTION * np.abs(origin), _SMALLEST))
        rows = rng.permutation(n_samples)[: min(most, (n_samples + 1) // 2)]
        n_near = min(max(_NEIGHBOURS * n_params, 2 * n_samples // len(rows)), n_samples)
        near = _nearest_rows(away / scale, rows, n_near)
        centre = away[rows]
        spread = away[near] - away[near].mean(axis=1, keepdims=True)
        overall = np.atleast_2d(np.cov(points, rowvar=False))
        covariance = np.einsum("kni,knj->kij", spread, spread) / n_near
        covariance += _RIDGE * (overall + np.diag(scale**2))
        covariance *= widened**2
        return cls.from_moments(centre, covariance, origin=origin)

    @classmethod
    def from_moments(cls, centre: FloatArray, covariance: FloatArray, *, origin: FloatArray | None = None) -> Self:
        """Build from centres, (n_kernels, n_params), and covariances, (n_kernels, n_params, n_params).

        The centres are relative to `origin`; without it, absolute.
        """
        if origin is None:
            origin = np.asarray(centre.mean(axis=0))
            centre = centre - origin
        n_params = centre.shape[1]
        root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
        precision = np.linalg.inv(covariance)
        log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        pull = np.einsum("kij,kj->ki", precision, centre)
        constant = -0.5 * (np.einsum("ki,ki->k", pull, centre) + log_det + n_params * math.log(2 * math.pi))
        upper = _upper_triangle_indices(n_params)
        product = -np.where(upper[0] == upper[1], 0.5, 1.0) * precision[:, upper[0], upper[1]]
        form = np.concatenate([constant[:, None], pull, product], axis=1).T
        return cls(origin, centre, root, form)

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, n_params)."""
        which = rng.integers(len(self.centre), size=n)
        white = rng.standard_normal((n, self.centre.shape[1]))
        return np.asarray(self.origin + self.centre[which] + np.einsum("nij,nj->ni", self.root[which], white))

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the natural log of the mixture's density at points, (n, n_params) -> (n,)."""
        upper = _upper_triangle_indices(points.shape[1])
        out = np.empty(len(points))
        for start in range(0, len(points), _BLOCK):
            away = points[start : start + _BLOCK] - self.origin
            features = np.concatenate([np.ones((len(away), 1)), away, away[:, upper[0]] * away[:, upper[1]]], axis=1)
            each = features @ self.form
            most = each.max(axis=1)
            # Only the nearest kernels matter, and single precision suffices for a proposal density.
            each -= most[:, None]
            out[start : start + _BLOCK] = most + np.log(np.exp(each.astype(np.float32)).sum(axis=1))
        return out - math.log(len(self.centre))


def _nearest_rows(points: FloatArray, rows: IntArray, n: int) -> IntArray:
    """Return the indices, (n_rows, n), of the `n` points nearest to each point of `rows`, itself included; no order."""
    if len(points) > _FEW:
        return np.asarray(cKDTree(points).query(points[rows], k=n)[1].reshape(len(rows), n))
    square = (points**2).sum(axis=1)
    away = square - 2.0 * points[rows] @ points.T  # less the row's own square, the same for all
    return np.asarray(np.argpartition(away, n - 1, axis=1)[:, :n])


@cache
def _upper_triangle_indices(n_params: int) -> tuple[IntArray, IntArray]:
    """Return row and column indices of the upper triangle of a matrix, diagonal included."""
    return np.triu_indices(n_params)
