"""A CSV file as a checked table of texts and numbers; rows are numbered from 1, the header."""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import FileError, shown
from probewise.progress import Progress, silent
from probewise.recordings.text import read_text

LARGEST = 1e15
"""Largest magnitude of a number in a file: beyond, squares and differences lose all precision."""

_WORDS = ("nan", "na", "n/a")
_SPELT = (map("".join, itertools.product(*zip(word, word.upper(), strict=True))) for word in _WORDS)
MISSING = frozenset(itertools.chain([""], *_SPELT))
"""Texts that mark a missing number."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
# On texts of these characters float() accepts exactly what _NUMBER does ('infinity' and '1_000' have others).
_OF_NUMBERS = re.compile(r"[-+.0-9eE]*", re.ASCII)
_OTHER_SEPARATORS = {";": "semicolons", "\t": "tabs"}
_BEGIN_FORMULA = ("=", "+", "-", "@")
_CHUNK = 2_000  # rows read at a time: few enough for the processor's cache


@dataclass(frozen=True, eq=False)
class CSVTable:
    """Cells by column, stripped of blanks; `rows` holds the row number of each record (header = 1), (n_rows,).

    Each column is one text, its cells joined by a character that does not occur in the file: a million separate texts
    would take ten times the memory.
    """

    path: Path
    columns: dict[str, str]
    separator: str
    rows: IntArray

    def __len__(self) -> int:
        return len(self.rows)

    def cells(self, name: str) -> list[str]:
        """Return the cells of a column."""
        return self.columns[name].split(self.separator) if len(self) else []

    def with_cells(self, name: str, cells: Iterable[str]) -> CSVTable:
        """Return the table with other cells in one column."""
        return replace(self, columns={**self.columns, name: self.separator.join(cells)})

    def row_number(self, k: int) -> int:
        """Return the row number of a record, the header being row 1."""
        return int(self.rows[k])

    def require_columns(self, *names: str) -> None:
        """Raise FileError if one of these columns is missing."""
        for name in names:
            if name not in self.columns:
                present = ", ".join(repr(c) for c in self.columns)
                raise FileError(
                    self.path, f"no such column; the header has {present}", "a comma-separated header row with it",
                    row=1, column=name,
                )  # fmt: skip

    def column_of_numbers(
        self, name: str, *, missing: bool = False, largest: float | None = LARGEST, allowed: str = ""
    ) -> FloatArray:
        """Read a column as numbers, shape (n_rows,).

        Parameters
        ----------
        name
            The column.
        missing
            Whether an empty cell, `nan`, `na` or `n/a` is allowed; it becomes NaN.
        largest
            Largest magnitude allowed; None: any finite number.
        allowed
            What is allowed, for the error; "": in words of the other arguments.

        Raises
        ------
        FileError
            At the first cell that is not such a number.
        """
        cells = self.cells(name)
        most = np.finfo(np.float64).max if largest is None else largest
        there = np.ones(len(cells), dtype=np.bool_)
        if missing:
            there = np.fromiter((cell not in MISSING for cell in cells), dtype=np.bool_, count=len(cells))
        values = _parsed_numbers(list(itertools.compress(cells, there)))
        if values is None or not (np.abs(values) <= most).all():
            number = "a finite number" if largest is None else f"a finite number of magnitude up to {largest:g}"
            allowed = allowed or number + (", or empty, nan or n/a where it is missing" if missing else "")
            k = first_cell_without_number(cells, missing=missing, largest=most)
            assert k is not None
            raise FileError(self.path, _cell_in_words(cells[k]), allowed, row=self.row_number(k), column=name)
        out = np.full(len(cells), math.nan)
        out[there] = values
        return out


def _parsed_numbers(cells: Sequence[str]) -> FloatArray | None:
    """Convert cells to numbers in one pass; None if one of them is not a plain decimal number."""
    if _OF_NUMBERS.fullmatch("".join(cells)) is None:
        return None
    try:
        return np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
    except ValueError:
        return None


def _is_number(cell: str) -> bool:
    return _NUMBER.fullmatch(cell) is not None


def first_cell_without_number(
    cells: Sequence[object], *, missing: bool = True, largest: float = math.inf
) -> int | None:
    """Return the index of the first cell that is no number up to `largest` and, if `missing`, not missing; or None."""
    for k, cell in enumerate(cells):
        text = str(cell).strip()
        is_number = _is_number(text) and abs(float(text)) <= largest
        if not is_number and not (missing and text in MISSING):
            return k
    return None


def count_numbers(cells: Sequence[str]) -> int:
    """Count the cells that hold a plain decimal number (float() would accept 'infinity' and '1_000' too)."""
    if _parsed_numbers(cells) is not None:
        return len(cells)
    return sum(n for cell, n in Counter(cells).items() if _is_number(cell))


def _cell_in_words(cell: str) -> str:
    return shown(cell) if cell else "the cell is empty"


def read_table(path: Path, *, progress: Progress = silent) -> CSVTable:
    """Read a CSV file with one header row; blank lines are skipped.

    Raises FileError if it cannot be read, has no header or a repeated column, a row is too short or too long, or quotes
    do not close.
    """
    text = read_text(path, "a CSV file")
    n_lines = text.count("\n")
    separator = next(c for c in itertools.chain("\x1f\x1e", map(chr, range(0xE000, 0x110000))) if c not in text)
    unescape = partial(re.compile(f"(?<![^{separator}])'(?='*[=+@-])").sub, "")  # see _not_as_formula
    header: list[str] | None = None
    columns: list[list[str]] = []
    rows: list[IntArray] = []
    n_read = 0
    for records, failed in _read_in_chunks(text):
        lengths = np.fromiter(map(len, records), dtype=np.int64, count=len(records))
        blank = [k for k in np.flatnonzero(lengths <= 1) if not any(cell.strip() for cell in records[k])]
        kept = np.delete(np.arange(len(records)), blank)
        if header is None and len(kept):
            header = [unescape(cell.strip()) for cell in records[kept[0]]]
            _require_commas(path, header, n_read + int(kept[0]) + 1)
            _require_distinct_columns(path, header, n_read + int(kept[0]) + 1)
            columns = [[] for _ in header]
            kept = kept[1:]
        wrong = kept[lengths[kept] != len(columns)]
        if wrong.size:
            k = int(wrong[0])
            found = f"the row has {len(records[k])} cells"
            raise FileError(path, found, f"{len(columns)} cells as in the header", row=n_read + k + 1)
        for column, cells in zip(columns, zip(*(records[k] for k in kept), strict=True), strict=False):
            column.append(separator.join(map(str.strip, cells)))
        rows.append(n_read + kept + 1)
        n_read += len(records)
        if failed is not None:
            found = f"not readable as CSV ({failed})"
            raise FileError(path, found, "comma-separated cells, quotes closed", row=n_read + 1) from failed
        progress(f"reading {path.name}", n_read, max(n_lines, n_read))
    if header is None:
        raise FileError(path, "the file is empty", "a header row and one row per reading")
    joined = {name: unescape(separator.join(column)) for name, column in zip(header, columns, strict=True)}
    return CSVTable(path, joined, separator, np.concatenate(rows))


def _read_in_chunks(text: str) -> Iterator[tuple[list[list[str]], csv.Error | None]]:
    """Yield lists of up to 2,000 records, each list with the error that ended it, if any."""
    # Not StringIO, which takes four bytes per character.
    lines = io.TextIOWrapper(io.BytesIO(text.encode()), encoding="utf-8", newline="")
    reader = csv.reader(lines, strict=True)
    failed = None
    while failed is None:
        records: list[list[str]] = []
        try:
            records.extend(itertools.islice(reader, _CHUNK))
        except csv.Error as error:
            failed = error
        if not records and failed is None:
            return
        yield records, failed


def _require_commas(path: Path, header: Sequence[str], row: int) -> None:
    """Raise FileError if a header of one cell has another separator, as spreadsheets of many countries write."""
    other = next((name for mark, name in _OTHER_SEPARATORS.items() if mark in header[0]), None)
    if len(header) == 1 and other is not None:
        allowed = (
            "cells separated by commas, numbers with a decimal point (1.5, not 1,5): in a spreadsheet, save as CSV "
            "with these"
        )
        raise FileError(path, f"the header is separated by {other}", allowed, row=row)


def _require_distinct_columns(path: Path, header: Sequence[str], row: int) -> None:
    seen: set[str] = set()
    for name in header:
        if name in seen:
            raise FileError(
                path, "the column comes twice in the header", "each column once", row=row, column=name or "''"
            )
        seen.add(name)


def number_text(value: float) -> str:
    """Format a number in full precision, integers without a point, NaN as an empty cell."""
    if math.isnan(value):
        return ""
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) <= LARGEST else repr(value)


def _not_as_formula(cell: object) -> object:
    """Return a cell, in front of a text like "=1+1" or "'=1+1" one apostrophe more; numbers stay as they are."""
    if isinstance(cell, str) and cell.lstrip("'")[:1] in _BEGIN_FORMULA and not _is_number(cell):
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
