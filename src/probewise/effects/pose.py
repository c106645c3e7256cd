"""Where the sensor really stands: effects on the pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.vocabulary import Extent, give_or_take
from probewise.priors import Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage

__all__ = ["Backlash"]


@dataclass(frozen=True)
class Backlash:
    """Play in the gears: place = commanded place - (width_mm / 2) direction, on each axis."""

    typical_mm: float = 0.5

    name: ClassVar[str] = "backlash"
    stage: ClassVar[Stage] = Stage.POSE
    units: ClassVar[tuple[str, ...]] = ("mm",)
    covariates: ClassVar[tuple[str, ...]] = ("slope", "direction")
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self:
        """Take half a percent of the longest scan as typical."""
        return cls(typical_mm=0.005 * extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        """Width, greater than zero: an arm cannot arrive before it has moved."""
        return Product({"width_mm": HeavyTailed(self.typical_mm, positive=True)})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Shift the poses against the direction of the last commanded move."""
        half_mm = theta[:, :1] / 2
        return Poses(
            x_mm=value.x_mm - half_mm * plan.direction[:, 0],
            y_mm=value.y_mm - half_mm * plan.direction[:, 1],
            orientation_rad=value.orientation_rad,
        )

    def bank(self) -> FloatArray:
        """One setting: the shift is linear in the width."""
        return np.full((1, 1, 1), self.typical_mm)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how far short of its goal the arm comes to rest."""
        return (
            f"the arm comes to rest {give_or_take(mean[0], sd[0], factor=0.5)} mm short of where it was sent, "
            f"on the side it came from: gear play of {give_or_take(mean[0], sd[0])} mm"
        )
