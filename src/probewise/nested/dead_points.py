"""Dead points of nested sampling as weighted samples of the posterior: means, quantiles, equally weighted draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray, frozen_int, own_arithmetic, read_only_floats
from probewise.errors import ParameterError, ShapeError
from probewise.nested.evidence import log_volumes
from probewise.nested.weighted_samples import WeightedSamples

PER_POINT = ("log_likelihood", "label", "log_weight", "log_birth", "birth_label")
COUNTS = ("parent", "n_at_death")


def checked_array_of_length(name: str, values: FloatArray | IntArray, n: int, one: str) -> FloatArray | IntArray:
    """Return an array after checking that it has shape (n,); `name` and `one` (a row's meaning) are for the message.

    Raises
    ------
    ShapeError
        If it has another shape.
    """
    if values.shape != (n,):
        raise ShapeError(f"{name} has shape {values.shape}; allowed: ({n},), one per {one}")
    return values


@dataclass(frozen=True, eq=False)
class DeadPoints(WeightedSamples):
    """The weighted samples of a run of nested sampling.

    Attributes
    ----------
    names
        Parameter names, one per column of theta.
    theta
        Dead points in order of death, followed by the last live points, (n_dead, n_params).
    log_likelihood, label, log_weight
        Of each: log likelihood, the number from 0 to 1 that orders points of equal likelihood,
        and log posterior weight (the weights sum to one), all (n_dead,).
    log_birth, birth_label
        Log likelihood and label of the dead point above which each was drawn, (n_dead,);
        minus infinity and 1 for draws from the whole prior.
    parent
        Row of the point at which each point's chain began; -1 for the initial draws from the prior, (n_dead,).
    n_at_death
        Number of points alive when each died, itself included, (n_dead,).
    log_start
        Natural log of the share of the prior with nonzero likelihood.
    """

    names: tuple[str, ...]
    theta: FloatArray
    log_likelihood: FloatArray
    label: FloatArray
    log_weight: FloatArray
    log_birth: FloatArray
    birth_label: FloatArray
    parent: IntArray
    n_at_death: IntArray
    log_start: float

    def __post_init__(self) -> None:
        theta = read_only_floats(self.theta)
        if theta.ndim != 2 or theta.shape[1] != len(self.names):
            raise ShapeError(f"theta has shape {theta.shape}; allowed: (n_dead, {len(self.names)}) for {self.names}")
        object.__setattr__(self, "theta", theta)
        for name in PER_POINT:
            self._store_read_only(name, read_only_floats(getattr(self, name)))
        for name in COUNTS:
            self._store_read_only(name, frozen_int(getattr(self, name)))

    def _store_read_only(self, name: str, values: FloatArray | IntArray) -> None:
        object.__setattr__(self, name, checked_array_of_length(name, values, self.n_dead, "row of theta"))

    @property
    def n_dead(self) -> int:
        """Number of weighted samples."""
        return len(self.theta)

    @property
    def log_volume(self) -> FloatArray:
        """Expected natural log of the prior share (volume X) with a likelihood above each sample's, (n_dead,)."""
        return log_volumes(self.n_at_death, self.log_start)

    @own_arithmetic
    def mean(self, f: Callable[[FloatArray], FloatArray] | None = None, *, block: int | None = None) -> FloatArray:
        """Average the parameters, or any function of them, over the posterior.

        Parameters
        ----------
        f
            Function from rows of theta, (n, n_params), to values, (n, ...), for instance sensitivity fields
            (n, n_v, n_u); by default the parameters themselves. ShapeError for another number of rows.
        block
            Largest number of rows passed to `f` at a time, to bound memory; by default all. ParameterError below 1.

        Returns
        -------
        The posterior mean, with the shape of one row's value; (n_params,) without `f`.
        """
        if block is not None and block < 1:
            raise ParameterError("block", block, "1 or more")
        if f is None:
            return np.asarray(self.weight @ self.theta)
        size = self.n_dead if block is None else block
        total: FloatArray | None = None
        for first in range(0, self.n_dead, size):
            theta, weight = self.theta[first : first + size], self.weight[first : first + size]
            values = np.asarray(f(theta))
            if values.shape[:1] != (len(theta),):
                raise ShapeError(f"f(theta) has shape {values.shape}; allowed: {len(theta)} rows, as many as theta has")
            part = np.asarray(np.tensordot(weight, values, axes=(0, 0)))
            total = part if total is None else total + part
        return np.zeros(0) if total is None else total

    def maximum_likelihood_theta(self) -> FloatArray:
        """Return the parameters of the sample with the greatest likelihood, (n_params,)."""
        return np.asarray(self.theta[int(np.argmax(self.log_likelihood))])
