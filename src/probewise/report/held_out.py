"""The held-out part of a recording on which a repair gains most."""

from __future__ import annotations

import numpy as np

from probewise._arrays import IntArray
from probewise.diagnosis import Diagnosis
from probewise.diagnosis.light_sensor import held_out_parts


def part_with_largest_gain(diagnosis: Diagnosis) -> tuple[str, float, IntArray] | None:
    """Return the held-out part with the largest gain: name, gain in nats per reading, row numbers, (n_rows,).

    None if the repair changes no prediction, or nothing could be held out.
    """
    gains = diagnosis.improvement.heldout_by_scan
    if not diagnosis.repair.changes_predictions or not gains:
        return None
    name, gain = max(gains, key=lambda pair: pair[1])
    part, names = held_out_parts(diagnosis.recording)
    rows = np.flatnonzero(diagnosis.recording.usable)[part == names.index(name)]
    return name, gain, rows
