"""Search again about what a run has found: the same evidence, from a prior that is near the posterior.

Evidence and posterior know prior and likelihood by their product alone, so that any density may stand for the prior
if the likelihood makes up for it (posterior repartitioning: Chen, Hobson, Das & Gelderblom 2019, Stat. Comput. 29,
835; Petrosyan & Handley 2023, Phys. Sci. Forum 5, 51). From a density near the posterior there are few nats to shrink
by, and both the cost of a run and the square of its error are in proportion to them. What the density reaches too
seldom, where importance sampling lives on a handful of weights (`probewise.nested.importance`), live points climb to.
A part of the posterior that the first run has not found is not looked for again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammaln, stdtr, stdtrit

from probewise._arrays import FloatArray, frozen
from probewise.errors import ParameterError
from probewise.nested.evaluate import Samplable
from probewise.nested.importance import Posterior
from probewise.nested.space import Space, unbounded

__all__ = ["Repartitioned", "repartitioned"]

_MOST_FITTED = 2000
_DEGREES_OF_FREEDOM = 5.0
_FLATTEST = 1e-12  # least variance along an axis, of the greatest


@dataclass(frozen=True, eq=False)
class _Near:
    """A product of Student t along the axes of samples of a posterior: heavy tails, and no corner left out.

    `center` (n_params,) and `root` (n_params, n_params) in coordinates without walls.
    """

    names: tuple[str, ...]
    space: Space
    center: FloatArray
    root: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", frozen(self.center))
        object.__setattr__(self, "root", frozen(self.root))

    @cached_property
    def inverse_root(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.root))

    @cached_property
    def log_volume(self) -> float:
        return float(np.linalg.slogdet(self.root)[1])

    @property
    def coordinates(self) -> _Near:
        """Its own axes."""
        return self

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self.leave(np.asarray(stdtrit(_DEGREES_OF_FREEDOM, u), dtype=np.float64))[0]

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        return np.asarray(stdtr(_DEGREES_OF_FREEDOM, self.enter(theta)))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Log density over the coordinates without walls, (n,)."""
        return np.asarray(_log_student(self.enter(theta)) - self.log_volume)

    def enter(self, theta: FloatArray) -> FloatArray:
        return np.asarray((self.space.enter(theta) - self.center) @ self.inverse_root.T)

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        theta, log_prior = self.space.leave(self.center + x @ self.root.T)
        # What the problem's own prior rules out is impossible here too: nobody need ask.
        return theta, np.where(np.isfinite(log_prior), _log_student(x), -np.inf)


@dataclass(frozen=True, eq=False)
class Repartitioned:
    """A problem of the same evidence and posterior, its prior near that posterior."""

    problem: Samplable
    prior: _Near

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log of likelihood times prior over the density that stands for the prior, (n, n_params) -> (n,)."""
        space = self.prior.space
        log_prior = space.leave(space.enter(theta))[1]
        possible = np.isfinite(log_prior)
        out = np.full(len(theta), -np.inf)
        if possible.any():
            made_up = log_prior[possible] - self.prior.log_prob(theta[possible])
            out[possible] = self.problem.log_likelihood(theta[possible]) + made_up
        return out


def repartitioned(
    problem: Samplable, found: Posterior, *, rng: np.random.Generator, widening: float = 1.4
) -> Repartitioned:
    """State a problem anew, with a prior that is near its posterior: for a second run, shorter and sharper.

    Parameters
    ----------
    problem
        Prior and likelihood.
    found
        What a run of it has found; its posterior samples say where the prior is to be.
    rng
        Source of randomness, for the samples.
    widening
        How many times wider than the samples the new prior is, 1 or more.

    Returns
    -------
    Repartitioned
        Its log Z is the problem's own; `log_likelihood` of its runs is not.

    Raises
    ------
    ParameterError
        If `widening` is below 1, or what was found is of other parameters.
    """
    if not 1.0 <= widening < math.inf:
        raise ParameterError("widening", widening, "1 or more, finite")
    if found.names != problem.prior.names:
        raise ParameterError("found.names", found.names, f"the problem's names {problem.prior.names}")
    space = unbounded(problem.prior)
    x = space.enter(found.samples(_MOST_FITTED, rng=rng))
    variance, axes = np.linalg.eigh(np.atleast_2d(np.cov(x, rowvar=False)))
    sd = np.sqrt(np.maximum(variance, _FLATTEST * max(float(variance[-1]), 1e-300)))
    return Repartitioned(problem, _Near(found.names, space, x.mean(axis=0), widening * axes * sd))


def _log_student(x: FloatArray) -> FloatArray:
    """Log density of independent Student t, (n, n_params) -> (n,)."""
    nu = _DEGREES_OF_FREEDOM
    each = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * math.log(nu * math.pi)
    return np.asarray((each - 0.5 * (nu + 1) * np.log1p(x**2 / nu)).sum(axis=1))
