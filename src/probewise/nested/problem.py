"""What is sampled: a prior and a log likelihood, evaluated in batches; the sampling coordinates; plain functions."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass, field, fields
from typing import Any, Protocol, Self, TypeAlias, cast

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import BoolArray, FloatArray, IntArray, floats
from probewise._kinds import checked_texts, require_callable, require_like
from probewise.errors import NotConvergedError, ParameterError, message_of, require
from probewise.priors import Coordinates, Marginal, Prior, Product, parse_prior, require_prior

AnyPrior: TypeAlias = "Prior | Mapping[str, Any] | Sequence[Any] | Callable[[FloatArray], Any]"

_EDGE = 1e-15  # from the ends of the unit cube, where normal scores are infinite
_ALLOWED_PRIOR = (
    "a prior such as Product({'x': Uniform(0.0, 1.0)}), a dict or list of distributions (probewise.priors, pairs (low, "
    "high) or frozen scipy.stats ones), or a function from the unit cube to parameters together with names=[...]"
)


class Samplable(Protocol):
    """A problem as the sampler needs it: `probewise.inference.SensorProblem`, or anything with the same attributes."""

    @property
    def prior(self) -> Prior:
        """The prior; its names are the problem's parameters."""
        ...

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood of a batch of hypotheses, (n_samples, n_params) -> (n_samples,)."""
        ...


# ------------------------------------------------------------------ sampling coordinates


@dataclass(frozen=True)
class Space:
    """Coordinates in which chains move: those of the prior, unbounded, or the unit cube, in which it is uniform.

    `periodic`: columns of the unit cube that are wrapped.
    """

    prior: Prior
    coordinates: Coordinates | None = None
    periodic: tuple[int, ...] = ()

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest value of each coordinate, (n_params,) both."""
        low, high = (0.0, 1.0) if self.coordinates is None else (-np.inf, np.inf)
        return np.full(len(self.prior.names), low), np.full(len(self.prior.names), high)

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, both (n, n_params)."""
        return self.prior.to_unit_cube(theta) if self.coordinates is None else self.coordinates.enter(theta)

    def leave(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n, n_params); also return the prior's log density in them, (n,)."""
        if self.coordinates is not None:
            return self.coordinates.leave(u)
        if self.periodic:
            u = u.copy()
            u[:, self.periodic] %= 1.0
        return self.prior.from_unit_cube(u), np.zeros(len(u))

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates from the prior, (n, n_params)."""
        draw = getattr(self.coordinates, "draw", None)  # of coordinates of which some match no possible parameters
        if draw is not None:
            return cast(FloatArray, draw(n, rng=rng))
        u = rng.random((n, len(self.prior.names)))
        return u if self.coordinates is None else self.enter(self.prior.from_unit_cube(u))

    def inside_mask(self, u: FloatArray) -> BoolArray:
        """Return a mask of the points, (n, n_params) -> (n,), strictly within the bounds of every coordinate."""
        low, high = self.bounds
        return np.asarray(((u > low) & (u < high)).all(axis=1))


@dataclass(frozen=True)
class _NormalScores:
    prior: Prior

    def enter(self, theta: FloatArray) -> FloatArray:
        return np.asarray(ndtri(np.clip(self.prior.to_unit_cube(theta), _EDGE, 1.0 - _EDGE)))

    def leave(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        cube = np.clip(ndtr(u), _EDGE, 1.0 - _EDGE)
        return self.prior.from_unit_cube(cube), -0.5 * (u * u + np.log(2 * np.pi)).sum(axis=1)

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        return rng.standard_normal((n, len(self.prior.names)))


def unbounded_space_of(prior: Prior) -> Space:
    """Return unbounded coordinates, the prior's, else normal scores; ParameterError without `to_unit_cube` either."""
    if hasattr(prior, "coordinates"):
        return Space(prior, prior.coordinates)
    require_prior("problem.prior", prior, "to_unit_cube")
    return Space(prior, _NormalScores(prior))


# ------------------------------------------------------------------ evaluated points


