"""A sensor that does not look straight down: an effect on the pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.vocabulary import NamedEffect, give_or_take
from probewise.priors import Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage

__all__ = ["SensorTilt"]


@dataclass(frozen=True)
class SensorTilt(NamedEffect[Poses]):
    """A tilt fixed in the lab frame: the footprint shifts by (dx_mm, dy_mm) = h tan(tilt) at any orientation."""

    typical_mm: float = 0.3

    name: ClassVar[str] = "sensor_tilt"
    stage: ClassVar[Stage] = Stage.POSE
    units: ClassVar[tuple[str, ...]] = ("mm", "mm")
    covariates: ClassVar[tuple[str, ...]] = ("orientation", "slope")
    amplitudes: ClassVar[tuple[int, ...]] = (0, 1)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical shift to 0.3 % of the longest scan."""
        return cls(typical_mm=0.003 * extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        """Shift along X and along Y."""
        shift = HeavyTailed(self.typical_mm)
        return Product({"dx_mm": shift, "dy_mm": shift})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Shift every pose."""
        return replace(value, x_mm=value.x_mm + theta[:, :1], y_mm=value.y_mm + theta[:, 1:2])

    def bank(self) -> FloatArray:
        """One entry of two columns: linear in both shifts."""
        return self.typical_mm * np.eye(2)[None, :, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how far the sensor looks from where it should."""
        return (
            f"the sensor looks {give_or_take(mean[0], sd[0])} mm along X and {give_or_take(mean[1], sd[1])} mm along Y "
            "beside where it should, however it is turned: it hangs at a tilt"
        )
