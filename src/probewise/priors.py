"""Prior distributions of named parameters.

The packages of shapes, sensors and effects all import this module, so it imports none of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray, floats
from probewise._kinds import checked_number, require_kind, require_like
from probewise.errors import ParameterError, ShapeError

__all__ = [
    "Empty",
    "Joint",
    "LogNormal",
    "LogUniform",
    "Marginal",
    "Normal",
    "Prior",
    "Product",
    "Uniform",
    "require_prior",
]


@runtime_checkable
class Prior(Protocol):
    """A distribution of several named parameters, with a map from the unit cube and back."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the columns of theta."""
        ...

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map points of the unit cube, (n_samples, n_params), to parameters of that shape: uniform draws to draws."""
        ...

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map parameters (n_samples, n_params) to points of the unit cube that `from_unit_cube` maps back to them."""
        ...

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the natural log of the density, shape (n_samples,); -inf outside the support."""
        ...


class Coordinates(Protocol):
    """Coordinates in which a sampler explores the posterior, simpler there than in parameters or unit cube.

    A prior with a property `coordinates` of this kind is sampled in them. A quantity that the readings
    determine sharply should be an axis there, not a curved surface across several axes.
    """

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters of positive prior density to coordinates, both (n_samples, n_params)."""
        ...

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (n_samples, n_params) to parameters; also return the prior's log density in the coordinates.

        Any finite coordinates are allowed; the density, (n_samples,), is -inf where they match no parameters.
        """
        ...


@runtime_checkable
class Marginal(Protocol):
    """A distribution of one parameter; its methods take and return arrays of any one shape."""

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function: probability in 0..1 -> value."""
        ...

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, the inverse of `from_unit`: value -> probability."""
        ...

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Uniform distribution from `low` to `high`."""

    low: float
    high: float

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            checked_number(name, getattr(self, name))
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ParameterError("Uniform(low, high)", (self.low, self.high), "finite, low < high")

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function, any shape: `u` in 0..1 -> low..high."""
        return self.low + (self.high - self.low) * u

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, any shape: low..high -> 0..1."""
        return np.clip((value - self.low) / (self.high - self.low), 0.0, 1.0)

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape; -inf outside the bounds."""
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
        for name in ("low", "high"):
            checked_number(name, getattr(self, name))
        if not (0 < self.low < self.high < math.inf):
            raise ParameterError("LogUniform(low, high)", (self.low, self.high), "0 < low < high, finite")

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function, any shape: equal steps of `u` are equal ratios."""
        return np.asarray(self.low * (self.high / self.low) ** u)

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, any shape."""
        within = np.clip(value, self.low, self.high)
        return np.asarray(np.log(within / self.low) / math.log(self.high / self.low))

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape; -inf outside the bounds."""
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
        for name in ("mean", "sd"):
            checked_number(name, getattr(self, name))
        if not (math.isfinite(self.mean) and 0 < self.sd < math.inf):
            raise ParameterError("Normal(mean, sd)", (self.mean, self.sd), "finite, sd > 0")

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function, any shape; 0 and 1 map to the infinities."""
        return self.mean + self.sd * np.asarray(ndtri(u))

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, any shape."""
        return np.asarray(ndtr((value - self.mean) / self.sd))

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape."""
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
        for name in ("median", "log_sd"):
            checked_number(name, getattr(self, name))
        if not (0 < self.median < math.inf and 0 < self.log_sd < math.inf):
            raise ParameterError("LogNormal(median, log_sd)", (self.median, self.log_sd), "greater than 0, finite")

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function, any shape."""
        return np.asarray(self.median * np.exp(self.log_sd * ndtri(u)))

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, any shape."""
        with np.errstate(divide="ignore"):
            return np.asarray(ndtr(np.log(np.maximum(value, 0.0) / self.median) / self.log_sd))

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape; -inf at and below zero."""
        safe = np.where(value > 0, value, self.median)
        z = np.log(safe / self.median) / self.log_sd
        density = -0.5 * z * z - np.log(safe * self.log_sd * math.sqrt(2 * math.pi))
        return np.where(value > 0, density, -np.inf)

    def __str__(self) -> str:
        return f"log-normal about {self.median:g}"


