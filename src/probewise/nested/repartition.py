"""Posterior repartitioning: run again from a prior near the posterior, with the same evidence.

Evidence and posterior depend only on the product of prior and likelihood, so any density may replace the prior if the
likelihood compensates for it (Chen, Hobson, Das & Gelderblom 2019, Stat. Comput. 29, 835; Petrosyan & Handley 2023,
Phys. Sci. Forum 5, 51). From a density near the posterior there are few nats of compression, which lowers the cost and
the error of a run. Live points climb to regions that the density undersamples, where importance sampling
(`probewise.nested.importance`) would depend on a few weights. A distant part of the posterior without any sample stays
unseen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammaln, stdtr, stdtrit

from probewise._arrays import FloatArray, IntArray, read_only_floats
from probewise.errors import ParameterError, ShapeError
from probewise.nested.clusters import find_clusters
from probewise.nested.problem import Samplable, Space, unbounded_space_of
from probewise.priors import Prior

_DEGREES_OF_FREEDOM = 5.0
_FLATTEST = 1e-12  # least variance along an axis, relative to the greatest
_SAMPLES_IN_CLUSTER = 20  # samples per parameter in each cluster: with fewer, repeated samples look like a cluster
_LEAST_SAMPLES = 2  # distinct samples per parameter, to determine the axes


@dataclass(frozen=True, eq=False)
class _StudentMixture:
    """A mixture of products of Student t in unbounded coordinates x, one part per cluster of samples.

    Part k has the probability `share` (n_parts,); in it x = `center` (n_parts, n_params) + `root` (n_parts, n_params,
    n_params) e, where the coordinates e along its principal axes are independent Student t of 5 degrees of freedom.
    """

    share: FloatArray
    center: FloatArray
    root: FloatArray

    def __post_init__(self) -> None:
        for name in ("share", "center", "root"):
            object.__setattr__(self, name, read_only_floats(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.share)

    @cached_property
    def inverse_root(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.root))

    @cached_property
    def log_det_of_roots(self) -> FloatArray:
        return np.asarray(np.linalg.slogdet(self.root)[1])

    def to_principal_axes(self, x: FloatArray, part: int) -> FloatArray:
        """Map x to coordinates along the axes of a part, (n, n_params) -> (n, n_params)."""
        # A matrix product would depend, in the last bit, on the batch, which an executor divides.
        return np.asarray(np.einsum("nj,ij->ni", x - self.center[part], self.inverse_root[part]))

    def log_densities(self, x: FloatArray) -> FloatArray:
        """Return each part's log density times its share, (n, n_params) -> (n_parts, n)."""
        own = [_student_t_log_density(self.to_principal_axes(x, part)) for part in range(len(self))]
        return np.asarray(np.stack(own) + (np.log(self.share) - self.log_det_of_roots)[:, None])

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the log density of the mixture, (n, n_params) -> (n,)."""
        return np.asarray(np.logaddexp.reduce(self.log_densities(x), axis=0))

    def x_from_principal_axes(self, e: FloatArray, part: IntArray) -> FloatArray:
        """Map coordinates along the axes of a part, one for each row, to x: (n, n_params) and (n,) -> (n, n_params)."""
        return np.asarray(self.center[part] + np.einsum("nij,nj->ni", self.root[part], e))

    @staticmethod
    def from_groups(groups: Sequence[FloatArray], widening: float) -> _StudentMixture:
        """Make a part of each group of points, (n, n_params): its share, mean, and principal axes times `widening`."""
        n = np.array([len(group) for group in groups])
        root = np.stack([covariance_root_of_points(group, widening) for group in groups])
        return _StudentMixture(n / n.sum(), np.stack([group.mean(axis=0) for group in groups]), root)


@dataclass(frozen=True, eq=False)
class _PriorNearPosterior:
    """A prior near the posterior: the mixture `parts` in unbounded coordinates; `original` is the problem's prior.

    Chains move in coordinates along the principal axes of `whole`, the mixture with one part for all samples.
    """

    original: Prior
    space: Space
    whole: _StudentMixture
    parts: _StudentMixture

    @property
    def names(self) -> tuple[str, ...]:
        return self.original.names

    @property
    def has_invertible_axes(self) -> bool:
        """Whether the matrices of the axes have finite inverses: they have none where samples hardly vary."""
        matrices = (m for each in (self.whole, self.parts) for m in (each.root, each.inverse_root))
        return all(bool(np.isfinite(matrix).all()) for matrix in matrices)

    @property
    def coordinates(self) -> _PriorNearPosterior:
        """The prior itself: it maps parameters to the coordinates of chains."""
        return self

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` points of this prior in the coordinates of chains, (n, n_params)."""
        part = rng.choice(len(self.parts), size=n, p=self.parts.share)
        e = rng.standard_t(_DEGREES_OF_FREEDOM, (n, len(self.names)))
        return self.whole.to_principal_axes(self.parts.x_from_principal_axes(e, part), 0)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        # The first number also chooses the part: its place within the part's share is again uniform.
        ladder = np.cumsum(self.parts.share)
        part = np.minimum(np.searchsorted(ladder, u[:, 0], side="right"), len(ladder) - 1)
        within = u.copy()
        within[:, 0] = (u[:, 0] - (ladder - self.parts.share)[part]) / self.parts.share[part]
        e = np.asarray(stdtrit(_DEGREES_OF_FREEDOM, np.clip(within, 0.0, 1.0)), dtype=np.float64)
        return self.space.leave(self.parts.x_from_principal_axes(e, part))[0]

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map theta to points of the unit cube, (n, n_params), by way of the part that is densest at theta."""
        x = self.space.enter(theta)
        part = np.argmax(self.parts.log_densities(x), axis=0)
        e = np.stack([self.parts.to_principal_axes(x, k) for k in range(len(self.parts))])[part, np.arange(len(x))]
        u = np.asarray(stdtr(_DEGREES_OF_FREEDOM, e))
        u[:, 0] = (np.cumsum(self.parts.share) - self.parts.share)[part] + self.parts.share[part] * u[:, 0]
        return u

    def log_prob(self, theta: FloatArray) -> FloatArray:
        log_plain = self.original.log_prob(theta)
        out = np.full(len(theta), -np.inf)
        possible = np.isfinite(log_plain)
        if possible.any():
            out[possible] = log_plain[possible] - self.log_prior_ratio(theta[possible])
        return out

    def log_prior_ratio(self, theta: FloatArray) -> FloatArray:
        """Return the log of the original prior's density over this one's, (n,): the same in theta and in x."""
        x = self.space.enter(theta)
        return np.asarray(self.space.leave(x)[1] - self.parts.log_density(x))

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates along the axes of `whole`, both (n, n_params)."""
        return self.whole.to_principal_axes(self.space.enter(theta), 0)

    def leave(self, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n, n_params); also return this prior's log density in the coordinates.

        The density, (n,), is -inf where that of the original prior is zero.
        """
        x = self.whole.center[0] + e @ self.whole.root[0].T
        theta, log_plain = self.space.leave(x)
        log_density = self.parts.log_density(x) + self.whole.log_det_of_roots[0]
        return theta, np.where(np.isfinite(log_plain), log_density, -np.inf)


@dataclass(frozen=True, eq=False)
class Repartitioned:
    """A problem with the same evidence and posterior, but a prior near that posterior."""

    problem: Samplable
    prior: _PriorNearPosterior

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood plus the log of the original over the new prior density, (n, n_params) -> (n,)."""
        # The ratio first: a likelihood may modify its argument.
        log_prior_ratio = self.prior.log_prior_ratio(theta)
        return np.asarray(self.problem.log_likelihood(theta) + log_prior_ratio)


