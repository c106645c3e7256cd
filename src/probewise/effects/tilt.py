"""A sensor that does not look straight down: an effect on the pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect
from probewise.recordings.plan import Plan
from probewise.sensor.commanded import height_ratio
from probewise.sensor.stages import Poses, Stage


@dataclass(frozen=True)
class SensorTilt(LinearEffect[Poses]):
    """A tilt fixed in the lab frame: the footprint shifts by (dx_mm, dy_mm) = h tan(tilt) at any orientation.

    The shift is that at the description's height; it grows with a commanded one.
    """

    typical_mm: float = 0.3

    name = "sensor_tilt"
    words = "a tilted sensor"
    stage = Stage.POSE
    units = ("mm", "mm")
    covariates = ("orientation", "slope")
    parameters = ("dx_mm", "dy_mm")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical shift to 0.3 % of the length of the longest scan."""
        return cls(typical_mm=0.003 * extent.length_mm)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        dx_mm, dy_mm = theta[:, :1], theta[:, 1:2]
        ratio = height_ratio(plan)
        if ratio is not None:
            dx_mm, dy_mm = dx_mm * ratio, dy_mm * ratio
        return replace(value, x_mm=value.x_mm + dx_mm, y_mm=value.y_mm + dy_mm)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the sensor's spot is off by {value_with_sd(mean[0], sd[0])} mm along X and "
            f"{value_with_sd(mean[1], sd[1])} mm along Y, whatever the orientation: the sensor is tilted"
        )
