"""Prior distributions of named parameters.

The packages of shapes, sensors and effects all import this module, so it imports none of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.special import erfc, gammainc, gammaincc, gammainccinv, gammaincinv, ndtr, ndtri

from probewise._arrays import FloatArray, floats, logsumexp
from probewise._kinds import checked_number, checked_pair, require_kind, require_like
from probewise.errors import ParameterError, ShapeError, require

__all__ = ["Joint", "LogNormal", "LogUniform", "Marginal", "Normal", "Prior", "Product", "Uniform", "require_prior"]


@runtime_checkable
class Prior(Protocol):
    """A distribution of several named parameters, with a map from the unit cube and back."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the columns of theta."""

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map points of the unit cube, (n_samples, n_params), to parameters of that shape: uniform draws to draws."""

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map parameters (n_samples, n_params) to points of the unit cube that `from_unit_cube` maps back to them."""

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the natural log of the density, shape (n_samples,); -inf outside the support."""


class Coordinates(Protocol):
    """Coordinates in which a sampler explores the posterior, simpler there than in parameters or unit cube.

    A prior with a property `coordinates` of this kind is sampled in them. A quantity that the readings
    determine sharply should be an axis there, not a curved surface across several axes.
    """

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters of positive prior density to coordinates, both (n_samples, n_params)."""

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (n_samples, n_params) to parameters; also return the prior's log density in the coordinates.

        Any finite coordinates are allowed; the density, (n_samples,), is -inf where they match no parameters.
        """


@runtime_checkable
class Marginal(Protocol):
    """A distribution of one parameter; its methods take and return arrays of any one shape."""

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function: probability in 0..1 -> value; 0 and 1 map to the ends, infinite or not."""

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, the inverse of `from_unit`: value -> probability."""

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape; -inf outside the support."""


def _require_arguments(marginal: Any, kind: type[Any], holds: Callable[..., bool], allowed: str) -> None:
    """Raise ParameterError unless the arguments of a kind of distribution are numbers for which a condition holds."""
    values = {field.name: getattr(marginal, field.name) for field in fields(kind)}
    for name, value in values.items():
        checked_number(name, value)
    require(holds(*values.values()), f"{kind.__name__}({', '.join(values)})", (*values.values(),), allowed)


