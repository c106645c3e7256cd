"""A user's table: columns, runs, and optionally time; and several tables joined to one."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import cached_property
from numbers import Real
from types import NoneType
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import (
    LAST_DIGITS,
    BoolArray,
    FloatArray,
    IntArray,
    array_or_none,
    data_frame,
    floats,
    read_only_floats,
    rounding_error,
)
from probewise._kinds import checked_path, require_kind, require_text
from probewise.errors import FileError, ParameterError, ShapeError, require
from probewise.recordings import Instrumentation, Recording
from probewise.recordings.cells import (
    count_numbers,
    first_cell_without_number,
    is_missing,
    parsed_numbers,
    times_to_numbers,
)
from probewise.recordings.columns import (
    is_missing_value,
    notes_on_names,
    require_one_order,
    text_of_name,
)
from probewise.recordings.plan import masks_of_readings_at_ends
from probewise.recordings.table import csv_text, number_text, read_table

_ONE_RUN = "all"
_OF_COLUMN = "column:"
_FILE = "file"
LARGEST_IN_FIT = 1e75
"""Largest magnitude in a fit: fourth powers, as squares of terms of second order have them, are floats."""
# Covariates of a diagnosis that are no columns: of a table, and of a light sensor's recording, which it treats apart.
_NOT_COLUMNS = frozenset({"time", "row", "run", "level", "previous"})
_OF_LIGHT_SENSOR = frozenset({"scan", "place", "slope", "direction", "orientation", "edge_distance"})


@dataclass(frozen=True, eq=False)
class RunTable:
    """The rows of a table in their order; all columns have shape (n_points,).

    Parameters
    ----------
    columns
        Every column by name: numbers (NaN where missing) or texts.
    time, time_unit
        Name of the time column, and its unit; None if no time was recorded. Dates, clocks and time differences in it
        count from the first row.
    run
        Name of the column that assigns rows to runs; None for a single run. Names are texts; a number is its shortest
        text, 1.0 as "1".
    instrumentation
        Unit, range and step of a reading.
    like
        Planned runs, each with the recorded run whose values of parameters and effects per run its prediction takes.
    first_row
        Number of the first row, counted from the first row of the recording to which effects are bound: 0 for that
        recording, its length for a table that follows it.
    notes
        How columns were read that are not plain numbers.
    first_line, row_names
        How messages call the rows: by their line in the file, from 1, or from 0 in memory; or by their labels in the
        index of a data frame, if these are others.
    """

    columns: Mapping[str, NDArray[Any]]
    time: str | None = None
    run: str | None = None
    instrumentation: Instrumentation = field(default_factory=Instrumentation)
    like: Mapping[str, str] = field(default_factory=dict)
    first_row: int = 0
    time_unit: str = "s"
    notes: tuple[str, ...] = ()
    first_line: int = 0
    row_names: tuple[object, ...] = ()

    def __post_init__(self) -> None:
        for what, name in (("time", self.time), ("run", self.run)):
            require_kind(what, name, (str, NoneType), "the name of a column, or None")
        require_text("time_unit", self.time_unit)
        allowed = "columns by name: a dict of arrays, or a data frame; of a file: read_run_table('DATA.csv', ...)"
        has_one_axis = getattr(self.columns, "ndim", 2) == 1  # a Series, whose items are its rows
        require(hasattr(self.columns, "items") and not has_one_axis, "table", self.columns, allowed)
        require_one_order(self.columns)
        columns, notes = dict[str, NDArray[Any]](), [*self.notes]
        for name, given in self.columns.items():
            values: Any = given
            require_kind("the name of a column", name, str, "a text")  # a table without a header has numbers
            require(name not in columns, "columns", f"{name} twice", "each column once")  # as a data frame may have two
            if name == self.time and name != self.run:
                values, note = times_to_numbers(name, values, self.time_unit)
                notes += [note] if note else []
            columns[name] = _checked_column(name, values, are_names=name == self.run)
            notes += notes_on_names(name, given, "runs") if name == self.run else []
            if name == self.run and 0 < np.count_nonzero(columns[name] == "") < len(columns[name]):
                cure = "where an empty cell repeats the one above, fill it in"
                notes += [f"the rows without a name in column {name} are taken for one run; {cure}"]
            if name == self.time and name != self.run and (like := _other_times(columns[name], self.time_unit)):
                notes += [f"column {name} is taken as plain numbers, though all look like {like}"]
        require(columns, "columns", (), "one or more")
        n_points = len(next(iter(columns.values())))
        for name, values in columns.items():
            if values.shape != (n_points,):
                raise ShapeError(f"column {name!r} has shape {values.shape}; allowed: ({n_points},), as the others")
        require(n_points > 0, "table", "without a row", "one row or more")
        if (index := getattr(self.columns, "index", None)) is not None:  # of a data frame
            object.__setattr__(self, "row_names", tuple(index.tolist()))
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "notes", tuple(dict.fromkeys(notes)))
        for what, column in (("time", self.time), ("run", self.run)):
            require(column is None or column in columns, what, column, f"a column of the table: {', '.join(columns)}")
        if self.time is not None:
            values = columns[self.time]
            if values.dtype != np.float64 or not np.isfinite(values).all():
                allowed = "a time, a finite number, in each row"
                raise column_error(f"column {self.time!r}", values, allowed, missing=False, row_name=self.row_name)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    @property
    def has_varying_time(self) -> bool:
        """Whether a time was recorded that is not the same in all rows."""
        return self.time is not None and float(np.ptp(self.time_s)) > 0

    @cached_property
    def time_s(self) -> FloatArray:
        """Time as recorded, in the unit of the time column; the row's number if none was recorded, (n_points,)."""
        return read_only_floats(np.arange(float(len(self))) if self.time is None else self.columns[self.time])

    @property
    def row_number(self) -> FloatArray:
        """Number of each row, counted from the first of the recording to which effects are bound, (n_points,)."""
        return self.first_row + np.arange(float(len(self)))

    @cached_property
    def scan_names(self) -> tuple[str, ...]:
        """Names of the runs, in the order in which they begin; "all" for a table without a run column."""
        return (_ONE_RUN,) if self.run is None else tuple(dict.fromkeys(self.columns[self.run].tolist()))

    @cached_property
    def scan(self) -> IntArray:
        """Number of each row's run, (n_points,), from 0 in the order in which the runs begin."""
        if self.run is None:
            return np.zeros(len(self), dtype=np.int64)
        number = {name: k for k, name in enumerate(self.scan_names)}
        return np.array([number[text] for text in self.columns[self.run].tolist()], dtype=np.int64)

    @cached_property
    def columns_as_given(self) -> Mapping[str, NDArray[Any]]:
        """The columns as a user's functions get them: names of runs as numbers, if they are numbers that differ."""
        numbers = None if self.run is None else parsed_numbers(self.scan_names)
        if numbers is None or len(set(numbers.tolist())) < len(numbers):  # 1.1 and 1.10 are two runs, but one number
            return self.columns
        return {**self.columns, cast(str, self.run): read_only_floats(numbers[self.scan])}

    @cached_property
    def covariates(self) -> dict[str, FloatArray]:
        """Columns of numbers by name, not all missing, without time and run; the reading is one of the columns."""
        kept = {k: v for k, v in self.columns.items() if k not in (self.time, self.run) and v.dtype == np.float64}
        return {name: values for name, values in kept.items() if np.isfinite(values).any()}

    @cached_property
    def time_begins_anew(self) -> bool:
        """Whether some run begins before another has ended, as if time were counted from the start of each run."""
        own = [self.time_s[rows] for rows in self.rows_by_scan()]
        first, last = np.array(sorted((times.min(), times.max()) for times in own)).T
        return bool((first[1:] < np.maximum.accumulate(last)[:-1]).any())

    @cached_property
    def median_gap(self) -> float:
        """Median time from a row to the next of its run, in the unit of time; 1 if no time passes."""
        gaps = np.concatenate([np.diff(self.time_s[rows]) for rows in self.rows_by_scan()])
        gaps = gaps[gaps > rounding_error(self.time_s)]
        return float(np.median(gaps)) if gaps.size else 1.0

    def rows_by_scan(self) -> list[IntArray]:
        """Return the row indices of each run, in the order of the table."""
        return [np.flatnonzero(self.scan == k) for k in range(len(self.scan_names))]

    def require_rising_time(self) -> None:
        """Raise ParameterError, with the row, if time decreases within a run."""
        for name, rows in zip(self.scan_names, self.rows_by_scan(), strict=True):
            falls = np.flatnonzero(np.diff(self.time_s[rows]) < 0)  # row numbers, where no time is, rise
            if falls.size:
                before, at = rows[falls[0]], rows[falls[0] + 1]
                where = f"column {self.time!r} in row {self.row_name(at)}"
                anew = 'its run; where it begins anew name the runs: run = "..."'
                own = anew if self.run is None else f"run {name}; sort the rows, or mend a clock that was set back"
                allowed = f"{self.time_s[before]:g} or more, since time does not fall within {own}"
                raise ParameterError(where, float(self.time_s[at]), allowed)

    def require_moderate_numbers(self) -> None:
        """Raise ParameterError, with the row, for a number, or a column's span, that a fit cannot be computed with."""
        for name, values in self.columns.items():
            if values.dtype != np.float64 or not np.isfinite(values).any():
                continue
            known = np.where(np.isfinite(values), values, 0.0)
            k = int(np.argmax(np.abs(known)))
            allowed = f"magnitudes up to {LARGEST_IN_FIT:g}: empty such cells, or use a larger unit"
            where = f"column {name!r} in row {self.row_name(k)}"
            require(abs(known[k]) <= LARGEST_IN_FIT, where, float(known[k]), allowed)
            span = float(np.ptp(values[np.isfinite(values)]))
            allowed = f"0, or {1 / LARGEST_IN_FIT:g} and more: use a smaller unit"
            require(span == 0 or span * LARGEST_IN_FIT >= 1, f"span of column {name!r}", span, allowed)

    def interpolated_within_runs(self, values: FloatArray) -> FloatArray:
        """Return a column, (n_points,), with its missing values interpolated linearly from row to row of each run.

        Beyond the first and the last value of a run, that value holds; in a run without one it is the column's median.
        """
        there = np.isfinite(values)
        out = np.where(there, values, np.median(values[there]))
        for own in self.rows_by_scan():
            known = np.flatnonzero(there[own])
            if known.size:
                out[own] = np.interp(np.arange(len(own)), known, values[own[known]])
        return out

    def take(self, rows: IntArray | BoolArray) -> RunTable:
        """Return a table of these rows, given by indices or by a mask, in this order."""
        kept = np.arange(len(self))[rows]
        names = tuple(self.row_names[k] for k in kept.tolist()) if len(self.row_names) == len(self) else ()
        return replace(self, columns={name: values[kept] for name, values in self.columns.items()}, row_names=names)

    def row_name(self, row: int) -> str:
        """Return what messages call a row, counted from 0."""
        row = int(row)
        return str(self.row_names[row] if len(self.row_names) == len(self) else row + self.first_line)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame of the columns, names of runs as texts; a row per row of the table."""
        return data_frame(self.columns)

    def with_columns(self, columns: Mapping[str, FloatArray]) -> RunTable:
        """Return a table with these columns replaced or added."""
        return replace(self, columns={**self.columns, **columns})


@dataclass(frozen=True, eq=False)
class RunRecording(Recording):
    """A table with its readings, as a recording for the diagnosis."""

    sd_column: str = ""
    """Column with the sd of each reading; "": all have the same sd."""

    least_share_of_span: ClassVar[float] = LAST_DIGITS
    """Least noise as a share of the span of the readings: set by arithmetic, since real noise may be a millionth."""

    def _require_plan(self) -> None:
        require(isinstance(self.plan, RunTable), "plan", self.plan, "a RunTable")

    @property
    def relative_sd(self) -> FloatArray:
        """Declared sd of each reading relative to the median, (n_points,); 1 if none is declared."""
        table = cast(RunTable, self.plan)
        return relative_sds_of_column(table, self.sd_column) if self.sd_column else np.ones(len(table))

    def to_frame(self) -> Any:
        """Return a pandas DataFrame of the table's columns, a row per reading."""
        return cast(RunTable, self.plan).to_frame()

    @property
    def weighting_in_words(self) -> str:
        """The column of sds by which `rms` weights residuals, as written after its unit; "" without one."""
        return f" (weighted by {self.sd_column})" if self.sd_column else ""

    @cached_property
    def usable(self) -> BoolArray:
        """Rows whose reading is present and within the declared range or at its ends, rounded, (n_points,)."""
        return super().usable | self.censored

    @cached_property
    def censored(self) -> BoolArray:
        """Mask of the readings at an end of the declared range: the signal with its noise is at it or beyond."""
        own = self.plan.instrumentation
        at_low, at_high = masks_of_readings_at_ends(self.readings, own.min, own.max, own.step)
        return at_low | at_high


