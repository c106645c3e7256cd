"""Thinning of long recordings: a diagnosis needs at most a few thousand readings."""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import IntArray
from probewise.recordings.plan import Recording

MOST_READINGS = 2400
_FEWEST_SCANS = 8
_STRETCH = 6  # readings


def rows_to_diagnose(recording: Recording, most: int = MOST_READINGS) -> IntArray:
    """Choose rows spread over the recording with about `most` usable readings; all rows if there are no more.

    Whole scans are chosen, to preserve correlations between readings; or, if these would be fewer than eight, stretches
    of six successive rows, evenly spaced.

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
        kept = np.unique(np.linspace(0, n_scans - 1, n_kept).round().astype(np.int64))
        return np.flatnonzero(np.isin(scan, kept))
    # Stretches of successive readings with gaps in between.
    within = np.arange(n_points) % round(_STRETCH / share)
    return np.flatnonzero(within < _STRETCH)
