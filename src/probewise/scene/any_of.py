"""One of several shapes, unknown which: the paper's set of shapes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._kinds import require_kind
from probewise.errors import ParameterError
from probewise.priors import checked_columns
from probewise.scene.albedo import Region, Shape, require_shape
from probewise.scene.regions import RegionsOfMixedKinds, UniformRegion
from probewise.scene.shapes import PlacedPrior


@dataclass(frozen=True)
class _AnyOfPrior:
    """Product-space prior: the shape's index, the shared centre, then the own parameters of every shape.

    The parameters of the shapes not selected follow their own priors, so evidences and the
    posterior probability of each shape are correct.
    """

    shapes: Mapping[str, Shape]
    weights: tuple[float, ...]
    shared: tuple[str, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        own = (f"{key}.{n}" for key, shape in self.shapes.items() for n in shape.prior.names if n not in self.shared)
        return ("shape", *self.shared, *own)

    @cached_property
    def columns_by_shape(self) -> list[IntArray]:
        """Column numbers of theta with the parameters of each shape, in the shape's order, an array per shape."""
        return [
            np.array([self.names.index(n if n in self.shared else f"{key}.{n}") for n in shape.prior.names], dtype=int)
            for key, shape in self.shapes.items()
        ]

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        u = checked_columns(u, self.names)
        ends = np.concatenate([[0.0], np.cumsum(self.weights)])
        theta = np.empty_like(u)
        theta[:, 0] = np.interp(u[:, 0], ends, np.arange(len(ends)))
        which = self.shape_index(theta)
        for k, (shape, columns) in enumerate(zip(self.shapes.values(), self.columns_by_shape, strict=True)):
            values = shape.prior.from_unit_cube(u[:, columns])
            # Every shape fills its own columns; the selected shape fills the shared ones.
            own = columns > len(self.shared)
            theta[:, columns[own]] = values[:, own]
            taken = which == k
            theta[np.ix_(taken, columns[~own])] = values[np.ix_(taken, ~own)]
        return theta

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        ends = np.concatenate([[0.0], np.cumsum(self.weights)])
        u = np.empty_like(theta)
        u[:, 0] = np.interp(theta[:, 0], np.arange(len(ends)), ends)
        which = self.shape_index(theta)
        for k, (shape, columns) in enumerate(zip(self.shapes.values(), self.columns_by_shape, strict=True)):
            values = shape.prior.to_unit_cube(theta[:, columns])
            own = columns > len(self.shared)
            u[:, columns[own]] = values[:, own]
            taken = which == k
            u[np.ix_(taken, columns[~own])] = values[np.ix_(taken, ~own)]
        return u

    def log_prob(self, theta: FloatArray) -> FloatArray:
        which = self.shape_index(theta)
        inside = (theta[:, 0] >= 0) & (theta[:, 0] <= len(self.shapes))
        total = np.where(inside, np.log(np.asarray(self.weights))[which], -np.inf)
        for k, (shape, columns) in enumerate(zip(self.shapes.values(), self.columns_by_shape, strict=True)):
            values = theta[:, columns]
            prior = shape.prior
            taken = prior.log_prob(values)
            idle = prior.own.log_prob(values[:, 2:]) if self.shared and isinstance(prior, PlacedPrior) else taken
            total = total + np.where(which == k, taken, idle)
        return total

    def shape_index(self, theta: FloatArray) -> IntArray:
        """Return the index of each hypothesis' shape, (n_samples,)."""
        return np.clip(np.floor(theta[:, 0]), 0, len(self.shapes) - 1).astype(np.int64)


@dataclass(frozen=True)
class AnyOf:
    """One of several shapes, unknown which and where (the paper's "set of shapes").

    Parameters: `shape`, whose floor is the index of the shape (continuous, so that a sampler can treat
    it like any other: uniform over [k, k + 1) for shape k, which has prior probability `weights[k]`);
    x_mm, y_mm of the centre, shared where every shape has a `PlacedPrior` prior; then each shape's own
    parameters, as "rectangle.width_mm".

    `weights` are relative prior probabilities, one per shape, normalised on construction; by default equal.
    ParameterError if there is no shape, or the weights are not one positive number per shape.
    """

    shapes: Mapping[str, Shape]
    weights: tuple[float, ...] = field(default=())

    def __post_init__(self) -> None:
        require_kind("shapes", self.shapes, Mapping, "shapes by name: {'circle': Circle(), 'rectangle': Rectangle()}")
        for name, shape in self.shapes.items():
            require_shape(shape, f"shapes[{name!r}]")
        if not self.shapes:
            raise ParameterError("shapes", dict(self.shapes), "one shape or more, by name")
        weights = tuple(self.weights) or (1.0,) * len(self.shapes)
        if len(weights) != len(self.shapes) or not all(0 < w < math.inf for w in weights):
            raise ParameterError("weights", self.weights, f"{len(self.shapes)} numbers greater than 0")
        object.__setattr__(self, "weights", tuple(w / sum(weights) for w in weights))

    @cached_property
    def prior(self) -> _AnyOfPrior:
        """Prior of index, centre, and the parameters of every shape."""
        placed = all(isinstance(shape.prior, PlacedPrior) for shape in self.shapes.values())
        return _AnyOfPrior(self.shapes, self.weights, ("x_mm", "y_mm") if placed else ())

    @property
    def shape_names(self) -> tuple[str, ...]:
        """Names of the shapes, by index."""
        return tuple(self.shapes)

    def shape_index(self, theta: FloatArray) -> IntArray:
        """Return the index of each hypothesis' shape, (n_samples,)."""
        return self.prior.shape_index(theta)

    def region(self, theta: FloatArray) -> RegionsOfMixedKinds:
        """Build the regions of the hypotheses, each of its own shape."""
        which = self.shape_index(theta)
        parts: list[Region] = []
        for k, (shape, columns) in enumerate(zip(self.shapes.values(), self.prior.columns_by_shape, strict=True)):
            rows = np.flatnonzero(which == k)
            # An empty field stands in for a shape that no hypothesis selects.
            parts.append(shape.region(theta[np.ix_(rows, columns)]) if rows.size else UniformRegion(np.zeros(1)))
        return RegionsOfMixedKinds(which, tuple(parts))


def shape_and_columns(shape: Shape, name: str) -> tuple[Shape, IntArray]:
    """Return a set's shape of this name and its column numbers of theta; for a single shape, itself and all columns."""
    if isinstance(shape, AnyOf):
        return shape.shapes[name], shape.prior.columns_by_shape[shape.shape_names.index(name)]
    return shape, np.arange(len(shape.prior.names))
