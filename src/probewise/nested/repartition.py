"""Search again about what a run has found: the same evidence, from a prior that is near the posterior.

Evidence and posterior know prior and likelihood by their product alone, so that any density may stand for the prior
if the likelihood makes up for it (posterior repartitioning: Chen, Hobson, Das & Gelderblom 2019, Stat. Comput. 29,
835; Petrosyan & Handley 2023, Phys. Sci. Forum 5, 51). From a density near the posterior there are few nats to shrink
by, and with them the cost of a run falls and its error. What the density reaches too seldom, where importance
sampling lives on a handful of weights (`probewise.nested.importance`), live points climb to. A far part of the
posterior that no sample stands for is not looked for again.
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

__all__ = ["Repartitioned", "repartitioned"]

_DEGREES_OF_FREEDOM = 5.0
_FLATTEST = 1e-12  # least variance along an axis, of the greatest
_LEAST_SAMPLES = 2  # for each parameter, to know the axes by


@dataclass(frozen=True, eq=False)
class _Near:
    """A product of Student t along the axes of samples of a posterior: heavy tails, and no corner left out.

    Coordinates e are those axes; those without walls, x, are `center` (n_params,) + `root` (n_params, n_params) e.
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
        """Log of the density of the plain prior over that of this one, (n,): the same over theta as over x."""
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
    """A problem of the same evidence and posterior, its prior near that posterior."""

    problem: Samplable
    prior: _Near

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log of the likelihood and of what makes up for the prior, (n, n_params) -> (n,)."""
        # First what needs theta as it is: a likelihood may write into its argument.
        made_up = self.prior.made_up(theta)
        return np.asarray(self.problem.log_likelihood(theta) + made_up)


def repartitioned(problem: Samplable, theta: FloatArray, *, widening: float = 1.4) -> Repartitioned:
    """State a problem anew, with a prior that is near its posterior: for a second run, shorter and sharper.

    Parameters
    ----------
    problem
        Prior and likelihood.
    theta
        Samples of the posterior, (n_samples, n_params), such as a run's: they say where the prior is to be.
    widening
        Scale of the new prior in sds of the samples, 1 or more; along each axis it is a Student t of five degrees of
        freedom.

    Returns
    -------
    Repartitioned
        Its log Z is the problem's own. The `log_likelihood` of its runs is not, so that they go with this problem
        into `refine` or `update`, and not into `merge` with runs of the other.

    Raises
    ------
    ShapeError
        If the samples are of other parameters.
    ParameterError
        If `widening` is below 1, or there are too few different samples to know so many axes by.
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
    variance, axes = np.linalg.eigh(np.atleast_2d(np.cov(x, rowvar=False)))
    sd = np.sqrt(np.maximum(variance, _FLATTEST * max(float(variance[-1]), 1e-300)))
    return Repartitioned(problem, _Near(problem.prior, space, x.mean(axis=0), widening * axes * sd))


def _log_student(x: FloatArray) -> FloatArray:
    """Log density of independent Student t, (n, n_params) -> (n,)."""
    nu = _DEGREES_OF_FREEDOM
    each = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * math.log(nu * math.pi)
    return np.asarray((each - 0.5 * (nu + 1) * np.log1p(x**2 / nu)).sum(axis=1))