def covariate_of_column(name: str) -> str:
    """Return the covariate's name for a column: as it is, or "column:NAME" if reserved ("time", "level", ...)."""
    taken = name in _NOT_COLUMNS | _OF_LIGHT_SENSOR or name.startswith(("state:", _OF_COLUMN))
    return f"{_OF_COLUMN}{name}" if taken else name


def published_covariate(name: str) -> str:
    """Return a covariate's name for results: without "column:" if only a light sensor's recordings reserve the name."""
    own = name.removeprefix(_OF_COLUMN)
    return own if own in _OF_LIGHT_SENSOR else name


def median_sd_of_column(table: RunTable, column: str) -> float | None:
    """Return the median of a column of sds, without those that are 0 or missing; None if there is no other."""
    values = table.covariates.get(column, np.empty(0))
    known = values[np.isfinite(values) & (values > 0)]
    return float(np.median(known)) if known.size else None


def relative_sds_of_column(table: RunTable, column: str, typical: float | None = None) -> FloatArray:
    """Return a column of sds over the typical one, by default its median, (n_points,); 1 where there is none."""
    median = median_sd_of_column(table, column)
    if median is None:
        return np.ones(len(table))
    values = table.covariates[column]
    there = np.isfinite(values) & (values > 0)
    return np.where(there, values, 1.0) / np.where(there, median if typical is None else typical, 1.0)


