"""Ask a problem for likelihoods and refuse answers that no sampler could use."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.errors import NotConvergedError

if TYPE_CHECKING:
    from probewise.priors import Prior

__all__ = ["Bound", "Evaluator", "Points", "Samplable"]


class Samplable(Protocol):
    """What the sampler needs of a problem: `probewise.inference.Problem`, or anything shaped like it."""

    @property
    def prior(self) -> Prior:
        """The prior; its names are the problem's parameters."""
        ...

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood of a batch of hypotheses, (n_samples, n_params) -> (n_samples,)."""
        ...


@dataclass(frozen=True, eq=False)
class Points:
    """Hold evaluated points.

    `u` in the unit cube and `theta` in parameters, both (n, n_params); `log_likelihood` (n,);
    `label` (n,): a uniform number each, which orders points of equal likelihood.
    """

    u: FloatArray
    theta: FloatArray
    log_likelihood: FloatArray
    label: FloatArray

    def __len__(self) -> int:
        return len(self.u)

    def take(self, rows: IntArray | BoolArray | slice) -> Points:
        """Keep these rows."""
        return Points(self.u[rows], self.theta[rows], self.log_likelihood[rows], self.label[rows])

    def order(self) -> IntArray:
        """Row numbers from worst to best, ties by label."""
        return np.lexsort((self.label, self.log_likelihood))

    @staticmethod
    def join(*parts: Points) -> Points:
        """Put points behind one another."""
        return Points(
            np.concatenate([p.u for p in parts]),
            np.concatenate([p.theta for p in parts]),
            np.concatenate([p.log_likelihood for p in parts]),
            np.concatenate([p.label for p in parts]),
        )


@dataclass(frozen=True)
class Bound:
    """Admit only what lies above a dead point in the order (log likelihood, label).

    The label makes the order strict, so that volume shrinks as it should where the likelihood
    is exactly constant over a finite part of the prior (a plateau).
    """

    log_likelihood: float
    label: float

    def admits(self, log_likelihood: FloatArray, label: FloatArray) -> BoolArray:
        """Say which points lie above the bound, both arguments (n,)."""
        tie = (log_likelihood == self.log_likelihood) & (label > self.label)
        return np.asarray((log_likelihood > self.log_likelihood) | tie)


@dataclass
class Evaluator:
    """Evaluate points of the unit cube, count them, and name the parameters of a useless answer."""

    problem: Samplable
    n_calls: int = 0
    names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.names = self.problem.prior.names

    def __call__(self, u: FloatArray, rng: np.random.Generator) -> Points:
        """Evaluate `u`, (n, n_params), and give every point a fresh label.

        Raises
        ------
        NotConvergedError
            If the likelihood raises, or returns the wrong shape, NaN or +inf; -inf (impossible) is allowed.
        """
        theta = self.problem.prior.from_unit_cube(u)
        return Points(u, theta, self.log_likelihood(theta), rng.random(len(u)))

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Evaluate hypotheses, (n, n_params) -> (n,), with the checks described above."""
        try:
            raw = self.problem.log_likelihood(theta)
        except Exception as error:
            raise NotConvergedError(
                f"the likelihood raised {type(error).__name__}: {error}; "
                f"first of the {len(theta)} hypotheses asked for: {self._show(theta[0])}"
            ) from error
        values = np.asarray(raw, dtype=np.float64)
        if values.shape != (len(theta),):
            raise NotConvergedError(
                f"the likelihood returned shape {values.shape}; allowed: ({len(theta)},), one number a hypothesis"
            )
        bad = np.isnan(values) | (values == np.inf)
        if bad.any():
            at = int(np.flatnonzero(bad)[0])
            raise NotConvergedError(
                f"the log likelihood is {values[at]} at {self._show(theta[at])}; "
                "allowed: a finite number, or -inf where the hypothesis is impossible"
            )
        self.n_calls += len(theta)
        return values

    def _show(self, row: FloatArray) -> str:
        return ", ".join(f"{name} = {value:.10g}" for name, value in zip(self.names, row, strict=True))
