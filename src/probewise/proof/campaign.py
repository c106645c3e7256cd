"""Run many independent tasks on any executor, with one line of a file per result, resumable after any stop.

Format "campaign/1". The first line holds the settings that determine the results. Every further line
is a finished task: its key and its result, in order of completion. Results are returned in the order
of the tasks, so that nothing depends on the executor.
"""

from __future__ import annotations

import json
import lzma
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeAlias, TypeVar

from probewise._tasks import results_as_tasks_end
from probewise._writing import write_and_sync
from probewise.errors import FileError, ParameterError, shown
from probewise.progress import Progress, silent
from probewise.recordings import hold_lock, parse_json_file_text, read_bytes, write_text_atomically

__all__ = ["FORMAT", "Campaign", "CampaignContents", "read_campaign", "run_campaign"]

FORMAT = "campaign/1"
Result = Mapping[str, Any]
Misfit: TypeAlias = Callable[[Result], tuple[str, str] | None]
T = TypeVar("T")


class Keyed(Protocol):
    """A task: everything that determines its result, a value to be hashed and pickled."""

    @property
    def key(self) -> str:
        """The task's key in the campaign's file."""
        ...


K = TypeVar("K", bound=Keyed)


@dataclass(frozen=True)
class Campaign(Generic[K]):
    """What a campaign runs: its work, its tasks, and the rest as `run_campaign` takes it."""

    work: Callable[[K], Result]
    tasks: Sequence[K]
    settings: Mapping[str, Any]
    misfit: Misfit
    noun: str = "runs"

    def run(
        self, *, path: str | os.PathLike[str], executor: Executor | None = None, progress: Progress = silent
    ) -> dict[K, Result]:
        """Run it, or resume it, as `run_campaign` does; return the results by task."""
        tasks = {task.key: task for task in self.tasks}
        more = {"executor": executor, "progress": progress, "noun": self.noun, "misfit": self.misfit}
        results = run_campaign(self.work, tasks, path=path, settings=self.settings, **more)  # type: ignore[arg-type]
        return {tasks[key]: result for key, result in results.items()}


@dataclass(frozen=True)
class CampaignContents:
    """Contents of a campaign's file: its settings, and results by task key in the order in which the tasks ended."""

    settings: Mapping[str, Any]
    results: Mapping[str, Result]


def run_campaign(
    work: Callable[[T], Result],
    tasks: Mapping[str, T],
    *,
    path: str | os.PathLike[str],
    settings: Mapping[str, Any],
    executor: Executor | None = None,
    progress: Progress = silent,
    noun: str = "tasks",
    misfit: Misfit = lambda result: None,
) -> dict[str, Result]:
    """Run the tasks whose results are not yet in the file; return the results of all by key, in the order of `tasks`.

    `work`: function from a task to its result, a dict for JSON, defined at module level if workers are processes;
    `tasks`: by key, each with its own seed, so that order and worker do not matter; `path`: the campaign's file,
    created or continued; `settings`: everything that determines the results, a dict for JSON: a file with others is
    refused; `executor`: any `concurrent.futures.Executor`, also of other machines, None for here, one by one;
    `progress`: called with `noun`, the number of finished tasks, earlier runs included, and the key of the last;
    `misfit`: function of a result in the file: what of it cannot be, and what is allowed, or None.

    Raises
    ------
    FileError
        If the file belongs to another campaign, is damaged before its last line, or is being written to, or if a
        result in it is a misfit.
    NotConvergedError
        If a worker dies.
    LinkError
        If the executor drops its tasks, as where a scheduler is killed.
    ParameterError
        If a result is not a JSON object of finite numbers.
    Exception
        Whatever `work` raises ends the campaign. Finished results are kept, and the same call continues from there.
    """
    path = Path(path)
    wanted = json.loads(json.dumps(dict(settings)))
    with hold_lock(path):
        before = read_campaign(path, misfit=misfit) if path.exists() else None
        if before is not None and before.settings != wanted:
            raise FileError(path, "it belongs to a campaign with other settings", f"{wanted}; or another file")
        done = {} if before is None else {key: before.results[key] for key in tasks if key in before.results}
        left = {key: task for key, task in tasks.items() if key not in done}
        with (
            _ResultLog(path, wanted, fresh=before is None) as lines,
            results_as_tasks_end(work, left, executor) as ended,
        ):
            progress(noun, len(done), len(tasks))
            for key, result in ended:
                line = json.loads(lines.add(key, result))  # as a later reader will see it
                done[key] = line["result"]
                progress(noun, len(done), len(tasks), key)
    return {key: done[key] for key in tasks}


def read_campaign(path: str | os.PathLike[str], *, misfit: Misfit = lambda result: None) -> CampaignContents:
    """Read a campaign's file, packed if its name ends in .xz; an incomplete last line is ignored.

    Raises
    ------
    FileError
        If it is missing, not a campaign's, or damaged before its last line, or if `misfit` (see `run_campaign`) finds
        a result that cannot be.
    """
    content = read_bytes(Path(path), "a campaign's file")
    # After the last line end there is nothing, or an incomplete line.
    *lines, _ = (lzma.decompress(content) if Path(path).suffix == ".xz" else content).split(b"\n")
    rows = [_parsed_line(path, number, line) for number, line in enumerate(lines, start=1)]
    if not rows or rows[0].get("format") != FORMAT or not isinstance(rows[0].get("settings"), dict):
        raise FileError(path, "this is not a campaign file", f'a first line with "format": "{FORMAT}" and its settings')
    results: dict[str, Result] = {}
    for number, row in enumerate(rows[1:], start=2):
        key, result = row.get("key"), row.get("result")
        if not (isinstance(key, str) and isinstance(result, dict)):
            raise FileError(path, "not a finished task", '"key" and "result"', row=number)
        if key in results:
            raise FileError(path, f"task {shown(key)} a second time", "every task once", row=number)
        if (wrong := misfit(result)) is not None:
            raise FileError(path, *wrong, row=number)
        results[key] = result
    return CampaignContents(rows[0]["settings"], results)


def _parsed_line(path: str | os.PathLike[str], number: int, line: bytes) -> dict[str, Any]:
    row = parse_json_file_text(path, line, "one JSON object per line", row=number)
    if not isinstance(row, dict):
        raise FileError(path, "not an object", "one JSON object per line", row=number)
    return row


class _ResultLog:
    """A campaign's file, open for results: each added line is synced to disk; an incomplete last line is cut off."""

    def __init__(self, path: Path, settings: Mapping[str, Any], *, fresh: bool) -> None:
        if fresh:
            write_text_atomically(path, json.dumps({"format": FORMAT, "settings": settings}, allow_nan=False) + "\n")
        self._path = path

    def __enter__(self) -> Self:
        self._file = self._path.open("r+b", buffering=0)
        content = self._file.read()
        self._file.truncate(self._file.seek(content.rfind(b"\n") + 1))
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, key: str, result: Result) -> str:
        """Write one finished task; return its line of JSON, {"key": ..., "result": ...}."""
        try:
            line = json.dumps({"key": key, "result": result}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ParameterError(
                f"the result of {key}", result, f"a JSON object of finite numbers ({error})"
            ) from error
        write_and_sync(self._file, self._path, line.encode() + b"\n")
        return line
