"""Thinning of long recordings: a diagnosis needs at most a few thousand readings."""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import IntArray
from probewise.recordings.plan import Recording

MOST_READINGS = 2400
_FEWEST_SCANS = 8
_STRETCH = 6  # readings
_SEED = 0  # the same rows of the same recording, whatever the seed of its diagnosis


def rows_to_diagnose(recording: Recording, most: int = MOST_READINGS) -> IntArray:
    """Choose rows spread over the recording with about `most` usable readings; all rows if there are no more.

    Whole scans are chosen, to preserve correlations between readings; or, if these would be fewer than eight, stretches
    of six successive rows. Both are spread evenly but not regularly, so that what repeats itself is seen at all phases.

    Returns
    -------
    Row numbers, ascending.
    """
    n_usable, n_points = int(recording.usable.sum()), len(recording)
    if n_usable <= most:
        return np.arange(n_points)
    share = most / n_usable
    scan = recording.plan.scan
    n_scans = len(recording.plan.scan_names)
    n_kept = math.floor(n_scans * share)
    if n_kept >= _FEWEST_SCANS:
        # One of each n_scans / n_kept, with the first and the last: scans that go there and back must not all go there.
        jitter = np.random.default_rng(_SEED).random(n_kept)
        kept = np.floor((np.arange(n_kept) + jitter) * n_scans / n_kept).astype(np.int64)
        kept[[0, -1]] = 0, n_scans - 1
        return np.flatnonzero(np.isin(scan, kept))
    return positions_in_stretches(scan, round(n_points * share))


def positions_in_stretches(run: IntArray, most: int) -> IntArray:
    """Choose about `most` of some rows in stretches of six neighbours of one run; all if there are no more.

    The gaps between stretches are a half to one and a half of their mean, the same for every table of this length: with
    equal gaps a table that repeats itself, as by the hour, may show the same hours in every stretch.

    Parameters
    ----------
    run
        Number of each row's run, (n_rows,). Neighbours are successive rows of a run, also where runs are interleaved.
    most
        Number of rows to choose.

    Returns
    -------
    Row numbers, ascending.
    """
    n_rows, n_stretches = len(run), round(most / _STRETCH)
    if n_rows <= most:
        return np.arange(n_rows)
    gaps = np.cumsum(0.5 + np.random.default_rng(_SEED).random(n_stretches + 1))
    slack = n_rows - n_stretches * _STRETCH
    first = _STRETCH * np.arange(n_stretches) + np.floor(slack * gaps[:-1] / gaps[-1]).astype(np.int64)
    by_run = np.argsort(run, kind="stable")
    own = run[by_run][first + _STRETCH // 2]  # a stretch over the end of a run is moved into it, if it is long enough
    begin, end = np.searchsorted(run[by_run], own, side="left"), np.searchsorted(run[by_run], own, side="right")
    first = np.where(end - begin >= _STRETCH, np.clip(first, begin, end - _STRETCH), first)
    return np.unique(by_run[first[:, None] + np.arange(_STRETCH)])
