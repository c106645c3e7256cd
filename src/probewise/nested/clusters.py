"""Clusters of points, by mean and covariance: of live points, posterior samples, or modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.nested.problem import Rows

_MOST_CLUSTERS = 32
_N_REFINEMENTS = 4
_LINKS = 10  # of a sample to its nearest neighbours


@dataclass(frozen=True, eq=False)
class Clusters(Rows):
    """Clusters of points, by mean and covariance; `assign` divides all space between them.

    `mean` (n_clusters, n_params); `root`, the Cholesky factors of the covariances, and `inverse_root`, their inverses,
    (n_clusters, n_params, n_params); `log_det` of each factor and `size`, the number of points, (n_clusters,).
    """

    mean: FloatArray
    root: FloatArray
    inverse_root: FloatArray
    log_det: FloatArray
    size: IntArray

    def __len__(self) -> int:
        return len(self.mean)

    def assign(self, u: FloatArray) -> IntArray:
        """Return for each point the index of the cluster of greatest Gaussian density there, (n, n_params) -> (n,)."""
        if len(self) == 1:
            return np.zeros(len(u), dtype=np.int64)
        z = (u[None, :, :] - self.mean[:, None, :]) @ self.inverse_root.transpose(0, 2, 1)
        return np.asarray(np.argmin(0.5 * np.einsum("cni,cni->cn", z, z) + self.log_det[:, None], axis=0))

    @staticmethod
    def from_groups(groups: list[FloatArray]) -> Clusters:
        """Make one cluster of each group of points, (n, n_params), by the group's mean and covariance."""
        mean = np.stack([g.mean(axis=0) for g in groups])
        root = np.stack([_cholesky_of_covariance(g) for g in groups])
        inverse = np.asarray(np.linalg.inv(root), dtype=np.float64)
        return Clusters(mean, root, inverse, _log_dets(root), np.array([len(g) for g in groups]))

    def map_with_log_volume_ratio(self, u: FloatArray, home: IntArray, goal: IntArray) -> tuple[FloatArray, FloatArray]:
        """Map points of clusters `home` to clusters `goal` by the affine map between the Gaussians.

        Points are (n, n_params), cluster indices (n,). Return the points and log(goal volume / home volume), (n,).
        """
        z = np.matmul(self.inverse_root[home], (u - self.mean[home])[:, :, None])
        moved = self.mean[goal] + np.matmul(self.root[goal], z)[:, :, 0]
        return moved, self.log_det[goal] - self.log_det[home]

    def home_clusters_without_each_point(self, u: FloatArray, home: IntArray) -> Clusters:
        """Recompute for each point, (n, n_params), its cluster `home`, (n,), with the point itself left out.

        Return one cluster per point, in the points' order.
        """
        n = self.size[home][:, None]
        off = u - self.mean[home]
        root = self.root[home]
        # Removing a point is a rank-one downdate of the covariance. In the whitened frame its length is at
        # most 1; a small remainder is kept where the point alone spans a direction.
        z = np.einsum("nij,nj->ni", self.inverse_root[home], off)
        share = np.einsum("ni,ni->n", z, z) * (n / (n - 1.0) ** 2)[:, 0]
        z *= np.sqrt(np.minimum(1.0, (1.0 - 1e-6) / np.maximum(share, 1e-300)))[:, None]
        inner = np.eye(u.shape[1]) - z[:, :, None] * z[:, None, :] * (n / (n - 1.0) ** 2)[:, :, None]
        factor = root @ np.linalg.cholesky(inner) * np.sqrt((n - 1.0) / np.maximum(n - 2.0, 1.0))[:, :, None]
        mean = self.mean[home] - off / (n - 1.0)
        return Clusters(mean, factor, np.linalg.inv(factor), _log_dets(factor), self.size[home] - 1)


