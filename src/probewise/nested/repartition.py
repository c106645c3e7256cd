"""Posterior repartitioning: run again from a prior near the posterior, with the same evidence.

Evidence and posterior depend only on the product of prior and likelihood, so any density may replace the prior if the
likelihood compensates for it (Chen, Hobson, Das & Gelderblom 2019, Stat. Comput. 29, 835; Petrosyan & Handley 2023,
Phys. Sci. Forum 5, 51). From a density near the posterior there are few nats of compression, which lowers the cost
and the error of a run. Live points climb to regions that the density undersamples, where importance sampling
(`probewise.nested.importance`) would depend on a few weights. A distant part of the posterior without any sample
is not searched for again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammaln, stdtr, stdtrit

from probewise._arrays import FloatArray, frozen
from probewise.errors import ParameterError, ShapeError
from probewise.nested.evaluate import Samplable
from probewise.nested.space import Space, unbounded
from probewise.priors import Prior

__all__ = ["Repartitioned", "principal_root", "repartitioned"]

_DEGREES_OF_FREEDOM = 5.0
_FLATTEST = 1e-12  # least variance along an axis, relative to the greatest
_LEAST_SAMPLES = 2  # distinct samples per parameter, to determine the axes


@dataclass(frozen=True, eq=False)
class _Near:
    """A prior near the posterior: a product of Student t along the principal axes of posterior samples.

    With e the coordinates along the axes, the unbounded coordinates are x = `center` (n_params,) +
    `root` (n_params, n_params) e.
    """

    plain: Prior
    space: Space
    center: FloatArray
    root: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", frozen(self.center))
        object.__setattr__(self, "root", frozen(self.root))

    @property
    def names(self) -> tuple[str, ...]:
        return self.plain.names

    @cached_property
    def inverse_root(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.root))

    @cached_property
    def log_volume(self) -> float:
        return float(np.linalg.slogdet(self.root)[1])

    @property
    def coordinates(self) -> _Near:
        return self

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        return rng.standard_t(_DEGREES_OF_FREEDOM, (n, len(self.names)))

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self.leave(np.asarray(stdtrit(_DEGREES_OF_FREEDOM, u), dtype=np.float64))[0]

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        return np.asarray(stdtr(_DEGREES_OF_FREEDOM, self.enter(theta)))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        log_plain = self.plain.log_prob(theta)
        out = np.full(len(theta), -np.inf)
        possible = np.isfinite(log_plain)
        if possible.any():
            out[possible] = log_plain[possible] - self.made_up(theta[possible])
        return out

    def made_up(self, theta: FloatArray) -> FloatArray:
        """Log of the original prior's density over this one's, (n,): the same ratio in theta and in x."""
        x = self.space.enter(theta)
        own = _log_student(self._along(x)) - self.log_volume
        return np.asarray(self.space.leave(x)[1] - own)

    def enter(self, theta: FloatArray) -> FloatArray:
        return self._along(self.space.enter(theta))

    def _along(self, x: FloatArray) -> FloatArray:
        return np.asarray((x - self.center) @ self.inverse_root.T)

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        theta, log_plain = self.space.leave(self.center + x @ self.root.T)
        return theta, np.where(np.isfinite(log_plain), _log_student(x), -np.inf)


@dataclass(frozen=True, eq=False)
class Repartitioned:
    """A problem with the same evidence and posterior, but a prior near that posterior."""

    problem: Samplable
    prior: _Near

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood plus the log ratio of the priors, (n, n_params) -> (n,)."""
        # The ratio first: a likelihood may modify its argument.
        made_up = self.prior.made_up(theta)
        return np.asarray(self.problem.log_likelihood(theta) + made_up)


def repartitioned(problem: Samplable, theta: FloatArray, *, widening: float = 1.4) -> Repartitioned:
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
    if not 1.0 <= widening < math.inf:
        raise ParameterError("widening", widening, "1 or more, finite")
    n_different, least = len(np.unique(theta, axis=0)), _LEAST_SAMPLES * n_params
    if n_different < least:
        raise ParameterError("theta", f"{n_different} different samples", f"{least} or more; run with more live points")
    space = unbounded(problem.prior)
    x = space.enter(theta)
    return Repartitioned(problem, _Near(problem.prior, space, x.mean(axis=0), principal_root(x, widening)))


def principal_root(x: FloatArray, scale: float = 1.0) -> FloatArray:
    """Return a root of the covariance of points (n, n_params): principal axes as columns, times sd and `scale`.

    Axes along which the points do not vary keep a millionth of the greatest sd, so that the root can be inverted.
    """
    variance, axes = np.linalg.eigh(np.atleast_2d(np.cov(x, rowvar=False)))
    sd = np.sqrt(np.maximum(variance, _FLATTEST * max(float(variance[-1]), 1e-300)))
    return np.asarray(scale * axes * sd)


def _log_student(x: FloatArray) -> FloatArray:
    """Log density of independent Student t, (n, n_params) -> (n,)."""
    nu = _DEGREES_OF_FREEDOM
    each = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * math.log(nu * math.pi)
    return np.asarray((each - 0.5 * (nu + 1) * np.log1p(x**2 / nu)).sum(axis=1))
