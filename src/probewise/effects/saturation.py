"""Where the electronics run out of range: effects on the finished reading."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.vocabulary import Extent, give_or_take
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage

__all__ = ["Saturation"]


@dataclass(frozen=True)
class Saturation:
    """Clip at a level: reading = min(reading, level)."""

    lowest: float = 0.0
    highest: float = 100.0

    name: ClassVar[str] = "saturation"
    stage: ClassVar[Stage] = Stage.SATURATION
    units: ClassVar[tuple[str, ...]] = ("reading",)
    covariates: ClassVar[tuple[str, ...]] = ("level",)
    amplitudes: ClassVar[tuple[int, ...]] = ()

    @classmethod
    def for_extent(cls, extent: Extent) -> Self:
        """Look among the levels that were reached: a level above all readings clips nothing."""
        return cls(lowest=extent.low + 0.2 * extent.span, highest=extent.high)

    @cached_property
    def prior(self) -> Product:
        """The level, even over the range where it would bite."""
        return Product({"level": Uniform(self.lowest, self.highest)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Clip the readings, (n_samples, n_points)."""
        return np.minimum(value, theta[:, :1])

    def bank(self) -> FloatArray:
        """One column each for twelve levels, closer together near the top."""
        share = 1 - np.geomspace(0.02, 0.9, 12)
        return (self.lowest + share * (self.highest - self.lowest))[:, None, None]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say above which reading nothing is reported."""
        return f"no reading rises above {give_or_take(mean[0], sd[0])}: the electronics saturate"
