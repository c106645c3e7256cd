"""Effects on the pose: where the sensor stands instead of where it was sent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect
from probewise.effects.origin import CountsPlaceFromOrigin
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage


@dataclass(frozen=True)
class Backlash(LinearEffect[Poses]):
    """Play in the gears: position = commanded position - (width_mm / 2) d, d the unit vector of the last motion.

    The width is positive: the arm lags behind the motion, never ahead.
    """

    typical_mm: float = 0.5

    name = "backlash"
    words = "backlash (play) of the arm"
    stage = Stage.POSE
    units = ("mm",)
    covariates = ("slope", "direction")
    parameters = ("width_mm",)
    positive = True

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical width to 0.5 % of the length of the longest scan."""
        return cls(typical_mm=0.005 * extent.length_mm)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Return the poses, shifted against the direction of the last commanded motion."""
        half_mm = theta[:, :1] / 2
        return replace(
            value,
            x_mm=value.x_mm - half_mm * plan.direction_of_motion[:, 0],
            y_mm=value.y_mm - half_mm * plan.direction_of_motion[:, 1],
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the arm comes to rest {value_with_sd(mean[0], sd[0], factor=0.5)} mm short of where it was sent, "
            f"on the side it came from: gear play of {value_with_sd(mean[0], sd[0])} mm"
        )


_LARGE_SCALES = (-0.3, -0.1, 0.1, 0.3)


@dataclass(frozen=True)
class PositionScale(CountsPlaceFromOrigin, LinearEffect[Poses]):
    """Motor steps of the wrong length: X (1 + x), Y (1 + y), from `origin`."""

    typical: float = 0.01

    name = "position_scale"
    words = "a wrong scale of the positions"
    stage = Stage.POSE
    units = ("1", "1")
    covariates = ("place", "slope")
    parameters = ("x", "y")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with its default scale: 1 % is a typical error, a wrong wheel size makes tens of %."""
        return cls(origin=extent.origin)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        x_mm, y_mm = self.origin.x_mm, self.origin.y_mm
        return replace(
            value,
            x_mm=x_mm + (value.x_mm - x_mm) * (1 + theta[:, :1]),
            y_mm=y_mm + (value.y_mm - y_mm) * (1 + theta[:, 1:2]),
        )

    def bank(self) -> FloatArray:
        """Return five entries, (5, 2, 2): a small one, which the SSF's width may absorb, and four large ones."""
        return np.array([self.typical, *_LARGE_SCALES])[:, None, None] * np.eye(2)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the arm moves {value_with_sd(mean[0], sd[0], factor=100)} % too far along X and "
            f"{value_with_sd(mean[1], sd[1], factor=100)} % along Y: the scale of its positions is wrong"
        )
