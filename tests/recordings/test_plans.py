"""The plans that come ready, and the recordings that ship."""

import numpy as np
import pytest

from probewise.errors import ParameterError
from probewise.recordings import paper_plan, shipped, two_way_plan
from probewise.recordings.plans import with_jittered_times


def test_the_paper_plan_is_the_papers():
    """Paper, "Data Collection for SSF Estimation": four scans of 101 places, then four quadrants."""
    plan = paper_plan()
    assert len(plan) == 408
    assert plan.scan_names == ("edge_0", "edge_90", "edge_180", "edge_270", "quadrants")
    rows = plan.rows_by_scan()
    assert [len(r) for r in rows] == [101, 101, 101, 101, 4]
    np.testing.assert_array_equal(plan.x_mm[rows[2]], np.arange(-50, 51))
    np.testing.assert_allclose(plan.orientation_rad[[r[0] for r in rows]], np.radians([0, 90, 180, 270, 0]))
    assert [plan.pattern_names[k] for k in plan.pattern[rows[4]]] == [f"quadrant_{c}" for c in "abcd"]
    quadrants = [plan.patterns[f"quadrant_{c}"] for c in "abcd"]
    assert [quadrant.corner_mm for quadrant in quadrants] == [(0, 0), (0, 0), (4, 4), (-4, 4)]
    assert [quadrant.direction for quadrant in quadrants] == [(1, 1), (-1, 1), (1, 1), (-1, 1)]
    np.testing.assert_array_equal(plan.direction_of_motion[rows[0]], np.tile([1.0, 0.0], (101, 1)))
    np.testing.assert_array_equal(plan.direction_of_motion[rows[4]], 0)
    np.testing.assert_allclose(np.diff(plan.time_s[rows[0]]), 1.2)


def test_the_two_way_plan_goes_both_ways_in_every_orientation():
    plan = two_way_plan()
    assert len(plan) == 961
    for deg in (0, 90, 180, 270):
        out, back = (plan.rows_by_scan()[plan.scan_names.index(f"edge_{deg}_{way}")] for way in ("out", "back"))
        np.testing.assert_array_equal(plan.x_mm[out], plan.x_mm[back][::-1])
        assert plan.direction_of_motion[out[0], 0] == 1
        assert plan.direction_of_motion[back[0], 0] == -1
        fast = 2 if deg >= 180 else 1
        np.testing.assert_allclose(np.diff(plan.time_s[out])[0], fast * np.diff(plan.time_s[back])[0])
    assert set(plan.pattern_names) >= {"white", "black", "disc"}
    np.testing.assert_array_equal(plan.direction_of_motion[-1], [0, -1])
    assert np.all(np.diff(plan.time_s) > 0)


def test_jitter_keeps_the_order_and_the_pace():
    plan = two_way_plan()
    taken = with_jittered_times(plan, rng=np.random.default_rng(1))
    ratio = np.diff(taken.time_s) / np.diff(plan.time_s)
    assert ratio.min() > 0.899
    assert ratio.max() < 1.101
    assert ratio.std() > 0.05
    assert taken.covariates["battery_mv"][-1] < taken.covariates["battery_mv"][0] - 100


def test_a_recording_that_does_not_ship_is_refused():
    with pytest.raises(ParameterError, match="'paper' or 'concealed'"):
        shipped("other")
