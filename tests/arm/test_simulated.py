"""The simulated arm as an instrument: reach, clock, scale."""

import numpy as np
import pytest

from probewise.arm import Pose, Reach, Reading, ReadingScale, SimulatedArm, Speed
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


def test_the_clock_is_advanced_by_travel_and_reading():
    arm = SimulatedArm(
        flat(50.0), speed=Speed(move_mm_s=50.0, read_s=2.0), last=Reading(50.0, Pose(500.0, 250.0), 100.0)
    )
    first = arm.measure(HERE)
    second = arm.measure(Pose(530.0, 240.0))
    third = arm.measure(Pose(530.0, 240.0))
    assert second.time_s - first.time_s == pytest.approx(50 / 50 + 2)
    assert third.time_s - second.time_s == pytest.approx(2.0)
    assert first.time_s == pytest.approx(100 + 50 / 50 + 2)
    assert arm.time_s == third.time_s


def test_the_sensor_is_lowered_to_14_mm_and_told_when_and_where():
    calls = []

    def light(pose, time_s, height_mm):
        calls.append((pose, time_s, height_mm))
        return 33.0

    reading = SimulatedArm(light).measure(HERE)
    assert calls == [(HERE, reading.time_s, 14.0)]
    assert reading.pose == HERE
    assert reading.covariates == {"height_mm": 14.0}


FINER, ENDS = ReadingScale(step=0.25), ReadingScale(step=None)


@pytest.mark.parametrize(
    ("value", "scale", "expected"),
    [
        *((value, {}, read) for value, read in ((33.4, 33), (33.6, 34), (0.2, 1), (-4, 1), (120, 100), (np.inf, 100))),
        (33.37, {"scale": FINER}, 33.25),
        (133.37, {"scale": ENDS}, 100),
        (133.37, {"scale": None}, 133.37),
    ],
)
def test_readings_are_whole_lego_units_from_1_to_100_or_of_another_scale(value, scale, expected):
    """Paper, "Robotic Arm Test Bed": a scale of 1 to 100."""
    assert SimulatedArm(flat(value), **scale).measure(HERE).value == expected


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
