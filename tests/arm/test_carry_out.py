"""A plan carried out by the arm: row after row, a person asked where there is something to do."""

import dataclasses

import numpy as np
import pytest

from probewise.arm import (
    DryRun,
    LegoArm,
    Pose,
    Reading,
    carry_out,
    read_geometry,
    readings_of_recording,
    recording_of_readings,
    shipped_geometry_path,
)
from probewise.errors import ReachError
from probewise.recordings import paper_plan

GEOMETRY = read_geometry(shipped_geometry_path())
ORIGIN = (524.0, 260.0)


class Told:
    """A machine of words, and the person beside it."""

    def __init__(self):
        self.asked = []
        self.arm = LegoArm(DryRun(GEOMETRY, lambda text: None), GEOMETRY)

    def take(self, plan, **options):
        with self.arm:
            return list(carry_out(self.arm, plan, origin_mm=ORIGIN, ask=self.asked.append, **options))


@pytest.fixture
def told():
    return Told()


def test_a_plan_that_the_arm_cannot_reach_moves_nothing(told):
    plan = paper_plan()
    with pytest.raises(
        ReachError, match=r"row 1 of the plan \(mm\) is \(-26.0, 20.0\);.*\d+ are in reach; move the plan"
    ):
        list(carry_out(told.arm, plan, origin_mm=(24.0, 20.0), ask=told.asked.append))
    assert not told.asked


def test_what_a_plan_commands_stays_in_rows_that_are_read_after_a_resumption():
    rows = paper_plan().take(np.arange(4))
    plan = dataclasses.replace(rows, covariates={"led": np.ones(4)})
    readings = [Reading(40.0, Pose(0.0, 0.0), float(k)) for k in range(4)]
    resumed = [*readings_of_recording(recording_of_readings(plan, readings[:2])), *readings[2:]]
    assert recording_of_readings(plan, resumed).plan.covariates["led"].tolist() == [1.0] * 4
