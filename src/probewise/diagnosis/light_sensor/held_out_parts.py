"""Partition for held-out tests: scans or, if there are many, scans over one pattern in one orientation."""

from __future__ import annotations

import numpy as np

from probewise.diagnosis.evidence.held_out import LEAST_ROWS, MOST_PARTS, Parts
from probewise.effects import orientation_deg
from probewise.recordings.plan import Recording


def held_out_parts(recording: Recording) -> Parts:
    """Return the part of each usable reading, (n_usable,), and the names of the parts: scans.

    If more than ten scans have eight readings or more, all scans over one pattern in one orientation are one part,
    since neighbouring scans would leak information; unless there is only one such part.
    """
    plan, usable = recording.plan, recording.usable
    scan = plan.scan[usable]
    if np.sum(np.bincount(scan) >= LEAST_ROWS) > MOST_PARTS:
        views = np.stack([plan.pattern[usable].astype(np.float64), orientation_deg(plan)[usable]])
        kinds, part = np.unique(views, axis=1, return_inverse=True)
        if kinds.shape[1] > 1:
            return part.reshape(-1), tuple(
                f"{plan.pattern_names[int(code)]}, {turn:.0f} degrees" for code, turn in kinds.T
            )
    return scan, plan.scan_names
