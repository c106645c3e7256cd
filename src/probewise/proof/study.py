"""A study: every row over its circles, run as a campaign and summarised as a table (paper, section 4, "Results")."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.stats import poisson

from probewise._kinds import checked_whole
from probewise._version import __version__
from probewise.errors import ParameterError, require
from probewise.proof.campaign import Campaign, Result
from probewise.proof.configurations import MOST_CIRCLES, SearchConfiguration
from probewise.proof.estimates import Estimate, estimated_share, grouped, mean_with_error, median_with_interval
from probewise.proof.results import TRIAL, misfit
from probewise.proof.trial import WRONG_MM, Trial, run_trial

__all__ = ["Summary", "study", "summaries", "summarise"]

_CHANCE = 0.01


@dataclass(frozen=True)
class Summary:
    """One row of the table, of the runs over one circle each; a run that misses the target counts as the limit.

    Means have standard errors, the median a 95 % interval; what comes from `error_mm` to `held` is of the runs that
    reached the target precision.
    """

    n_runs: int
    reached: Estimate  # share of the runs, within the limit of readings
    mean: Estimate  # readings needed
    median: Estimate
    to_white: Estimate  # readings up to the first one on white
    after_white: Estimate
    bits_each: Estimate  # per reading: prior minus posterior differential entropy
    error_mm: float  # largest error of a length, median; NaN if none reached
    wrong: int  # runs off by more than `WRONG_MM`
    wrong_expected: float  # by their own posteriors
    wrong_limit: int  # the 99 % quantile of a Poisson distribution with that mean
    held: Estimate  # share of the 95 % intervals that hold the truth
    arm_s: Estimate
    cpu_s: float  # per decision, median over runs of each run's median


def summarise(trials: Sequence[Result], *, max_readings: int) -> Summary:
    """Summarise the runs of one row, each a result of `run_trial`.

    Raises ParameterError if there are fewer than two runs, which have no standard error.
    """
    require(len(trials) >= 2, "number of trials", len(trials), "2 or more, so that there is a standard error")
    sure = [t for t in trials if t["reached"]]
    needed = np.array([t["readings"] if t["reached"] else max_readings for t in trials], dtype=np.float64)
    after = [t["readings"] - t["first_white"] for t in sure if t["first_white"] is not None]
    met = [max_readings if t["first_white"] is None else t["first_white"] for t in trials]
    errors = np.array([t["error_mm"] for t in sure])
    expected = float(sum(t["chance_wrong"] for t in sure))
    return Summary(
        n_runs=len(trials),
        reached=estimated_share(t["reached"] for t in trials),
        mean=mean_with_error(needed),
        median=median_with_interval(needed),
        to_white=mean_with_error(met),
        after_white=mean_with_error(after),
        bits_each=mean_with_error(t["bits"] / t["readings"] for t in trials),
        error_mm=float(np.median(errors)) if len(errors) else math.nan,
        wrong=int((errors > WRONG_MM).sum()),
        wrong_expected=expected,
        wrong_limit=int(poisson.isf(_CHANCE, expected)) if expected > 0 else 0,
        held=mean_with_error(float(np.mean(t["held"])) for t in sure),
        arm_s=mean_with_error(t["arm_s"] for t in trials),
        cpu_s=float(np.median([t["cpu_s"] for t in trials])),
    )


def summaries(results: Mapping[Trial, Result]) -> dict[SearchConfiguration, Summary]:
    """Return the summary of every row with two or more runs, by row."""
    most = {trial.row: trial.max_readings for trial in results}
    return {row: summarise(t, max_readings=most[row]) for row, t in trials_by_row(results).items() if len(t) > 1}


def trials_by_row(results: Mapping[Trial, Result]) -> dict[SearchConfiguration, list[Result]]:
    """Return the results of each row, in the order of the circles."""
    return grouped((trial.row, result) for trial, result in results.items())


def study(
    rows: Mapping[SearchConfiguration, int] | Sequence[SearchConfiguration],
    n_circles: int | None = None,
    *,
    max_readings: int = 100,
) -> Campaign[Trial]:
    """Return the campaign of every row over the first circles of its population.

    `rows`: the rows; a mapping gives each its own number of circles, else it is `n_circles`; rows and circles may be
    added later to a file. `max_readings`: a run that has not reached the target precision after so many is a miss.
    Raises ParameterError if there is no row, or a row has no circle.
    """
    wanted = dict(rows) if isinstance(rows, Mapping) else dict.fromkeys(rows, n_circles or 0)
    if not wanted:
        raise ParameterError("rows", rows, "one row or more, such as those of standard_rows()")
    for row, n in wanted.items():
        checked_whole(f"circles of the row {row.name!r}", n, most=MOST_CIRCLES)
    # Circle by circle, so that an interrupted study has equally many runs in each row.
    trials = [Trial(row, k, max_readings) for k in range(max(wanted.values())) for row, n in wanted.items() if k < n]
    settings = {"study": __version__, "max_readings": max_readings}
    return Campaign(run_trial, {trial.key: trial for trial in trials}, settings, partial(misfit, schema=TRIAL))