def repartitioned(
    problem: Samplable, theta: FloatArray, *, widening: float = 1.4, clustered: bool = False
) -> Repartitioned:
    """Repartition a problem: a prior near its posterior, for a second run that is shorter and more precise.

    Parameters
    ----------
    problem
        Prior and likelihood.
    theta
        Posterior samples, (n_samples, n_params), such as a run's, which determine the new prior.
    widening
        Scale of the new prior in sds of the samples, 1 or more; along each axis it is a Student t with five degrees of
        freedom.
    clustered
        Whether the new prior is a mixture with a part for each cluster of the samples, instead of one part for all. It
        lies nearer to a curved posterior, or to one of several modes. A cluster has at least 20 samples per parameter.

    Returns
    -------
    Repartitioned
        Its log Z is that of the original problem. Its `log_likelihood` is not: use its runs with this problem in
        `refine` or `update`, and do not `merge` them with runs of the original.

    Raises
    ------
    ShapeError
        If the samples have other parameters.
    ParameterError
        If `widening` is below 1, or there are too few distinct samples to determine the axes.
    """
    n_params = len(problem.prior.names)
    if theta.ndim != 2 or theta.shape[1] != n_params:
        raise ShapeError(f"theta has shape {theta.shape}; allowed: (n_samples, {n_params})")
    if not n_params:
        raise ParameterError("problem", "one without parameters", "one with some; its prior cannot be narrower")
    if not 1.0 <= widening < math.inf:
        raise ParameterError("widening", widening, "1 or more, finite")
    n_different, least = len(np.unique(theta, axis=0)), _LEAST_SAMPLES * n_params
    if n_different < least:
        raise ParameterError("theta", f"{n_different} different samples", f"{least} or more; run with more live points")
    space = unbounded_space_of(problem.prior)
    x = space.enter(theta)
    whole = _StudentMixture.from_groups([x], widening)
    parts = _StudentMixture.from_groups(split_into_clusters(x), widening) if clustered else whole
    return Repartitioned(problem, _PriorNearPosterior(problem.prior, space, whole, parts))


def split_into_clusters(x: FloatArray) -> list[FloatArray]:
    """Divide samples (n, n_params) into groups by cluster, of 20 or more samples per parameter, else into one."""
    least = _SAMPLES_IN_CLUSTER * x.shape[1]
    clusters = find_clusters(x, least=least)
    home = clusters.assign(x)
    groups = [x[home == k] for k in range(len(clusters))]
    # The last division of space may leave a cluster with fewer.
    return groups if min(map(len, groups)) >= least else [x]


def covariance_root_of_points(x: FloatArray, scale: float = 1.0) -> FloatArray:
    """Return a root of the covariance of points (n, n_params), times `scale`; see `root_of_covariance`."""
    return root_of_covariance(np.atleast_2d(np.cov(x, rowvar=False)), scale)


def root_of_covariance(covariance: FloatArray, scale: float = 1.0) -> FloatArray:
    """Return a root of a covariance, (n_params, n_params): the principal axes as columns, times sd and `scale`.

    Axes without variance keep a millionth of the greatest sd, so that the root can be inverted.
    """
    variance, axes = np.linalg.eigh(covariance)
    sd = np.sqrt(np.maximum(variance, _FLATTEST * max(float(variance[-1]), 1e-300)))
    return np.asarray(scale * axes * sd)


def _student_t_log_density(x: FloatArray) -> FloatArray:
    """Log density of independent Student t, (n, n_params) -> (n,)."""
    nu = _DEGREES_OF_FREEDOM
    each = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * math.log(nu * math.pi)
    return np.asarray((each - 0.5 * (nu + 1) * np.log1p(x**2 / nu)).sum(axis=1))
