"""The simulated arm as an instrument: reach, clock, scale."""

import numpy as np
import pytest

from probewise.arm import Pose, Reach, ReadingScale, SimulatedArm, Speed
from probewise.errors import ParameterError, ReachError, ShapeError

HERE = Pose(500.0, 200.0)


def flat(value):
    return lambda pose, time_s, height_mm: value


@pytest.mark.parametrize("pose", [Pose(0.0, 0.0), Pose(-5.0, 300.0), Pose(np.nan, 1.0), Pose(500.0, 200.0, np.inf)])
def test_an_unreachable_pose_is_refused_with_what_is_allowed_and_the_arm_stays(pose):
    arm = SimulatedArm(flat(50.0))
    before = arm.pose, arm.time_s
    with pytest.raises(ReachError, match=r"126 to 755 mm from the arm's axis at \(524, 580\)|a finite orientation"):
        arm.measure(pose)
    assert (arm.pose, arm.time_s) == before


def test_the_sensor_is_lowered_to_14_mm_and_told_when_and_where():
    calls = []

    def light(pose, time_s, height_mm):
        calls.append((pose, time_s, height_mm))
        return 33.0

    reading = SimulatedArm(light).measure(HERE)
    assert calls == [(HERE, reading.time_s, 14.0)]
    assert reading.pose == HERE
    assert reading.covariates == {"height_mm": 14.0}


def test_leaving_the_block_brings_the_arm_to_rest_after_an_exception_too():
    arm = SimulatedArm(flat(50.0))
    home = arm.pose
    with arm as entered:
        assert entered is arm
        arm.measure(HERE)
    assert arm.pose == home

    def fail():
        with arm:
            arm.measure(HERE)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert arm.pose == home


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Reach(axis_beyond_mm=900.0), ReachError, r"field_mm is \(1048.*; move the arm"),
        (lambda: Reach(farthest_mm=np.inf), ParameterError, "farthest_mm is inf"),
        (lambda: Reach(nearest_mm=800.0), ParameterError, "less than farthest_mm"),
        (lambda: Speed(move_mm_s=0.0), ParameterError, "move_mm_s"),
        (lambda: Speed(read_s=-1.0), ParameterError, "read_s is -1.0"),
        (lambda: ReadingScale(step=0.0), ParameterError, "step"),
        (lambda: SimulatedArm(flat(1.0), height_mm=0.0), ParameterError, "height_mm"),
        (lambda: SimulatedArm(flat(1.0)).reachable(np.zeros(3)), ShapeError, "n_places, 2"),
    ],
)
def test_an_arm_without_sense_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()
