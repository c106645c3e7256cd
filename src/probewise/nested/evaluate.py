"""Evaluate the likelihood of points, with checks of what it returns."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise._kinds import require_like
from probewise.errors import NotConvergedError, message_of
from probewise.nested.space import Space, space_of
from probewise.priors import Prior, require_prior


class Samplable(Protocol):
    """A problem as the sampler needs it: `probewise.inference.Problem`, or anything with the same attributes."""

    @property
    def prior(self) -> Prior:
        """The prior; its names are the problem's parameters."""
        ...

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood of a batch of hypotheses, (n_samples, n_params) -> (n_samples,)."""
        ...


@dataclass(frozen=True, eq=False)
class Points:
    """Evaluated points.

    `u` in the sampling coordinates (see `nested.space`) and `theta` in parameters, both (n, n_params); `log_density` of
    the prior in `u`, (n,); `log_likelihood`, (n,); `label`, (n,): uniform random numbers that order points of equal
    likelihood.
    """

    u: FloatArray
    theta: FloatArray
    log_density: FloatArray
    log_likelihood: FloatArray
    label: FloatArray

    def __len__(self) -> int:
        return len(self.u)

    def take_rows(self, rows: IntArray | BoolArray | slice) -> Points:
        """Select points by row numbers, mask or slice."""
        return Points(
            self.u[rows], self.theta[rows], self.log_density[rows], self.log_likelihood[rows], self.label[rows]
        )

    def copy(self) -> Points:
        """Return the points with a copy of every array."""
        return Points(
            self.u.copy(),
            self.theta.copy(),
            self.log_density.copy(),
            self.log_likelihood.copy(),
            self.label.copy(),
        )

    def overwrite_rows(self, rows: IntArray | BoolArray, points: Points, which: IntArray) -> None:
        """Overwrite these points' `rows` in place with the rows `which` of `points`."""
        self.u[rows], self.theta[rows] = points.u.take(which, axis=0), points.theta.take(which, axis=0)
        self.log_density[rows], self.label[rows] = points.log_density[which], points.label[which]
        self.log_likelihood[rows] = points.log_likelihood[which]

    def rows_by_rising_likelihood(self) -> IntArray:
        """Return the row numbers from the least to the greatest log likelihood, ties by label, (n,)."""
        return np.lexsort((self.label, self.log_likelihood))

    @staticmethod
    def join(*parts: Points) -> Points:
        """Return the points of all parts, in order."""
        return Points(
            np.concatenate([p.u for p in parts]),
            np.concatenate([p.theta for p in parts]),
            np.concatenate([p.log_density for p in parts]),
            np.concatenate([p.log_likelihood for p in parts]),
            np.concatenate([p.label for p in parts]),
        )


@dataclass(frozen=True)
class Bound:
    """A lower bound in the order (log likelihood, label), set by a dead point.

    The label makes the order strict, so that the volume shrinks correctly where the likelihood is
    constant over a finite part of the prior (a plateau).
    """

    log_likelihood: float
    label: float

    def mask_above(self, log_likelihood: FloatArray, label: FloatArray) -> BoolArray:
        """Return a mask of the points above the bound; all arrays are (n,)."""
        tie = (log_likelihood == self.log_likelihood) & (label > self.label)
        return np.asarray((log_likelihood > self.log_likelihood) | tie)


class OutOfCallsError(Exception):
    """The evaluations that come next would exceed the limit; nothing was evaluated."""


