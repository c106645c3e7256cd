"""A specular reflection at one place, on black and white alike: an effect on the offset."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.patches import PatchEffect, distinct_scan_lines, gaussian_bump
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage


@dataclass(frozen=True)
class Glint(PatchEffect[FloatArray]):
    """A reflection at one place, on black too: reading + amp exp(-d^2 / 2 r^2), d the distance from (x, y)."""

    typical: float = 1.0
    unit: str = field(default="", kw_only=True)

    name = "glint"
    words = "a glint at one place"
    stage = Stage.OFFSET
    size = "amp"
    units = ("reading", "mm", "mm", "mm")
    covariates = ("place",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical height to 2 % of the readings' range, and the bank on straight scans; None without any."""
        lines = distinct_scan_lines(extent.plan)
        return cls(0.02 * extent.span, lines[0], lines, unit=extent.reading_unit) if lines else None

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        amp, x, y, r = (theta[:, k : k + 1] for k in range(4))
        return np.asarray(value + amp * gaussian_bump((plan.x_mm - x) ** 2 + (plan.y_mm - y) ** 2, r))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"within {value_with_sd(mean[3], sd[3])} mm of the place ({value_with_sd(mean[1], sd[1])}, "
            f"{value_with_sd(mean[2], sd[2])}) mm the readings are {value_with_sd(abs(mean[0]), sd[0], self.unit)} too "
            f"{'high' if mean[0] > 0 else 'low'}, over black and white alike: a reflection"
        )