class Rows:
    """Base of frozen dataclasses whose fields are arrays with the same rows."""

    def take_rows(self, rows: IntArray | BoolArray | slice) -> Self:
        """Select rows by number, mask or slice."""
        return type(self)(*(array[rows] for array in vars(self).values()))

    @classmethod
    def join(cls, *parts: Self) -> Self:
        """Return the rows of all parts, in order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Points(Rows):
    """Evaluated points: `u` in the sampling coordinates and `theta` in parameters, both (n, n_params).

    `log_density` of the prior in `u`, `log_likelihood` and `label`, uniform random numbers that order points of equal
    likelihood, are (n,).
    """

    u: FloatArray
    theta: FloatArray
    log_density: FloatArray
    log_likelihood: FloatArray
    label: FloatArray

    def __len__(self) -> int:
        return len(self.u)

    def copy(self) -> Points:
        """Return the points with a copy of every array."""
        return Points(*(array.copy() for array in vars(self).values()))

    def overwrite_rows(self, rows: IntArray | BoolArray, points: Points, which: IntArray) -> None:
        """Overwrite these points' `rows` in place with the rows `which` of `points`."""
        for mine, new in zip(vars(self).values(), vars(points).values(), strict=True):
            mine[rows] = new.take(which, axis=0)

    def rows_by_rising_likelihood(self) -> IntArray:
        """Return the row numbers from the least to the greatest log likelihood, ties by label, (n,)."""
        return np.lexsort((self.label, self.log_likelihood))


