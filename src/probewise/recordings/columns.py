"""Conversion of a user's columns (arrays, lists, tables) to a plan's numbers, codes and names."""

from __future__ import annotations

import contextlib
import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray, IntArray, array_or_none, floats
from probewise._kinds import require_kind, require_mapping
from probewise.errors import ParameterError, ShapeError, require
from probewise.recordings.cells import MISSING, count_numbers
from probewise.recordings.patterns import PATTERNS, Pattern
from probewise.recordings.table import number_text

A_PATTERN = "a pattern such as HalfPlane(normal_rad=0.0, offset_mm=0.0), of probewise.recordings"
KNOWN = ("reading", "x_mm", "y_mm", "orientation_deg", "orientation_rad", "scan", "pattern", "time_s")
"""Names of a table's columns that are no covariates; SESSION is none either."""
SESSION = "session"
"""Name of the column of `Plan.sessions`."""
A_SESSION = "a whole number from 0, the same throughout a scan"
A_SCAN = "a name in every row, or in none; leave out rows without a scan"


class TableLike(Protocol):
    """Columns by name: a dict of lists or arrays, or a data frame."""

    def keys(self) -> Iterable[Any]:
        """Return the names of the columns."""

    def __getitem__(self, name: Any, /) -> Any:
        """Values of a column."""


_CODE = re.compile(r"-99|-?9{3,}(\.9+)?|-273\.15|-?32768|32767|65535")  # of a missing value, in loggers


def is_commanded(name: str, controls: Sequence[str]) -> bool:
    """Return whether a column holds what the apparatus was told: the readings mean something else without it."""
    return name not in KNOWN and name in ("led", "height_mm", *controls)


def led_cell(cell: str) -> str:
    """Return a cell of the column `led` with true and false, in any case, as 1 and 0."""
    return {"true": "1", "false": "0"}.get(cell.lower(), cell)


def a_command(name: str) -> str:
    """Return, for an error message, what is allowed in the cell of a commanded column."""
    number = "0 or false (off), 1 or true (on)" if name == "led" else "a number, without its unit"
    return f"{number}, or empty where it is not known; under another name, a column of text is ignored"


def columns_by_name(table: TableLike) -> dict[str, Any]:
    """Return a table's columns by name, stripped of blanks.

    Raises ParameterError if it has no columns by name, or two names that differ only in the blanks around them.
    """
    names: Any = getattr(table, "columns", None)  # of a data frame, pandas or polars
    if isinstance(table, Mapping) or names is None:
        names = table.keys() if hasattr(table, "keys") else getattr(getattr(table, "dtype", None), "names", None)
    require(names is not None, "table", table, "columns by name: a dict of arrays, or a data frame")
    columns: dict[str, Any] = {}
    for name in names:
        own = str(name).strip()
        require(own not in columns, "columns", own, "each name once, also without the blanks around it")
        columns[own] = table[name]
    require_one_order(columns)
    return columns


def require_one_order(columns: Mapping[str, Any]) -> None:
    """Raise ParameterError if columns of a data frame have the same labels of rows in another order than the first."""
    indices: dict[str, Any] = {name: getattr(each, "index", None) for name, each in columns.items()}
    labels = {name: index for name, index in indices.items() if hasattr(index, "equals")}
    first = next(iter(labels.values()), ())
    for name, index in labels.items():
        differs = not index.equals(first) and set(index) == set(first)
        require(
            not differs, f"order of column {name!r}", list(index[:3]), "that of the others: make them one data frame"
        )


def numbers_per_reading(name: str, values: ArrayLike, n_points: int | None = None) -> FloatArray:
    """Convert to one number per reading, shape (n_points,); a single number is repeated if `n_points` is given.

    Raises ParameterError if a value is not a number, ShapeError for another shape or length.
    """
    out = floats(values, name)
    if out.ndim == 0 and n_points is not None:
        return np.full(n_points, float(out))
    if out.ndim != 1 or (n_points is not None and len(out) != n_points):
        each = "place (x_mm, y_mm)" if name == "readings" else "reading"
        allowed = f"one number per {each}" if n_points is None else f"({n_points},), one per {each}"
        raise ShapeError(f"{name} has shape {out.shape}; allowed: {allowed}")
    return out


def texts_to_numbers(values: ArrayLike) -> ArrayLike:
    """Parse a column of texts as in a file: numbers, and "", "nan", "n/a" and the like, which become NaN, as does None.

    A column without texts, or with a text that is none of these, is returned unchanged.
    """
    cells = values if isinstance(values, str) else array_or_none(values)
    if isinstance(cells, str) or cells is None or cells.ndim != 1 or cells.dtype.kind not in "OUT":
        return values
    try:
        return np.array([_number_or_nan(cell) for cell in cells.tolist()], dtype=np.float64)
    except (ValueError, OverflowError):
        return values