def column_error(
    column: str, cells: NDArray[Any], allowed: str, *, missing: bool = True, row_name: Callable[[int], str]
) -> ParameterError:
    """Return the error of a column of texts that should be numbers: its first wrong cell, with the name of its row."""
    k = first_cell_without_number(cells.tolist(), missing=missing, largest=np.finfo(np.float64).max)
    if k is None:
        return ParameterError(column, "texts, all of them numbers", f"numbers: {allowed}")
    return ParameterError(f"{column} in row {row_name(k)}", str(cells[k]), allowed)


def _other_times(values: NDArray[Any], unit: str) -> str:
    """Return what a column of numbers, not all the same, looks like if not times in `unit`, and the cure; "": nothing.

    Such as 20261128, or 20261128235959 with a clock; 1795824000000, milliseconds since 1970; 46354.52083, days since
    1900, of a spreadsheet: all of this century, and the days less than half an hour apart and no thousandths.
    """
    if values.dtype != np.float64 or not np.isfinite(values).all() or not values.size or not np.ptp(values):
        return ""
    dates = np.floor(values / 1e6 if values.min() > 1e13 else values)
    year, month, day = dates // 10_000, dates // 100 % 100, dates % 100
    if ((year > 1899) & (year < 2101) & (month > 0) & (month < 13) & (day > 0) & (day < 32)).all():
        return "dates: write 2026-11-28 for 20261128"
    if unit != "ms" and values.min() > 9e11 and values.max() < 5e12:
        return 'milliseconds since 1970: divide by 1000, or time_unit = "ms"'
    apart, parts = np.median(np.abs(np.diff(values))), 1e3 * values
    if unit == "s" and values.min() > 36524 and values.max() < 73415 and apart < 0.02 and (parts % 1 > 0).any():
        return "days since 1900, of a spreadsheet: write 2026-11-28 12:30:00"
    return ""


