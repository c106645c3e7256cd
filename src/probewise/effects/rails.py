"""An arm whose rails are not straight or whose teeth are not all there: effects on the place without a name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.vocabulary import NamedEffect, give_or_take
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage

__all__ = ["BentRails", "MissingTooth"]

_UNIT_MM = 10.0
_MOST_PLACES = 160


@dataclass(frozen=True)
class BentRails(NamedEffect[Poses]):
    """Each axis errs by a square and a cube of itself: X + x2_mm (X / 10 mm)^2 + x3_mm (X / 10 mm)^3, likewise Y."""

    typical_mm: float = 0.1

    name: ClassVar[str] = "bent_rails"
    stage: ClassVar[Stage] = Stage.POSE
    units: ClassVar[tuple[str, ...]] = ("mm", "mm", "mm", "mm")
    covariates: ClassVar[tuple[str, ...]] = ("place", "slope")
    amplitudes: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Take an error of a two-hundredth of the longest scan at its end as typical."""
        return cls(typical_mm=0.005 * extent.length_mm / max(0.5 * extent.length_mm / _UNIT_MM, 1.0) ** 2)

    @cached_property
    def prior(self) -> Product:
        """Error at 10 mm from the origin of the lab frame."""
        error = HeavyTailed(self.typical_mm)
        return Product({"x2_mm": error, "x3_mm": error, "y2_mm": error, "y3_mm": error})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Bend both axes."""
        x, y = plan.x_mm / _UNIT_MM, plan.y_mm / _UNIT_MM
        return replace(
            value,
            x_mm=value.x_mm + theta[:, :1] * x**2 + theta[:, 1:2] * x**3,
            y_mm=value.y_mm + theta[:, 2:3] * y**2 + theta[:, 3:4] * y**3,
        )

    def bank(self) -> FloatArray:
        """One setting of four columns: linear in all."""
        return self.typical_mm * np.eye(4)[None, :, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how far off the places are at 10 mm."""
        of_x, of_y = (give_or_take(mean[k] + mean[k + 1], float(np.hypot(sd[k], sd[k + 1]))) for k in (0, 2))
        return f"the rails are bent: 10 mm from the origin the arm is off by {of_x} mm along X and {of_y} mm along Y"


@dataclass(frozen=True)
class MissingTooth(NamedEffect[Poses]):
    """Beyond a place of one axis all places are amp_mm off: X + amp_mm 1(X > at_mm), or along Y.

    `places_mm` are the places, by axis, between which a jump is told from the next one; `along` is 0 for X.
    """

    typical_mm: float = 0.3
    places_mm: tuple[tuple[float, ...], tuple[float, ...]] = ((-100.0, 100.0), (-100.0, 100.0))
    along: int = 0
    between_mm: tuple[float, float] = (-100.0, 100.0)

    name: ClassVar[str] = "missing_tooth"
    stage: ClassVar[Stage] = Stage.POSE
    units: ClassVar[tuple[str, ...]] = ("mm", "mm", "1")
    covariates: ClassVar[tuple[str, ...]] = ("place", "slope")
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Take half a percent of the longest scan as typical; look between the places of the recording."""
        places = tuple(_some(axis) for axis in (extent.plan.x_mm, extent.plan.y_mm))
        return cls(0.005 * extent.length_mm, (places[0], places[1])) if any(len(own) > 2 for own in places) else None

    @cached_property
    def prior(self) -> Product:
        """Jump of either sign, its place, and its axis: 0 along X, 1 along Y."""
        axis = Uniform(self.along - 0.5, self.along + 0.5)
        return Product({"amp_mm": HeavyTailed(self.typical_mm), "at_mm": Uniform(*self.between_mm), "axis": axis})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Shift what lies beyond the place."""
        along_y = theta[:, 2:3] > 0.5
        beyond = np.where(along_y, plan.y_mm, plan.x_mm) > theta[:, 1:2]
        jump = theta[:, :1] * beyond
        return replace(value, x_mm=value.x_mm + jump * ~along_y, y_mm=value.y_mm + jump * along_y)

    def variants(self) -> tuple[Self, ...]:
        """Choose the axis and the two places between which it is."""
        return tuple(
            replace(self, along=axis, between_mm=pair) for axis in (0, 1) for pair in pairwise(self.places_mm[axis])
        )

    def bank(self) -> FloatArray:
        """One setting, half way between the two places."""
        return np.array([[[self.typical_mm, sum(self.between_mm) / 2, float(self.along)]]])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say where, and how far."""
        axis = "Y" if mean[2] > 0.5 else "X"
        return (
            f"beyond {axis} = {give_or_take(mean[1], sd[1])} mm the arm is off by {give_or_take(mean[0], sd[0])} mm: "
            "a tooth is missing"
        )


def _some(axis_mm: FloatArray) -> tuple[float, ...]:
    """List distinct places of one axis, at most about 48."""
    places = np.unique(np.round(axis_mm, 6))
    stride = -(-len(places) // _MOST_PLACES)
    return tuple(places[::stride].tolist())
