"""Proposal densities for importance sampling, fitted to posterior samples: Student-t kernels per cluster."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, logsumexp

from probewise._arrays import FloatArray
from probewise.nested.clusters import Clusters, find_clusters

# Heavier tails than a Gaussian's keep the weights bounded where the fit is too narrow.
DEGREES_OF_FREEDOM = 8.0
_MOST_KERNELS = 400
_FEW = 40
_SCALES = (1.0, 0.5, 0.2, 0.05, 0.01)
_BLOCK = 2048
_LINKS = 10


@dataclass(frozen=True, eq=False)
class Proposal:
    """A mixture of Student-t kernels, of one shape within each cluster.

    `centres` in each cluster's whitened frame, one array (n_kernels, n_params) per cluster; `width` of the kernels in
    that frame; `share` of the draws for each cluster, (n_clusters,).
    """

    clusters: Clusters
    centres: tuple[FloatArray, ...]
    width: tuple[float, ...]
    share: FloatArray

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, n_params)."""
        n_params = self.clusters.mean.shape[1]
        which = rng.choice(len(self.share), size=n, p=self.share)
        white = rng.standard_normal((n, n_params))
        white *= np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, size=(n, 1)))
        out = np.empty((n, n_params))
        for k, (centres, width) in enumerate(zip(self.centres, self.width, strict=True)):
            rows = np.flatnonzero(which == k)
            place = centres[rng.integers(len(centres), size=rows.size)] + width * white[rows]
            out[rows] = self.clusters.mean[k] + place @ self.clusters.root[k].T
        return out

    def widened(self, factor: float) -> Proposal:
        """Return the same mixture with kernels wider by a factor."""
        return replace(self, width=tuple(factor * width for width in self.width))

    def log_density(self, x: FloatArray) -> FloatArray:
        """Natural log of the density, (n, n_params) -> (n,)."""
        blocks = np.array_split(x, max(1, -(-len(x) // _BLOCK)))
        return np.concatenate([self._log_density_of_block(block) for block in blocks])

    def _log_density_of_block(self, x: FloatArray) -> FloatArray:
        n_params, nu = x.shape[1], DEGREES_OF_FREEDOM
        constant = gammaln((nu + n_params) / 2) - gammaln(nu / 2) - 0.5 * n_params * math.log(nu * math.pi)
        parts = []
        for k, (centres, width) in enumerate(zip(self.centres, self.width, strict=True)):
            white = (x - self.clusters.mean[k]) @ self.clusters.inverse_root[k].T
            square = (white**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2.0 * white @ centres.T
            kernel = -0.5 * (nu + n_params) * np.log1p(np.maximum(square, 0.0) / (nu * width**2))
            norm = constant - self.clusters.log_det[k] - n_params * math.log(width) - math.log(len(centres))
            parts.append(logsumexp(kernel, axis=1) + norm + math.log(self.share[k]))
        return np.asarray(logsumexp(parts, axis=0))


def mixture_of_proposals(proposals: Sequence[Proposal], share: Sequence[float]) -> Proposal:
    """Combine proposals into one mixture with the shares `share`, which need not be normalised."""
    total = math.fsum(share)
    return Proposal(
        _concatenated_clusters([p.clusters for p in proposals]),
        tuple(centres for p in proposals for centres in p.centres),
        tuple(width for p in proposals for width in p.width),
        np.concatenate([s / total * p.share for p, s in zip(proposals, share, strict=True)]),
    )


def single_student_t(mean: FloatArray, covariance: FloatArray) -> Proposal:
    """Return one Student t distribution of this mean, (n_params,), and scale matrix, (n_params, n_params)."""
    # A small ridge where there is no extent.
    variance = np.diag(covariance)
    ridge = 1e-10 * variance + 1e-13 * variance.mean() + 1e-24
    root = np.linalg.cholesky(covariance + ridge * np.eye(len(mean)))
    log_det = np.log(np.diag(root)).sum()
    shape = Clusters(mean[None], root[None], np.linalg.inv(root)[None], np.array([log_det]), np.ones(1, dtype=np.int64))
    return Proposal(shape, (np.zeros((1, len(mean))),), (1.0,), np.ones(1))


def find_disconnected_clusters(x: FloatArray) -> Clusters:
    """Split samples, (n_samples, n_params), into disconnected pieces, each piece into clusters; return all clusters.

    Pieces are the connected components of the nearest-neighbour graph, so they are found at any scale and in any number
    (also a lattice of modes, which pairs of Gaussians do not split). Pieces too small for a covariance join the
    nearest.
    """
    # Imported here: they take a quarter of a second, and most runs of the program do not need them.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    n_samples, n_params = x.shape
    if n_samples <= _LINKS:
        return Clusters.from_groups([x])
    white = (x - x.mean(axis=0)) @ Clusters.from_groups([x]).inverse_root[0].T
    near = np.asarray(cKDTree(white).query(white, k=_LINKS + 1)[1])[:, 1:].ravel()
    links = coo_array((np.ones(near.size), (np.repeat(np.arange(n_samples), _LINKS), near)), 2 * (n_samples,))
    n_pieces, piece = connected_components(links, directed=False)
    large = [k for k in range(n_pieces) if (piece == k).sum() > 2 * n_params + 1]
    if len(large) < 2:
        return find_clusters(x)
    home = Clusters.from_groups([x[piece == k] for k in large]).assign(x)
    return _concatenated_clusters([find_clusters(x[home == k]) for k in range(len(large))])


def _concatenated_clusters(parts: Sequence[Clusters]) -> Clusters:
    return Clusters(
        np.concatenate([c.mean for c in parts]),
        np.concatenate([c.root for c in parts]),
        np.concatenate([c.inverse_root for c in parts]),
        np.concatenate([c.log_det for c in parts]),
        np.concatenate([c.size for c in parts]),
    )


def fit_wide_and_narrow_proposals(x: FloatArray, *, rng: np.random.Generator) -> tuple[Proposal, ...]:
    """Fit two proposals to samples, (n_samples, n_params): the best wide form, then the best narrow form.

    Wide: one kernel per cluster, as wide as the cluster. Narrow: kernels at the samples, of Silverman's width or less.
    Either with or without clusters. Of each form the variant with the greatest held-out likelihood (fit to one half,
    score on the other) is fitted to all samples. The caller decides between the two by weighted draws: the likelihood
    favours a close fit, the weights a wide one. Fewer than 80 samples give one wide kernel only.
    """
    x = x[rng.permutation(len(x))]
    half = len(x) // 2
    if half < _FEW:
        return (_fit_kernels(x, False, None),)

    def held_out_score(form: tuple[bool, float | None]) -> float:
        return float(_fit_kernels(x[:half], *form).log_density(x[half:]).mean())

    wide: list[tuple[bool, float | None]] = [(False, None), (True, None)]
    narrow: list[tuple[bool, float | None]] = [(split, scale) for split in (False, True) for scale in _SCALES]
    return tuple(_fit_kernels(x, *max(forms, key=held_out_score)) for forms in (wide, narrow))


def _fit_kernels(x: FloatArray, split: bool, scale: float | None) -> Proposal:
    """Fit one form of proposal: by cluster if `split`; one kernel per cluster if `scale` is None, else at samples.

    `scale`: width of the kernels in units of Silverman's.
    """
    clusters = find_disconnected_clusters(x) if split else Clusters.from_groups([x])
    home = clusters.assign(x)
    n_params = x.shape[1]
    centres, width = [], []
    for k in range(len(clusters)):
        own = x[home == k]
        if scale is None or len(own) < 2:
            centres.append(np.zeros((1, n_params)))
            width.append(1.0)
        else:
            kept = own[:_MOST_KERNELS]
            centres.append((kept - clusters.mean[k]) @ clusters.inverse_root[k].T)
            width.append(scale * (4 / (n_params + 2) / len(kept)) ** (1 / (n_params + 4)))
    size = np.maximum(np.bincount(home, minlength=len(clusters)), 1)
    return Proposal(clusters, tuple(centres), tuple(width), size / size.sum())
