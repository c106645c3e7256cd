"""Effects on the offset: they add to the reading whatever lies under the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from probewise._arrays import FloatArray, varies
from probewise._words import value_with_sd
from probewise.effects.change_points import ChangePointEffect, candidate_change_times_s
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect
from probewise.effects.origin import CountsPlaceFromOrigin, CountsTimeFromOrigin
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage


@dataclass(frozen=True)
class AmbientGradient(CountsPlaceFromOrigin, LinearEffect[FloatArray]):
    """Stray light that grows across the table: reading + per_mm_x X + per_mm_y Y, lab frame, from `origin`."""

    typical_per_mm: float = 0.005
    unit: str = field(default="", kw_only=True)

    name = "ambient_gradient"
    words = "stray light from one side"
    stage = Stage.OFFSET
    units = ("reading/mm", "reading/mm")
    covariates = ("place",)
    parameters = ("per_mm_x", "per_mm_y")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical slope to 1 % of the readings' range over the longest scan; None where nothing moves."""
        if not (varies(extent.plan.x_mm) or varies(extent.plan.y_mm)):
            return None
        typical = 0.01 * extent.span / extent.length_mm
        return cls(typical_per_mm=typical, unit=extent.reading_unit, origin=extent.origin)

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        x_mm, y_mm = plan.x_mm - self.origin.x_mm, plan.y_mm - self.origin.y_mm
        return np.asarray(value + theta[:, :1] * x_mm + theta[:, 1:2] * y_mm)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the reading changes by {value_with_sd(mean[0], sd[0], self.unit, factor=100)} per 100 mm along X and by "
            f"{value_with_sd(mean[1], sd[1], self.unit, factor=100)} per 100 mm along Y, over black and white alike: "
            "stray light from one side"
        )


@dataclass(frozen=True)
class OffsetDrift(CountsTimeFromOrigin, LinearEffect[FloatArray]):
    """A slow drift: reading + per_hour t, t the plan's time since `origin` in hours."""

    typical_per_hour: float = 1.0
    unit: str = field(default="", kw_only=True)

    name = "offset_drift"
    words = "a slow drift of all readings"
    stage = Stage.OFFSET
    units = ("reading/h",)
    covariates = ("time",)
    parameters = ("per_hour",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical drift to 1 % of the readings' range over the recording."""
        typical = 0.01 * extent.span / (extent.duration_s / 3600)
        return cls(typical_per_hour=typical, unit=extent.reading_unit, origin=extent.origin)

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value + theta[:, :1] * self.origin.hours(plan))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "rises" if mean[0] > 0 else "falls"
        return (
            f"the reading {way} by {value_with_sd(abs(mean[0]), sd[0], self.unit)} per hour, over black and white "
            "alike: the electronics or the room light drift"
        )


@dataclass(frozen=True)
class AmbientStep(ChangePointEffect[FloatArray]):
    """Light switched on or off in the room: reading + amp 1(t > at_s)."""

    typical: float = 0.5
    unit: str = field(default="", kw_only=True)

    name = "ambient_step"
    words = "a sudden change of the room light"
    stage = Stage.OFFSET
    units = ("reading", "s")
    covariates = ("time",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical step to 1 % of the readings' range; None where all readings share one time."""
        times = candidate_change_times_s(extent)
        return None if times is None else cls(times, typical=0.01 * extent.span, unit=extent.reading_unit)

    @property
    def typical_sizes(self) -> Mapping[str, float]:
        return {"amp": self.typical}

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value + theta[:, :1] * self.after_change_mask(theta, plan))

    def with_fewer_variants(self) -> Self:
        """Return the effect with all intervals: the time of the step is what identifies it."""
        return self

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "jumps up" if mean[0] > 0 else "drops"
        return (
            f"the reading {way} by {value_with_sd(abs(mean[0]), sd[0], self.unit)} at "
            f"{value_with_sd(mean[1], sd[1])} s and stays there, over black and white alike: the room light changed"
        )