@dataclass
class Evaluator:
    """Evaluates the likelihood of points and counts them in `n_calls`; errors name the parameters at which it failed.

    Evaluations beyond `most_calls` in all, if not None, are refused with OutOfCallsError.

    With an `executor` (any `concurrent.futures.Executor`) a batch is split into `n_parts` parts, by default the number
    of processors; the problem must then be picklable. Results come back in order, so the run does not depend on the
    executor if a hypothesis' likelihood does not depend, to the last bit, on the rest of its batch.
    """

    problem: Samplable
    n_calls: int = 0
    executor: Executor | None = None
    n_parts: int | None = None
    most_calls: int | None = None
    names: tuple[str, ...] = field(init=False)
    space: Space = field(init=False)

    def __post_init__(self) -> None:
        allowed = "a value with a prior and a log_likelihood(theta), such as inference.SensorProblem"
        require_like("problem", self.problem, ("prior", "log_likelihood"), allowed)
        require_prior("problem.prior", self.problem.prior)
        self.names = self.problem.prior.names
        self.space = space_of(self.problem.prior, getattr(self.problem, "periodic", ()))

    def draw_from_prior(self, n: int, rng: np.random.Generator) -> Points:
        """Draw `n` points from the prior and return them evaluated; NotConvergedError as for `log_likelihood`."""
        return self(self.space.draw(n, rng=rng), rng)

    def points_from_known_values(self, theta: FloatArray, log_likelihood: FloatArray, label: FloatArray) -> Points:
        """Make points of hypotheses (n, n_params) whose log likelihood and label, (n,), are known; evaluate nothing."""
        u = self.space.enter(theta)
        return Points(u, theta, self.space.leave(u)[1], log_likelihood, label)

    def __call__(self, u: FloatArray, rng: np.random.Generator) -> Points:
        """Evaluate `u`, (n, n_params), inside the space, and give every point a new label.

        Raises
        ------
        NotConvergedError
            If the likelihood raises, or returns the wrong shape, NaN or +inf; -inf (impossible) is allowed.
        """
        theta, log_density = self.space.leave(u)
        return self.evaluate_mapped(u, theta, log_density, rng)

    def evaluate_mapped(
        self, u: FloatArray, theta: FloatArray, log_density: FloatArray, rng: np.random.Generator
    ) -> Points:
        """Evaluate points that are already mapped from `u` to parameters and log prior density; give each a new label.

        Where the prior density is zero the log likelihood is -inf, without a call of the problem.
        """
        possible = np.isfinite(log_density)
        if possible.all():
            return Points(u, theta, log_density, self.log_likelihood(theta), rng.random(len(u)))
        log_likelihood = np.full(len(u), -np.inf)
        if possible.any():
            log_likelihood[possible] = self.log_likelihood(theta[possible])
        return Points(u, theta, log_density, log_likelihood, rng.random(len(u)))

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Evaluate the log likelihood of hypotheses, (n, n_params) -> (n,), and count the calls.

        NotConvergedError if the likelihood raises, or returns the wrong shape, NaN or +inf; OutOfCallsError beyond
        `most_calls`.
        """
        if not len(theta):
            return np.empty(0)  # a likelihood need not take an empty batch
        if self.most_calls is not None and self.n_calls + len(theta) > self.most_calls:
            raise OutOfCallsError
        shared = self.executor is not None and len(theta) > 1
        n_parts = self.n_parts or os.cpu_count() or 1
        parts = np.array_split(theta, min(n_parts, len(theta))) if shared else [theta]
        answers: list[object] = []
        try:
            for answer in self._likelihoods_of_parts(parts):
                answers.append(answer)  # one by one: their number identifies the part that failed
        except Exception as error:
            raise NotConvergedError(self._failure_message(error, parts[len(answers)])) from error
        # Concatenation copies: a likelihood may return the same array every time.
        values = np.concatenate(
            [self._checked_log_likelihoods(a, part) for a, part in zip(answers, parts, strict=True)]
        )
        fine = values < np.inf
        if not fine.all():
            at = int(np.argmin(fine))
            raise NotConvergedError(
                f"the log likelihood is {values[at]} at {self._parameters_as_text(theta[at])}; "
                "allowed: a finite number, or -inf where the hypothesis is impossible"
            )
        self.n_calls += len(theta)
        return values

    def _likelihoods_of_parts(self, parts: list[FloatArray]) -> Iterator[object]:
        """Yield the likelihoods of the parts in order; the parts run in parallel where there is an executor."""
        # Copies: a likelihood that writes into its argument must not change the samples.
        if self.executor is not None and len(parts) > 1:
            # Not `map`: dask builds a task graph for it, which takes longer than submitting the parts.
            sent = [self.executor.submit(self.problem.log_likelihood, part.copy()) for part in parts]
            try:
                for future in sent:
                    yield future.result()
            finally:
                for future in sent:
                    future.cancel()
        else:
            for part in parts:
                yield self.problem.log_likelihood(part.copy())

    def _checked_log_likelihoods(self, answer: object, theta: FloatArray) -> FloatArray:
        """Convert the likelihood's answer to (n,) floats; NotConvergedError for masked, complex or misshapen ones."""
        if isinstance(answer, np.ma.MaskedArray) and (n_masked := int(np.ma.getmaskarray(answer).sum())):
            raise NotConvergedError(
                f"the likelihood returned a masked array with {n_masked} of {answer.size} values masked; allowed: "
                "plain numbers; return answer.filled(-np.inf) if masked means impossible; "
                f"{self._first_hypothesis_as_text(theta)}"
            )
        if np.asarray(answer).dtype.kind == "c":
            raise NotConvergedError(
                "the likelihood returned complex numbers; allowed: real ones; return their real part if that is "
                f"meant; {self._first_hypothesis_as_text(theta)}"
            )
        try:
            values = np.asarray(answer, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise NotConvergedError(
                f"the likelihood returned something other than numbers ({error}); "
                f"{self._first_hypothesis_as_text(theta)}"
            ) from error
        if values.shape == () and len(theta) == 1:
            return values.reshape(1)  # many functions drop the axis of a batch of one, scipy.stats among them
        if values.shape != (len(theta),):
            raise NotConvergedError(
                f"the likelihood returned shape {values.shape}; "
                f"allowed: ({len(theta)},), one number per hypothesis: theta is a batch of shape {theta.shape}, "
                f"one hypothesis per row; {self._first_hypothesis_as_text(theta)}"
            )
        return values

    def _failure_message(self, error: Exception, theta: FloatArray) -> str:
        """Describe the failure of a batch, (n, n_params), and name a hypothesis that fails by itself, if any."""
        why = message_of(error)
        if self.executor is not None and "pickle" in why.lower():
            return (
                f"the problem cannot be sent to the executor's workers ({why}); allowed: one that pickles, so made of "
                "functions and classes at the top level of a module, without lambdas; or take a ThreadPoolExecutor"
            )
        # A hypothesis that killed its worker could kill this process too.
        culprit = None if isinstance(error, BrokenExecutor) else self._find_failing_hypothesis(theta)
        if culprit is not None:
            return f"the likelihood raised {why}; at {self._parameters_as_text(culprit)}"
        batch = f"it is given a batch theta of shape {theta.shape}, one hypothesis per row"
        return f"the likelihood raised {why}; {batch}; {self._first_hypothesis_as_text(theta)}"

    def _find_failing_hypothesis(self, theta: FloatArray) -> FloatArray | None:
        """Find by bisection a hypothesis, (n_params,), that fails by itself; None where only the whole batch fails."""
        while len(theta) > 1:
            half = len(theta) // 2
            theta = theta[:half] if self._likelihood_fails(theta[:half]) else theta[half:]
        return theta[0] if self._likelihood_fails(theta) else None

    def _likelihood_fails(self, theta: FloatArray) -> bool:
        try:
            if self.executor is None:
                self.problem.log_likelihood(theta.copy())
            else:
                self.executor.submit(self.problem.log_likelihood, theta.copy()).result()
        except Exception:
            return True
        return False

    def _first_hypothesis_as_text(self, theta: FloatArray) -> str:
        return f"first of the {len(theta)} hypotheses asked for: {self._parameters_as_text(theta[0])}"

    def _parameters_as_text(self, row: FloatArray) -> str:
        return ", ".join(f"{name} = {value:.10g}" for name, value in zip(self.names, row, strict=True))
