"""Shapes on the field (paper, section 2.2, "The Circle Characterization Experiment", eq. 1: a circle).

Each is a prior over named parameters and the region they define; `AnyOf` is the paper's set of shapes. A new shape is
one short class: a frozen dataclass with `prior` and `region`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._kinds import (
    checked_number,
    checked_one_or_several_numbers,
    checked_pair,
    checked_whole,
    require_flag,
    require_kind,
    require_like,
)
from probewise.errors import ParameterError, require
from probewise.priors import Prior, Product, Uniform, checked_columns
from probewise.scene.regions import (
    EllipseRegion,
    PolygonRegion,
    Region,
    RegionsOfMixedKinds,
    UniformRegion,
    disc_region,
)


class Shape(Protocol):
    """A hypothesis about what lies on the field: named parameters, their prior, and the region they define."""

    @property
    def prior(self) -> Prior:
        """Prior of the shape's parameters, with their names."""
        ...

    def region(self, theta: FloatArray) -> Region:
        """Build the regions of the hypotheses, one per row of theta (n_samples, n_params)."""
        ...


def require_shape(shape: object, name: str = "shape") -> None:
    """Raise ParameterError unless `shape` has `prior` and `region`."""
    require_like(name, shape, ("prior", "region"), "a shape such as Circle() or Rectangle(), of probewise.scene")


Bounds = tuple[float, float]


@dataclass(frozen=True)
class SymmetryTurn:
    """The `symmetry_turn` of a shape with an angle: the turn after which it is the same again.

    `by_rad` is added to the parameter of index `angle`; parameters `swapped`, such as two sides, change places.
    """

    by_rad: float
    angle: int
    swapped: tuple[int, int] | None = None


@dataclass(frozen=True)
class Field:
    """The playing field, mm: from (0, 0) to (width, height)."""

    width_mm: float = 1048.0
    height_mm: float = 520.0

    def __post_init__(self) -> None:
        for name in ("width_mm", "height_mm"):
            value = checked_number(name, getattr(self, name))
            require(0 < value < math.inf, name, value, "greater than 0, finite")


