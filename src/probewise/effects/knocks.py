"""Sudden changes that are outside the vocabulary: the arm is knocked, or the gain jumps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.change_points import ChangePointEffect, candidate_change_times_s
from probewise.effects.extent import Extent
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage


@dataclass(frozen=True)
class ArmKnock(ChangePointEffect[Poses]):
    """The arm is pushed: after at_s every position is off by (dx_mm, dy_mm) and the sensor is turned by turn_deg."""

    typical_mm: float = 0.3
    typical_deg: ClassVar[float] = 2.0

    name = "arm_knock"
    words = "an arm or sheet that was pushed"
    stage = Stage.POSE
    units = ("mm", "mm", "deg", "s")
    covariates = ("time", "slope")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical displacement to 0.5 % of the longest scan's length; None if all readings share one time."""
        times = candidate_change_times_s(extent)
        return None if times is None else cls(times, typical_mm=0.005 * extent.length_mm)

    @property
    def typical_sizes(self) -> Mapping[str, float]:
        return {"dx_mm": self.typical_mm, "dy_mm": self.typical_mm, "turn_deg": self.typical_deg}

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        since = self.after_change_mask(theta, plan)
        return replace(
            value,
            x_mm=value.x_mm + theta[:, :1] * since,
            y_mm=value.y_mm + theta[:, 1:2] * since,
            orientation_rad=value.orientation_rad + np.deg2rad(theta[:, 2:3]) * since,
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"from {value_with_sd(mean[3], sd[3])} s on, all positions are off by {value_with_sd(mean[0], sd[0])} mm "
            f"along X and {value_with_sd(mean[1], sd[1])} mm along Y, and the sensor is turned by "
            f"{value_with_sd(mean[2], sd[2])} degrees: the arm or the paper was pushed"
        )


@dataclass(frozen=True)
class GainStep(ChangePointEffect[FloatArray]):
    """The lamp or lens changes suddenly: signal x (1 + frac 1(t > at_s))."""

    typical: float = 0.02

    name = "gain_jump"
    words = "a sudden change of the signal's strength"
    stage = Stage.GAIN
    units = ("1", "s")
    covariates = ("time", "level")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with a change between any two readings; None if all readings share one time."""
        times = candidate_change_times_s(extent)
        return None if times is None else cls(times)

    @property
    def typical_sizes(self) -> Mapping[str, float]:
        return {"frac": self.typical}

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value * (1 + theta[:, :1] * self.after_change_mask(theta, plan)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "stronger" if mean[0] > 0 else "weaker"
        return (
            f"from {value_with_sd(mean[1], sd[1])} s on, the signal is "
            f"{value_with_sd(abs(mean[0]), sd[0], factor=100)} % {way}: the lamp or the lens changed suddenly"
        )
