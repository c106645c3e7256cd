"""Readings that an instrument could not take (NaN): where the next one has a chance of a value, and when to give up."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.instrument import Reading

MOST_MISSING = 8
"""Missing readings in a row after which a run ends."""

_SAME_MM = 1.0  # closer than this, two places count as one


def n_missing_at_end(readings: Sequence[Reading]) -> int:
    """Count the missing readings since the last value."""
    n = 0
    for reading in reversed(readings):
        if not math.isnan(reading.value):
            break
        n += 1
    return n


def chance_of_value(readings: Sequence[Reading], places_mm: FloatArray, *, reach_mm: float) -> FloatArray | None:
    """Return the chance that a reading at each place is not missing, (n_places, 2) -> (n_places,).

    It is the share of values among the readings so far, each weighted by one over its squared distance. One value at
    the distance `reach_mm` is added, so that a missing reading hardly counts farther away than that. So it is near 0
    where a reading was missing, and near 1 where one was not. None if no reading is missing.
    """
    missing = np.array([math.isnan(reading.value) for reading in readings], dtype=np.bool_)
    if not missing.any():
        return None
    taken = np.array([[reading.pose.x_mm, reading.pose.y_mm] for reading in readings])
    square = ((places_mm[:, None] - taken) ** 2).sum(axis=2) + _SAME_MM**2
    weight = reach_mm**2 / square
    return np.asarray((1.0 + weight[:, ~missing].sum(axis=1)) / (1.0 + weight.sum(axis=1)))
