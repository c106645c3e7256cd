"""What adds to the reading whatever lies under the sensor: effects on the offset."""

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
from probewise.sensor.stages import Stage

__all__ = ["AmbientGradient"]


@dataclass(frozen=True)
class AmbientGradient:
    """Stray light that grows across the table: reading + per_mm_x X + per_mm_y Y, lab frame."""

    typical_per_mm: float = 0.005

    name: ClassVar[str] = "ambient_gradient"
    stage: ClassVar[Stage] = Stage.OFFSET
    units: ClassVar[tuple[str, ...]] = ("1/mm", "1/mm")
    covariates: ClassVar[tuple[str, ...]] = ("place",)
    amplitudes: ClassVar[tuple[int, ...]] = (0, 1)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self:
        """Take a hundredth of the readings' range over the longest scan as typical."""
        return cls(typical_per_mm=0.01 * extent.span / extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        """The slope along X and along Y."""
        slope = HeavyTailed(self.typical_per_mm)
        return Product({"per_mm_x": slope, "per_mm_y": slope})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Add the plane to the readings, (n_samples, n_points)."""
        return np.asarray(value + theta[:, :1] * plan.x_mm + theta[:, 1:2] * plan.y_mm)

    def bank(self) -> FloatArray:
        """One setting of two columns: linear in both slopes."""
        return self.typical_per_mm * np.eye(2)[None, :, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how much the reading rises over 100 mm along each axis."""
        return (
            f"the reading rises by {give_or_take(mean[0], sd[0], factor=100)} per 100 mm along X and by "
            f"{give_or_take(mean[1], sd[1], factor=100)} per 100 mm along Y, black or white: stray light from one side"
        )
