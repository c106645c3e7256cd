"""Dates and clocks of a column of time as numbers: the time since the first row."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray, array_or_none
from probewise.errors import ParameterError
from probewise.recordings.cells import UnclearCellError

_UNITS = {
    "s sec second seconds": 1.0,
    "ms millisecond milliseconds": 1e-3,
    "us µs μs microsecond microseconds": 1e-6,
    "min minute minutes": 60.0,
    "h hr hour hours": 3600.0,
    "d day days": 86400.0,
}
_SECONDS = {name: seconds for names, seconds in _UNITS.items() for name in names.split()}
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_CLOCK = r"(?P<hour>\d{1,4}):(?P<minute>\d\d)(?::(?P<second>\d\d))?(?P<fraction>[.,]\d+)?(?: ?(?P<half>[ap])\.?m\.?)?"
_ZONE = r"(?: ?(?P<zone>z|utc|gmt|[+-]\d\d:?\d\d|[+-]\d\d))?"
_YEAR_FIRST = re.compile(rf"(?P<y>\d{{4}})([-/.])(?P<m>\d\d?)\2(?P<d>\d\d?)(?:[t ]+{_CLOCK}{_ZONE})?", re.I | re.ASCII)
_YEAR_LAST = re.compile(
    rf"(?P<a>\d\d?)([-/. ])(?P<b>\d\d?|[a-z]{{3,9}})\2(?P<y>\d{{4}}|\d\d)(?:[t, ]+{_CLOCK}{_ZONE})?", re.I | re.ASCII
)
_CLOCK_ALONE = re.compile(_CLOCK, re.I | re.ASCII)
_DAY = 86400.0


def looks_like_time(cell: str) -> bool:
    """Return whether a cell holds a date or a clock."""
    return any(form.fullmatch(cell) for form in (_CLOCK_ALONE, _YEAR_FIRST, _YEAR_LAST))


def require_unit_of_time(name: str, unit: str, wanted: str) -> None:
    """Raise UnclearCellError if the cells of a column of times have another unit than is wanted."""
    if unit and _SECONDS.get(unit.lower()) != _SECONDS.get(wanted.lower(), unit):
        raise UnclearCellError(0, f'times in {wanted}, or time_unit = "{unit}"', name=name)


def times_to_numbers(name: str, values: ArrayLike, unit: str = "s") -> tuple[ArrayLike, str]:
    """Convert dates, clocks and time differences (NumPy's, Python's, texts) to the time since the first, in `unit`.

    Returns the times, (n_points,), and a note on how they were read; anything else unchanged, and "". ParameterError if
    a cell is missing or can be read in several ways, or some dates have a time zone and others none.
    """
    array = array_or_none(values)
    if array is None:
        return values, ""
    cells = array.tolist() if array.ndim == 1 and array.dtype.kind in "OUmM" else []
    if not cells:
        return values, ""
    try:
        if array.dtype.kind in "mM" and not np.isnat(array).any():
            seconds = np.asarray((array - array[:1]) / np.timedelta64(1, "s"), dtype=np.float64)
            return _in_unit(name, seconds, str(array[0]), unit)
        if all(isinstance(cell, datetime.datetime) for cell in cells):
            if len({cell.utcoffset() is None for cell in cells}) > 1:
                raise ParameterError(name, values, "dates that all have a time zone, or none of them")
        elif not all(isinstance(cell, datetime.timedelta) for cell in cells):
            read = None
            if isinstance(cells[0], str | datetime.date | datetime.time):
                read = texts_to_times(name, [str(cell).strip() for cell in cells], unit)
            return read or (values, "")
        seconds = np.array([(cell - cells[0]).total_seconds() for cell in cells])
        return _in_unit(name, seconds, str(cells[0]), unit)
    except UnclearCellError as error:
        where = f"{name} in row {error.index} (the first is 0)"
        raise ParameterError(where, str(cells[error.index]), error.allowed) from error


def texts_to_times(name: str, cells: Sequence[str], unit: str) -> tuple[FloatArray, str] | None:
    """Convert dates or clocks to the time since the first in `unit`, (n_points,), with a note; or None if it is none.

    Raises UnclearCellError at the first cell of another form, or one that can be read in several ways.
    """
    form = next((form for form in (_CLOCK_ALONE, _YEAR_FIRST, _YEAR_LAST) if form.fullmatch(cells[0])), None)
    if form is None:
        return None
    try:
        found = [form.fullmatch(cell) for cell in cells]
        if None in found:
            raise UnclearCellError(found.index(None), f"a time in each row, written as in the first: {cells[0]!r}")
        parts = [match.groupdict() for match in found if match is not None]
        seconds, said = _seconds_of_clocks(parts) if form is _CLOCK_ALONE else _seconds_of_dates(parts)
        return _in_unit(name, np.round(seconds - seconds[0], 9), f"{cells[0]}{said}", unit)
    except UnclearCellError as error:
        raise UnclearCellError(error.index, error.allowed, name=name) from error


def _in_unit(name: str, seconds: FloatArray, first: str, unit: str) -> tuple[FloatArray, str]:
    if unit.lower() not in _SECONDS:
        raise UnclearCellError(0, f'numbers, or time_unit = "s", "ms", "min", "h" or "d" in place of "{unit}"')
    return seconds / _SECONDS[unit.lower()], f"{name} counted in {unit} from {first}"


def _seconds_of_clocks(parts: Sequence[dict[str, Any]]) -> tuple[FloatArray, str]:
    """Return the seconds of clocks; one that falls by more than half a day has passed midnight."""
    if any(p["second"] is None and p["half"] is None for p in parts):
        if not any(p["fraction"] or int(p["hour"]) > 23 for p in parts):
            raise UnclearCellError(
                0, "hours, minutes and seconds (12:30:00): two numbers may be hours or minutes first"
            )
        if any(p["second"] is not None for p in parts):
            raise UnclearCellError(0, "the same number of colons in each row")
        shifted = [{**p, "hour": "0", "minute": p["hour"], "second": p["minute"]} for p in parts]
        return np.array([_seconds_of_clock(k, p, 10_000) for k, p in enumerate(shifted)]), ", minutes and seconds"
    seconds = np.array([_seconds_of_clock(k, p) for k, p in enumerate(parts)])
    if (seconds >= _DAY).any():
        return seconds, ""
    midnights = np.cumsum(np.diff(seconds, prepend=seconds[0]) < -_DAY / 2)
    return seconds + _DAY * midnights, ", past midnight" if midnights[-1] else ""


def _seconds_of_clock(index: int, part: dict[str, Any], most_minutes: int = 60) -> float:
    hour, minute, second = (int(part[name] or 0) for name in ("hour", "minute", "second"))
    if part["half"]:
        if not 1 <= hour <= 12:
            raise UnclearCellError(index, "hours from 1 to 12 before am and pm")
        hour = hour % 12 + 12 * (part["half"].lower() == "p")
    if minute >= most_minutes or second >= 60:
        raise UnclearCellError(index, "minutes and seconds below 60")
    fraction = float("0." + part["fraction"][1:]) if part["fraction"] else 0.0
    return 3600.0 * hour + 60.0 * minute + second + fraction


def _seconds_of_dates(parts: Sequence[dict[str, Any]]) -> tuple[FloatArray, str]:
    """Return the seconds of dates since the first day; UnclearCellError if day and month may be interchanged."""
    if short := [k for k, p in enumerate(parts) if len(p["y"]) == 2]:
        raise UnclearCellError(short[0], "a year of four digits: of two, day, month and year cannot be told apart")
    if len({p["zone"] is None for p in parts if p["hour"]}) > 1:
        raise UnclearCellError(0, "dates that all have a time zone, or none of them")
    clocks = np.array([_seconds_of_clock(k, p) for k, p in enumerate(parts)])
    for k, zone in enumerate(p["zone"] for p in parts):
        if zone is not None and zone[0] in "+-":
            digits = zone[1:].replace(":", "").ljust(4, "0")
            clocks[k] -= float(f"{zone[0]}1") * (3600.0 * int(digits[:2]) + 60.0 * int(digits[2:]))
    if "a" not in parts[0]:
        days = _days(((p["y"], p["m"], p["d"]) for p in parts), strict=True)
        return _DAY * (days - days[0]) + clocks, ""
    if any(p["b"].isalpha() for p in parts):
        months = {month: number for number, month in enumerate(_MONTHS, 1)}
        days = _days(((p["y"], months.get(p["b"][:3].lower(), 0), p["a"]) for p in parts), strict=True)
        return _DAY * (days - days[0]) + clocks, ""
    day_first = _days((p["y"], p["b"], p["a"]) for p in parts)
    month_first = _days((p["y"], p["a"], p["b"]) for p in parts)
    either = [days - days[0] for days in (day_first, month_first) if days.size]
    if len(either) == 2 and (either[0] != either[1]).any():
        k = int(np.argmax(either[0] != either[1]))
        raise UnclearCellError(k, "year first (2026-11-28): day and month cannot be told apart, as no day is above 12")
    if not either:
        _days(((p["y"], p["b"], p["a"]) for p in parts), strict=True)
    order = "" if len(either) == 2 else ", day first" if day_first.size else ", month first"
    return _DAY * either[0] + clocks, order


def _days(dates: Iterable[tuple[Any, Any, Any]], *, strict: bool = False) -> FloatArray:
    """Return the days of dates (year, month, day); without one that does not exist, or empty unless `strict`."""
    out = []
    for k, (year, month, day) in enumerate(dates):
        try:
            out.append(datetime.date(int(year), int(month), int(day)).toordinal())
        except ValueError as error:
            if strict:
                raise UnclearCellError(k, "a date that exists, such as 2026-11-28") from error
            return np.empty(0)
    return np.array(out, dtype=np.float64)
