"""File format of the marks for calibrating the geometry: CSV, a row per mark, joint angles from home, x, y, height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import JOINTS
from probewise.recordings.atomic import write_text_atomically
from probewise.recordings.table import csv_text, number_text, read_table

_TURNED = tuple(f"{joint}_turned_deg" for joint in JOINTS)
_PLACE = ("x_mm", "y_mm", "height_mm")
_LARGEST = 1e4


@dataclass(frozen=True)
class TouchedMark:
    """A mark: angles of base, shoulder, elbow from home; x, y, height of the sensor's face (NaN: not measured)."""

    turned_rad: tuple[float, float, float]
    place_mm: tuple[float, float, float]


def read_turns_and_places(path: Path) -> tuple[FloatArray, FloatArray]:
    """Read marks: joint angles from home in radians, and x, y, height in mm, both (n_marks, 3).

    Raises FileError if a column is missing or a cell is not a number; only `height_mm` may be empty, which gives NaN.
    """
    table = read_table(path, wanted=(*_TURNED, *_PLACE))
    table.require_columns(*_TURNED, *_PLACE)
    turned = [table.column_of_numbers(name, largest=_LARGEST) for name in _TURNED]
    place = [table.column_of_numbers(name, missing=name == "height_mm", largest=_LARGEST) for name in _PLACE]
    return np.radians(np.stack(turned, axis=-1)), np.stack(place, axis=-1)


def write_marks(marks: Sequence[TouchedMark], path: Path) -> None:
    """Write marks for `read_turns_and_places`, angles in degrees and places in mm, atomically."""
    turned = np.degrees([mark.turned_rad for mark in marks]).reshape(-1, 3).round(4)
    place = np.array([mark.place_mm for mark in marks]).reshape(-1, 3).round(4)
    columns = dict(zip((*_TURNED, *_PLACE), np.concatenate([turned, place], axis=1).T.tolist(), strict=True))
    write_text_atomically(path, csv_text({name: [number_text(v) for v in cells] for name, cells in columns.items()}))
