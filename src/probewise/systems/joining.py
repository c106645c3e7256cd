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
from probewise.systems.table import RunTable

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
    The table, and notes on the missing and the omitted columns.

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
    first, notes = tables[0], []
    for source, table in zip(sources[1:], tables[1:], strict=True):
        notes += [
            f"{source} has no column {name}: missing there" for name in first.columns if name not in table.columns
        ]
        beyond = [name for name in table.columns if name not in first.columns]
        notes += [f"column {name} of {source} left out: {sources[0]} has none" for name in beyond]
    run = first.run or unused_name(_FILE, first.columns)
    names = np.array(list(_run_names_by_row(tables, sources, named=first.run is not None)))
    columns = {
        name: names  # whether they were numbers or texts
        if name == run
        else _concatenated_column(name, [t.columns.get(name) for t in tables], [len(t) for t in tables], sources)
        for name in dict.fromkeys((*first.columns, run))
    }
    return replace(first, columns=columns, run=run), tuple(notes)


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
            raise ParameterError(f"column {name!r} of {source}", str(part[0]), f"numbers, as in {sources[0]}")
        else:
            out.append(part if numeric else np.array([_text(value) for value in part.tolist()]))
    return np.concatenate(out)


def _text(value: object) -> str:
    return number_text(value) if isinstance(value, float) else str(value)


def _run_names_by_row(tables: Sequence[RunTable], sources: Sequence[str], *, named: bool) -> Iterable[str]:
    """Yield the name of each row's run, with a number appended if a run of an earlier table has that name."""
    taken: set[str] = set()
    for table, source in zip(tables, sources, strict=True):
        names: tuple[str, ...] = table.scan_names if named else (source,)
        own: dict[str, str] = {}
        for name in names:
            # A new name must not be one of this table's own either, which follows unchanged.
            own[name] = unused_name(name, taken | set(own.values()) | (set(names) - {name}))
        taken |= set(own.values())
        yield from (own[names[k]] for k in table.scan.tolist())


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
