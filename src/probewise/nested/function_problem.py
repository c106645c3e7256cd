"""Make a problem from plain functions: a log likelihood of one point or many, and a prior in any usual form."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, TypeAlias, cast

import numpy as np

from probewise._arrays import FloatArray
from probewise._kinds import require_callable
from probewise.errors import ParameterError
from probewise.nested.evaluate import Samplable
from probewise.priors import Marginal, Prior, Product, Uniform

AnyPrior: TypeAlias = "Prior | Mapping[str, Any] | Sequence[Any] | Callable[[FloatArray], Any]"

_ALLOWED_PRIOR = (
    "a prior such as Product({'x': Uniform(0.0, 1.0)}), a dict or list of distributions (probewise.priors, pairs (low, "
    "high) or frozen scipy.stats ones), or a function from the unit cube to parameters together with names=[...]"
)


@dataclass(frozen=True)
class _ScipyMarginal:
    """A frozen continuous distribution of scipy.stats as a marginal."""

    distribution: Any

    def from_unit(self, u: FloatArray) -> FloatArray:
        quantile = getattr(self.distribution, "ppf", None) or self.distribution.icdf
        return np.asarray(quantile(u), dtype=np.float64)

    def to_unit(self, value: FloatArray) -> FloatArray:
        return np.asarray(self.distribution.cdf(value), dtype=np.float64)

    def log_prob(self, value: FloatArray) -> FloatArray:
        return np.asarray(self.distribution.logpdf(value), dtype=np.float64)


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
        if self.vectorized:
            return np.asarray(self.function(u.copy()), dtype=np.float64)
        # Many transforms modify their argument in place and return it.
        return np.array([np.array(self.function(row.copy()), dtype=np.float64) for row in u]).reshape(len(u), -1)


@dataclass(frozen=True)
class FunctionProblem:
    """A problem made of plain functions by `make_problem`, for every function of `probewise.nested`.

    Attributes
    ----------
    function
        The log likelihood as given.
    prior
        The prior, with names.
    vectorized, pass_dict
        How the function is called; see `make_problem`.
    periodic
        Names of the periodic parameters.
    """

    function: Callable[..., Any]
    prior: Prior
    vectorized: bool = False
    pass_dict: bool = False
    periodic: tuple[str, ...] = field(default=())

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood of a batch, (n_samples, n_params) -> (n_samples,)."""
        if self.vectorized:
            given = dict(zip(self.prior.names, theta.T, strict=True)) if self.pass_dict else theta
            return self.function(given)  # type: ignore[no-any-return]
        return np.array([self._log_likelihood_of_one(row) for row in theta])

    def _log_likelihood_of_one(self, row: FloatArray) -> Any:
        if self.pass_dict:
            answer = self.function(dict(zip(self.prior.names, row.tolist(), strict=True)))
        else:
            answer = self.function(row)
        if np.size(answer) != 1:
            raise ValueError(
                f"the likelihood of one point has shape {np.shape(answer)}; allowed: one number; a function of many "
                "points at once needs vectorized=True"
            )
        return np.asarray(answer).reshape(())[()] if not np.ma.isMaskedArray(answer) else np.nan


def make_problem(
    log_likelihood: Callable[..., Any],
    prior: AnyPrior,
    *,
    names: Sequence[str] | None = None,
    vectorized: bool = False,
    pass_dict: bool = False,
    periodic: Sequence[str] = (),
) -> FunctionProblem:
    """Make a problem of a log likelihood and a prior.

    Parameters
    ----------
    log_likelihood
        Natural log of the likelihood of one point, (n_params,) -> a number; -inf where it is impossible.
    prior
        A prior with names (`probewise.priors`); a dict of distributions by name; a list of distributions; or a function
        that maps a point of the unit cube to parameters, both (n_params,). Distributions are those of
        `probewise.priors`, pairs (low, high) for uniform ones, or frozen continuous ones of scipy.stats.
    names
        Names of the parameters, in order: required if the prior is a function; for a list p0, p1, ... by default.
    vectorized
        Whether the functions take many points at once, (n_samples, n_params), and return one result per point: much
        faster with NumPy.
    pass_dict
        Whether the likelihood takes a dict of parameters by name instead of an array.
    periodic
        Names of parameters whose range is periodic.

    Returns
    -------
    FunctionProblem
        A problem for `run`, `refine`, `repartitioned`, `update` and `diversify`. A prior given as a function from the
        unit cube suffices for `run`; the others need its density or inverse and raise an error without.

    Raises
    ------
    ParameterError
        If an argument has the wrong type, or names and prior do not match.
    """
    require_callable("log_likelihood", log_likelihood, "a function of a point, such as lambda x: -0.5 * (x**2).sum()")
    named = _as_named_prior(prior, names, vectorized)
    unknown = [name for name in periodic if name not in named.names]
    if isinstance(periodic, str) or unknown:
        raise ParameterError("periodic", periodic, f"names among {named.names}")
    return FunctionProblem(log_likelihood, named, vectorized, pass_dict, tuple(periodic))


