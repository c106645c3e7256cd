"""A file of rows as a checked table of texts and numbers; how it is laid out is found from the file."""

from __future__ import annotations

import contextlib
import csv
import io
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import count_with_noun
from probewise.errors import FileError, shown
from probewise.progress import Progress, silent
from probewise.recordings.cells import (
    MISSING,
    UnclearCellError,
    are_other_days,
    first_cell_without_number,
    is_missing,
    is_other_unit_of_time,
    looks_like_number,
    looks_like_time,
    parsed_numbers,
    plain_cells,
    require_unit_of_time,
    texts_to_times,
)
from probewise.recordings.io import LARGEST, read_text

LARGEST_PLACE_MM = 1e9  # places have smaller squares than other numbers, up to `LARGEST`

_ESCAPED = re.compile(r"'(?='*[=+@-])")  # see _not_as_formula
_PLAIN = re.compile(r"[-+.0-9eE]*")
_DASHES = frozenset({"-", "--", "---", "----"})  # words for what is missing
_PROGRESS = 2_000  # rows between two reports
_SAMPLE = 100_000  # characters from which the layout is found
_N_LAST = 10  # rows at the end of these that show how many cells a row has
# Marks between cells, or the blanks to replace by one: first those that stand in numbers and texts least.
_SEPARATORS = ("\t", ""), (";", ""), (",", ""), ("|", ""), ("\t", r"[ \t]{2,}"), ("\t", r"[ \t]+")
_DECLARED = re.compile(r'"?sep=(.)"?\r?\n')  # a spreadsheet's own line
_MAY_LACK = frozenset({"", "Comment", "comment"})  # the last column of LabVIEW's files, empty in most rows
_X_VALUE = "X_Value"  # LabVIEW's column of times, in seconds, where X_Dimension is Time
_SUMMARY = re.compile(r"(mean|average|avg|median|total|sum|min|max|minimum|maximum|sd|std|stdev|count|end)\b", re.I)
_NO_NAME = re.compile(r"(grand |sub)?(mean|average|avg|median|total|totals|sum):?", re.I)  # of a row among names


@dataclass(frozen=True, eq=False)
class CSVTable:
    """Cells by column, stripped of blanks; `rows` holds the row number of each record in the file, (n_rows,)."""

    path: Path
    columns: dict[str, list[str]]
    rows: list[int]
    header_row: int = 1
    notes: tuple[str, ...] = ()
    """How the file was read, one line, where it is not plain CSV."""

    def __len__(self) -> int:
        return len(self.rows)

    def require_columns(self, *names: str, allowed: str = "a header row with it") -> None:
        """Raise FileError, which says what is `allowed`, if one of these columns is missing."""
        for name in names:
            if name not in self.columns:
                found = f"no such column; the header has {_in_words(list(self.columns))}"
                raise FileError(self.path, found, allowed, row=self.header_row, column=name)

    def column_of_numbers(
        self, name: str, *, missing: bool = False, largest: float | None = LARGEST, allowed: str = ""
    ) -> FloatArray:
        """Read a column as numbers, (n_rows,); FileError, which says what is `allowed`, at the first cell that is none.

        With `missing` an empty cell, `nan`, `na` or `n/a` is allowed and becomes NaN; `largest` is the largest
        magnitude allowed, None: any finite number.
        """
        cells = self.columns[name]
        most = np.finfo(np.float64).max if largest is None else largest
        there = np.ones(len(cells), dtype=np.bool_)
        if missing:
            there = np.fromiter((cell not in MISSING for cell in cells), dtype=np.bool_, count=len(cells))
        values = parsed_numbers(list(itertools.compress(cells, there)))
        if values is None or not (np.abs(values) <= most).all():
            number = "a finite number" if largest is None else f"a finite number of magnitude up to {largest:g}"
            allowed = allowed or number + (", or empty, nan or n/a where it is missing" if missing else "")
            k = first_cell_without_number(cells, missing=missing, largest=most)
            assert k is not None
            raise FileError(self.path, cell_in_words(cells[k]), allowed, row=self.rows[k], column=name)
        out = np.full(len(cells), math.nan)
        out[there] = values
        return out


def cell_in_words(cell: object) -> str:
    """Return what a cell holds, for an error message."""
    return "the cell is empty" if cell == "" else shown(cell)


