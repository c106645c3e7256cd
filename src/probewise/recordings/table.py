"""A CSV file as a checked table of texts and numbers, rows counted as a person counts them."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import FileError

__all__ = ["LARGEST", "Table", "csv_text", "number_text", "read_bytes", "read_table", "read_text"]

LARGEST = 1e15
"""Largest magnitude of a number in a file: beyond it squares and differences lose their meaning."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Table:
    """Cells by column, stripped of surrounding blanks; `rows` numbers each record (header = row 1)."""

    path: Path
    columns: dict[str, tuple[str, ...]]
    rows: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.rows)

    def require(self, *names: str) -> None:
        """Raise FileError if one of these columns is missing."""
        for name in names:
            if name not in self.columns:
                present = ", ".join(repr(c) for c in self.columns)
                raise FileError(
                    self.path, f"no such column; the header has {present}", "a comma-separated header row with it",
                    row=1, column=name,
                )  # fmt: skip

    def numbers(self, name: str, *, missing: bool = False, largest: float | None = LARGEST) -> FloatArray:
        """Read a column as numbers, shape (n_rows,).

        Parameters
        ----------
        name
            The column.
        missing
            Whether an empty cell or `nan` is allowed; it becomes NaN.
        largest
            Largest magnitude allowed; None: any finite number.

        Raises
        ------
        FileError
            At the first cell that is not such a number.
        """
        out = np.empty(len(self))
        allowed = "a finite number" if largest is None else f"a finite number of magnitude up to {largest:g}"
        if missing:
            allowed += ", or empty or nan where it is missing"
        for k, cell in enumerate(self.columns[name]):
            if missing and cell.lower() in ("", "nan"):
                out[k] = math.nan
                continue
            value = float(cell) if is_number(cell) else math.nan
            if not math.isfinite(value) or (largest is not None and abs(value) > largest):
                raise FileError(self.path, described(cell), allowed, row=self.rows[k], column=name)
            out[k] = value
        return out


def is_number(cell: str) -> bool:
    """Tell whether a cell is a plain decimal number (float() would take 'infinity' and '1_000' too)."""
    return _NUMBER.fullmatch(cell) is not None


def described(cell: str) -> str:
    """Say what stands in a cell, briefly."""
    if not cell:
        return "the cell is empty"
    return f"{cell!r}" if len(cell) <= 60 else f"{cell[:57] + '...'!r}"


def read_bytes(path: Path, what: str) -> bytes:
    """Read a file whole.

    Raises
    ------
    FileError
        If it is missing or cannot be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise FileError(path, "there is no such file", what) from error
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read ({error})", what) from error


def read_text(path: Path, what: str) -> str:
    """Read a UTF-8 file whole, without its byte-order mark.

    Raises
    ------
    FileError
        If it is missing, cannot be read or is not UTF-8.
    """
    content = read_bytes(path, what)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = content.count(b"\n", 0, error.start) + 1
        found = f"byte 0x{content[error.start]:02x} at offset {error.start} is not UTF-8"
        raise FileError(path, found, "UTF-8 text (save the file again with that encoding)", row=row) from error


def read_table(path: Path) -> Table:
    """Read a CSV file with one header row; lines without anything are passed over.

    Raises
    ------
    FileError
        If there is no header, a column comes twice, a row is short or long, or quotes do not close.
    """
    text = read_text(path, "a CSV file")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    records: list[list[str]] = []
    rows: list[int] = []
    header: list[str] | None = None
    row = 0
    try:
        for row, record in enumerate(reader, start=1):
            cells = [cell.strip() for cell in record]
            if not any(cells) and len(cells) <= 1:
                continue
            if header is None:
                header = cells
                _check_header(path, header, row)
                continue
            if len(cells) != len(header):
                raise FileError(
                    path, f"the row has {len(cells)} cells", f"{len(header)} cells as in the header", row=row
                )
            records.append(cells)
            rows.append(row)
    except csv.Error as error:
        raise FileError(
            path, f"not readable as CSV ({error})", "comma-separated cells, quotes closed", row=row + 1
        ) from error
    if header is None:
        raise FileError(path, "the file is empty", "a header row and one row a reading")
    columns = {name: tuple(record[k] for record in records) for k, name in enumerate(header)}
    return Table(path=path, columns=columns, rows=tuple(rows))


def _check_header(path: Path, header: Sequence[str], row: int) -> None:
    seen: set[str] = set()
    for name in header:
        if name in seen:
            raise FileError(
                path, "the column comes twice in the header", "each column once", row=row, column=name or "''"
            )
        seen.add(name)


def number_text(value: float) -> str:
    """Write a number in full precision, whole ones without a point, NaN as an empty cell."""
    if math.isnan(value):
        return ""
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) <= LARGEST else repr(value)


def csv_text(columns: dict[str, Sequence[str]]) -> str:
    """Write columns of cells, equally long, as CSV with a header row and LF line ends."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return out.getvalue()
