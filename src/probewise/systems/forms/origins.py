"""Origins from which times and columns are counted, and numbers rounded finely against a spread."""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.origin import is_far_from_zero
from probewise.systems.table import RunTable

_ALL = 17  # digits of a number in double precision


def origin_of_column(values: FloatArray) -> float:
    """Return the origin from which an effect counts a column, (n_points,), in its unit: 0 unless that is far away.

    Where all values are more than ten times the column's range from 0, as times in seconds of the epoch are, the origin
    is the least of them. Counted from 0, a drift would be a constant, and a phase would turn with the last digit of a
    frequency.
    """
    least = float(np.nanmin(values))
    return least if is_far_from_zero(values, float(np.nanmax(values)) - least) else 0.0


def time_origin(table: RunTable) -> float:
    """Return the origin from which drifts and waves count the time of a recording: `origin_of_column` of the times.

    Effects keep the origin of the recording to which they were bound, whatever table they predict.
    """
    return origin_of_column(table.time_s)


def origin_in_words(name: str | None, origin: float, unit: str = "") -> str:
    """Return a phrase on the origin from which an effect counts the column `name`; "" for 0."""
    unit = "" if unit == name else unit  # "year counts from 1912 year"
    return f"{name} counts from {origin:.12g} {unit}".rstrip() if origin else ""


def rounded_to_spread(value: float, spread: float, least: int) -> float:
    """Round a number to `least` significant digits, or to more if that would move it by a twentieth of the spread."""
    return float(text_rounded_to_spread(value, spread, least))


def text_rounded_to_spread(value: float, spread: float, least: int = 4) -> str:
    """Return the text of a number rounded as by `rounded_to_spread`."""
    beyond = math.ceil(math.log10(abs(value) / spread)) if value and spread > 0 else 0
    return f"{value:.{min(max(least, 2 + beyond), _ALL)}g}"