def _as_named_prior(prior: AnyPrior, names: Sequence[str] | None, vectorized: bool) -> Prior:
    """Convert a prior in any form that `make_problem` takes to one with names; ParameterError for anything else."""
    if isinstance(names, str):
        raise ParameterError("names", names, "a list of names: names=['x', 'y']")
    given = None if names is None else tuple(str(name) for name in names)
    if isinstance(prior, type):
        raise ParameterError("prior", prior, _ALLOWED_PRIOR)
    if isinstance(prior, Mapping):
        made: Prior = Product({str(name): _as_marginal(f"prior[{name!r}]", one) for name, one in prior.items()})
    elif isinstance(prior, Prior) or (hasattr(prior, "names") and hasattr(prior, "from_unit_cube")):
        made = prior  # type: ignore[assignment]
    elif isinstance(prior, Sequence) and not isinstance(prior, str | bytes):
        made = _product_of_list(prior, given, names)
    elif callable(prior) and not hasattr(prior, "logpdf"):
        if given is None:
            allowed = "the names of the parameters, since the prior is a function: names=['x', 'y']"
            raise ParameterError("names", None, allowed)
        if len(set(given)) != len(given):
            raise ParameterError("names", names, "each name once")
        return _TransformPrior(given, prior, vectorized)  # type: ignore[return-value]
    else:
        raise ParameterError("prior", prior, _ALLOWED_PRIOR)
    if len(set(made.names)) != len(made.names):
        raise ParameterError("names of the prior", made.names, "each name once")
    if given is not None and given != made.names:
        raise ParameterError("names", names, f"those of the prior, {made.names}, or none")
    return made


def _product_of_list(prior: Sequence[Any], given: tuple[str, ...] | None, names: Sequence[str] | None) -> Product:
    """Make a prior of a list of distributions, named `given` or p0, p1, ...; ParameterError if they do not match."""
    own = given if given is not None else tuple(f"p{i}" for i in range(len(prior)))
    if len(own) != len(prior):
        raise ParameterError("names", names, f"{len(prior)} names, one for each distribution")
    made = Product({n: _as_marginal(f"prior[{i}]", one) for i, (n, one) in enumerate(zip(own, prior, strict=True))})
    if len(made.names) != len(prior):
        raise ParameterError("names", names, "each name once")
    return made


def _as_marginal(name: str, one: Any) -> Marginal:
    """Convert a distribution in any of its forms to a marginal; `name` is its name in error messages."""
    if isinstance(one, tuple | list) and len(one) == 2 and all(isinstance(end, Real) for end in one):
        return Uniform(float(one[0]), float(one[1]))
    if isinstance(one, Marginal):
        return one
    if _is_scipy_distribution(one):
        if hasattr(one, "freeze"):
            raise ParameterError(name, one, "a frozen distribution, with its parameters: scipy.stats.norm(0, 1)")
        return _ScipyMarginal(one)
    raise ParameterError(
        name,
        one,
        "Uniform(low, high) or a pair (low, high), LogUniform(low, high), Normal(mean, sd), or a frozen continuous "
        "scipy.stats one",
    )


def _is_scipy_distribution(one: Any) -> bool:
    quantile = hasattr(one, "ppf") or hasattr(one, "icdf")
    return quantile and hasattr(one, "cdf") and hasattr(one, "logpdf") and not isinstance(one, type)


def as_problem(
    problem: object,
    prior: AnyPrior | None,
    names: Sequence[str] | None,
    vectorized: bool,
    pass_dict: bool,
    periodic: Sequence[str],
) -> Samplable:
    """Return a problem as it is, or make one of a log likelihood and its prior by `make_problem`.

    ParameterError if a problem comes with one of the other arguments, or a likelihood without a prior.
    """
    if hasattr(problem, "log_likelihood") or isinstance(problem, type):
        if prior is not None or names is not None or vectorized or pass_dict or periodic:
            raise ParameterError(
                "prior, names, vectorized, pass_dict, periodic",
                "given beside a problem that has its own",
                "these beside a log likelihood, a function; or nested.run(problem, rng=rng)",
            )
        return cast(Samplable, problem)
    if prior is None:
        allowed = "a problem with a prior and a log_likelihood(theta), such as inference.SensorProblem; or a function"
        raise ParameterError(
            "problem", problem, f"{allowed} with its prior: nested.run(log_likelihood, prior, rng=rng)"
        )
    return make_problem(
        cast("Callable[..., Any]", problem),
        prior,
        names=names,
        vectorized=vectorized,
        pass_dict=pass_dict,
        periodic=periodic,
    )