def _number_or_nan(cell: Any) -> Any:
    if not isinstance(cell, str):
        if not (is_missing_value(cell) or hasattr(cell, "__float__") or hasattr(cell, "__index__")):
            raise ValueError("no number")
        return math.nan if is_missing_value(cell) else cell
    text = cell.strip()
    if text not in MISSING and not count_numbers([text]):  # float() would accept 'infinity' and '1_000' too
        raise ValueError("no number")
    return math.nan if text in MISSING else float(text)


def checked_covariates(columns: Mapping[str, ArrayLike] | None, n_points: int) -> dict[str, FloatArray]:
    """Convert a user's covariates, none with the name of a recording's own column, to arrays by name; {} for None."""
    if columns is None:
        return {}
    require_mapping(
        "covariates", columns, "what was logged beside the readings, by name: {'temperature_c': [21.3, ...]}"
    )
    for name in columns:
        allowed = "a name that is no column of a recording; see its own argument"
        require(name not in (*KNOWN, SESSION), "covariates", name, allowed)
    return {name: numbers_per_reading(name, values, n_points) for name, values in columns.items()}


def selected_row_numbers(rows: ArrayLike | slice, n_points: int) -> IntArray:
    """Convert a selection of rows (numbers, a truth value per row, or a slice) to row numbers, (n_rows,)."""
    with contextlib.suppress(IndexError):
        at = rows if isinstance(rows, slice) else np.asarray(rows) if np.size(rows) else slice(0)
        numbers = np.arange(n_points)[at]
        if numbers.ndim == 1:
            return numbers
    allowed = f"numbers of rows in a list, up to {n_points - 1}; {n_points} truth values; or a slice"
    raise ParameterError("rows", rows, allowed)


def numeric_covariates_and_notes(
    columns: Mapping[str, ArrayLike], controls: Sequence[str]
) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    """Return the numeric columns by name, without a recording's own but for `session`, and notes on the others.

    ParameterError if a column that was commanded, or a `session` that differs between readings, is text.
    """
    out, notes = {}, []
    for name, values in columns.items():
        if name in KNOWN:
            continue
        if name == "led":
            values = _led_words_to_numbers(values)
        try:
            out[name] = numbers_per_reading(name, texts_to_numbers(values))
        except ParameterError as error:
            if is_commanded(name, controls):
                raise ParameterError(name, values, a_command(name)) from error
            if name == SESSION and len({str(value) for value in np.ravel(np.asarray(values, dtype=object))}) > 1:
                raise ParameterError(name, values, A_SESSION) from error
            notes.append(f"column {name} holds no numbers, ignored")
    return out, tuple(notes)


def _led_words_to_numbers(values: ArrayLike) -> ArrayLike:
    cells = np.asarray(values, dtype=object)
    if cells.ndim != 1 or not any(isinstance(cell, str) for cell in cells):
        return values
    return np.array([led_cell(cell.strip()) if isinstance(cell, str) else cell for cell in cells], dtype=object)


def scan_codes_and_names(names: str | Iterable[object] | None, n_points: int) -> tuple[IntArray, tuple[str, ...]]:
    """Assign scan numbers: every change of name, even to an earlier one, begins a new scan; a single name is one scan.

    Returns the number of each reading's scan, (n_points,), and the scans' names. ShapeError for another number of
    names; ParameterError if a name is missing, or empty where others are not.
    """
    if names is None or isinstance(names, str):
        return np.zeros(n_points, dtype=np.int64), (_checked_name("scan", names or "scan"),)
    cells = _names_per_reading("scan", names, n_points)
    if "" in cells and any(cells):
        raise ParameterError(f"scan[{cells.index('')}]", "", A_SCAN)
    begins = np.fromiter((k == 0 or cells[k] != cells[k - 1] for k in range(len(cells))), dtype=np.bool_)
    return np.cumsum(begins) - 1, tuple(cells[k] for k in np.flatnonzero(begins).tolist())


def sessions_of_scans(session: FloatArray, scan: IntArray) -> tuple[int, ...]:
    """Return the session of each scan, given each reading's, (n_points,), the same within a scan; () if all are one."""
    _, rows, which = np.unique(scan, return_index=True, return_inverse=True)
    first = session[rows]
    whole = np.isfinite(session) & (session >= 0) & (session == np.floor(session))
    wrong = np.flatnonzero(~(whole & (session == first[which.reshape(-1)])))
    if wrong.size:
        raise ParameterError(f"session[{wrong[0]}]", float(session[wrong[0]]), A_SESSION)
    return tuple(int(number) for number in first) if len(set(first.tolist())) > 1 else ()


def require_patterns(patterns: Mapping[str, Pattern]) -> None:
    """Raise ParameterError unless every value is a pattern; a dict of a pattern's fields is the usual mistake."""
    for name, pattern in patterns.items():
        require_kind("a name in patterns", name, str, "a text")
        require(isinstance(pattern, PATTERNS), f"patterns[{name!r}]", pattern, A_PATTERN)


