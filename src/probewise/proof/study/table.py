"""Summary of the runs of a row of a study, with errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binom, binomtest, poisson

from probewise._arrays import FloatArray
from probewise.errors import ParameterError

WRONG_MM = 12.0
"""Three times the 4 mm of the stopping rule: a run that ends with a larger error is sure and wrong."""

LEAST_FOR_MEDIAN = 6
"""Smallest number of runs whose range covers the median with 95 %: 1 - 2 / 2^6 is 97 %."""

_CHANCE = 0.01


@dataclass(frozen=True)
class Estimate:
    """An estimate and its bounds: one standard error to either side, or a 95 % interval where stated."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        half = 0.5 * (self.high - self.low)
        return f"{self.value:.3g} ± {half:.2g}"


@dataclass(frozen=True)
class Summary:
    """One row of the table.

    Attributes
    ----------
    n_runs
        Number of runs, one per circle.
    reached
        Share of runs that reached the target precision within the limit of readings, with its 95 % interval.
    mean, median
        Readings needed, a miss counted as the limit; mean with standard error, median with 95 % interval (NaN bounds
        for fewer than `LEAST_FOR_MEDIAN` runs).
    to_white
        Readings up to the first one on white, a run without one counted as the limit.
    after_white
        Readings after the first one on white, over runs that reached the precision.
    bits_each
        Bits per reading: prior minus posterior differential entropy.
    error_mm
        Largest error of a length at the stop, median over runs that reached the precision; NaN if none did.
    wrong
        Number of runs that reached the precision with an error above `WRONG_MM`.
    wrong_expected, wrong_limit
        Number expected from their own posteriors, and the 99 % quantile of a Poisson distribution with that mean.
    held
        Share of the 95 % intervals at the stop that hold the truth, over runs that reached the precision.
    arm_s
        Arm time per run in seconds, with the standard error.
    cpu_s
        Processor time per decision, median over runs of each run's median, in seconds.
    """

    n_runs: int
    reached: Estimate
    mean: Estimate
    median: Estimate
    to_white: Estimate
    after_white: Estimate
    bits_each: Estimate
    error_mm: float
    wrong: int
    wrong_expected: float
    wrong_limit: int
    held: Estimate
    arm_s: Estimate
    cpu_s: float


def summarise(trials: Sequence[Mapping[str, Any]], *, max_readings: int) -> Summary:
    """Summarise the runs of one row, each a result of `run_trial`.

    Raises ParameterError if there are fewer than two runs, which have no standard error.
    """
    if len(trials) < 2:
        raise ParameterError("number of trials", len(trials), "2 or more, so that there is a standard error")
    sure = [t for t in trials if t["reached"]]
    needed = np.array([t["readings"] if t["reached"] else max_readings for t in trials], dtype=np.float64)
    after = [t["readings"] - t["first_white"] for t in sure if t["first_white"] is not None]
    met = np.array([max_readings if t["first_white"] is None else t["first_white"] for t in trials], dtype=np.float64)
    errors = np.array([t["error_mm"] for t in sure])
    expected = float(sum(t["chance_wrong"] for t in sure))
    return Summary(
        n_runs=len(trials),
        reached=share_with_interval(len(sure), len(trials)),
        mean=_mean_with_error(needed),
        median=_median_with_interval(needed),
        to_white=_mean_with_error(met),
        after_white=_mean_with_error(np.array(after, dtype=np.float64)),
        bits_each=_mean_with_error(np.array([t["bits"] / t["readings"] for t in trials])),
        error_mm=float(np.median(errors)) if len(errors) else math.nan,
        wrong=int((errors > WRONG_MM).sum()),
        wrong_expected=expected,
        wrong_limit=int(poisson.isf(_CHANCE, expected)) if expected > 0 else 0,
        held=_mean_with_error(np.array([np.mean(t["held"]) for t in sure])),
        arm_s=_mean_with_error(np.array([t["arm_s"] for t in trials])),
        cpu_s=float(np.median([t["cpu_s"] for t in trials])),
    )


def share_with_interval(k: int, n: int) -> Estimate:
    """Estimate the share k / n, with Wilson's 95 % interval (Wilson 1927)."""
    found = binomtest(k, n).proportion_ci(method="wilson")
    return Estimate(k / n, float(found.low), float(found.high))


def _mean_with_error(values: FloatArray) -> Estimate:
    if values.size < 2:
        return Estimate(math.nan, math.nan, math.nan)
    mean, error = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(values.size)
    return Estimate(mean, mean - error, mean + error)


def _median_with_interval(values: FloatArray) -> Estimate:
    """Return the median with a distribution-free 95 % interval of order statistics, NaN bounds below six values."""
    ordered = np.sort(values)
    if len(ordered) < LEAST_FOR_MEDIAN:
        return Estimate(float(np.median(ordered)), math.nan, math.nan)
    below = max(int(binom.ppf(0.025, len(ordered), 0.5)) - 1, 0)
    return Estimate(float(np.median(ordered)), float(ordered[below]), float(ordered[len(ordered) - 1 - below]))