def _checked_column(name: str, values: Any, *, are_names: bool) -> NDArray[Any]:
    if isinstance(values, np.ma.MaskedArray):  # what is masked is missing
        values = np.ma.filled(values.astype(np.object_), np.nan if values.dtype.kind in "biufO" else "")
    array = floats(values, f"column {name!r}") if (given := array_or_none(values)) is None else given
    if array.ndim != 1:
        raise ShapeError(f"column {name!r} has shape {array.shape}; allowed: one axis, one value for each row")
    if are_names and array.dtype.kind == "U" and not array.flags.writeable:
        return array
    if array.dtype == object and not are_names:
        array = np.array([None if is_missing_value(value) else value for value in array.tolist()], dtype=object)
    if array.dtype == object and all(value is None or isinstance(value, Real | Decimal) for value in array.tolist()):
        array = array if are_names else floats(array, f"column {name!r}")  # None is missing, NaN
    if array.dtype.kind in "biuf" and not are_names:
        return read_only_floats(array)
    texts = np.array([text_of_name(v) if are_names else str(v) for v in array.tolist()], dtype=np.str_)
    texts.flags.writeable = False
    return texts


def read_run_table(
    path: str | os.PathLike[str], *, time: str | None, run: str | None, reading: str = "", time_unit: str = "s"
) -> RunTable:
    """Read a table with a header row; a column is numeric if every cell is a number, empty or nan, else text.

    Loggers and spreadsheets write tables in many ways; `notes` of the result says how one was read that is not plain
    CSV. The names `time`, `run` and `reading` show which row is the header. Names of runs are texts. Dates and clocks
    in the time column count from the first row, in `time_unit`. Raises FileError, which says where, if the file is
    unusable, lacks the column `time` or `run`, a time is no number, or a cell can be read in several ways.
    """
    path = checked_path("path", path, "the name of a CSV file; columns in memory make a RunTable(...)")
    own = [name for name in (time, run) if name is not None]
    wanted = (*own, reading) if reading else own
    table = read_table(path, wanted=wanted, names=() if run is None else (run,), time=time, time_unit=time_unit)
    if not len(table):
        raise FileError(path, "there is no row below the header", "one row for each reading")
    table.require_columns(*own)
    columns: dict[str, NDArray[Any]] = {name: np.array(cells) for name, cells in table.columns.items()}
    if time is not None and time != run:
        columns[time] = table.column_of_numbers(time)
    notes = list(table.notes)
    for name in [name for name in columns if name not in (time, run)]:
        try:
            columns[name] = table.column_of_numbers(name, missing=True, largest=None)
        except FileError as error:
            filled = [cell for cell in table.columns[name] if not is_missing(cell)]
            if 2 * count_numbers(filled) > len(filled):
                notes.append(f"{path.name}: column {name} is taken as text: row {error.row} holds {error.found}")
    return RunTable(columns, time, run, time_unit=time_unit, notes=tuple(notes), first_line=table.rows[0])


