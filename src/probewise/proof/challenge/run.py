"""Run the cases of a challenge as a campaign: many tasks, with results in a file, that can be interrupted."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from typing import Any

from probewise._kinds import checked_whole
from probewise._version import __version__
from probewise.progress import Progress, silent
from probewise.proof.campaign import run_campaign
from probewise.proof.challenge.case import Task, run_case


def run_challenge(
    n_cases: int,
    *,
    seed: int,
    work: Callable[[Task], Mapping[str, Any]] = run_case,
    of: str = "",
    path: str | os.PathLike[str],
    executor: Executor | None = None,
    progress: Progress = silent,
) -> tuple[Mapping[str, Any], ...]:
    """Run the first cases of a challenge, or resume an interrupted one.

    Parameters
    ----------
    n_cases
        Number of cases, from case 0. It may be raised later: cases in the file are not run again.
    seed
        The secret seed: with its number, it determines a case.
    work
        Function that runs a case; by default the light sensor's.
    of
        Name of what is diagnosed, if not the light sensor; a file of another name is refused.
    path
        The campaign's file.
    executor
        Any `concurrent.futures.Executor`: processes here; for many machines `distributed.Client(...).get_executor()`.
    progress
        Called with the number of finished cases.

    Returns
    -------
    Results of `work`, in the order of the cases.

    Raises
    ------
    ParameterError
        If `n_cases` is less than 1.
    FileError, NotConvergedError
        See `run_campaign`.
    """
    checked_whole("n_cases", n_cases, most=100_000)
    return run_cases(range(n_cases), seed=seed, work=work, of=of, path=path, executor=executor, progress=progress)


def run_cases(
    numbers: Iterable[int],
    *,
    seed: int,
    work: Callable[[Task], Mapping[str, Any]] = run_case,
    of: str = "",
    path: str | os.PathLike[str],
    executor: Executor | None = None,
    progress: Progress = silent,
) -> tuple[Mapping[str, Any], ...]:
    """Run the cases of these numbers, or resume them; all else is as in `run_challenge`."""
    tasks = [Task(seed, number) for number in numbers]
    results = run_campaign(
        work,
        {task.key: task for task in tasks},
        path=path,
        settings={"challenge": __version__, "seed": seed} | ({"of": of} if of else {}),
        executor=executor,
        progress=progress,
        noun="cases",
    )
    return tuple(results[task.key] for task in tasks)
