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

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError, ShapeError
from probewise.nested.problem import Samplable, Space, unbounded_space_of
from probewise.priors import Prior

_DEGREES_OF_FREEDOM = 5.0
_FLATTEST = 1e-12  # least variance along an axis, relative to the greatest
_LEAST_SAMPLES = 2  # distinct samples per parameter, to determine the axes


@dataclass(frozen=True, eq=False)
class _PriorNearPosterior:
    """A prior near the posterior: a mixture of Student t products in unbounded coordinates x, those of `space`.

    Part k has the probability `share` (n_parts,); in it x = `center` (n_parts, n_params) + `root` (n_parts, n_params,
    n_params) e, where the coordinates e along its principal axes are independent Student t of 5 degrees of freedom.
    Chains move in the coordinates e of the first part. `original`: the problem's prior.
    """

    original: Prior
    space: Space
    share: FloatArray
    center: FloatArray
    root: FloatArray

    @staticmethod
    def about(groups: Sequence[FloatArray], widening: float, original: Prior, space: Space) -> _PriorNearPosterior:
        """Make a part of each group of points x, (n, n_params): share, mean, and principal axes times `widening`."""
        n = np.array([len(group) for group in groups])
        root = np.stack([covariance_root_of_points(group, widening) for group in groups])
        center = np.stack([group.mean(axis=0) for group in groups])
        return _PriorNearPosterior(original, space, n / n.sum(), center, root)

    @property
    def names(self) -> tuple[str, ...]:
        return self.original.names

    @cached_property
    def inverse_root(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.root))

    @cached_property
    def log_det_of_roots(self) -> FloatArray:
        return np.asarray(np.linalg.slogdet(self.root)[1])

    @property
    def has_invertible_axes(self) -> bool:
        """Whether the matrices of the axes have finite inverses: they have none where samples hardly vary."""
        return bool(np.isfinite(self.root).all() and np.isfinite(self.inverse_root).all())

    @property
    def coordinates(self) -> _PriorNearPosterior:
        """The prior itself: it maps parameters to the coordinates of chains."""
        return self

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` points of this prior in the coordinates of chains, (n, n_params)."""
        part = rng.choice(len(self.share), size=n, p=self.share)
        e = rng.standard_t(_DEGREES_OF_FREEDOM, (n, len(self.names)))
        return self._to_axes(self._from_axes(e, part), 0)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        # The first number also chooses the part: its place within the part's share is again uniform.
        ladder = np.cumsum(self.share)
        part = np.minimum(np.searchsorted(ladder, u[:, 0], side="right"), len(ladder) - 1)
        within = u.copy()
        within[:, 0] = (u[:, 0] - (ladder - self.share)[part]) / self.share[part]
        e = np.asarray(stdtrit(_DEGREES_OF_FREEDOM, np.clip(within, 0.0, 1.0)), dtype=np.float64)
        return self.space.leave(self._from_axes(e, part))[0]

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map theta to points of the unit cube, (n, n_params), by way of the part that is densest at theta."""
        x = self.space.enter(theta)
        part = np.argmax(self._log_densities(x), axis=0)
        e = np.stack([self._to_axes(x, k) for k in range(len(self.share))])[part, np.arange(len(x))]
        u = np.asarray(stdtr(_DEGREES_OF_FREEDOM, e))
        u[:, 0] = (np.cumsum(self.share) - self.share)[part] + self.share[part] * u[:, 0]
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
        return np.asarray(self.space.leave(x)[1] - np.logaddexp.reduce(self._log_densities(x), axis=0))

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates along the axes of the first part, both (n, n_params)."""
        return self._to_axes(self.space.enter(theta), 0)

    def leave(self, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n, n_params); also return this prior's log density in the coordinates.

        The density, (n,), is -inf where that of the original prior is zero.
        """
        x = self.center[0] + e @ self.root[0].T
        theta, log_plain = self.space.leave(x)
        log_density = np.logaddexp.reduce(self._log_densities(x), axis=0) + self.log_det_of_roots[0]
        return theta, np.where(np.isfinite(log_plain), log_density, -np.inf)

    def _from_axes(self, e: FloatArray, part: IntArray) -> FloatArray:
        """Map coordinates along the axes of a part, one for each row, to x: (n, n_params) and (n,) -> (n, n_params)."""
        return np.asarray(self.center[part] + np.einsum("nij,nj->ni", self.root[part], e))

    def _to_axes(self, x: FloatArray, part: int) -> FloatArray:
        """Map x to coordinates along the axes of a part, (n, n_params) -> (n, n_params)."""
        # A matrix product would depend, in the last bit, on the batch, which an executor divides.
        return np.asarray(np.einsum("nj,ij->ni", x - self.center[part], self.inverse_root[part]))

    def _log_densities(self, x: FloatArray) -> FloatArray:
        """Return each part's log density times its share, (n, n_params) -> (n_parts, n)."""
        nu = _DEGREES_OF_FREEDOM
        norm = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * math.log(nu * math.pi)
        e = np.stack([self._to_axes(x, part) for part in range(len(self.share))])
        along = (norm - 0.5 * (nu + 1) * np.log1p(e**2 / nu)).sum(axis=2)
        return np.asarray(along + (np.log(self.share) - self.log_det_of_roots)[:, None])


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
    problem: Samplable, theta: FloatArray, *, widening: float = 1.4, peaks: Sequence[FloatArray] = ()
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
    peaks
        Further groups of points, (n, n_params) each, such as peaks without samples: the new prior is a mixture with a
        part for each group, by its number of points, and one for the samples.

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
    groups = [space.enter(each) for each in (theta, *peaks)]
    return Repartitioned(problem, _PriorNearPosterior.about(groups, widening, problem.prior, space))


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