class _Layout:
    """Where the header of a file is, and how its cells are separated, by its first rows; rows are indices of records.

    `declared`: whether the file itself names its separator, `mark`; `blanks`: which blanks are one; `numeric`: columns
    of numbers or times; `width`: cells of a row below the header; `above`, `units`: rows above the header, and below it
    those without readings.
    """

    def __init__(
        self, sample: str, wanted: Sequence[str], mark: str, blanks: str = "", *, declared: bool = False
    ) -> None:
        self.mark, self.blanks, self.declared = mark, blanks, declared
        self.header, self.at, self.first, self.width = list[str](), -1, 2**62, 0
        self.numeric, self.above, self.units = frozenset[int](), list[list[str]](), list[list[str]]()
        rows: list[list[str]] = []
        with contextlib.suppress(csv.Error):
            for row in csv.reader(io.StringIO(_separated(sample, blanks), newline=""), delimiter=mark, strict=True):
                rows.append([cell.strip() for cell in row])
        full = [k for k, row in enumerate(rows) if any(row) and not _DECLARED.match(mark.join(row) + "\n")]
        if not full:
            return
        last = [rows[k] for k in full[-_N_LAST:]]
        counts = Counter(map(len, last))
        self.width = max(counts, key=lambda n: (counts[n], n))
        columns = zip(*(row for row in last[-max(1, len(last) // 2) :] if len(row) == self.width), strict=True)
        self.numeric = frozenset(j for j, cells in enumerate(columns) if _are_numbers(cells))
        readings = [k for k in full if len(rows[k]) == self.width and _holds_numbers(rows[k], self.numeric)]
        at = full[0]
        if self.numeric and readings and (heads := [k for k in full if k < readings[0]]):
            at = heads[-1]
            if len(heads) > 1 and len(rows[heads[-2]]) == len(rows[at]) > 1 and all(rows[heads[-2]]):
                at = heads[-2]  # below it the units
        n_wanted = {k: len(set(wanted) & set(_names(rows[k], wanted, self.width))) for k in full}
        if max(n_wanted.values()) > n_wanted[at]:
            at = max(full, key=lambda k: n_wanted[k])
        self.at, self.header = at, _names(rows[at], wanted, self.width)
        below = [k for k in full if k > at]
        self.first = next((k for k in below if not _holds_units(rows[k], self.numeric)), at + 1)
        unnamed = mark != "," and len(self.header) + 1 == self.width
        numbers = parsed_numbers([row[0] for row in last if len(row) == self.width]) if unnamed else None
        if numbers is not None and len(numbers) > 1 and (np.diff(numbers) == 1).all():  # rows are numbered
            self.header = ["", *self.header]
        self.above, self.units = [rows[k] for k in full if k < at], [rows[k] for k in below if k < self.first]

    @classmethod
    def of_text(cls, text: str, wanted: Sequence[str]) -> _Layout:
        """Find the layout of a file by its first rows; where several would do, by the columns that are wanted."""
        end = max(text.rfind("\n", 0, _SAMPLE), text.rfind("\r", 0, _SAMPLE)) + 1
        sample = text[:end] if end and len(text) > _SAMPLE else text
        if declared := _DECLARED.match(sample):
            found = [cls(sample, wanted, declared[1], declared=True)]
        else:
            found = [cls(sample, wanted, *marks) for marks in _SEPARATORS if marks[0] in _separated(sample, marks[1])]
        fitting = [layout for layout in found if min(layout.width, len(layout.header)) > 1]
        known = [layout for layout in fitting if set(wanted) <= set(layout.header)]
        return next(iter((*known, *fitting)), None) or cls(sample, wanted, ",")

    def fitted_row(self, row: tuple[str, ...]) -> tuple[str, ...]:
        """Return a row with as many cells as the header, if it has more that are empty, or lacks but comments."""
        n = len(self.header)
        if any(cell.strip() for cell in row[n:]) or any(name not in _MAY_LACK for name in self.header[len(row) :]):
            return row
        return (*row, *[""] * n)[:n]

    def error_of_row(self, path: Path, row: Sequence[str], number: int) -> FileError:
        commas = self.mark == "," and len(row) > len(self.header) and all(_is_value(cell.strip()) for cell in row)
        cure = "; a decimal comma cannot be told from one between cells: write 1.5, or separate cells by semicolons"
        found = f"the row has {len(row)} cells; row {self.at + 1} is taken for the header: {_in_words(self.header)}"
        return FileError(path, found, f"{len(self.header)} cells as in the header{cure * commas}", row=number)

    def is_comment(self, row: Sequence[str]) -> bool:
        return 0 in self.numeric and row[0].lstrip().startswith("#")

    def is_below_table(self, row: Sequence[str], before: Sequence[Sequence[str]]) -> bool:
        """Return whether a row after all others, those `before`, is no reading, but a text or a summary."""
        first = next(cell.strip() for cell in row if cell.strip())
        if 0 not in self.numeric:  # but names
            return _NO_NAME.fullmatch(first) is not None and all(other[0].strip() != first for other in before)
        if _is_value(first):
            return False
        return len(row) not in (len(self.header), self.width) or _SUMMARY.match(first) is not None

    def notes(self) -> list[str]:
        separators = {";": "semicolons", "\t": "tabs", ",": "commas"}
        separator = "blanks" if self.blanks else separators.get(self.mark, repr(self.mark))
        out = [f"cells separated by {separator}"] * (self.mark != "," or self.declared)
        out += [f"header in row {self.at + 1}, rows above it left out"] * bool(self.above)
        return out + [f"row {_in_words(row)} below the header left out" for row in self.units]


def _separated(text: str, blanks: str) -> str:
    return re.sub(blanks, "\t", re.sub(r"(?m)^[ \t]+|[ \t]+$", "", text)) if blanks else text


def _is_value(cell: str) -> bool:
    return looks_like_number(cell) or looks_like_time(cell)


def _are_numbers(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if not is_missing(cell)]
    return 0 < len(filled) <= 2 * sum(_is_value(cell) for cell in filled)


def _holds_numbers(row: Sequence[str], numeric: frozenset[int]) -> bool:
    cells = [row[j] for j in numeric]
    return _are_numbers(cells) and all(is_missing(cell) or _is_value(cell) for cell in cells)


def _holds_units(row: Sequence[str], numeric: frozenset[int]) -> bool:
    cells = [row[j] for j in numeric if j < len(row)]
    filled = [cell for cell in cells if not is_missing(cell) or set(cell) == {"-"}]  # or a line below the header
    return bool(filled) and not any(_is_value(cell) for cell in filled)


def _names(row: Sequence[str], wanted: Sequence[str], width: int) -> list[str]:
    """Return the names of a header: on one line, without the # of a comment if such a column is wanted."""
    names = [_not_escaped(re.sub(r"\s*[\r\n]\s*", " ", cell)) for cell in row]
    if names[0] in ("#", "%") and len(names) == width + 1:
        return names[1:]
    bare = names[0].lstrip("#% ")
    return [bare, *names[1:]] if bare in wanted else names


def _not_escaped(cell: str) -> str:
    """Return a cell without the apostrophe that keeps a text from being a formula."""
    return cell[1:] if _ESCAPED.match(cell) else cell


def _in_words(row: Sequence[str]) -> str:
    return ", ".join(map(repr, row))


def read_table(
    path: Path,
    *,
    wanted: Sequence[str] = (),
    names: Sequence[str] = (),
    time: str | None = None,
    time_unit: str = "s",
    progress: Progress = silent,
) -> CSVTable:
    """Read a table with one header row, as loggers and spreadsheets write it; blank lines are skipped.

    Cells may be separated by commas, semicolons, tabs or blanks. The header is the row above the numbers, or the one
    with more of the `wanted` columns. Numbers and times are rewritten as plain numbers, but for the columns `names`,
    which are texts; `notes` says how. The column `time` holds numbers, or dates or clocks, which count from the first
    row in `time_unit`. `progress` is called as rows are read.

    Raises FileError if it cannot be read, has no header or a repeated column, a row is too short or too long, quotes do
    not close, or a cell can be read in several ways.
    """
    text = read_text(path, "a CSV file")
    layout = _Layout.of_text(text, wanted)
    text, header = _separated(text, layout.blanks), layout.header
    if twice := next((name for name, n in Counter(header).items() if name and n > 1), None):
        cure = "each column once: rename or delete one of them"
        raise FileError(path, "the column comes twice in the header", cure, row=layout.at + 1, column=twice)
    n_below, number = text.count("\n") - layout.at - 1, 0  # lines below the header
    records, rows, left_out = list[tuple[str, ...]](), list[int](), list[int]()
    failed: csv.Error | None = None
    try:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=layout.mark, strict=True)
        for number, record in enumerate(reader, 1):
            if number > layout.first and any(map(str.strip, record)):
                if len(record) != len(header) and layout.is_comment(record):
                    left_out.append(number)
                else:
                    records.append(tuple(record))  # which, unlike lists, cost the garbage collector nothing
                    rows.append(number)
            if number % _PROGRESS == 0:
                progress(f"reading {path.name}", len(rows), max(n_below, len(rows)))
    except csv.Error as error:
        failed = error
    while failed is None and records and layout.is_below_table(records[-1], records[:-1]):
        left_out.append(rows.pop())
        records.pop()
    for k, cells in enumerate(records):
        if len(cells) != len(header):
            records[k] = layout.fitted_row(cells)
            if len(records[k]) != len(header):
                raise layout.error_of_row(path, cells, rows[k])
    if failed is not None:
        found = f"not readable as CSV ({failed})"
        cure = f"cells of up to {csv.field_size_limit():,} characters, quotes closed"
        raise FileError(path, found, cure, row=number + 1) from failed
    progress(f"reading {path.name}", len(rows), len(rows))
    if not header:
        raise FileError(path, "the file is empty", "a header row and one row per reading")
    for row, units in enumerate(layout.units, layout.at + 2):
        unit = dict(zip(header, units, strict=False)).get(time or "", "").strip("[(]) ")
        if is_other_unit_of_time(unit, time_unit):
            raise FileError(path, shown(unit), f'times in {time_unit}, or time_unit = "{unit}"', row=row, column=time)
    notes = layout.notes()
    if left_out:
        notes.append(f"{count_with_noun(len(left_out), 'row')} without readings left out (first: row {min(left_out)})")
    columns = [list(map(str.strip, cells)) for cells in zip(*records, strict=True)] or [list[str]() for _ in header]
    columns = [list(map(_not_escaped, cells)) if "'" in "".join(cells) else cells for cells in columns]
    unnamed = [cells for name, cells in zip(header, columns, strict=True) if not name]
    if n_filled := sum(any(cells) for cells in unnamed):
        if n_filled > 1:
            found = "two columns without a name in the header"
            raise FileError(path, found, "a name for each column, or one without a name", row=layout.at + 1)
        notes.append("a column without a name, ignored")
    if len(unnamed) > n_filled or layout.width > len(header):
        notes.append("empty cells at the ends of rows ignored")
    named = {name: cells for name, cells in zip(header, columns, strict=True) if name}
    is_time = ["X_Dimension", "Time"] in [row[:2] for row in layout.above]
    if time and time not in named and time_unit == "s" and is_time:
        named = {time if name == _X_VALUE else name: cells for name, cells in named.items()}
        notes.append(f"{_X_VALUE}, in s, is {time}")
    return _with_plain_numbers(CSVTable(path, named, rows, layout.at + 1), notes, names, time, time_unit)


def _with_plain_numbers(
    table: CSVTable, notes: list[str], names: Sequence[str], time: str | None, time_unit: str
) -> CSVTable:
    """Rewrite the numbers and times of a table as plain numbers, and join the notes to one."""
    odd = {
        name: cells
        for name, cells in table.columns.items()
        if name not in names and not (_PLAIN.fullmatch("".join(cells)) and _DASHES.isdisjoint(cells))
    }
    columns = dict(table.columns)
    try:
        cells = [] if time is None else columns.get(time, [])
        if time and cells and (times := texts_to_times(time, cells, time_unit)) is not None:
            columns[time] = list(map(number_text, times[0].tolist()))
            odd.pop(time, None)
            notes.append(times[1])
            if others := [name for name in columns if name != time and are_other_days(columns[name], cells)]:
                cure = "of a time of day, write date and clock into one column, 2026-11-28 12:30:00"
                notes.append(f"{others[0]} has other days than {time}, which passes midnight where it falls: {cure}")
        elif time in odd:
            require_unit_of_time(time, odd[time], time_unit)
        usual = [name for name in columns if name not in odd and name not in names and name != time]
        rewritten, said = plain_cells(odd, lambda: {name: columns[name] for name in usual})
    except UnclearCellError as error:
        cell, row = cell_in_words(table.columns[error.name][error.index]), table.rows[error.index]
        raise FileError(table.path, cell, error.allowed, row=row, column=error.name) from error
    notes += said
    said_how = (f"{table.path.name}: {'; '.join(notes)}",) if notes else ()
    return replace(table, columns=columns | rewritten, notes=said_how)


def number_text(value: float) -> str:
    """Format a number in full precision, integers without a point, NaN as an empty cell."""
    if math.isnan(value):
        return ""
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) <= LARGEST else repr(value)


def _not_as_formula(cell: object) -> object:
    """Return a cell, in front of a text like "=1+1" or "'=1+1" one apostrophe more; numbers stay as they are."""
    if isinstance(cell, str) and cell.lstrip("'")[:1] in ("=", "+", "-", "@") and parsed_numbers([cell]) is None:
        return f"'{cell}"
    return cell


def csv_text(columns: dict[str, Sequence[str]]) -> str:
    """Format columns of cells of equal length as CSV with a header row and LF line ends."""
    return csv_text_of_rows(columns, zip(*columns.values(), strict=True))


def csv_text_of_rows(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Format rows as CSV with a header row and LF line ends.

    A text that a spreadsheet would take for a formula gains an apostrophe in front, which `read_table` removes.
    """
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(map(_not_as_formula, header))
    writer.writerows(map(_not_as_formula, row) for row in rows)
    return out.getvalue()
