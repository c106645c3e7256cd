"""The hidden shape on a simulated field, given or drawn from its prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, floats, read_only_floats
from probewise._kinds import checked_finite_number, require_rng
from probewise.errors import ParameterError
from probewise.experiment.simulation import surface_of_region
from probewise.priors import Prior
from probewise.scene import SHAPES, AnyOf, Field, Shape, outlines
from probewise.world import Surface

Truth = Sequence[float] | Mapping[str, float] | Mapping[str, Sequence[float]] | Mapping[str, Mapping[str, float]]
"""Parameters of the first shape, in order or by name; or {"rectangle": ...}, those of a shape by its name."""


@dataclass(frozen=True, eq=False)
class HiddenShape:
    """A shape with its parameters, theta (n_params,), and its name among the possible shapes."""

    name: str
    shape: Shape
    theta: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", read_only_floats(self.theta))

    @classmethod
    def from_parameters(cls, name: str, shape: Shape, theta: FloatArray, *, called: str = "truth") -> HiddenShape:
        """Build from parameters, (n_params,); `called` is the name of these in messages.

        Raises
        ------
        ParameterError
            If the number of parameters is wrong, or the shape's prior excludes one, given the others.
        """
        prior = shape.prior
        values = floats(theta, called)
        if values.shape != (len(prior.names),):
            raise ParameterError(called, theta, f"{len(prior.names)} numbers, {', '.join(prior.names)}")
        for parameter, value, low, high in zip(
            prior.names, values.tolist(), *_conditional_lows_and_highs(prior, values), strict=True
        ):
            if not low <= value <= high:
                option = called.partition(" ")[0]
                raise ParameterError(
                    f"{parameter} of {called}",
                    value,
                    f"{low:g} to {high:g}, as the {name}'s prior has it; without {option} the seed draws one",
                )
        return cls(name, shape, values)

    @classmethod
    def drawn_from_prior(cls, members: Mapping[str, Shape], *, rng: np.random.Generator) -> HiddenShape:
        """Draw one of several shapes, all equally probable, and its parameters from its prior."""
        require_rng(rng)
        name = list(members)[int(rng.integers(len(members)))]
        prior = members[name].prior
        return cls(name, members[name], prior.from_unit_cube(rng.random((1, len(prior.names))))[0])

    @classmethod
    def given_or_drawn(
        cls, truth: Truth | None, members: Mapping[str, Shape], field: Field, *, rng: np.random.Generator
    ) -> HiddenShape:
        """Build from parameters, of the first of `members` or as {shape: parameters}; None: draw shape and parameters.

        Raises
        ------
        ParameterError
            If the shape's name is unknown, or its prior excludes the numbers.
        """
        if truth is None:
            return cls.drawn_from_prior(members, rng=rng)
        first = next(iter(members))
        known = {**{name: make(field) for name, make in SHAPES.items()}, **members}
        if isinstance(truth, Mapping) and len(truth) == 1 and set(truth) <= set(known):
            ((name, values),) = truth.items()
            return cls.from_parameters(name, known[name], _theta_in_prior_order(known[name].prior.names, values))
        if isinstance(truth, Mapping) and not set(truth) & set(members[first].prior.names):
            raise ParameterError("truth", truth, f"one shape of {', '.join(known)} with its parameters")
        return cls.from_parameters(first, members[first], _theta_in_prior_order(members[first].prior.names, truth))

    @property
    def journal_entry(self) -> dict[str, str | float]:
        """The shape's name and parameters for the journal's first line, since a resumed run needs the same shape."""
        return {"shape": self.name, **self.parameters}

    @property
    def surface(self) -> Surface:
        """The shape's surface in the simulated world, which shares only geometry with the models."""
        return surface_of_region(self.shape.region(self.theta[None, :]), self.name)

    @property
    def outline_mm(self) -> FloatArray:
        """The shape's outline, closed, (n_points, 2)."""
        return outlines(self.shape.region(self.theta[None, :]))[0]

    @property
    def parameters(self) -> dict[str, float]:
        """The shape's parameters by name."""
        return dict(zip(self.shape.prior.names, self.theta.tolist(), strict=True))

    def parameters_by_hypothesis_name(self, names: Sequence[str]) -> dict[str, float]:
        """Return the parameters under the names of a hypothesis, such as "rectangle.width_mm" in a set of shapes.

        Of `names`, those of parameters that this shape does not have are left out.
        """
        known, prefix = self.parameters, f"{self.name}."
        return {name: known[name.removeprefix(prefix)] for name in names if name.removeprefix(prefix) in known}


def possible_shapes_by_name(shape: Shape) -> dict[str, Shape]:
    """Return the possible shapes by name: those of a set, or the single one."""
    return dict(shape.shapes) if isinstance(shape, AnyOf) else {type(shape).__name__.lower(): shape}


def _theta_in_prior_order(names: Sequence[str], values: object) -> FloatArray:
    """Convert parameters, given by name or already in order, to an array in the order of `names`, (n_params,).

    Raises ParameterError if the names of the parameters are not `names`.
    """
    if not isinstance(values, Mapping):
        return floats(values, "truth")  # type: ignore[arg-type]
    if set(values) != set(names):
        raise ParameterError("truth", values, f"one number for each of {', '.join(names)}")
    return np.array([checked_finite_number(f"truth[{name!r}]", values[name]) for name in names])


def _conditional_lows_and_highs(prior: Prior, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the least and greatest value that the prior allows each parameter, given the others, (n_params,) each."""
    own = np.eye(len(theta), dtype=np.bool_)
    with np.errstate(invalid="ignore"):  # of a ratio of infinities
        given = prior.to_unit_cube(theta[None])
    low, high = (np.diagonal(prior.from_unit_cube(np.where(own, end, given))) for end in (0.0, 1.0))
    return low, high
