"""Which rows of a long recording are diagnosed."""

from __future__ import annotations

import numpy as np
import pytest

from probewise.diagnosis.thinning import rows_to_diagnose
from probewise.recordings import HalfPlane, Plan, Recording


def recording(n_scans: int, per_scan: int) -> Recording:
    n = n_scans * per_scan
    plan = Plan(
        x_mm=np.tile(np.linspace(-50, 50, per_scan), n_scans),
        y_mm=np.zeros(n),
        orientation_rad=np.zeros(n),
        time_s=np.arange(n, dtype=float),
        scan=np.repeat(np.arange(n_scans), per_scan),
        scan_names=tuple(f"s{k}" for k in range(n_scans)),
        pattern=np.zeros(n),
        pattern_names=("edge",),
        patterns={"edge": HalfPlane(0.0, 0.0)},
    )
    return Recording(plan, np.sin(plan.x_mm))


def test_a_short_recording_is_taken_whole():
    np.testing.assert_array_equal(rows_to_diagnose(recording(4, 100), 400), np.arange(400))


def test_of_many_scans_whole_ones_are_taken_from_first_to_last():
    whole = recording(100, 40)
    rows = rows_to_diagnose(whole, 800)
    scans, counts = np.unique(whole.plan.scan[rows], return_counts=True)
    assert len(rows) == 800
    np.testing.assert_array_equal(counts, 40)
    assert (scans[0], scans[-1]) == (0, 99)


def test_of_few_long_scans_stretches_are_taken_from_each():
    whole = recording(3, 5000)
    rows = rows_to_diagnose(whole, 1000)
    assert len(rows) == pytest.approx(1000, rel=0.05)
    np.testing.assert_allclose(np.bincount(whole.plan.scan[rows]), len(rows) / 3, rtol=0.05)
    assert np.mean(np.diff(rows) == 1) > 0.8
