"""Join several tables of one system."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise.errors import ParameterError
from probewise.recordings.table import number_text
from probewise.systems.table import RunTable, column_error

_FILE = "file"


def concatenate_tables(tables: Sequence[RunTable], sources: Sequence[str]) -> tuple[RunTable, tuple[str, ...]]:
    """Concatenate tables: columns are those of the first, and runs of different tables remain distinct.

    A column that a later table lacks is missing there; one that only a later table has is left out. Without a column of
    runs, each of several tables is one run.

    Parameters
    ----------
    tables
        One or more, with the same time and run.
    sources
        Name of each in messages.

    Returns
    -------
    The table, and notes on missing and omitted columns and on renamed runs.

    Raises
    ------
    ParameterError
        If there is no table, two are the same, or a column of numbers in the first has texts in another.
    """
    if not tables:
        raise ParameterError("tables", (), "one or more")
    for (one, first), (another, second) in itertools.combinations(zip(sources, tables, strict=True), 2):
        if _same_tables(first, second):
            raise ParameterError("tables", f"{one} and {another}", "tables that differ; these hold the same rows")
    if len(tables) == 1:
        return tables[0], ()
    first, notes = tables[0], list[str]()
    for source, table in zip(sources[1:], tables[1:], strict=True):
        notes += [
            f"{source} has no column {name}: missing there" for name in first.columns if name not in table.columns
        ]
        beyond = [name for name in table.columns if name not in first.columns]
        notes += [f"column {name} of {source} left out: {sources[0]} has none" for name in beyond]
    run = first.run or unused_name(_FILE, first.columns)
    by_table = _distinct_run_names(tables, sources, named=first.run is not None)
    if first.run is not None:
        for source, own in zip(sources, by_table, strict=True):
            if renamed := [f"{name} is {new}" for name, new in own.items() if new != name]:
                notes.append(f"runs of {source} renamed, as another table has them too: {', '.join(renamed)}")
    names = np.concatenate([np.array([*own.values()])[t.scan] for t, own in zip(tables, by_table, strict=True)])
    columns = {
        name: names  # whether they were numbers or texts
        if name == run
        else _concatenated_column(name, [t.columns.get(name) for t in tables], [len(t) for t in tables], sources)
        for name in dict.fromkeys((*first.columns, run))
    }
    how = tuple(dict.fromkeys(note for table in tables for note in table.notes))
    return replace(first, columns=columns, run=run, notes=how), tuple(notes)


def append_tables(table: RunTable, more: Sequence[RunTable]) -> RunTable:
    """Append the rows of tables with the same columns to a table; runs of one name become one run."""
    columns = {name: np.concatenate([t.columns[name] for t in (table, *more)]) for name in table.columns}
    return replace(table, columns=columns, like={key: value for t in (table, *more) for key, value in t.like.items()})


def _concatenated_column(
    name: str, parts: Sequence[NDArray[Any] | None], lengths: Sequence[int], sources: Sequence[str]
) -> NDArray[Any]:
    first = parts[0]
    assert first is not None
    has_texts = any(part is not None and part.dtype != np.float64 for part in parts)
    numeric = first.dtype == np.float64 and not (has_texts and np.isnan(first).all())
    out: list[NDArray[Any]] = []
    for part, n, source in zip(parts, lengths, sources, strict=True):
        if part is None:
            out.append(np.full(n, np.nan) if numeric else np.full(n, ""))
        elif numeric and part.dtype != np.float64:
            allowed = f"a number, or nothing where it is missing, as in {sources[0]}"
            raise column_error(f"column {name!r} of {source}", part, allowed)
        else:
            out.append(part if numeric else np.array([_text(value) for value in part.tolist()]))
    return np.concatenate(out)


def _text(value: object) -> str:
    return number_text(value) if isinstance(value, float) else str(value)


def _distinct_run_names(tables: Sequence[RunTable], sources: Sequence[str], *, named: bool) -> list[dict[str, str]]:
    """Return for each table the names of its runs, in order: a number is appended to one that an earlier table has."""
    taken: set[str] = set()
    out: list[dict[str, str]] = []
    for table, source in zip(tables, sources, strict=True):
        names: tuple[str, ...] = table.scan_names if named else (source,)
        own: dict[str, str] = {}
        for name in names:
            # A new name must not be one of this table's own either, which follows unchanged.
            own[name] = unused_name(name, taken | set(own.values()) | (set(names) - {name}))
        taken |= set(own.values())
        out.append(own)
    return out


def unused_name(name: str, taken: Iterable[str]) -> str:
    """Return the name, with a number appended if it is among those taken."""
    known = set(taken)
    numbered = (f"{name} ({k})" for k in itertools.count(2))
    return next(n for n in itertools.chain([name], numbered) if n not in known)


def _same_tables(first: RunTable, second: RunTable) -> bool:
    if len(first) != len(second) or set(first.columns) != set(second.columns):
        return False
    return all(_equal_columns(values, second.columns[name]) for name, values in first.columns.items())


def _equal_columns(first: NDArray[Any], second: NDArray[Any]) -> bool:
    if first.dtype == np.float64 and second.dtype == np.float64:
        return bool(np.array_equal(first, second, equal_nan=True))
    return [str(v) for v in first.tolist()] == [str(v) for v in second.tolist()]