def find_clusters(points: FloatArray, *, least: int | None = None) -> Clusters:
    """Split points, (n, n_params), recursively while two Gaussians fit better than one; return at most 32 clusters.

    `least`: fewest points of a cluster; by default 2 n_params + 2, so that its covariance is well determined.

    The gain in log likelihood must exceed the number of additional parameters (Akaike's criterion), plus 10 nats
    against chance, plus 0.15 nats per point: halving a uniform box gains less, two equal modes 5 sd apart gain 0.25
    nats per point. A false split costs little: the moves are exact however space is divided.
    """
    least = 2 * points.shape[1] + 2 if least is None else least
    queue, done = [points], list[FloatArray]()
    while queue:
        group = queue.pop()
        halves = _split_in_two(group, least) if len(queue) + len(done) + 2 <= _MOST_CLUSTERS else None
        if halves is None:
            done.append(group)
        else:
            queue.extend(halves)
    clusters = Clusters.from_groups(done)
    if len(done) > 1:
        # Recompute the clusters from the division of space that will be used.
        home = clusters.assign(points)
        if np.bincount(home, minlength=len(done)).min() >= least:
            clusters = Clusters.from_groups([points[home == k] for k in range(len(done))])
    return clusters


def _split_in_two(points: FloatArray, least: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the two groups of points, (n, n_params), where two Gaussians fit better by enough; None where not."""
    n, n_params = points.shape
    if n < 2 * least:
        return None
    z = (points - points.mean(axis=0)) / np.maximum(points.std(axis=0), 1e-300)
    values, vectors = np.linalg.eigh(z.T @ z / n)
    # An axis without extent would overflow in the fourth power.
    flattest = max(1e-12 * float(values[-1]), 1e-300)
    axes = np.concatenate([z, z @ vectors / np.sqrt(np.maximum(values, flattest))], axis=1)
    # Two equal modes make the kurtosis small, a small mode beside a large one makes it large.
    fourth = (axes**4).mean(axis=0)
    whole = n * _log_det_of_covariance_cholesky(points)
    n_more = 1 + n_params * (n_params + 3) / 2
    best, halves = n_more + 0.15 * n + 10.0, None
    for axis in {int(np.argmin(fourth)), int(np.argmax(fourth))}:
        column = axes[:, axis]
        side = column > (0.0 if fourth[axis] < 3 else 0.5 * (column.max() + column.min()))
        for _ in range(_N_REFINEMENTS):
            if not least <= side.sum() <= n - least:
                break
            refined = Clusters.from_groups([points[~side], points[side]]).assign(points) == 1
            if np.array_equal(refined, side):
                break
            side = refined
        n_one = int(side.sum())
        if not least <= n_one <= n - least:
            continue
        a, b = points[~side], points[side]
        entropy = n_one * np.log(n_one / n) + (n - n_one) * np.log(1 - n_one / n)
        gain = (
            whole - len(a) * _log_det_of_covariance_cholesky(a) - len(b) * _log_det_of_covariance_cholesky(b) + entropy
        )
        if gain > best:
            best, halves = float(gain), (a, b)
    return halves


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
    return Clusters.join(*(find_clusters(x[home == k]) for k in range(len(large))))


def _cholesky_of_covariance(points: FloatArray) -> FloatArray:
    """Cholesky factor of the covariance of points (n, n_params), with a ridge in case a direction has no extent."""
    n_params = points.shape[1]
    centred = points - points.mean(axis=0)
    covariance = centred.T @ centred / max(len(points) - 1, 1)
    ridge = 1e-10 * np.diag(covariance) + 1e-24 + 1e-13 * np.trace(covariance) / n_params
    return np.linalg.cholesky(covariance + np.diag(ridge))


def _log_det_of_covariance_cholesky(points: FloatArray) -> float:
    return float(np.log(np.diag(_cholesky_of_covariance(points))).sum())


def _log_dets(root: FloatArray) -> FloatArray:
    return np.asarray(np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1))
