"""How high the sensor hangs: the higher, the wider its footprint and the weaker its signal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.moves import in_scans, mountings
from probewise.effects.vocabulary import NamedEffect, give_or_take
from probewise.priors import Product
from probewise.recordings.plan import Plan
from probewise.sensor.commanded import raised
from probewise.sensor.stages import Footprint, Stage

__all__ = ["HeightGradient", "HeightOffset"]

_USUAL_MM = 14.0  # where a recording does not say


@dataclass(frozen=True)
class HeightGradient(NamedEffect[Footprint]):
    """A table that slopes: height h = h0 + mm_per_mm X; footprint x h/h0, signal x (h0/h)^2.

    h0 is the height of the recording's description, 14 mm where it has none.
    """

    typical: float = 0.001

    name: ClassVar[str] = "height_gradient"
    stage: ClassVar[Stage] = Stage.FOOTPRINT
    units: ClassVar[tuple[str, ...]] = ("mm/mm",)
    covariates: ClassVar[tuple[str, ...]] = ("place",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Take a hundredth of the height over the longest scan as typical."""
        return cls(typical=0.01 * _height_mm(extent.plan) / extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        """Rise of the sensor above the surface, of either sign."""
        return Product({"mm_per_mm": HeavyTailed(self.typical)})

    def apply(self, value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        """Widen and dim the footprint along X."""
        return raised(value, 1 + theta[:, :1] * plan.x_mm / _height_mm(plan))

    def bank(self) -> FloatArray:
        """One setting: linear in the slope."""
        return np.full((1, 1, 1), self.typical)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how far the sensor rises over 100 mm."""
        way = "rises" if mean[0] > 0 else "sinks"
        return (
            f"the sensor {way} by {give_or_take(abs(mean[0]), sd[0], factor=100)} mm above the surface for each 100 mm "
            "along X: the table slopes"
        )


@dataclass(frozen=True)
class HeightOffset(NamedEffect[Footprint]):
    """A mounting, or a scan, at another height: h = h0 + mm there; footprint x h/h0, signal x (h0/h)^2.

    `scans` names those scans, `choices` are all that they might be.
    """

    typical_mm: float = 0.15
    scans: tuple[str, ...] = ()
    choices: tuple[tuple[str, ...], ...] = ()

    name: ClassVar[str] = "height_offset"
    stage: ClassVar[Stage] = Stage.FOOTPRINT
    units: ClassVar[tuple[str, ...]] = ("mm",)
    covariates: ClassVar[tuple[str, ...]] = ("scan",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Take a hundredth of the height as typical, where there is more than one scan."""
        choices = mountings(extent.plan)
        return cls(0.01 * _height_mm(extent.plan), (), choices) if choices else None

    @cached_property
    def prior(self) -> Product:
        """How much higher, of either sign."""
        return Product({"mm": HeavyTailed(self.typical_mm)})

    def apply(self, value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        """Widen and dim the footprint in those scans."""
        return raised(value, 1 + theta * in_scans(plan, self.scans) / _height_mm(plan))

    def variants(self) -> tuple[Self, ...]:
        """Choose the mounting or the scan."""
        return tuple(replace(self, scans=choice) for choice in self.choices)

    def bank(self) -> FloatArray:
        """One setting: linear in the height."""
        return np.full((1, 1, 1), self.typical_mm)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how much higher, and in which scans."""
        way = "higher" if mean[0] > 0 else "lower"
        much = give_or_take(abs(mean[0]), sd[0])
        return f"in {', '.join(self.scans)} the sensor hangs {much} mm {way} than in the others"


def _height_mm(plan: Plan) -> float:
    return plan.instrumentation.height_mm or _USUAL_MM
