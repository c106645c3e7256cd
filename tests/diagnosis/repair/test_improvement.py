"""What has no name, repaired by bases: one after another, on readings kept back that can tell."""

from __future__ import annotations

import numpy as np
import pytest

from probewise.diagnosis import diagnose
from probewise.diagnosis.held_out import partition_into_blocks
from probewise.recordings import Recording, two_way_plan
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

PLAN = two_way_plan()
SD = 0.45


@pytest.mark.slow
def test_two_bumps_in_time_are_both_repaired():
    """No other scan tells of what is local in time; readings on both sides of a block do."""
    world = World(gaussian_spot([Blob(1.0, (0.4, -0.3), (5.0, 3.5), 0.3)], pixel_mm=0.5))
    rng = np.random.default_rng(3)
    bumps = sum(sign * np.exp(-0.5 * ((PLAN.time_s - at) / 60) ** 2) for sign, at in ((1, 500), (-1, 1400)))
    found = diagnose(
        Recording(PLAN, world.expected_readings(PLAN) + SD * rng.standard_normal(len(PLAN)) + bumps), rng=rng
    )
    assert found.verdict == "unknown"
    gain = found.improvement
    assert gain.rms_before > 1.2 * SD
    assert gain.rms_after == pytest.approx(SD, rel=0.05)
    assert gain.p_value_after > 0.01
    assert gain.heldout_log_density_per_reading > 5 * gain.heldout_sd > 0
    assert all("block" in name for name, _ in gain.heldout_by_scan)
    change = found.repair.before.residuals - found.repair.after.residuals
    assert np.corrcoef(change, bumps)[0, 1] > 0.9


def test_blocks_are_kept_back_whole_and_every_reading_once():
    readings = np.ones(len(PLAN))
    readings[:3] = np.nan
    part, names = partition_into_blocks(Recording(PLAN, readings))
    assert len(part) == len(PLAN) - 3
    assert sorted(np.unique(part)) == list(range(len(names)))
    ends = np.flatnonzero(np.diff(part)) + 1
    assert (np.diff(ends) == 8).all()
