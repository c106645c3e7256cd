"""Readings at an end of an instrument's declared range: the signal with its noise is at that end or beyond."""

from __future__ import annotations

import numpy as np

from probewise._arrays import BoolArray, FloatArray


def masks_of_readings_at_ends(
    readings: FloatArray, low: float | None, high: float | None, step: float | None
) -> tuple[BoolArray, BoolArray]:
    """Return which readings, of any shape, are at the low and at the high end of a range, within half a rounding step.

    An end may be None or infinite: open.
    """

    def are_at(end: float | None) -> BoolArray:
        if end is None or not np.isfinite(end):
            return np.zeros(np.shape(readings), dtype=np.bool_)
        return np.asarray(np.abs(readings - end) <= 0.5 * (1 + 1e-9) * (step or 0.0) + 1e-12 * abs(end))

    return are_at(low), are_at(high)
