"""Weighted samples of a posterior: equally weighted draws, standard deviations, quantiles."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from probewise._arrays import FloatArray, IntArray, own_arithmetic
from probewise._display import ShowsItself
from probewise._kinds import checked_number, checked_whole, require_rng
from probewise.errors import ParameterError
from probewise.nested.weights import resampled_rows, weighted_quantiles


class WeightedSamples(ShowsItself):
    """Base of results that hold `names`, `theta` (n, n_params) and `log_weight` (n,), whose weights sum to one."""

    names: tuple[str, ...]
    theta: FloatArray
    log_weight: FloatArray

    @abstractmethod
    def mean(self) -> FloatArray:
        """Posterior mean of the parameters, (n_params,)."""

    @property
    @own_arithmetic
    def weight(self) -> FloatArray:
        """Posterior weights, summing to one, (n,)."""
        return np.asarray(np.exp(self.log_weight))

    @own_arithmetic
    def draw_rows(self, n: int, *, rng: np.random.Generator) -> IntArray:
        """Draw the row numbers of `n` equally weighted samples, (n,), in random order; see `samples`."""
        require_rng(rng)
        n = checked_whole("n", n)
        return np.asarray(rng.permutation(resampled_rows(self.weight, n, rng)))

    def samples(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` equally weighted posterior samples, (n, n_params), in random order.

        Systematic resampling: a point of weight w occurs n w times, rounded up or down, so points
        repeat only where a weight exceeds 1 / n; `diversify` makes repeated samples distinct.
        """
        return np.asarray(self.theta[self.draw_rows(n, rng=rng)])

    @own_arithmetic
    def sd(self) -> FloatArray:
        """Posterior standard deviation of the parameters, (n_params,)."""
        return np.asarray(np.sqrt(self.weight @ (self.theta - self.mean()) ** 2))

    @own_arithmetic
    def covariance(self) -> FloatArray:
        """Posterior covariance of the parameters, (n_params, n_params)."""
        centred = self.theta - self.mean()
        return np.asarray((centred * self.weight[:, None]).T @ centred)

    @own_arithmetic
    def quantiles(self, q: FloatArray | list[float] | tuple[float, ...]) -> FloatArray:
        """Weighted quantiles of each parameter at levels 0 to 1, (n_q,) -> (n_q, n_params); ParameterError outside."""
        return weighted_quantiles(self.theta, self.weight, q)

    def interval(self, mass: float = 0.95) -> FloatArray:
        """Central interval of each parameter that holds `mass`, (2, n_params): lower, upper.

        ParameterError unless 0 < mass < 1.
        """
        share = "greater than 0, less than 1"
        columns = ", ".join(f"{name} {k}" for k, name in enumerate(self.names))
        if not 0 < checked_number("mass", mass, f"a number {share}; columns of the result are {columns}") < 1:
            raise ParameterError("mass", mass, share)
        return self.quantiles([0.5 - mass / 2, 0.5 + mass / 2])
