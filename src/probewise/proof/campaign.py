"""Run many independent tasks on any executor, with one line of a file per result, resumable after any stop.

Format "campaign/1". The first line holds the settings that determine the results. Every further line
is a finished task: its key and its result, in order of completion. Results are returned in the order
of the tasks, so that nothing depends on the executor.
"""

from __future__ import annotations

import json
import lzma
import os
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

from probewise._tasks import results_as_tasks_end
from probewise._writing import write_and_sync
from probewise.errors import FileError, ParameterError, shown
from probewise.progress import Progress, silent
from probewise.recordings import hold_lock, parse_json_file_text, read_bytes, write_text_atomically

__all__ = ["FORMAT", "Campaign", "CampaignContents", "read_campaign"]

FORMAT = "campaign/1"
Result = Mapping[str, Any]
Misfit: TypeAlias = Callable[[Result], tuple[str, str] | None]
K = TypeVar("K")


@dataclass(frozen=True)
class Campaign(Generic[K]):
    """Tasks whose results a file keeps."""

    work: Callable[[K], Result]  # a dict for JSON from a task; defined at module level if workers are processes
    tasks: Mapping[str, K]  # by key, each with its own seed, so that order and worker do not matter
    settings: Mapping[str, Any]  # everything that determines the results, a dict for JSON
    misfit: Misfit = lambda result: None  # what of a result in the file cannot be, and what is allowed, or None
    noun: str = "runs"  # of several tasks

    def run(
        self, *, path: str | os.PathLike[str], executor: Executor | None = None, progress: Progress = silent
    ) -> dict[K, Result]:
        """Run the tasks whose results are not yet in the file; return the results of all by task, in their order.

        `path`: the campaign's file, created or continued: one of other settings is refused; `executor`: any
        `concurrent.futures.Executor`, also of other machines, None for here, one by one; `progress`: called with the
        noun, the number of finished tasks, earlier runs included, and the key of the last.

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
        path, tasks, settings = Path(path), self.tasks, json.loads(json.dumps(dict(self.settings)))
        with hold_lock(path):
            if not path.exists():
                write_text_atomically(
                    path, json.dumps({"format": FORMAT, "settings": settings}, allow_nan=False) + "\n"
                )
            before = read_campaign(path, misfit=self.misfit)
            if before.settings != settings:
                raise FileError(path, "it belongs to a campaign with other settings", f"{settings}; or another file")
            done = {key: before.results[key] for key in tasks if key in before.results}
            left = {key: task for key, task in tasks.items() if key not in done}
            with path.open("r+b", buffering=0) as file, results_as_tasks_end(self.work, left, executor) as ended:
                file.truncate(file.seek(file.read().rfind(b"\n") + 1))  # without an incomplete last line
                progress(self.noun, len(done), len(tasks))
                for key, result in ended:
                    try:
                        line = json.dumps({"key": key, "result": result}, allow_nan=False)
                    except (TypeError, ValueError) as error:
                        allowed = f"a JSON object of finite numbers ({error})"
                        raise ParameterError(f"the result of {key}", result, allowed) from error
                    write_and_sync(file, path, line.encode() + b"\n")
                    done[key] = json.loads(line)["result"]  # as a later reader will see it
                    progress(self.noun, len(done), len(tasks), key)
        return {task: done[key] for key, task in tasks.items()}


@dataclass(frozen=True)
class CampaignContents:
    """Contents of a campaign's file: its settings, and results by task key in the order in which the tasks ended."""

    settings: Mapping[str, Any]
    results: Mapping[str, Result]


def read_campaign(path: str | os.PathLike[str], *, misfit: Misfit = lambda result: None) -> CampaignContents:
    """Read a campaign's file, packed if its name ends in .xz; an incomplete last line is ignored.

    Raises
    ------
    FileError
        If it is missing, not a campaign's, or damaged before its last line, or if `misfit` (see `Campaign`) finds a
        result that cannot be.
    """
    content = read_bytes(Path(path), "a campaign's file")
    # After the last line end there is nothing, or an incomplete line.
    *lines, _ = (lzma.decompress(content) if Path(path).suffix == ".xz" else content).split(b"\n")
    rows = [
        parse_json_file_text(path, line, "one JSON object per line", row=k) for k, line in enumerate(lines, start=1)
    ]
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, dict):
            raise FileError(path, "not an object", "one JSON object per line", row=number)
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
