"""Posterior repartitioning: run again from a prior near the posterior, with the same evidence.

Evidence and posterior depend only on the product of prior and likelihood, so any density may replace the prior if the
likelihood compensates for it (Chen, Hobson, Das & Gelderblom 2019, Stat. Comput. 29, 835). From a density near the
posterior there are few nats of compression, which lowers the cost and the error of a run. Live points climb to regions
that the density undersamples; a distant part of the posterior without any sample stays unseen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.nested.problem import Samplable, unbounded_space_of
from probewise.nested.weights import student_t_log_norm
from probewise.priors import Prior

_DEGREES_OF_FREEDOM = 5.0
_WIDENING = 1.4  # of the samples' sds
_FLATTEST = 1e-12  # least variance along an axis, relative to the greatest
_LEAST_SAMPLES = 2  # distinct samples per parameter, to determine the axes


@dataclass(frozen=True, eq=False)
class Repartitioned:
    """A problem with the same evidence and posterior, but a prior near that posterior.

    `prior` has coordinates to draw in, and `log_prior_ratio`: the log of the original prior's density over its own.
    """

    problem: Samplable
    prior: Any

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood plus the log of the original over the new prior density, (n, n_params) -> (n,)."""
        # The ratio first: a likelihood may modify its argument.
        log_prior_ratio = self.prior.log_prior_ratio(theta)
        return np.asarray(self.problem.log_likelihood(theta) + log_prior_ratio)


class _PriorNearPosterior:
    """A prior near the posterior: a mixture of Student t products in unbounded coordinates x, those of `space`.

    There is a part for each of some groups of points. In it x = `center` (n_parts, n_params) + `root` (n_parts,
    n_params, n_params) e, where the coordinates e along its principal axes are independent Student t of 5 degrees of
    freedom. Chains move in the coordinates e of the first part. `original`: the problem's prior.
    """

    def __init__(self, original: Prior, groups: Sequence[FloatArray]) -> None:
        self.original, self.names, self.space = original, original.names, unbounded_space_of(original)
        x = [self.space.enter(each) for each in groups]
        self.share: FloatArray = np.array([len(group) for group in x]) / sum(map(len, x))
        self.center = np.stack([group.mean(axis=0) for group in x])
        self.root = np.stack([covariance_root_of_points(group, _WIDENING) for group in x])
        self.inverse_root: FloatArray = np.asarray(np.linalg.inv(self.root), dtype=np.float64)
        self._log_dets: FloatArray = np.asarray(np.linalg.slogdet(self.root)[1], dtype=np.float64)

    @property
    def coordinates(self) -> _PriorNearPosterior:
        return self

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self.original.from_unit_cube(u)  # of the original; samplers use `draw`

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` points of this prior in the coordinates of chains, (n, n_params)."""
        part = rng.choice(len(self.share), size=n, p=self.share)
        e = rng.standard_t(_DEGREES_OF_FREEDOM, (n, len(self.names)))
        return self._to_axes(self.center[part] + np.einsum("nij,nj->ni", self.root[part], e), 0)

    def log_prior_ratio(self, theta: FloatArray) -> FloatArray:
        x = self.space.enter(theta)
        return np.asarray(self.space.leave(x)[1] - self._log_density(x))

    def enter(self, theta: FloatArray) -> FloatArray:
        return self._to_axes(self.space.enter(theta), 0)

    def leave(self, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = self.center[0] + e @ self.root[0].T
        theta, log_plain = self.space.leave(x)
        return theta, np.where(np.isfinite(log_plain), self._log_density(x) + self._log_dets[0], -np.inf)

    def _to_axes(self, x: FloatArray, part: int) -> FloatArray:
        # A matrix product would depend, in the last bit, on the batch, which an executor divides.
        return np.asarray(np.einsum("nj,ij->ni", x - self.center[part], self.inverse_root[part]))

    def _log_density(self, x: FloatArray) -> FloatArray:
        nu = _DEGREES_OF_FREEDOM
        e = np.stack([self._to_axes(x, part) for part in range(len(self.share))])
        along = (student_t_log_norm(1, nu) - 0.5 * (nu + 1) * np.log1p(e**2 / nu)).sum(axis=2)
        return np.asarray(np.logaddexp.reduce(along + (np.log(self.share) - self._log_dets)[:, None], axis=0))


def repartitioned(problem: Samplable, theta: FloatArray, *, peaks: Sequence[FloatArray] = ()) -> Repartitioned:
    """Repartition a problem: a prior near its posterior, for a second run that is shorter and more precise.

    Its log Z is that of the original problem; its `log_likelihood` is not, so that `refine` takes its runs with this
    problem. Along each principal axis the prior is a Student t with five degrees of freedom, 1.4 times as wide as the
    samples `theta`, (n_samples, n_params), of the posterior. With `peaks`, further groups of points, it is a mixture
    with a part for each group, by its number of points. ParameterError if there are too few distinct samples to
    determine the axes.
    """
    n_different, least = len(np.unique(theta, axis=0)), _LEAST_SAMPLES * len(problem.prior.names)
    if n_different < max(least, 1):
        raise ParameterError("theta", f"{n_different} different samples", f"{least} or more; run with more live points")
    return Repartitioned(problem, _PriorNearPosterior(problem.prior, (theta, *peaks)))


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
