"""Trial frequencies of waves, evenly spaced over what the rows with a reading resolve."""

from __future__ import annotations

from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.priors import LogUniform
from probewise.systems.forms.about import ReferenceFit

_MOST_FREQUENCIES = 1024
_ROWS_OF_WAVES = 250_000  # rows at which a law is solved for the trial frequencies of one form: a fifth of a second


def trial_frequencies(
    values: FloatArray,
    groups: list[Any],
    most: int = _MOST_FREQUENCIES,
    rows_each: int = 2,
    least_waves: float = 1.0,
) -> FloatArray:
    """Return trial frequencies along a covariate, (n_trial,), rising evenly from `least_waves` / range.

    A wave slower than one in the range is never seen as a whole: nothing tells it from a drift or a bend. They go up to
    one wave in `rows_each` rows, and to 2 `least_waves` / range at least, in steps of about half the resolution; where
    that gives fewer than 8 or more than `most`, there are 8 or `most`. `groups` are the rows of each run.
    """
    reach = float(np.ptp(values))
    highest = _frequency_of_median_gap(values, groups, rows_each)
    highest = min(highest, len(np.unique(values)) / (rows_each * reach))
    n = int(np.clip(np.ceil(2 * highest * reach), 8, most))
    return np.asarray(np.linspace(least_waves / reach, max(highest, 2 * least_waves / reach), n))


def trial_frequencies_in_time(about: ReferenceFit, most: int = _MOST_FREQUENCIES, rows_each: int = 2) -> FloatArray:
    """Return `trial_frequencies` along the times of the readings, (n_trial,); other rows resolve nothing."""
    times, groups = _times_of_readings(about)
    return trial_frequencies(times, groups, most, rows_each)


def max_n_trial_frequencies(n_points: int) -> int:
    """Return the affordable number of trial frequencies of a form of a law: 64 to 1,024, fewer for more rows."""
    return int(np.clip(_ROWS_OF_WAVES // (2 * n_points), 64, _MOST_FREQUENCIES))


def frequency_prior(frequencies: FloatArray) -> LogUniform:
    """Return the log-uniform prior of a frequency: over the trial frequencies and a little beyond."""
    return LogUniform(float(0.9 * frequencies[0]), float(frequencies[-1] * 1.02))


def _times_of_readings(about: ReferenceFit) -> tuple[FloatArray, list[Any]]:
    """Return the times of the rows with a reading, (n_read,), and the numbers of those of each run."""
    read = np.flatnonzero(about.has_reading)
    if np.ptp(about.table.time_s[read]) == 0:
        return about.table.time_s, about.table.rows_by_scan()
    run = about.table.scan[read]
    return about.table.time_s[read], [np.flatnonzero(run == k) for k in np.unique(run)]


def _frequency_of_median_gap(values: FloatArray, groups: list[Any], rows_each: int) -> float:
    """Return the frequency of one wave in `rows_each` median gaps between rows of a group, or else one in the range."""
    reach = float(np.ptp(values))
    gaps = np.concatenate([np.abs(np.diff(values[rows])) for rows in groups])
    gaps = gaps[gaps > 1e-9 * max(reach, 1e-300)]
    return 1 / (rows_each * float(np.median(gaps))) if gaps.size else 1.0 / reach