@dataclass(frozen=True)
class Bound:
    """A lower bound in the order (log likelihood, label), set by a dead point.

    The label makes the order strict, so that the volume shrinks correctly on a plateau of the likelihood.
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
        prior, periodic = self.problem.prior, tuple(getattr(self.problem, "periodic", ()))
        self.names = prior.names
        if hasattr(prior, "coordinates"):
            require(not periodic, "periodic", periodic, "none: the prior has coordinates of its own")
        require(set(periodic) <= set(prior.names), "periodic", periodic, f"names among {prior.names}")
        self.space = Space(prior, getattr(prior, "coordinates", None), tuple(map(prior.names.index, periodic)))

    def points_from_known_values(self, theta: FloatArray, log_likelihood: FloatArray, label: FloatArray) -> Points:
        """Make points of hypotheses (n, n_params) whose log likelihood and label, (n,), are known; evaluate nothing."""
        u = self.space.enter(theta)
        return Points(u, theta, self.space.leave(u)[1], log_likelihood, label)

    def __call__(self, u: FloatArray, rng: np.random.Generator) -> Points:
        """Evaluate `u`, (n, n_params), inside the space, and give every point a new label; errors: `log_likelihood`."""
        return self.evaluate_mapped(u, *self.space.leave(u), rng)

    def evaluate_mapped(
        self, u: FloatArray, theta: FloatArray, log_density: FloatArray, rng: np.random.Generator
    ) -> Points:
        """Evaluate points that are already mapped from `u` to parameters and log prior density; give each a new label.

        Where the prior density is zero the log likelihood is -inf, without a call of the problem.
        """
        possible = np.isfinite(log_density)
        log_likelihood = np.full(len(u), -np.inf)
        log_likelihood[possible] = self.log_likelihood(theta[possible])
        return Points(u, theta, log_density, log_likelihood, rng.random(len(u)))

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Evaluate the log likelihood of hypotheses, (n, n_params) -> (n,), and count the calls.

        NotConvergedError if the likelihood raises, or returns the wrong shape, NaN or +inf; -inf (impossible) is
        allowed. OutOfCallsError beyond `most_calls`.
        """
        if not len(theta):
            return np.empty(0)  # a likelihood need not take an empty batch
        if self.most_calls is not None and self.n_calls + len(theta) > self.most_calls:
            raise OutOfCallsError
        n_parts = 1 if self.executor is None else min(self.n_parts or os.cpu_count() or 1, len(theta))
        parts = np.array_split(theta, n_parts)
        answers: list[object] = []
        try:
            for answer in self._likelihoods_of_parts(parts):
                answers.append(answer)  # one by one: their number identifies the part that failed
        except Exception as error:
            raise NotConvergedError(self._failure_message(error, parts[len(answers)])) from error
        # Concatenation copies: a likelihood may return the same array every time.
        values = np.concatenate([self._checked_answer(a, part) for a, part in zip(answers, parts, strict=True)])
        if not (fine := values < np.inf).all():
            at = int(np.argmin(fine))
            raise NotConvergedError(
                f"the log likelihood is {values[at]} at {self._parameters_as_text(theta[at])}; "
                "allowed: a finite number, or -inf where the hypothesis is impossible"
            )
        self.n_calls += len(theta)
        return values

    def _likelihoods_of_parts(self, parts: list[FloatArray]) -> Iterator[object]:
        # Copies: a likelihood that writes into its argument must not change the samples.
        if self.executor is None or len(parts) == 1:
            yield from (self.problem.log_likelihood(part.copy()) for part in parts)
            return
        # Not `map`: dask builds a task graph for it, which takes longer than submitting the parts.
        sent = [self.executor.submit(self.problem.log_likelihood, part.copy()) for part in parts]
        try:
            yield from (future.result() for future in sent)
        finally:
            for future in sent:
                future.cancel()

    def _checked_answer(self, answer: object, theta: FloatArray) -> FloatArray:
        """Convert the likelihood's answer to (n,) floats; NotConvergedError for masked, complex or misshapen ones."""
        returned = "the likelihood returned"
        if isinstance(answer, np.ma.MaskedArray) and (n_masked := int(np.ma.getmaskarray(answer).sum())):
            why = (
                f"{returned} a masked array with {n_masked} of {answer.size} values masked; allowed: "
                "plain numbers; return answer.filled(-np.inf) if masked means impossible"
            )
        elif np.asarray(answer).dtype.kind == "c":
            why = f"{returned} complex numbers; allowed: real ones; return their real part if that is meant"
        else:
            try:
                values = np.asarray(answer, dtype=np.float64)
                if values.shape == () and len(theta) == 1:
                    return values.reshape(1)  # many functions drop the axis of a batch of one, scipy.stats among them
                if values.shape == (len(theta),):
                    return values
                why = (
                    f"{returned} shape {values.shape}; allowed: ({len(theta)},), one number per hypothesis: "
                    f"theta is a batch of shape {theta.shape}, one hypothesis per row"
                )
            except (TypeError, ValueError, OverflowError) as error:
                why = f"{returned} something other than numbers ({error})"
        raise NotConvergedError(f"{why}; {self._first_hypothesis_as_text(theta)}")

    def _failure_message(self, error: Exception, theta: FloatArray) -> str:
        """Describe the failure of a batch, (n, n_params), and name a hypothesis that fails by itself, if any."""
        why = message_of(error)
        if self.executor is not None and "pickle" in why.lower():
            return (
                f"the problem cannot be sent to the executor's workers ({why}); allowed: one that pickles, so made of "
                "functions and classes at the top level of a module, without lambdas; or take a ThreadPoolExecutor"
            )

        def fails(some: FloatArray) -> bool:
            try:
                if self.executor is None:
                    self.problem.log_likelihood(some.copy())
                else:
                    self.executor.submit(self.problem.log_likelihood, some.copy()).result()
            except Exception:
                return True
            return False

        if not isinstance(error, BrokenExecutor):  # a hypothesis that killed its worker could kill this process too
            culprit = theta
            while len(culprit) > 1:
                half = culprit[: len(culprit) // 2]
                culprit = half if fails(half) else culprit[len(culprit) // 2 :]
            if fails(culprit):
                return f"the likelihood raised {why}; at {self._parameters_as_text(culprit[0])}"
        batch = f"it is given a batch theta of shape {theta.shape}, one hypothesis per row"
        return f"the likelihood raised {why}; {batch}; {self._first_hypothesis_as_text(theta)}"

    def _first_hypothesis_as_text(self, theta: FloatArray) -> str:
        return f"first of the {len(theta)} hypotheses asked for: {self._parameters_as_text(theta[0])}"

    def _parameters_as_text(self, row: FloatArray) -> str:
        return ", ".join(f"{name} = {value:.10g}" for name, value in zip(self.names, row, strict=True))


# ------------------------------------------------------------------ problems of plain functions


@dataclass(frozen=True)
class FunctionProblem:
    """A problem of plain functions; `make_problem` makes it and describes the fields."""

    function: Callable[..., Any]
    prior: Prior
    vectorized: bool = False
    pass_dict: bool = False
    periodic: tuple[str, ...] = ()

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood of a batch, (n_samples, n_params) -> (n_samples,)."""
        if self.vectorized:
            given = dict(zip(self.prior.names, theta.T, strict=True)) if self.pass_dict else theta
            return self.function(given)  # type: ignore[no-any-return]
        names = self.prior.names
        rows = (dict(zip(names, row.tolist(), strict=True)) for row in theta) if self.pass_dict else theta
        answers = []
        for answer in map(self.function, rows):
            if np.size(answer) != 1:
                raise ValueError(
                    f"the likelihood of one point has shape {np.shape(answer)}; allowed: one number; a function of "
                    "many points at once needs vectorized=True"
                )
            answers.append(np.nan if np.ma.isMaskedArray(answer) else np.asarray(answer).reshape(())[()])
        return np.array(answers)


def make_problem(
    log_likelihood: Callable[..., Any],
    prior: AnyPrior,
    *,
    names: Sequence[str] | None = None,
    vectorized: bool = False,
    pass_dict: bool = False,
    periodic: Sequence[str] = (),
) -> FunctionProblem:
    """Make a problem of a log likelihood and a prior, for every function of `probewise.nested`.

    Parameters
    ----------
    log_likelihood
        Natural log of the likelihood of one point, (n_params,) -> a number; -inf where it is impossible.
    prior
        A prior with names (`probewise.priors`); distributions in a dict by name, or in a list; or a function that maps
        a point of the unit cube to parameters, both (n_params,). Distributions are those of `probewise.priors`, (low,
        high), ("log", low, high), ("normal", mean, sd), or frozen continuous ones of scipy.stats. A function suffices
        for `run`; `refine`, `update` and `diversify` need the prior's density or inverse.
    names, periodic
        Names of the parameters, in order: required if the prior is a function; for a list p0, p1, ... by default; and
        of those whose range is periodic.
    vectorized, pass_dict
        Whether the functions take many points at once, (n_samples, n_params), and return one result per point, much
        faster with NumPy; whether the likelihood takes a dict of parameters by name instead of an array.

    ParameterError if an argument has the wrong type, or names and prior do not match.
    """
    require_callable("log_likelihood", log_likelihood, "a function of a point, such as lambda x: -0.5 * (x**2).sum()")
    named = _as_named_prior(prior, names, vectorized)
    allowed = f"names among {named.names}"
    wrapped = checked_texts("periodic", periodic, allowed)
    require(set(wrapped) <= set(named.names), "periodic", periodic, allowed)
    return FunctionProblem(log_likelihood, named, vectorized, pass_dict, wrapped)


def as_problem(
    problem: object,
    prior: AnyPrior | None,
    names: Sequence[str] | None,
    vectorized: bool,
    pass_dict: bool,
    periodic: Sequence[str],
) -> Samplable:
    """Return a problem as it is, or make one of a log likelihood and its prior by `make_problem`."""
    if hasattr(problem, "log_likelihood") or isinstance(problem, type):
        if prior is not None or names is not None or vectorized or pass_dict or periodic:
            found = "given beside a problem that has its own"
            allowed = "these beside a log likelihood, a function; or nested.run(problem, rng=rng)"
            raise ParameterError("prior, names, vectorized, pass_dict, periodic", found, allowed)
        return cast(Samplable, problem)
    if prior is None:
        allowed = "a problem with a prior and a log_likelihood(theta), such as inference.SensorProblem; or a function"
        raise ParameterError(
            "problem", problem, f"{allowed} with its prior: nested.run(log_likelihood, prior, rng=rng)"
        )
    function = cast("Callable[..., Any]", problem)
    return make_problem(function, prior, names=names, vectorized=vectorized, pass_dict=pass_dict, periodic=periodic)


_FROM_CUBE = "what the prior makes of a point of the unit cube"


@dataclass(frozen=True)
class _TransformPrior:
    """A prior given only as a function from the unit cube, without density or inverse."""

    names: tuple[str, ...]
    function: Callable[[FloatArray], Any]
    vectorized: bool

    def __post_init__(self) -> None:
        shape = self.from_unit_cube(np.full((2, len(self.names)), 0.5)).shape
        if shape != (2, len(self.names)):
            points = "two points (2, n_params)" if self.vectorized else "one point (n_params,)"
            got = shape if self.vectorized else shape[1:]
            wanted = f"the {len(self.names)} parameters of names, {', '.join(self.names)}"
            raise ParameterError("prior", f"a function that makes {points} into shape {got}", wanted)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        # Many transforms modify their argument in place and return it.
        if self.vectorized:
            return floats(self.function(u.copy()), _FROM_CUBE)
        return np.array([floats(self.function(row.copy()), _FROM_CUBE).ravel() for row in u]).reshape(len(u), -1)


@dataclass(frozen=True)
class _ScipyMarginal:
    distribution: Any

    def from_unit(self, u: FloatArray) -> FloatArray:
        quantile = getattr(self.distribution, "ppf", None) or self.distribution.icdf
        return np.asarray(quantile(u), dtype=np.float64)

    def to_unit(self, value: FloatArray) -> FloatArray:
        return np.asarray(self.distribution.cdf(value), dtype=np.float64)

    def log_prob(self, value: FloatArray) -> FloatArray:
        return np.asarray(self.distribution.logpdf(value), dtype=np.float64)


def _as_named_prior(prior: AnyPrior, names: Sequence[str] | None, vectorized: bool) -> Prior:
    given = None if names is None else checked_texts("names", names, "names of the parameters")
    made: Prior
    require(not isinstance(prior, type), "prior", prior, _ALLOWED_PRIOR)
    if isinstance(prior, Mapping):
        made = Product({str(name): _as_marginal(f"prior[{name!r}]", one) for name, one in prior.items()})
    elif hasattr(prior, "names") and hasattr(prior, "from_unit_cube"):
        made = cast(Prior, prior)
    elif isinstance(prior, Sequence) and not isinstance(prior, str | bytes):
        chosen = given if given is not None else tuple(f"p{i}" for i in range(len(prior)))
        require(len(chosen) == len(prior), "names", names, f"{len(prior)} names, one for each distribution")
        require(len(set(chosen)) == len(chosen), "names", names, "each name once")
        made = Product(
            {n: _as_marginal(f"prior[{i}]", one) for i, (n, one) in enumerate(zip(chosen, prior, strict=True))}
        )
    elif callable(prior) and not hasattr(prior, "logpdf"):
        if given is None:
            allowed = "the names of the parameters, since the prior is a function: names=['x', 'y']"
            raise ParameterError("names", None, allowed)
        require(len(set(given)) == len(given), "names", names, "each name once")
        made = cast(Prior, _TransformPrior(given, prior, vectorized))
    else:
        raise ParameterError("prior", prior, _ALLOWED_PRIOR)
    require(made.names, "prior", prior, "one parameter or more")
    require(len(set(made.names)) == len(made.names), "names of the prior", made.names, "each name once")
    require(given is None or given == made.names, "names", names, f"those of the prior, {made.names}, or none")
    return made


def _as_marginal(name: str, one: Any) -> Marginal:
    if isinstance(one, tuple | list | Marginal):
        return parse_prior(name, one)
    has_quantile = hasattr(one, "ppf") or hasattr(one, "icdf")
    if has_quantile and hasattr(one, "cdf") and hasattr(one, "logpdf") and not isinstance(one, type):
        frozen = "a frozen distribution, with its parameters: scipy.stats.norm(0, 1)"
        require(not hasattr(one, "freeze"), name, one, frozen)
        return _ScipyMarginal(one)
    raise ParameterError(
        name,
        one,
        "Uniform(low, high) or a pair (low, high), LogUniform(low, high), Normal(mean, sd), or a frozen continuous "
        "scipy.stats one",
    )