@dataclass(frozen=True)
class PlacedPrior:
    """Prior of a shape anywhere on a field: x_mm, y_mm, then the shape's other parameters, with prior `own`.

    The centre is uniform over the field or, given
    `extent` (other parameters (n_samples, n_own) -> half width and half height (n_samples, 2)),
    over the centres for which the whole shape lies inside the field.
    """

    field: Field
    own: Prior
    extent: Callable[[FloatArray], FloatArray] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return ("x_mm", "y_mm", *self.own.names)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        u = checked_columns(u, self.names)
        own = self.own.from_unit_cube(u[:, 2:])
        low, high = self._bounds_of_centre(own)
        return np.concatenate([low + (high - low) * u[:, :2], own], axis=1)

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        low, high = self._bounds_of_centre(theta[:, 2:])
        centre = np.clip((theta[:, :2] - low) / np.maximum(high - low, 1e-300), 0.0, 1.0)
        return np.concatenate([centre, self.own.to_unit_cube(theta[:, 2:])], axis=1)

    def log_prob(self, theta: FloatArray) -> FloatArray:
        own = self.own.log_prob(theta[:, 2:])
        low, high = self._bounds_of_centre(theta[:, 2:])
        inside = ((theta[:, :2] >= low) & (theta[:, :2] <= high)).all(axis=1)
        room = np.where(inside, np.prod(np.maximum(high - low, 1e-300), axis=1), 1.0)
        return np.where(inside & np.isfinite(own), own - np.log(room), -np.inf)

    def _bounds_of_centre(self, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the least and the greatest (x, y) of the centre, (n_samples, 2) each, given the other parameters."""
        size = np.array([self.field.width_mm, self.field.height_mm])
        margin = np.zeros((len(own), 2)) if self.extent is None else self.extent(own)
        return margin, size - margin


def _require_bounds_fit_field(shape: Circle | Ellipse | Rectangle | RegularPolygon, name: str, reach: float) -> None:
    """Raise ParameterError unless 0 < low < high and, if `inside`, the largest shape fits the field."""
    field, bounds = shape.field, getattr(shape, name)
    require_kind("field", field, Field, "a Field: Field(width_mm, height_mm)")
    require_flag("inside", shape.inside)
    low, high = checked_pair(name, bounds, "(low, high): its prior is even between them")
    require(0 < low < high < math.inf, name, bounds, "0 < low < high, finite")
    fits = not shape.inside or 2 * reach * high < min(field.width_mm, field.height_mm)
    name, found = f"{type(shape).__name__}(inside=True)", f"up to {2 * reach * high:g} mm wide"
    require(fits, name, found, f"less than the field's {field.width_mm:g} x {field.height_mm:g} mm (or inside=False)")


def _half_extent_of_circle(own: FloatArray) -> FloatArray:
    """Return half width and half height (n_samples, 2) of circles; the first column of `own` is the radius."""
    return np.repeat(own[:, :1], 2, axis=1)


@dataclass(frozen=True)
class Circle:
    """A disc of unknown place and radius (paper, eq. 1). Parameters, in this order: x_mm, y_mm, radius_mm.

    The argument `radius_mm` is (low, high) of the radius' uniform prior. `inside=True` keeps the whole circle on the
    field. ParameterError unless 0 < low < high, finite, and, with `inside`, the largest circle is smaller than the
    field.
    """

    field: Field = Field()
    radius_mm: Bounds = (20.0, 150.0)
    inside: bool = False

    def __post_init__(self) -> None:
        _require_bounds_fit_field(self, "radius_mm", 1.0)

    @cached_property
    def prior(self) -> PlacedPrior:
        """Uniform over radius and centre; with `inside`, over the centres that keep the circle on the field."""
        own = Product({"radius_mm": Uniform(*self.radius_mm)})
        return PlacedPrior(self.field, own, _half_extent_of_circle if self.inside else None)

    def region(self, theta: FloatArray) -> EllipseRegion:
        """Build the discs of the hypotheses, one per row of theta (n_samples, 3)."""
        return disc_region(theta[:, :2], theta[:, 2])


@dataclass(frozen=True)
class _EllipseOwnPrior:
    """Semi-major axis uniform within the bounds, semi-minor uniform from the lower bound to it, angle 0 to pi."""

    bounds_mm: Bounds

    @property
    def names(self) -> tuple[str, ...]:
        return ("semi_major_mm", "semi_minor_mm", "angle_rad")

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        low, high = self.bounds_mm
        major = low + (high - low) * u[:, 0]
        return np.stack([major, low + (major - low) * u[:, 1], np.pi * u[:, 2]], axis=1)

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        low, high = self.bounds_mm
        major, minor, angle = theta.T
        share = (minor - low) / np.maximum(major - low, 1e-300)
        return np.asarray(np.clip(np.stack([(major - low) / (high - low), share, angle / np.pi], axis=1), 0.0, 1.0))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        low, high = self.bounds_mm
        major, minor, angle = theta.T
        inside = (low < major) & (major <= high) & (low <= minor) & (minor <= major) & (angle >= 0) & (angle <= np.pi)
        room = np.where(inside, (high - low) * np.pi * (major - low), 1.0)
        return np.where(inside, -np.log(room), -np.inf)


def _half_extent_of_ellipse(own: FloatArray) -> FloatArray:
    major, minor, angle = own.T
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([np.hypot(major * cosine, minor * sine), np.hypot(major * sine, minor * cosine)], axis=1)


@dataclass(frozen=True)
class Ellipse:
    """An ellipse: x_mm, y_mm, semi_major_mm, semi_minor_mm, angle_rad of the major axis, 0 to pi, anticlockwise from X.

    The argument `semi_axes_mm` is (low, high) of its prior, as for `Circle`; `inside=True` keeps it on the field.
    """

    field: Field = Field()
    semi_axes_mm: Bounds = (20.0, 150.0)
    inside: bool = False

    symmetry_turn: ClassVar[SymmetryTurn] = SymmetryTurn(np.pi, angle=4)

    def __post_init__(self) -> None:
        _require_bounds_fit_field(self, "semi_axes_mm", 1.0)

    @cached_property
    def prior(self) -> PlacedPrior:
        """Uniform over centre, semi-major axis, angle; the semi-minor axis from the lower bound to the semi-major.

        With `inside`, the centre is uniform over the places that keep the ellipse on the field.
        """
        own = _EllipseOwnPrior(self.semi_axes_mm)
        return PlacedPrior(self.field, own, _half_extent_of_ellipse if self.inside else None)

    def region(self, theta: FloatArray) -> EllipseRegion:
        """Build the ellipses of the hypotheses, one per row of theta (n_samples, 5)."""
        return EllipseRegion(theta[:, :2], theta[:, 2:4], theta[:, 4])


def _half_extent_of_rectangle(own: FloatArray) -> FloatArray:
    width, height, angle = own.T
    cosine, sine = np.abs(np.cos(angle)), np.abs(np.sin(angle))
    return 0.5 * np.stack([width * cosine + height * sine, width * sine + height * cosine], axis=1)


@dataclass(frozen=True)
class Rectangle:
    """A rectangle: x_mm, y_mm of its centre, width_mm, height_mm, angle_rad of its width, 0 to pi/2.

    Either side may be the longer, so that angles over a quarter turn describe every rectangle once. The argument
    `sides_mm` is (low, high) of their prior, as for `Circle`; `inside=True` keeps it on the field.
    """

    field: Field = Field()
    sides_mm: Bounds = (40.0, 300.0)
    inside: bool = False

    symmetry_turn: ClassVar[SymmetryTurn] = SymmetryTurn(np.pi / 2, angle=4, swapped=(2, 3))

    def __post_init__(self) -> None:
        _require_bounds_fit_field(self, "sides_mm", 1 / math.sqrt(2))

    @cached_property
    def prior(self) -> PlacedPrior:
        """Uniform over all five parameters; with `inside`, over centres that keep the rectangle on the field."""
        side = Uniform(*self.sides_mm)
        own = Product({"width_mm": side, "height_mm": side, "angle_rad": Uniform(0.0, np.pi / 2)})
        return PlacedPrior(self.field, own, _half_extent_of_rectangle if self.inside else None)

    def region(self, theta: FloatArray) -> PolygonRegion:
        """Build the rectangles of the hypotheses, one per row of theta (n_samples, 5)."""
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        return _turned_polygon(theta[:, :2], corners * theta[:, None, 2:4], theta[:, 4])


@dataclass(frozen=True)
class RegularPolygon:
    """A regular polygon of `n_sides`: x_mm, y_mm, radius_mm of its corners, angle_rad of the first.

    The argument `radius_mm` is (low, high) of its prior, as for `Circle`; `inside=True` keeps it on the field.
    """

    n_sides: int
    field: Field = Field()
    radius_mm: Bounds = (30.0, 150.0)
    inside: bool = False

    def __post_init__(self) -> None:
        checked_whole("n_sides", self.n_sides, least=3)
        _require_bounds_fit_field(self, "radius_mm", 1.0)

    @cached_property
    def prior(self) -> PlacedPrior:
        """Uniform over centre, radius, and an angle from 0 to 2 pi / n_sides.

        With `inside`, the centre is uniform over the places that keep the circumscribed circle on the field.
        """
        own = Product({"radius_mm": Uniform(*self.radius_mm), "angle_rad": Uniform(0.0, 2 * np.pi / self.n_sides)})
        # The circumscribed circle: slightly more room than a polygon needs, the same on all sides.
        return PlacedPrior(self.field, own, _half_extent_of_circle if self.inside else None)

    @property
    def symmetry_turn(self) -> SymmetryTurn:
        """The turn from one corner to the next."""
        return SymmetryTurn(2 * np.pi / self.n_sides, angle=3)

    def region(self, theta: FloatArray) -> PolygonRegion:
        """Build the polygons of the hypotheses, one per row of theta (n_samples, 4)."""
        t = 2 * np.pi * np.arange(self.n_sides) / self.n_sides
        corners = np.stack([np.cos(t), np.sin(t)], axis=-1) * theta[:, None, 2:3]
        return _turned_polygon(theta[:, :2], corners, theta[:, 3])


def _turned_polygon(center_mm: FloatArray, corners_mm: FloatArray, angle_rad: FloatArray) -> PolygonRegion:
    """Build polygons with corners (n_samples, n_vertices, 2) about their centres, turned anticlockwise by an angle."""
    cosine, sine = np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]
    x = center_mm[:, :1] + cosine * corners_mm[..., 0] - sine * corners_mm[..., 1]
    y = center_mm[:, 1:] + sine * corners_mm[..., 0] + cosine * corners_mm[..., 1]
    return PolygonRegion.from_vertices(np.stack([x, y], axis=-1))


SHAPES: Mapping[str, Callable[[Field], Shape]] = {
    "circle": lambda field: Circle(field),
    "ellipse": lambda field: Ellipse(field),
    "rectangle": lambda field: Rectangle(field),
    "triangle": lambda field: RegularPolygon(3, field),
    "hexagon": lambda field: RegularPolygon(6, field),
}
"""Shapes by name, as the command line offers them; each takes the field it lies on."""


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
        theta = np.empty_like(u)
        theta[:, 0] = np.interp(u[:, 0], self._ends, np.arange(len(self._ends)))
        self._fill(theta, self.shape_index(theta), [shape.prior.from_unit_cube for shape in self.shapes.values()], u)
        return theta

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        u = np.empty_like(theta)
        u[:, 0] = np.interp(theta[:, 0], np.arange(len(self._ends)), self._ends)
        self._fill(u, self.shape_index(theta), [shape.prior.to_unit_cube for shape in self.shapes.values()], theta)
        return u

    @cached_property
    def _ends(self) -> FloatArray:
        return np.concatenate([[0.0], np.cumsum(self.weights)])

    def _fill(
        self, out: FloatArray, which: IntArray, maps: Sequence[Callable[[FloatArray], FloatArray]], values: FloatArray
    ) -> None:
        """Fill every column of `out`, (n_samples, n_params), except the first, from each shape's map of `values`."""
        for k, (mapped_by, columns) in enumerate(zip(maps, self.columns_by_shape, strict=True)):
            mapped = mapped_by(values[:, columns])
            # Every shape fills its own columns; the selected shape fills the shared ones.
            own = columns > len(self.shared)
            out[:, columns[own]] = mapped[:, own]
            taken = which == k
            out[np.ix_(taken, columns[~own])] = mapped[np.ix_(taken, ~own)]

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
        require(self.shapes, "shapes", dict(self.shapes), "one shape or more, by name")
        weights = checked_one_or_several_numbers("weights", self.weights) or (1.0,) * len(self.shapes)
        if len(weights) != len(self.shapes) or not all(w > 0 for w in weights):
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


def mean_angles(shape: Shape, theta: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the circular mean of each angle of a shape, modulo its symmetry, (n_params,); NaN for other parameters.

    `theta` (n_samples, n_params) are weighted samples, `weight` (n_samples,). For a set of shapes, each angle's mean is
    taken over the samples of its own shape.
    """
    out = np.full(theta.shape[1], np.nan)
    for rows, columns, turn in _rows_columns_and_turns(shape, theta):
        phase = np.exp(2j * math.pi * theta[rows, columns[turn.angle]] / turn.by_rad)
        out[columns[turn.angle]] = float(np.angle(weight[rows] @ phase)) % (2 * math.pi) * turn.by_rad / (2 * math.pi)
    return out


def with_angles_near(shape: Shape, theta: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Return samples of the same shapes, (n_samples, n_params), each angle within half a symmetry turn of a given one.

    `angles_rad` is (n_params,); NaN leaves a column as it is. Sides are swapped where the symmetry says so. Mean and sd
    of the result are meaningful, while angles of 0.01 and pi - 0.01 may be of nearly the same ellipse.
    """
    out = theta
    for rows, columns, turn in _rows_columns_and_turns(shape, theta):
        near = angles_rad[columns[turn.angle]]
        turns = np.round((theta[rows, columns[turn.angle]] - near) / turn.by_rad) if np.isfinite(near) else np.zeros(1)
        if not turns.any():
            continue
        out = theta.copy() if out is theta else out
        out[rows, columns[turn.angle]] -= turns * turn.by_rad
        if turn.swapped is not None:
            odd = rows[turns % 2 == 1]
            sides = columns[list(turn.swapped)]
            out[np.ix_(odd, sides)] = out[np.ix_(odd, sides[::-1])]
    return out


def _rows_columns_and_turns(shape: Shape, theta: FloatArray) -> list[tuple[IntArray, IntArray, SymmetryTurn]]:
    """List (row numbers, column numbers, symmetry) of each shape among the samples that has an angle."""
    found = [(np.arange(len(theta)), np.arange(theta.shape[1]), shape)]
    if isinstance(shape, AnyOf):
        which = shape.shape_index(theta)
        parts = zip(shape.shapes.values(), shape.prior.columns_by_shape, strict=True)
        found = [(np.flatnonzero(which == k), columns, part) for k, (part, columns) in enumerate(parts)]
    turns = [(rows, columns, getattr(part, "symmetry_turn", None)) for rows, columns, part in found if rows.size]
    return [(rows, columns, turn) for rows, columns, turn in turns if turn is not None]
