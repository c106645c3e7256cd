"""Bent rails and missing rack teeth: effects on the position that are outside the vocabulary."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.linear import LinearEffect
from probewise.effects.motion import distinct_positions_mm
from probewise.effects.origin import CountsPlaceFromOrigin
from probewise.effects.vocabulary import NamedEffect
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage

_UNIT_MM = 10.0
_MOST_PLACES = 160


@dataclass(frozen=True)
class BentRails(CountsPlaceFromOrigin, LinearEffect[Poses]):
    """Quadratic and cubic position error of each axis: X + x2_mm (X / 10 mm)^2 + x3_mm (X / 10 mm)^3, likewise Y.

    In the powers X and Y count from `origin`.
    """

    typical_mm: float = 0.1

    name = "bent_rails"
    words = "bent rails"
    stage = Stage.POSE
    units = ("mm", "mm", "mm", "mm")
    covariates = ("place", "slope")
    parameters = ("x2_mm", "x3_mm", "y2_mm", "y3_mm")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical quadratic error at X = max(L / 2, 10 mm) to 0.5 % of L, the length of the longest scan."""
        typical_mm = 0.005 * extent.length_mm / max(0.5 * extent.length_mm / _UNIT_MM, 1.0) ** 2
        return cls(typical_mm=typical_mm, origin=extent.origin)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        x, y = (plan.x_mm - self.origin.x_mm) / _UNIT_MM, (plan.y_mm - self.origin.y_mm) / _UNIT_MM
        return replace(
            value,
            x_mm=value.x_mm + theta[:, :1] * x**2 + theta[:, 1:2] * x**3,
            y_mm=value.y_mm + theta[:, 2:3] * y**2 + theta[:, 3:4] * y**3,
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        of_x, of_y = (value_with_sd(mean[k] + mean[k + 1], float(np.hypot(sd[k], sd[k + 1]))) for k in (0, 2))
        return f"the rails are bent: 10 mm from the origin the arm is off by {of_x} mm along X and {of_y} mm along Y"


@dataclass(frozen=True)
class MissingTooth(NamedEffect[Poses]):
    """A jump at one place of an axis, which shifts all positions beyond: X + amp_mm 1(X > at_mm), or likewise Y.

    `places_mm` are the recorded positions of each axis: between which two the jump lies (`between_mm`) is a discrete
    choice. `along` is 0 for X, 1 for Y.
    """

    typical_mm: float = 0.3
    places_mm: tuple[tuple[float, ...], tuple[float, ...]] = ((-100.0, 100.0), (-100.0, 100.0))
    along: int = 0
    between_mm: tuple[float, float] = (-100.0, 100.0)

    name = "missing_tooth"
    words = "a jump of the arm's position"
    stage = Stage.POSE
    units = ("mm", "mm", "1")
    covariates = ("place", "slope")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical jump to 0.5 % of the longest scan's length; None where no axis has over two positions."""
        places = tuple(_thinned_positions(axis) for axis in (extent.plan.x_mm, extent.plan.y_mm))
        return cls(0.005 * extent.length_mm, (places[0], places[1])) if any(len(own) > 2 for own in places) else None

    @cached_property
    def prior(self) -> Product:
        """Prior of the jump (of either sign), of its place, and of its axis, near 0 for X or near 1 for Y."""
        axis = Uniform(self.along - 0.5, self.along + 0.5)
        return Product({"amp_mm": HeavyTailedPrior(self.typical_mm), "at_mm": Uniform(*self.between_mm), "axis": axis})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        along_y = theta[:, 2:3] > 0.5
        beyond = np.where(along_y, plan.y_mm, plan.x_mm) > theta[:, 1:2]
        jump = theta[:, :1] * beyond
        return replace(value, x_mm=value.x_mm + jump * ~along_y, y_mm=value.y_mm + jump * along_y)

    def variants(self) -> tuple[Self, ...]:
        return tuple(
            replace(self, along=axis, between_mm=pair) for axis in (0, 1) for pair in pairwise(self.places_mm[axis])
        )

    def bank(self) -> FloatArray:
        return np.array([[[self.typical_mm, sum(self.between_mm) / 2, float(self.along)]]])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        axis = "Y" if mean[2] > 0.5 else "X"
        return (
            f"beyond {axis} = {value_with_sd(mean[1], sd[1])} mm the arm is {value_with_sd(mean[0], sd[0])} mm off "
            f"along {axis}: a tooth is missing"
        )


def _thinned_positions(axis_mm: FloatArray) -> tuple[float, ...]:
    """Return the distinct positions of one axis, sorted and thinned to at most 160."""
    places = distinct_positions_mm(axis_mm)
    stride = -(-len(places) // _MOST_PLACES)
    return tuple(places[::stride].tolist())
