"""The scales of a recording (readings, length, time) from which effects set their priors and template banks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import rounding_error
from probewise.effects.origin import Origin
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan, Recording


@dataclass(frozen=True, eq=False)
class Extent:
    """Scales of a recording, from the range of its usable readings and from its plan.

    Parameters
    ----------
    low, high
        Least and largest usable reading.
    plan
        Pose, time and pattern of every reading.
    """

    low: float
    high: float
    plan: Plan

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ParameterError("Extent(low, high)", (self.low, self.high), "low < high")

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """Measure the scales of a recording.

        Raises
        ------
        ParameterError
            If there is no usable reading.
        """
        readings = recording.readings[recording.usable]
        if readings.size == 0:
            raise ParameterError("usable readings", 0, "at least one; the recording holds none")
        low, high = float(readings.min()), float(readings.max())
        tiny = (max(abs(low), abs(high)) or 1.0) * 1e-6  # relative: the unit of a reading may be large
        return cls(low, max(high, low + tiny), recording.plan)

    @property
    def reading_unit(self) -> str:
        """Unit of a reading, as written after a number."""
        return self.plan.instrumentation.unit_after_number

    @property
    def span(self) -> float:
        """Largest minus least usable reading."""
        return self.high - self.low

    @cached_property
    def origin(self) -> Origin:
        """Time and place from which effects on this recording count."""
        return Origin.of(self.plan)

    @cached_property
    def length_mm(self) -> float:
        """Diagonal of the X and Y ranges of the longest scan, mm; 1 if nothing moves."""
        plan = self.plan
        ends = [(plan.x_mm[rows], plan.y_mm[rows]) for rows in plan.rows_by_scan() if rows.size]
        longest = max(float(np.hypot(np.ptp(x), np.ptp(y))) for x, y in ends)
        return longest if longest > rounding_error(np.append(plan.x_mm, plan.y_mm)) else 1.0

    @cached_property
    def duration_s(self) -> float:
        """Time from the first reading to the last, s; 1 where no time passes."""
        return float(np.ptp(self.plan.time_s)) or 1.0

    @cached_property
    def gap_s(self) -> float:
        """Median time between consecutive readings of a scan, s; 1 where no time passes."""
        return median_gap_s(self.plan)


def median_gap_s(plan: Plan) -> float:
    """Return the median time between consecutive readings of a scan, s; 1 where no time passes."""
    gaps = np.diff(plan.time_s)[np.diff(plan.scan) == 0]
    gaps = gaps[gaps > rounding_error(plan.time_s)]
    return float(np.median(gaps)) if gaps.size else 1.0
