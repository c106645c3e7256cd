"""What a sampler is to the benchmark: it runs a problem whose evaluations are counted, and says an outcome."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from nested_sampling.problems import FloatArray, Known


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a sampler says of a problem.

    `theta` (n, n_params) with `log_weight` (n,), normalised or not. `doubts`: what the sampler itself says against its
    result. `n_live`: live points it ran with; None where its live points mean another thing.
    """

    log_z: float
    log_z_error: float
    n_evaluations: int
    theta: FloatArray
    log_weight: FloatArray
    n_live: int | None = None
    insertion_p_value: float | None = None
    doubts: tuple[str, ...] = ()

    @property
    def n_eff(self) -> float:
        """Kish's effective number of samples."""
        weight = self._weight
        return float(1 / (weight @ weight))

    @property
    def _weight(self) -> FloatArray:
        return np.exp(self.log_weight - logsumexp(self.log_weight))

    def samples(self, n: int, seed: int) -> FloatArray:
        """Draw equally weighted samples, (n, n_params), by systematic resampling."""
        rng = np.random.default_rng(seed)
        ladder = np.cumsum(self._weight)
        rows = np.searchsorted(ladder / ladder[-1], (np.arange(n) + rng.random()) / n, side="right")
        return self.theta[np.minimum(rows, len(ladder) - 1)]

    def mean(self, values: FloatArray) -> tuple[float, float]:
        """Posterior mean of a function given at every theta, (n,), and its sd."""
        weight = self._weight
        mean = float(weight @ values)
        return mean, math.sqrt(float(weight @ (values - mean) ** 2))


class Counted:
    """A problem whose evaluations are counted, also given point by point and from the unit cube."""

    def __init__(self, known: Known) -> None:
        self.known = known
        self.prior = known.prior
        self.n_params = known.n_params
        self.n_evaluations = 0

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Evaluate a batch, (n, n_params) -> (n,)."""
        self.n_evaluations += len(theta)
        return self.known.log_likelihood(theta)

    def batch(self, theta: FloatArray) -> FloatArray:
        """Evaluate a batch of any array type."""
        return self.log_likelihood(np.atleast_2d(np.asarray(theta, dtype=np.float64)))

    def single(self, theta: FloatArray) -> float:
        """Evaluate one point, (n_params,)."""
        return float(self.batch(theta)[0])

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Map the unit cube to parameters, (n_params,) or (n, n_params)."""
        u = np.asarray(u, dtype=np.float64)
        return self.prior.from_unit_cube(u[None])[0] if u.ndim == 1 else self.prior.from_unit_cube(u)


Run = Callable[[Counted, int, "int | None"], Outcome]


@dataclass(frozen=True)
class Sampler:
    """A way to run a problem: `run(problem, seed, n_live)`; its libraries are imported before the clock starts."""

    libraries: tuple[str, ...]
    run: Run
