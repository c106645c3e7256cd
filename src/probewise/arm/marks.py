"""Places of the marks for calibrating an arm's geometry."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import Geometry
from probewise.errors import ReachError

LEAST_MARKS = 5
"""Least number of marks, with place and height, that determine the nine parameters of the geometry."""

_COLUMNS, _ROWS = (0.1, 0.3, 0.5, 0.7, 0.9), (0.12, 0.45, 0.75)
_STEP_MM = 10.0


def spread_mark_places(geometry: Geometry) -> FloatArray:
    """Choose places spread over the arm's reach on the field, in whole steps of 10 mm.

    Returns
    -------
    Five to eight places, shape (n_marks, 2), in mm, in the order of use.

    Raises
    ------
    ReachError
        If fewer than five are within reach.
    """
    width, height = geometry.field_mm
    # Every second place of a grid, as on a chessboard, so that no two rows have the same base angles.
    grid = [
        (x * width, y * height)
        for row, y in enumerate(_ROWS)
        for column, x in enumerate(_COLUMNS if row % 2 == 0 else _COLUMNS[::-1])
        if (row + column) % 2 == 0
    ]
    marks = np.round(np.array(grid) / _STEP_MM) * _STEP_MM
    marks = marks[geometry.contains(marks)]
    if len(marks) < LEAST_MARKS:
        raise ReachError("marks", f"{len(marks)} within reach", f"{LEAST_MARKS} or more on {geometry.sentence()}")
    return marks