@dataclass(frozen=True)
class Uniform:
    """Uniform distribution from `low` to `high`."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _require_arguments(self, Uniform, lambda low, high: -math.inf < low < high < math.inf, "finite, low < high")

    def from_unit(self, u: FloatArray) -> FloatArray:
        return self.low + (self.high - self.low) * u

    def to_unit(self, value: FloatArray) -> FloatArray:
        return np.clip((value - self.low) / (self.high - self.low), 0.0, 1.0)

    def log_prob(self, value: FloatArray) -> FloatArray:
        inside = (value >= self.low) & (value <= self.high)
        return np.where(inside, -math.log(self.high - self.low), -np.inf)

    def __str__(self) -> str:
        return f"uniform {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class LogUniform:
    """Log-uniform distribution from `low` > 0 to `high` (Jeffreys' prior of a scale, made proper)."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _require_arguments(self, LogUniform, lambda low, high: 0 < low < high < math.inf, "0 < low < high, finite")

    def from_unit(self, u: FloatArray) -> FloatArray:
        return np.asarray(self.low * (self.high / self.low) ** u)

    def to_unit(self, value: FloatArray) -> FloatArray:
        return np.asarray(np.log(np.clip(value, self.low, self.high) / self.low) / math.log(self.high / self.low))

    def log_prob(self, value: FloatArray) -> FloatArray:
        inside = (value >= self.low) & (value <= self.high)
        safe = np.where(inside, value, self.low)
        return np.where(inside, -np.log(safe) - math.log(math.log(self.high / self.low)), -np.inf)

    def __str__(self) -> str:
        return f"log-uniform {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Normal:
    """Normal distribution with `mean` and standard deviation `sd`."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        _require_arguments(self, Normal, lambda mean, sd: math.isfinite(mean) and 0 < sd < math.inf, "finite, sd > 0")

    def from_unit(self, u: FloatArray) -> FloatArray:
        return self.mean + self.sd * np.asarray(ndtri(u))

    def to_unit(self, value: FloatArray) -> FloatArray:
        return np.asarray(ndtr((value - self.mean) / self.sd))

    def log_prob(self, value: FloatArray) -> FloatArray:
        z = (value - self.mean) / self.sd
        return np.asarray(-0.5 * z * z - math.log(self.sd * math.sqrt(2 * math.pi)))

    def __str__(self) -> str:
        return f"normal {self.mean:g} ± {self.sd:g}"


@dataclass(frozen=True)
class LogNormal:
    """Log-normal distribution of a positive number, by its `median` and the sd `log_sd` of its natural logarithm."""

    median: float
    log_sd: float

    def __post_init__(self) -> None:
        _require_arguments(self, LogNormal, lambda *both: all(0 < x < math.inf for x in both), "greater than 0, finite")

    def from_unit(self, u: FloatArray) -> FloatArray:
        return np.asarray(self.median * np.exp(self.log_sd * ndtri(u)))

    def to_unit(self, value: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.asarray(ndtr(np.log(np.maximum(value, 0.0) / self.median) / self.log_sd))

    def log_prob(self, value: FloatArray) -> FloatArray:
        safe = np.where(value > 0, value, self.median)
        z = np.log(safe / self.median) / self.log_sd
        density = -0.5 * z * z - np.log(safe * self.log_sd * math.sqrt(2 * math.pi))
        return np.where(value > 0, density, -np.inf)

    def __str__(self) -> str:
        return f"log-normal about {self.median:g}"


def parse_prior(what: str, given: Any) -> Marginal:
    """Parse a user's prior: (low, high), ("log", low, high), ("normal", mean, sd), or a prior object.

    Raises ParameterError if it is none of these, or has no mass; `what` is its name there.
    """
    allowed = '(low, high), ("log", low, high), ("normal", mean, sd), or a prior of probewise.priors'
    if isinstance(given, Marginal):
        return given
    require(isinstance(given, Sequence) and not isinstance(given, str) and given, what, given, allowed)
    kinds: dict[object, Callable[[float, float], Marginal]] = {"log": LogUniform, "normal": Normal, "uniform": Uniform}
    kind, numbers = (given[0], given[1:]) if isinstance(given[0], str) else ("uniform", given)
    require(kind in kinds and bool not in map(type, numbers), what, given, allowed)
    low, high = checked_pair(what, numbers, allowed)
    try:
        return kinds[kind](low, high)
    except ParameterError as error:
        raise ParameterError(what, given, f"{error.allowed}: a prior with mass") from error


@dataclass(frozen=True)
class Product:
    """Joint distribution of independent parameters: `marginals`, a mapping of name to the distribution of one.

    `Product({})` is the prior of a model without free parameters.
    """

    marginals: Mapping[str, Marginal]

    def __post_init__(self) -> None:
        allowed = "distributions by name: Product({'x_mm': Uniform(0.0, 1.0), 'sd': LogUniform(0.1, 10.0)})"
        require_kind("marginals", self.marginals, Mapping, allowed)
        for name, marginal in self.marginals.items():
            require_kind("name of a marginal", name, str, "a text")
            one = "a distribution of one parameter, such as Uniform(low, high), LogUniform(low, high), Normal(mean, sd)"
            require_like(f"marginals[{name!r}]", marginal, ("from_unit", "to_unit", "log_prob"), one)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.marginals)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self._mapped(u, "from_unit")

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        return self._mapped(theta, "to_unit")

    def _mapped(self, values: FloatArray, method: str) -> FloatArray:
        values = checked_columns(values, self.names)
        columns = [getattr(m, method)(values[:, i]) for i, m in enumerate(self.marginals.values())]
        return np.stack(columns, axis=-1) if columns else values

    def log_prob(self, theta: FloatArray) -> FloatArray:
        theta = checked_columns(theta, self.names)
        return sum((m.log_prob(theta[:, i]) for i, m in enumerate(self.marginals.values())), np.zeros(len(theta)))


@dataclass(frozen=True)
class Joint:
    """Joint distribution of independent priors `parts`, each of one or more parameters; columns in order of parts."""

    parts: tuple[Prior, ...]

    def __post_init__(self) -> None:
        require_kind("parts", self.parts, (tuple, list), "priors: Joint((Product({...}), Product({...})))")
        for k, part in enumerate(self.parts):
            require_prior(f"parts[{k}]", part)
        object.__setattr__(self, "parts", tuple(self.parts))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in part.names)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        columns = [p.from_unit_cube(c) for p, c in self._parts_with_columns(u)]
        return np.concatenate([np.empty((len(u), 0)), *columns], axis=-1)

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        columns = [p.to_unit_cube(c) for p, c in self._parts_with_columns(theta)]
        return np.concatenate([np.empty((len(theta), 0)), *columns], axis=-1)

    def log_prob(self, theta: FloatArray) -> FloatArray:
        return sum((part.log_prob(c) for part, c in self._parts_with_columns(theta)), np.zeros(len(theta)))

    def _parts_with_columns(self, columns: FloatArray) -> list[tuple[Prior, FloatArray]]:
        columns = checked_columns(columns, self.names)
        ends = np.cumsum([len(p.names) for p in self.parts])
        return [(p, columns[:, end - len(p.names) : end]) for p, end in zip(self.parts, ends, strict=True)]


def require_prior(name: str, prior: object, *more: str) -> None:
    """Raise ParameterError unless `prior` has `names`, `from_unit_cube` and the methods named in `more`."""
    allowed = "a prior of named parameters, such as Product({'x_mm': Uniform(0.0, 1.0)})"
    require_like(name, prior, ("names", "from_unit_cube"), allowed)
    missing = [method for method in more if not hasattr(prior, method)]
    require(not missing, name, prior, f"a prior with {' and '.join(missing)}; see probewise.priors.Prior")


def checked_columns(values: FloatArray, names: tuple[str, ...]) -> FloatArray:
    """Return parameters as floats; raise ShapeError unless their shape is (n_samples, number of `names`)."""
    array = floats(values, "parameters")
    if array.ndim != 2 or array.shape[1] != len(names):
        raise ShapeError(f"parameters have shape {array.shape}; allowed: (n_samples, {len(names)}) for {names}")
    return array


# Heavy-tailed priors of a size: highest density at zero, large values never ruled out.
_N_SCALES = 9  # over the range of sds; a wider one has as many to a decade
_N_SIZES = 1500  # in the table of quantiles
_LEAST_TAIL = 1e-250  # of both tails of the table
_FARTHEST_SD = 1e-16  # distance from the ends of the unit cube, 8.2 standard deviations


SMALLEST_AND_LARGEST = (0.05, 25.0)
"""Smallest and largest sd of the mixture, in typical sizes: with a narrower range large effects are misnamed."""


@dataclass(frozen=True)
class HeavyTailedPrior:
    """Scale mixture of normal distributions about zero, by default with sds from 0.05 to 25 times a typical size.

    The weights are equal, so the density falls about as 1/abs(x) between the sds `smallest` and `largest`, in typical
    sizes, and is proper. With `positive` the distribution is folded onto x >= 0.
    """

    typical: float
    positive: bool = False
    smallest: float = SMALLEST_AND_LARGEST[0]
    largest: float = SMALLEST_AND_LARGEST[1]

    def __post_init__(self) -> None:
        require(0 < self.typical < math.inf, "HeavyTailedPrior(typical)", self.typical, "greater than 0, finite")
        small, allowed = self.smallest, f"0 < smallest < {self.largest:g}"
        require(0 < small < self.largest, "HeavyTailedPrior(smallest)", small, allowed)

    @cached_property
    def component_sds(self) -> FloatArray:
        """Sds of the normal distributions of equal weight that it mixes, (n_components,)."""
        return self.typical * _relative_component_sds(self.smallest, self.largest)

    def log_prob(self, value: FloatArray) -> FloatArray:
        x = np.asarray(value, dtype=np.float64)[..., None] / self.component_sds
        terms = np.exp(-0.5 * x * x) / (self.component_sds * math.sqrt(2 * math.pi))
        with np.errstate(divide="ignore"):
            density = np.log(terms.mean(axis=-1))
        if not self.positive:
            return np.asarray(density)
        return np.where(np.asarray(value) >= 0, density + math.log(2.0), -np.inf)

    def from_unit(self, u: FloatArray) -> FloatArray:
        u = np.asarray(u, dtype=np.float64)
        if self.positive:
            tail, sign = (1.0 - u) / 2, np.ones_like(u)
        else:
            tail, sign = np.minimum(u, 1.0 - u), np.where(u < 0.5, -1.0, 1.0)
        goal = -np.log(2 * np.clip(tail, 1e-15, 0.5))
        sds, size, depth = _tabulated_quantiles(self.smallest, self.largest)
        x = np.interp(goal, depth, size)
        # One Newton step from the table is exact to 1e-10 of the tail.
        scaled = x[..., None] / (sds * math.sqrt(2))
        upper = np.maximum(0.5 * erfc(scaled).mean(axis=-1), 1e-300)
        density = (np.exp(-(scaled**2)) / (sds * math.sqrt(2 * math.pi))).mean(axis=-1)
        x = np.clip(x + (np.log(2 * upper) + goal) * upper / density, 0.0, size[-1])
        return np.asarray(sign * self.typical * x)

    def to_unit(self, value: FloatArray) -> FloatArray:
        value = np.asarray(value, dtype=np.float64)
        tail = np.asarray(0.5 * erfc(np.abs(value)[..., None] / (self.component_sds * math.sqrt(2))).mean(axis=-1))
        if self.positive:
            return np.where(value > 0, 1.0 - 2.0 * tail, 0.0)
        return np.asarray(np.where(value < 0, tail, 1.0 - tail))

    def __str__(self) -> str:
        kind = "positive heavy-tailed" if self.positive else "heavy-tailed about 0"
        return f"{kind}, typical {self.typical:g}"


def _relative_component_sds(smallest: float, largest: float) -> FloatArray:
    """Return the sds of the mixture's components, in typical sizes: evenly spaced in their logarithm."""
    decades = math.log(largest / SMALLEST_AND_LARGEST[1]) / math.log(SMALLEST_AND_LARGEST[1] / SMALLEST_AND_LARGEST[0])
    return np.asarray(np.geomspace(smallest, largest, _N_SCALES + max(math.ceil((_N_SCALES - 1) * decades), 0)))


@lru_cache(maxsize=16)
def _tabulated_quantiles(smallest: float, largest: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the sds of the mixture of typical size one, sizes from 0 upwards, and -log(2 x upper tail) at each."""
    sds = _relative_component_sds(smallest, largest)
    size = np.concatenate([[0.0], np.geomspace(1e-5, 12.0 * largest, 5_000)])
    upper = 0.5 * erfc(size[:, None] / (sds * math.sqrt(2))).mean(axis=-1)
    return sds, size, -np.log(2 * upper)


@dataclass(frozen=True)
class LogHeavyTailedPrior:
    """Prior of a positive factor or exponent about one: its logarithm has a heavy-tailed prior about zero."""

    typical_log: float
    smallest: float = SMALLEST_AND_LARGEST[0]

    @cached_property
    def _prior_of_log(self) -> HeavyTailedPrior:
        return HeavyTailedPrior(self.typical_log, smallest=self.smallest)

    def from_unit(self, u: FloatArray) -> FloatArray:
        return np.exp(self._prior_of_log.from_unit(u))

    def to_unit(self, value: FloatArray) -> FloatArray:
        value = np.asarray(value, dtype=np.float64)
        return np.where(value > 0, self._prior_of_log.to_unit(np.log(np.where(value > 0, value, 1.0))), 0.0)

    def log_prob(self, value: FloatArray) -> FloatArray:
        value = np.asarray(value, dtype=np.float64)
        safe = np.where(value > 0, value, 1.0)
        return np.where(value > 0, self._prior_of_log.log_prob(np.log(safe)) - np.log(safe), -np.inf)

    def __str__(self) -> str:
        return f"logarithm {self._prior_of_log}"


@dataclass(frozen=True)
class SharedScalePrior:
    """Values that are normal about zero with the same sd, log-uniform over the sds of `each`; `names` are two or more.

    Independent heavy-tailed priors, such as `each`, of one value, leave the size of every value open. Where one is
    known, here the others are expected to be as large. The distribution depends on the root of the sum of squares
    alone, so that standard-normal coordinates have the direction of the values, and their length is that of equal
    probability.
    """

    names: tuple[str, ...]
    each: HeavyTailedPrior

    @property
    def typical(self) -> float:
        """Typical size of a value."""
        return self.each.typical

    @cached_property
    def component_sds(self) -> FloatArray:
        """Sds of the normal distributions of equal weight that it mixes, (n_components,)."""
        return self.typical * _sds(len(self.names), self.each.smallest, self.each.largest)

    @property
    def _ratios(self) -> tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]:
        return _ratios_of_lengths(len(self.names), self.each.smallest, self.each.largest)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        z = ndtri(np.clip(checked_columns(u, self.names), _FARTHEST_SD, 1 - _FARTHEST_SD))
        return np.asarray(self.typical * z * self._ratios[0](np.linalg.norm(z, axis=1, keepdims=True)))

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        values = checked_columns(theta, self.names) / self.typical
        return np.asarray(ndtr(values / self._ratios[1](np.linalg.norm(values, axis=1, keepdims=True))))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        values = checked_columns(theta, self.names)
        n, sds = len(self.names), self.component_sds
        squares = np.sum(values**2, axis=1)[:, None]
        terms = -0.5 * squares / sds**2 - n * np.log(sds)
        return np.asarray(logsumexp(terms, axis=1) - math.log(len(sds)) - 0.5 * n * math.log(2 * math.pi))


def _sds(n_values: int, smallest: float, largest: float) -> FloatArray:
    """Return sds, evenly spaced in their logarithm, so close that lengths of vectors of neighbouring ones overlap."""
    spread_of_log_length = 1 / math.sqrt(2 * n_values)
    return np.geomspace(smallest, largest, 2 + math.ceil(math.log(largest / smallest) / spread_of_log_length))


@lru_cache(maxsize=64)
def _ratios_of_lengths(
    n_values: int, smallest: float, largest: float
) -> tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]:
    """Return functions of lengths of standard-normal vectors and of vectors of values (typical size one), any shape.

    Both give values per standard-normal coordinate at lengths of the same probability; their logarithms rise alike, and
    the ratios beyond the ends of the table are those at the ends.
    """
    from scipy.interpolate import CubicSpline  # a third of a second, which few diagnoses need

    sds, half = _sds(n_values, smallest, largest), 0.5 * n_values
    near, far = (math.sqrt(2 * inverse(half, _LEAST_TAIL)) for inverse in (gammaincinv, gammainccinv))
    values = np.geomspace(sds[0] * max(near, 1e-6), sds[-1] * far, _N_SIZES)
    squares = 0.5 * (values[:, None] / sds) ** 2
    below, above = gammainc(half, squares).mean(axis=1), gammaincc(half, squares).mean(axis=1)
    near_zero = below < 0.5
    lower = gammaincinv(half, np.where(near_zero, below, 0.5))
    normal = np.sqrt(2 * np.where(near_zero, lower, gammainccinv(half, np.where(near_zero, 0.5, above))))
    kept = (below > _LEAST_TAIL) & (above > _LEAST_TAIL) & (np.diff(normal, prepend=0.0) > 0)
    normal, values = normal[kept], values[kept]
    to_values, to_normal = (CubicSpline(np.log(x), np.log(y)) for x, y in ((normal, values), (values, normal)))

    def at_length(length: FloatArray) -> FloatArray:
        at = np.log(np.clip(length, normal[0], normal[-1]))
        return np.asarray(np.exp(to_values(at) - at))

    def at_size(size: FloatArray) -> FloatArray:
        at = np.log(np.clip(size, values[0], values[-1]))
        return np.asarray(np.exp(at - to_normal(at)))

    return at_length, at_size
