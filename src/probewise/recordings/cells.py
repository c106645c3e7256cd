"""Cells of a table as numbers: plain ones, those with commas, thousands and units, and dates and clocks."""

from __future__ import annotations

import datetime
import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray, array_or_none
from probewise.errors import ParameterError

_SPELT = (map("".join, itertools.product(*zip(word, word.upper(), strict=True))) for word in ("nan", "na", "n/a"))
MISSING = frozenset(itertools.chain([""], *_SPELT))
"""Texts that mark a missing number."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
# On texts of these characters float() accepts exactly what _NUMBER does ('infinity' and '1_000' have others).
_OF_NUMBERS = re.compile(r"[-+.0-9eE]*", re.ASCII)

_OTHER_WORDS = frozenset({"#n/a", "#na", "#value!", "#div/0!", "null", "none", "missing", "-", "--", "---", "----"})
_ODD_SIGNS = str.maketrans(
    {"\u2212": "-", "\u2013": "-", "\u2019": "'", **dict.fromkeys("\u00a0\u2007\u2009\u202f", " ")}
)
_QUANTITY = re.compile(
    r"(?P<number>[+-]? ?(?:[0-9](?:[0-9.,' ]*[0-9.,])?|[.,][0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r" *(?P<unit>(?![DdXx][+-]?\d)(?:[^\W\d_]|[%‰°])[^,;:]{0,15})?"  # not Fortran's 1.5D+01, nor 0x1
)
_GROUPS = {".": (",", " ", "'"), ",": (".", " ", "'")}  # between thousands, by decimal mark


def parsed_numbers(cells: Sequence[str]) -> FloatArray | None:
    """Convert cells to numbers in one pass; None if one of them is not a plain decimal number."""
    if _OF_NUMBERS.fullmatch("".join(cells)) is None:
        return None
    try:
        return np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
    except ValueError:
        return None


def first_cell_without_number(
    cells: Sequence[object], *, missing: bool = True, largest: float = math.inf
) -> int | None:
    """Return the index of the first cell that is no number up to `largest` and, if `missing`, not missing; or None.

    One that is no number however it is written comes before those that another way of writing would explain.
    """
    first: int | None = None
    for k, cell in enumerate(cells):
        text = str(cell).strip()
        if (missing and text in MISSING) or (_NUMBER.fullmatch(text) and abs(float(text)) <= largest):
            continue
        if not looks_like_number(text):
            return k
        first = k if first is None else first
    return first


def count_numbers(cells: Sequence[str]) -> int:
    """Count the cells that hold a plain decimal number (float() would accept 'infinity' and '1_000' too)."""
    if parsed_numbers(cells) is not None:
        return len(cells)
    return sum(n for cell, n in Counter(cells).items() if _NUMBER.fullmatch(cell))


class UnclearCellError(ValueError):
    """Report a column that can be read in several ways, or in none: the index of a cell, what is allowed there."""

    def __init__(self, index: int, allowed: str, *, name: str = "") -> None:
        self.name, self.index, self.allowed = name, index, allowed
        super().__init__(allowed)


def is_missing(cell: str) -> bool:
    """Return whether a cell is empty or holds a word for a missing number."""
    return cell in MISSING or cell.lower() in _OTHER_WORDS


def looks_like_number(cell: str) -> bool:
    """Return whether a cell holds a number, however it is written, with a unit or without."""
    return _QUANTITY.fullmatch(cell.translate(_ODD_SIGNS)) is not None


def plain_cells(
    odd: Mapping[str, Sequence[str]], usual: Callable[[], Mapping[str, Sequence[str]]]
) -> tuple[dict[str, list[str]], list[str]]:
    """Rewrite columns of numbers as plain numbers: decimal commas, thousands, units, words for what is missing.

    `odd` are the cells by name of the columns that are not plain numbers throughout; `usual` returns those that are.
    Where all numbers of a column can be read with either decimal mark, it has that of the other columns. Returns the
    rewritten columns by name, and notes on how they were read; UnclearCellError if a comma may be a decimal comma or
    separate thousands.
    """
    columns = dict(odd)
    read = {name: found for name, cells in odd.items() if (found := _Quantities.of(cells)) is not None}
    if any("," in number for found in read.values() for number in found.numbers.values()):
        columns |= usual()
        others = {name: _Quantities.of(cells) for name, cells in columns.items() if name not in odd}
        read |= {name: found for name, found in others.items() if found is not None}
    marks = {name: found.decimal_marks() for name, found in read.items()}
    certain = {mark for own in marks.values() if len(own) == 1 for mark in own}
    out: dict[str, list[str]] = {}
    commas, grouped, notes = list[str](), list[str](), list[str]()
    for name, found in read.items():
        own = marks[name] if len(marks[name]) < 2 else marks[name] & certain
        if len(own) != 1 and (len(marks[name]) == 0 or name not in odd):
            continue  # texts, or plain numbers of which nothing else says otherwise
        numbers = found.numbers.values()
        if len(own) != 1 and any("," in number for number in numbers):
            k = next(k for k, cell in enumerate(columns[name]) if "," in cell)
            allowed = "a number without thousands: the comma may be a decimal comma or set them apart"
            raise UnclearCellError(k, allowed, name=name)
        mark = own.pop() if len(own) == 1 else "."
        if mark == "," and any("," in number for number in numbers):
            commas.append(name)
        if any(group in number for number in numbers for group in _GROUPS[mark]):
            grouped.append(name)
        notes += [f"{name} in {found.unit}, as its cells say"] * bool(found.unit)
        notes += [f"{', '.join(map(repr, sorted(found.words)))} missing in {name}"] * bool(found.words)
        cells = found.plain(mark)
        out[name] = [cells[cell] for cell in columns[name]]
    for said, names in (("thousands set apart", grouped), ("decimal commas", commas)):
        notes[:0] = [f"{said} in {', '.join(names)}"] * bool(names)
    return out, notes


class _Quantities:
    """The distinct cells of a column of numbers, the number in each, their unit, and the words for missing ones."""

    def __init__(self, numbers: dict[str, str], unit: str, words: set[str], missing: set[str]) -> None:
        self.numbers, self.unit, self.words, self.missing = numbers, unit, words, missing

    @classmethod
    def of(cls, cells: Sequence[str]) -> _Quantities | None:
        """Take a column apart; None if it is one of texts, or if its units differ."""
        numbers, units, words, missing = dict[str, str](), set[str](), set[str](), set[str]()
        for cell in dict.fromkeys(cells):
            if cell in MISSING:
                missing.add(cell)
            elif cell.lower() in _OTHER_WORDS:
                words.add(cell)
            elif (found := _QUANTITY.fullmatch(cell.translate(_ODD_SIGNS))) is not None:
                numbers[cell] = found["number"].replace("- ", "-").replace("+ ", "+")
                units.add(found["unit"] or "")
            else:
                return None
        return cls(numbers, next(iter(units)), words, missing) if len(units) == 1 else None

    def decimal_marks(self) -> set[str]:
        """Return the decimal marks with which all numbers can be read, in one of the ways to set thousands apart."""
        marks, exponent = set[str](), r"(?:[eE][+-]?\d+)?"
        for mark, groups in _GROUPS.items():
            point = re.escape(mark)
            for group in map(re.escape, groups):
                whole = rf"(?:\d+|[1-9]\d{{0,2}}(?:{group}\d{{3}})+)(?:{point}\d*)?"
                form = re.compile(rf"[+-]?(?:{whole}{exponent}|{point}\d+{exponent})")
                if all(map(form.fullmatch, self.numbers.values())):
                    marks.add(mark)
        return marks

    def plain(self, mark: str) -> dict[str, str]:
        dropped = str.maketrans("", "", "".join(_GROUPS[mark]))
        out = {cell: number.translate(dropped).replace(mark, ".") for cell, number in self.numbers.items()}
        return out | dict.fromkeys(self.words, "") | {cell: cell for cell in self.missing}


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


def require_unit_of_time(name: str, cells: Sequence[str], wanted: str) -> None:
    """Raise UnclearCellError if the cells of a column of times have another unit than is wanted."""
    found = _Quantities.of(cells)
    unit = "" if found is None else found.unit
    if unit and _SECONDS.get(unit.lower()) != _SECONDS.get(wanted.lower(), unit):
        raise UnclearCellError(0, f'times in {wanted}, or time_unit = "{unit}"', name=name)


def is_other_unit_of_time(unit: str, wanted: str) -> bool:
    """Return whether a text is a unit of time, and another than is wanted."""
    return unit.lower() in _SECONDS and _SECONDS[unit.lower()] != _SECONDS.get(wanted.lower())


def are_other_days(days: Sequence[str], clocks: Sequence[str]) -> bool:
    """Return whether cells are dates alone, not all the same, that change where clocks in the same rows do not."""
    if not (looks_like_time(days[0]) and _CLOCK_ALONE.fullmatch(clocks[0])):
        return False
    dates = [match for cell in days if (match := _YEAR_FIRST.fullmatch(cell) or _YEAR_LAST.fullmatch(cell))]
    hours = [match for cell in clocks if (match := _CLOCK_ALONE.fullmatch(cell)) and match["second"]]
    all_read = len(dates) == len(days) and len(hours) == len(clocks)
    if not all_read or len(set(days)) == 1 or any(match["hour"] for match in dates):
        return False
    try:
        by_date, _ = _seconds_of_dates([match.groupdict() for match in dates])
        by_clock, _ = _seconds_of_clocks([match.groupdict() for match in hours])
    except UnclearCellError:  # a date that can be read in two ways
        return False
    return bool((np.diff(by_date // _DAY) != np.diff(by_clock // _DAY)).any())


def times_to_numbers(name: str, values: ArrayLike, unit: str = "s") -> tuple[ArrayLike, str]:
    """Convert dates, clocks and time differences (NumPy's, Python's, texts) to the time since the first, in `unit`.

    Returns the times, (n_points,), and a note on how they were read; anything else unchanged, and "". ParameterError if
    a cell is missing or can be read in several ways, or some dates have a time zone and others none.
    """
    array = array_or_none(values)
    if array is None or array.ndim != 1 or array.dtype.kind not in "OUmM" or not array.size:
        return values, ""
    cells = array.tolist()
    try:
        if array.dtype.kind in "mM" and not np.isnat(array).any():
            if array.dtype.kind == "M" and np.datetime_data(array.dtype)[0] in "YM":
                array = array.astype("M8[D]")
            seconds = np.asarray((array - array[:1]) / np.timedelta64(1, "s"), dtype=np.float64)
            return _in_unit(name, seconds, str(array[0]), unit)
        if all(isinstance(cell, datetime.datetime) for cell in cells):
            if len({cell.utcoffset() is None for cell in cells}) > 1:
                raise ParameterError(name, values, "dates that all have a time zone, or none of them")
            if cells[0].tzinfo is not None:  # Python subtracts what clocks of one zone show, also across summer time
                cells = [cell.astimezone(datetime.UTC) for cell in cells]
        elif not all(isinstance(cell, datetime.timedelta) for cell in cells):
            read = None
            if isinstance(cells[0], str | datetime.date | datetime.time):
                read = texts_to_times(name, [str(cell).strip() for cell in cells], unit)
            return read or (values, "")
        seconds = np.array([(cell - cells[0]).total_seconds() for cell in cells])
        return _in_unit(name, seconds, str(cells[0]), unit)
    except UnclearCellError as error:
        index = getattr(values, "index", None)  # of a column of a data frame; a list has a method of this name
        row = f"{error.index} (the first is 0)" if index is None or callable(index) else index[error.index]
        where = f"{name} in row {row}"
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
    same = ", the time of all rows" if len(seconds) > 1 and not seconds.any() else ""
    return seconds / _SECONDS[unit.lower()], f"column {name!r} counted in {unit} from {first}{same}"


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
        orders = {"": [(p["y"], p["m"], p["d"]) for p in parts]}
    elif any(p["b"].isalpha() for p in parts):
        months = {month: number for number, month in enumerate(_MONTHS, 1)}
        orders = {"": [(p["y"], months.get(p["b"][:3].lower(), 0), p["a"]) for p in parts]}
    else:
        orders = {", day first": [(p["y"], p["b"], p["a"]) for p in parts]}
        orders[", month first"] = [(p["y"], p["a"], p["b"]) for p in parts]
    read = [(days - days[0], said) for said, dates in orders.items() if (days := _days(dates)).size]
    if not read:
        _days(next(iter(orders.values())), strict=True)
    days, said = read[0]
    if len(read) > 1 and (differ := days != read[1][0]).any():
        k = int(np.argmax(differ))
        raise UnclearCellError(k, "year first (2026-11-28): day and month cannot be told apart, as no day is above 12")
    return _DAY * days + clocks, said if len(read) == 1 else ""


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
