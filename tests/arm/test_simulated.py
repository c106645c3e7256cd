"""Plans carried out by the simulated arm, and the check of its height over sheets."""

import dataclasses
import math

import numpy as np
import pytest

from probewise.arm import (
    DryRun,
    LegoArm,
    Pose,
    Reach,
    Reading,
    ReadingScale,
    SimulatedArm,
    Speed,
    carry_out,
    read_geometry,
    readings_of_recording,
    recording_of_readings,
    shipped_geometry_path,
)
from probewise.arm.fitting import check_heights
from probewise.errors import ParameterError, ReachError, ShapeError
from probewise.recordings import paper_plan

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


HEIGHTS = np.arange(14.0, 23.0).tolist()
LAWS = {
    "square": lambda h: 60.0 * (14.0 / h) ** 2,
    "beside a room's light": lambda h: 25.0 + 35.0 * (14.0 / h) ** 2,
    "behind its peak": lambda h: 95.0 * h / 8 * math.exp(1 - h / 8),
}


def looks(law, heights, *, off_mm=0.0, noise=0.0, rng=None):
    return np.array(
        [(h, law(h + off_mm) + (noise * rng.standard_normal() if rng else 0.0), noise or 0.02) for h in heights]
    )


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("off_mm", [-1.0, 0.4])
def test_a_sensor_that_hangs_elsewhere_is_told_by_how_much(law, off_mm):
    curve = looks(law, HEIGHTS)
    found = check_heights(curve, looks(law, [14.0, 14.3], off_mm=off_mm))
    np.testing.assert_allclose(found.off_mm, off_mm, atol=0.2 * abs(off_mm))
    assert np.sign(found.off_mm).tolist() == [math.copysign(1, off_mm)] * 2


def test_light_that_does_not_fall_with_the_height_tells_nothing():
    flat = looks(lambda h: 30.0, [14.0, 17.0, 20.0])
    with pytest.raises(ParameterError, match="is the LED lit"):
        check_heights(flat, looks(lambda h: 30.0, [14.0]))
    rising = looks(lambda h: 10.0 * h, [14.0, 17.0, 20.0])
    with pytest.raises(ParameterError, match="fall with the height"):
        check_heights(rising, looks(lambda h: 30.0, [14.0]))
