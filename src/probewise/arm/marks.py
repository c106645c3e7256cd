"""Where on the field the marks lie that an arm's geometry is fitted to."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import Geometry
from probewise.errors import ReachError

__all__ = ["LEAST_MARKS", "marks_of"]

LEAST_MARKS = 5
"""So many marks, with place and height each, determine the nine numbers of the geometry."""

_COLUMNS, _ROWS = (0.1, 0.3, 0.5, 0.7, 0.9), (0.12, 0.45, 0.75)
_STEP_MM = 10.0


def marks_of(geometry: Geometry) -> FloatArray:
    """Choose places spread over the field and within the arm's reach, in whole steps of 10 mm.

    Returns
    -------
    Shape (n_marks, 2), nine or fewer, in the order of taking.

    Raises
    ------
    ReachError
        If fewer than five are within reach.
    """
    width, height = geometry.field_mm
    # Every second place of a grid, as on a chessboard: no two rows show the same angles of the base.
    grid = [
        (x * width, y * height)
        for row, y in enumerate(_ROWS)
        for column, x in enumerate(_COLUMNS if row % 2 == 0 else _COLUMNS[::-1])
        if (row + column) % 2 == 0
    ]
    marks = np.round(np.array(grid) / _STEP_MM) * _STEP_MM
    marks = marks[geometry.holds(marks)]
    if len(marks) < LEAST_MARKS:
        raise ReachError("marks", f"{len(marks)} within reach", f"{LEAST_MARKS} or more on {geometry.sentence()}")
    return marks