@dataclass(frozen=True)
class Product:
    """Joint distribution of independent parameters: `marginals`, a mapping of name to the distribution of one."""

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
        """Names of the parameters, in the order of `marginals`."""
        return tuple(self.marginals)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map each column of the unit cube by its own marginal, (n_samples, n_params) -> same shape."""
        u = checked_columns(u, self.names)
        columns = [m.from_unit(u[:, i]) for i, m in enumerate(self.marginals.values())]
        return np.stack(columns, axis=-1) if columns else u

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map each column of the parameters by its own marginal, (n_samples, n_params) -> same shape."""
        theta = checked_columns(theta, self.names)
        columns = [m.to_unit(theta[:, i]) for i, m in enumerate(self.marginals.values())]
        return np.stack(columns, axis=-1) if columns else theta

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the sum of the marginals' log densities, (n_samples, n_params) -> (n_samples,)."""
        theta = checked_columns(theta, self.names)
        total = np.zeros(len(theta))
        for i, marginal in enumerate(self.marginals.values()):
            total = total + marginal.log_prob(theta[:, i])
        return total


@dataclass(frozen=True)
class Joint:
    """Joint distribution of independent priors `parts`, each of one or more parameters; columns in order of parts."""

    parts: tuple[Prior, ...]

    def __post_init__(self) -> None:
        allowed = "priors: Joint((Product({...}), Product({...})))"
        require_kind("parts", self.parts, (tuple, list), allowed)
        for k, part in enumerate(self.parts):
            require_prior(f"parts[{k}]", part)
        object.__setattr__(self, "parts", tuple(self.parts))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters of all parts, in order."""
        return tuple(name for part in self.parts for name in part.names)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map the columns of each part by that part, (n_samples, n_params) -> same shape."""
        u = checked_columns(u, self.names)
        columns = [p.from_unit_cube(c) for p, c in self._parts_with_columns(u)]
        return np.concatenate(columns, axis=-1) if columns else u

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map the columns of each part by that part, (n_samples, n_params) -> same shape."""
        theta = checked_columns(theta, self.names)
        columns = [p.to_unit_cube(c) for p, c in self._parts_with_columns(theta)]
        return np.concatenate(columns, axis=-1) if columns else theta

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the sum of the parts' log densities, (n_samples, n_params) -> (n_samples,)."""
        theta = checked_columns(theta, self.names)
        total = np.zeros(len(theta))
        for part, columns in self._parts_with_columns(theta):
            total = total + part.log_prob(columns)
        return total

    def _parts_with_columns(self, columns: FloatArray) -> list[tuple[Prior, FloatArray]]:
        """Return pairs of a part and its columns, (n_samples, n_params of the part)."""
        ends = np.cumsum([len(p.names) for p in self.parts])
        return [(p, columns[:, end - len(p.names) : end]) for p, end in zip(self.parts, ends, strict=True)]


@dataclass(frozen=True)
class Empty:
    """The prior of a model without free parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """The empty tuple."""
        return ()

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Return the points, (n_samples, 0), unchanged."""
        return u

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Return the parameters, (n_samples, 0), unchanged."""
        return theta

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return zero for each sample, (n_samples,): the density of the only point is 1."""
        return np.zeros(len(theta))


def require_prior(name: str, prior: object, *more: str) -> None:
    """Raise ParameterError unless `prior` has `names`, `from_unit_cube` and the methods named in `more`."""
    allowed = "a prior of named parameters, such as Product({'x_mm': Uniform(0.0, 1.0)})"
    require_like(name, prior, ("names", "from_unit_cube"), allowed)
    missing = [method for method in more if not hasattr(prior, method)]
    if missing:
        raise ParameterError(name, prior, f"a prior with {' and '.join(missing)}; see probewise.priors.Prior")


def checked_columns(values: FloatArray, names: tuple[str, ...]) -> FloatArray:
    """Return parameters as floats; raise ShapeError unless their shape is (n_samples, number of `names`)."""
    array = floats(values, "parameters")
    if array.ndim != 2 or array.shape[1] != len(names):
        raise ShapeError(f"parameters have shape {array.shape}; allowed: (n_samples, {len(names)}) for {names}")
    return array
