"""The scale of readings; by default LEGO units, whole numbers from 1 to 100 (paper, "Robotic Arm Test Bed")."""

from __future__ import annotations

import math
from dataclasses import dataclass

from probewise.errors import ParameterError


@dataclass(frozen=True)
class ReadingScale:
    """Conversion of a value to a reading: rounded to multiples of `step` (None: not rounded), clipped to `low`, `high`.

    The default is the scale of LEGO units.
    """

    low: float = 1.0
    high: float = 100.0
    step: float | None = 1.0

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ParameterError("low", self.low, f"less than high, {self.high:g}")
        if self.step is not None and not self.step > 0:
            raise ParameterError("step", self.step, "greater than 0, or None")

    def clip_and_round(self, value: float) -> float:
        """Clip a value to the scale and round it to a step, within the scale; NaN, a missing reading, stays NaN."""
        if math.isnan(value):
            return value
        value = min(max(value, self.low), self.high)
        if self.step is not None:
            value = round(value / self.step) * self.step
        # A step that does not divide the range may have rounded past its end.
        return min(max(value, self.low), self.high)
