"""The option --simulator, and tables of readings for a user's simulator."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from probewise.cli._common import add, count_up_to, parse_path
from probewise.errors import FileError, ParameterError

if TYPE_CHECKING:
    from probewise.systems import RunTable, Simulator


def add_simulator(parser: argparse.ArgumentParser, *, replaces: str = " instead of the light sensor") -> None:
    """Add --simulator FILE.py; the help says what it replaces."""
    about = (
        f"a simulator of your own{replaces}; the file says which columns of the table it reads (it is a program: run "
        "only those that you trust)"
    )
    add(parser, "--simulator FILE.py", about, type=parse_path)


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add --workers N for the calls of a simulator."""
    about = "processes for a simulator that is called for one sample at a time (default 1); results are the same"
    add(parser, "--workers N", about, type=count_up_to(1024), default=1)


@contextlib.contextmanager
def open_simulator(path: Path, n_workers: int) -> Iterator[Simulator]:
    """Read a simulator; with workers, the calls of its `simulate` are spread over processes."""
    from dataclasses import replace

    from probewise.cli._executor import worker_pool
    from probewise.systems import read_simulator
    from probewise.systems.calls import SpreadCalls

    simulator = read_simulator(path)
    if n_workers == 1 or simulator.simulate is None or simulator.vectorized:
        yield simulator
        return
    with worker_pool(n_workers) as pool:
        yield replace(simulator, simulate=SpreadCalls(simulator.simulate, path, pool, n_workers))


def read_joined_table(simulator: Simulator, paths: Sequence[Path]) -> tuple[RunTable, tuple[str, ...]]:
    """Read tables of one system, all with the reading or none; return them joined, and notes on their columns."""
    from probewise.systems import as_recording, concatenate_tables, read_table_for

    tables = []
    for path in paths:
        if path.suffix == ".jsonl":
            raise FileError(path, "a journal", "a CSV table; the journal of an explore run goes with --sensor")
        tables.append(read_table_for(simulator, path))
    with_reading = [path for path, table in zip(paths, tables, strict=True) if simulator.reading in table.columns]
    for path, table in zip(paths, tables, strict=True):
        if with_reading and path not in with_reading:
            header = ", ".join(repr(name) for name in table.columns)
            allowed = f"the reading, as in {with_reading[0].name}; the header has {header}"
            raise FileError(path, f"no column {simulator.reading!r}", allowed)
        if len(paths) > 1:  # after they are joined, a row would be one of no file
            try:
                as_recording(simulator, table)
                table.require_rising_time()
            except ParameterError as error:
                raise FileError(path, f"{error.name} is {error.value}", error.allowed) from error
    return concatenate_tables(tables, [path.name for path in paths])