def run_table_csv(table: RunTable) -> str:
    """Return a table as CSV text, with numbers in full precision."""
    return csv_text({name: [_text(value) for value in values.tolist()] for name, values in table.columns.items()})


def table_digest(table: RunTable) -> str:
    """Return the fingerprint of a table, by which a fitted simulator knows its recording."""
    return hashlib.sha256(run_table_csv(table).encode(errors="surrogatepass")).hexdigest()[:16]


def concatenate_tables(tables: Sequence[RunTable], sources: Sequence[str]) -> tuple[RunTable, tuple[str, ...]]:
    """Concatenate tables: columns are those of the first, and runs of different tables remain distinct.

    A column that a later table lacks is missing there; one that only a later table has is left out. Without a column of
    runs, each of several tables is one run.

    `tables`, one or more, have the same time and run; `sources` are their names in messages. Returns the table, and
    notes on missing and omitted columns and on renamed runs. Raises ParameterError if there is no table, two are the
    same, or a column of numbers in the first has texts in another.
    """
    require(tables, "tables", (), "one or more")
    if len(tables) == 1:
        return tables[0], ()
    texts = [{name: [*map(_text, v.tolist())] for name, v in table.columns.items()} for table in tables]
    for (one, first_rows), (another, rows) in itertools.combinations(zip(sources, texts, strict=True), 2):
        allowed = "tables that differ; these hold the same rows"
        require(first_rows != rows, "tables", f"{one} and {another}", allowed)
    first, notes = tables[0], list[str]()
    for source, table in zip(sources[1:], tables[1:], strict=True):
        lacking, beyond = ([n for n in a.columns if n not in b.columns] for a, b in ((first, table), (table, first)))
        notes += [f"{source} has no column {name}: missing there" for name in lacking]
        notes += [f"column {name} of {source} left out: {sources[0]} has none" for name in beyond]
    run, taken, of_run = first.run or unused_name(_FILE, first.columns), set[str](), list[NDArray[Any]]()
    for source, table in zip(sources, tables, strict=True):
        names: tuple[str, ...] = (source,) if first.run is None else table.scan_names
        new: dict[str, str] = {}
        for name in names:  # a new name must not be one of this table's own either, which follows unchanged
            new[name] = unused_name(name, taken | (set(names) - {name}))
            taken.add(new[name])
        if first.run is not None and (renamed := [f"{old} is {name}" for old, name in new.items() if old != name]):
            notes.append(f"runs of {source} renamed, as another table has them too: {', '.join(renamed)}")
        of_run.append(np.array([*new.values()])[table.scan])
    columns = {}
    for name in dict.fromkeys((*first.columns, run)):
        parts = of_run if name == run else [t.columns.get(name) for t in tables]
        columns[name] = _concatenated_column(name, parts, tables, sources)
    how = tuple(dict.fromkeys(note for table in tables for note in table.notes))
    return replace(first, columns=columns, run=run, notes=how), tuple(notes)


def _concatenated_column(
    name: str, parts: Sequence[NDArray[Any] | None], tables: Sequence[RunTable], sources: Sequence[str]
) -> NDArray[Any]:
    first, out = parts[0], list[NDArray[Any]]()
    assert first is not None
    has_texts = any(part is not None and part.dtype != np.float64 for part in parts)
    numeric = first.dtype == np.float64 and not (has_texts and np.isnan(first).all())
    for part, table, source in zip(parts, tables, sources, strict=True):
        if part is None:
            out.append(np.full(len(table), np.nan) if numeric else np.full(len(table), ""))
        elif numeric and part.dtype != np.float64:
            allowed = f"a number, or nothing where it is missing, as in {sources[0]}"
            raise column_error(f"column {name!r} of {source}", part, allowed, row_name=table.row_name)
        else:
            out.append(part if numeric else np.array([_text(value) for value in part.tolist()]))
    return np.concatenate(out)


def _text(value: object) -> str:
    return number_text(value) if isinstance(value, float) else str(value)


def unused_name(name: str, taken: Iterable[str]) -> str:
    """Return the name, with a number appended if it is among those taken."""
    known, new, k = set(taken), name, 2
    while new in known:
        new, k = f"{name} ({k})", k + 1
    return new