def pattern_codes(names: str | Iterable[object] | None, patterns: Mapping[str, Pattern], n_points: int) -> IntArray:
    """Return the index in `patterns` of each reading's pattern, (n_points,); ParameterError for an unknown name."""
    known = list(patterns)
    if names is None:
        if len(known) > 1:
            listed = ", ".join(map(repr, known))
            raise ParameterError(
                "pattern", None, f"the name of each reading's pattern, since there are several: {listed}"
            )
        return np.zeros(n_points, dtype=np.int64)
    cells = [names] * n_points if isinstance(names, str) else _names_per_reading("pattern", names, n_points)
    code = {name: k for k, name in enumerate(known)}
    if unknown := set(cells).difference(code):
        k = next(k for k, cell in enumerate(cells) if cell in unknown)
        name = "pattern" if isinstance(names, str) else f"pattern[{k}]"
        raise ParameterError(name, cells[k], how_to_describe_pattern(cells[k], known))
    return np.fromiter(map(code.__getitem__, cells), dtype=np.int64, count=len(cells))


def how_to_describe_pattern(name: str, known: Sequence[str]) -> str:
    """Return, for an error message, what is allowed where a pattern is named but not described."""
    listed = ", ".join(map(repr, known)) or "none"
    return f"one that is described ({listed}); {name!r} is named but not described: pass patterns={{{name!r}: ...}}"


def _names_per_reading(name: str, values: Iterable[object], n_points: int) -> list[str]:
    """Return one name per reading, stripped; ShapeError for another number, ParameterError if one is missing."""
    try:
        cells = list(values)
    except Exception as error:  # an array without an axis, or an object of a user, which may raise anything
        raise ParameterError(name, values, "a text, or one per reading") from error
    if len(cells) != n_points:
        raise ShapeError(f"{name} has {len(cells)} names; allowed: {n_points}, one per reading, or a single text")
    for k, cell in enumerate(cells):
        require(
            not is_missing_value(cell), f"{name}[{k}]", cell, f"a name in every row; leave out rows without a {name}"
        )
    texts, own = list(map(text_of_name, cells)), dict[str, str]()
    for k, text in enumerate(texts):
        if text not in own:
            own[text] = _checked_name(f"{name}[{k}]", text)
    return [own[text] for text in texts]


def text_of_name(value: object) -> str:
    """Return the name of a run, scan or pattern as text: numbers in full precision, 1.0 as "1", a missing one as ""."""
    if isinstance(value, np.generic):
        value = value.item()
    if is_missing_value(value):
        return ""
    return number_text(value) if isinstance(value, float) else str(value)


def notes_on_names(column: str, values: object, named: str) -> list[str]:
    """Return notes if a column names runs, scans or patterns by numbers that are not whole, or names look alike."""
    cells = set(np.ravel(np.asarray(values, dtype=object)).tolist())
    as_numbers = any(isinstance(cell, float) and cell % 1 > 0 for cell in cells)
    notes = [f"column {column} names {named} by numbers, of which 1.10 is 1.1; read it as text if they are two"]
    alike: dict[str, set[str]] = {}
    for text in (text_of_name(cell).strip() for cell in cells):
        alike.setdefault(" ".join(unicodedata.normalize("NFKC", text).casefold().split()), set()).add(text)
    several = sorted(" and ".join(map(ascii, sorted(texts))) for texts in alike.values() if len(texts) > 1)[:1]
    return notes * as_numbers + [f"column {column}: {names} are different {named}" for names in several]


def notes_on_codes(columns: Mapping[str, FloatArray]) -> list[str]:
    """Note numbers such as loggers write where a value is missing, -9999 for one, that are far from all others."""
    notes = []
    for name, values in columns.items():
        known = values[np.isfinite(values)]
        ends = {known.min(), known.max()} if known.size else set()
        codes = [end for end in sorted(ends) if _CODE.fullmatch(number_text(float(end)))]
        others = known[~np.isin(known, codes)]
        for code in codes if others.size else []:
            if max(code - others.max(), others.min() - code) > 2 * np.ptp(others):
                text = number_text(float(code))
                notes.append(f"column {name} holds {text}: if that says that a value is missing, empty the cell")
    return notes


def _checked_name(what: str, text: str) -> str:
    require(text.strip().isprintable(), what, text, "a printable text, without line ends")
    return text.strip()


def is_missing_value(cell: object) -> bool:
    """Return whether a cell is None, NaN, masked, or a data frame's marker of a missing value."""
    return (
        cell is None
        or cell is np.ma.masked
        or (isinstance(cell, float) and math.isnan(cell))
        or str(cell) in ("<NA>", "NaT")
    )
