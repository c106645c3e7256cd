"""A study: every row over its circles, run as a campaign and summarised as a table."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probewise._kinds import checked_whole
from probewise._version import __version__
from probewise.errors import FileError, ParameterError
from probewise.progress import Progress, silent
from probewise.proof.campaign import read_campaign, run_campaign
from probewise.proof.study.circles import MOST_CIRCLES
from probewise.proof.study.rows import SearchConfiguration
from probewise.proof.study.table import Summary, summarise
from probewise.proof.study.trial import Trial, run_trial


@dataclass(frozen=True, eq=False)
class Study:
    """Results (`run_trial`) of each row, in the order of the circles, and the limit of readings."""

    trials: Mapping[SearchConfiguration, tuple[Mapping[str, Any], ...]]
    max_readings: int

    def table(self) -> dict[SearchConfiguration, Summary]:
        """Return the summary of every row with two or more runs, by row."""
        return {row: summarise(t, max_readings=self.max_readings) for row, t in self.trials.items() if len(t) > 1}


def run_study(
    rows: Mapping[SearchConfiguration, int] | Sequence[SearchConfiguration],
    n_circles: int | None = None,
    *,
    path: str | os.PathLike[str],
    max_readings: int = 100,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> Study:
    """Run every row over the first circles of its population, or resume an interrupted study; return the results.

    Parameters
    ----------
    rows
        The rows; a mapping gives each its own number of circles.
    n_circles
        Circles per row, unless `rows` gives them.
    path
        The campaign's file. Rows and circles may be added later: runs in the file are not repeated.
    max_readings
        A run that has not reached the target precision after this many readings is a miss.
    executor
        Any `concurrent.futures.Executor`: processes here; for many machines `distributed.Client(...).get_executor()`.
    progress
        Called with the number of finished runs.

    Raises
    ------
    ParameterError
        If there is no row, or a row has no circle.
    FileError, NotConvergedError
        See `run_campaign`.
    """
    wanted = dict(rows) if isinstance(rows, Mapping) else dict.fromkeys(rows, n_circles or 0)
    if not wanted:
        raise ParameterError("rows", rows, "one row or more, such as those of standard_rows()")
    for row, n in wanted.items():
        checked_whole(f"circles of the row {row.name!r}", n, most=MOST_CIRCLES)
    # Circle by circle, so that an interrupted study has equally many runs in each row.
    trials = [Trial(row, k, max_readings) for k in range(max(wanted.values())) for row, n in wanted.items() if k < n]
    results = run_campaign(
        run_trial,
        {trial.key: trial for trial in trials},
        path=path,
        settings={"study": __version__, "max_readings": max_readings},
        executor=executor,
        progress=progress,
        noun="runs",
    )
    own = {row: tuple(results[Trial(row, k).key] for k in range(n)) for row, n in wanted.items()}
    return Study(own, max_readings)


def read_study(path: str | os.PathLike[str], rows: Sequence[SearchConfiguration]) -> Study:
    """Read the results of these rows from a study's file, finished or not; runs not in the file are left out.

    Raises FileError if the file does not belong to a study.
    """
    found = read_campaign(path)
    if "study" not in found.settings:
        raise FileError(Path(path), "no study's campaign", "a file that `probewise study` wrote")
    numbers = range(1 + max((int(key.rpartition(" / ")[2]) for key in found.results), default=-1))
    keys = {row: [Trial(row, k).key for k in numbers] for row in rows}
    trials = {row: tuple(found.results[k] for k in own if k in found.results) for row, own in keys.items()}
    return Study(trials, found.settings["max_readings"])
