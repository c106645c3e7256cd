"""Long recordings: a diagnosis needs a few thousand readings, and its time grows with each more."""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import IntArray
from probewise.recordings.plan import Recording

__all__ = ["MOST_READINGS", "rows_to_diagnose"]

MOST_READINGS = 2400
_FEWEST_SCANS = 8
_STRETCH = 6  # readings


def rows_to_diagnose(recording: Recording, most: int = MOST_READINGS) -> IntArray:
    """Choose rows, spread over the recording, that hold about `most` usable readings; all where there are no more.

    Whole scans, so that what one reading leaves to the next is kept; where that leaves fewer than eight
    scans, stretches of each scan.

    Returns
    -------
    Rows, ascending.
    """
    n_usable, n_points = int(recording.usable.sum()), len(recording)
    if n_usable <= most:
        return np.arange(n_points)
    share = most / n_usable
    scan = recording.plan.scan
    n_scans = len(recording.plan.scan_names)
    n_kept = math.floor(n_scans * share)
    if n_kept >= _FEWEST_SCANS:
        kept = np.unique(np.linspace(0, n_scans - 1, n_kept).round().astype(np.int64))
        return np.flatnonzero(np.isin(scan, kept))
    # A stretch of neighbours, then a gap, and so on.
    within = np.arange(n_points) % round(_STRETCH / share)
    return np.flatnonzero(within < _STRETCH)
