"""Slow changes of the mounting: the sensor turns in its holder, or sinks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect
from probewise.effects.origin import CountsTimeFromOrigin
from probewise.recordings.plan import Plan
from probewise.sensor.commanded import footprint_at_added_height
from probewise.sensor.stages import Footprint, Poses, Stage


@dataclass(frozen=True)
class SlowTurn(CountsTimeFromOrigin, LinearEffect[Poses]):
    """The sensor turns in its holder: orientation + deg_per_hour t, t the hours since `origin`."""

    typical_deg_per_hour: float = 2.0

    name = "slow_turn"
    words = "a sensor that slowly turns"
    stage = Stage.POSE
    units = ("deg/h",)
    covariates = ("time", "orientation")
    parameters = ("deg_per_hour",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical rate to two degrees over the recording."""
        return cls(typical_deg_per_hour=2.0 / (extent.duration_s / 3600), origin=extent.origin)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        turn = np.deg2rad(theta[:, :1]) * self.origin.hours(plan)
        return replace(value, orientation_rad=value.orientation_rad + turn)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"the sensor turns by {value_with_sd(mean[0], sd[0])} degrees per hour: it is loose in its holder"


@dataclass(frozen=True)
class SlowSinking(CountsTimeFromOrigin, LinearEffect[Footprint]):
    """The sensor sinks or rises: per_hour t h0 adds to the height; footprint x h/h0, signal x (h0/h)^2.

    t is the time since `origin` in hours; h0 and h are those of `HeightGradient`.
    """

    typical_per_hour: float = 0.1

    name = "slow_sinking"
    words = "a sensor that slowly rises or sinks"
    stage = Stage.FOOTPRINT
    units = ("1/h",)
    covariates = ("time", "level")
    parameters = ("per_hour",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical rate to 1 % of the height over the recording."""
        return cls(typical_per_hour=0.01 / (extent.duration_s / 3600), origin=extent.origin)

    def apply(self, value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        return footprint_at_added_height(value, theta[:, :1] * self.origin.hours(plan), plan)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "rises" if mean[0] > 0 else "sinks"
        return (
            f"the sensor {way} by {value_with_sd(abs(mean[0]), sd[0], factor=100)} % of its height per hour: "
            "it is loose in its holder"
        )
