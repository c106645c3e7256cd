"""Files of results: JSON lines that grow as runs end and survive an interruption, and one compact JSON."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from nested_sampling import one_thread


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Read the whole lines of a file; a last line cut short by an interruption is left out."""
    return list(_whole(path)) if path.exists() else []


def _whole(path: Path) -> Iterator[dict[str, Any]]:
    for line in path.read_bytes().splitlines(keepends=True):
        if line.endswith(b"\n"):
            yield json.loads(line)


class Lines:
    """Append JSON lines; a line cut short by an earlier interruption is removed first."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        content = path.read_bytes() if path.exists() else b""
        self._stream = path.open("r+b" if path.exists() else "w+b")
        self._stream.truncate(content.rfind(b"\n") + 1)
        self._stream.seek(0, os.SEEK_END)

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *error: object) -> None:
        self._stream.close()

    def add(self, record: dict[str, Any]) -> None:
        """Write one line, and make sure that it is on its way to the disk before the next run begins."""
        self._stream.write(json.dumps(record).encode() + b"\n")
        self._stream.flush()
        os.fsync(self._stream.fileno())


def complete(
    out: Path, jobs: Mapping[tuple[Any, ...], tuple[Any, ...]], keys: Iterable[str], one: Any, n_workers: int
) -> None:
    """Make every run that is not in the file yet.

    `jobs`: the arguments of `one`, a function of a module, which returns a line, by the values that the line has at
    `keys`. Several workers are fresh interpreters: their libraries read the thread variables at their start.
    """
    seen = {tuple(line[key] for key in keys) for line in read_lines(out)}
    left = [arguments for key, arguments in jobs.items() if key not in seen]
    with Lines(out) as lines:
        if n_workers == 1:
            for arguments in left:
                lines.add(one(*arguments))
            return
        with ProcessPoolExecutor(n_workers, get_context("spawn"), initializer=one_thread.settle) as pool:
            for done in as_completed([pool.submit(one, *arguments) for arguments in left]):
                lines.add(done.result())


def summarise(arguments: list[str], summary_of: Any, table: Any) -> None:
    """Sum files up, as the arguments say: print the table of their entries, and write these where `--out` is given."""
    parser = argparse.ArgumentParser()
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    entries = summary_of(options.files)
    print(table(entries))
    if options.out:
        from probewise import __version__

        write_json(options.out, {"version": __version__, "date": today(), "problems": entries})


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file in one piece or not at all, arrays of numbers on one line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_text(_laid_out(value) + "\n", encoding="utf-8")
    partial.replace(path)


def _laid_out(value: Any, indent: int = 0) -> str:
    """Lay out JSON one entry a line, but what holds only numbers and words in one."""
    inner = " " * (indent + 1)
    if isinstance(value, dict) and any(isinstance(v, dict | list) for v in value.values()):
        entries = (f"{inner}{json.dumps(str(k))}: {_laid_out(v, indent + 1)}" for k, v in value.items())
        return "{\n" + ",\n".join(entries) + "\n" + " " * indent + "}"
    if isinstance(value, list) and any(isinstance(v, dict | list) for v in value):
        return "[\n" + ",\n".join(inner + _laid_out(v, indent + 1) for v in value) + "\n" + " " * indent + "]"
    return json.dumps(value)


def today() -> str:
    """Date of a result."""
    return time.strftime("%Y-%m-%d")


def markdown_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Lay out a table."""
    titles = list(head)
    lines = ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])
