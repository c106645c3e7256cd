"""The LEGO arm as an instrument: down on a place from above, up again, behind the guard, on a brick made of paper."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probewise.arm import DryRun, LegoArm, Pose, SimulatedArm, SoftLimits, read_geometry, shipped_geometry_path
from probewise.arm.nxt import Brick, BrickMachine, Link
from probewise.errors import LinkError, ParameterError, ReachError

SHIPPED = read_geometry(shipped_geometry_path())
PLACES = [(300.0, 200.0), (800.0, 450.0), (524.0, 60.0), (524.0, 320.0), (60.0, 300.0)]


def relative(geometry):
    return dataclasses.replace(
        geometry,
        elbow_is_relative=True,
        elbow=dataclasses.replace(geometry.elbow, home_rad=math.radians(-110), low_rad=-2.8, high_rad=-0.1),
    )


def reversed_gears(geometry):
    turned = {
        name: dataclasses.replace(joint, gear_ratio=-joint.gear_ratio)
        for name, joint in zip(("base", "shoulder", "elbow"), geometry.joints, strict=True)
    }
    return dataclasses.replace(geometry, **turned)


class Bench:
    """An arm on a paper brick; `height_mm` and `place_mm` follow from the motors, play left out of account."""

    def __init__(self, paper_brick, clock, geometry):
        rigid = {
            name: dataclasses.replace(joint, play_rad=0.0)
            for name, joint in zip(("base", "shoulder", "elbow"), geometry.joints, strict=True)
        }
        self.geometry, self.paper = dataclasses.replace(geometry, **rigid), paper_brick
        self.brick = Brick(Link(paper_brick, clock=clock), clock=clock)
        self.arm = LegoArm(BrickMachine(self.brick, self.geometry), self.geometry, clock=clock)

    @property
    def sensor_mm(self):
        angles = [
            joint.home_rad + math.radians(self.paper.motors[joint.port].position / joint.gear_ratio)
            for joint in self.geometry.joints
        ]
        return self.geometry.position_mm(np.array([angles]))[0]

    def pose(self, x_mm, y_mm):
        return Pose(x_mm, y_mm, float(self.arm.orientation_rad(np.array([[x_mm, y_mm]]))[0]))


@pytest.fixture(params=[lambda g: g, relative, reversed_gears], ids=["shipped", "relative elbow", "reversed gears"])
def bench(request, paper_brick, clock):
    return Bench(paper_brick, clock, request.param(SHIPPED))


def test_a_reading_is_taken_at_its_place_and_height(bench):
    seen = []
    carry_out = bench.paper.carry_out

    def watched(opcode, body):
        if opcode == 0x07:
            seen.append(bench.sensor_mm)
            assert bench.paper.input[:2] == [5, 0]  # its LED is on
        return carry_out(opcode, body)

    bench.paper.carry_out = watched
    with bench.arm as arm:
        for place in PLACES:
            reading = arm.measure(bench.pose(*place))
            assert bench.paper.input[0] == 0  # and off again: it flashes, as in the paper
            np.testing.assert_allclose(seen[-1], [*place, 14.0], atol=2.0)
            assert reading.value == 56  # 500 counts of the converter: 56.9 %
            assert reading.covariates == {"height_mm": 14.0, "battery_mv": 7412}
            assert bench.sensor_mm[2] > 45  # and it is up again
    assert bench.paper.at_rest
    assert not bench.paper.is_open


@pytest.mark.parametrize("height_mm", [None, 20.0])
def test_the_first_lowering_to_any_height_is_in_steps_that_a_person_confirms(bench, height_mm):
    seen = []
    with bench.arm as arm:
        arm.first_down = lambda step_mm: seen.append((step_mm, bench.sensor_mm[2]))
        for place in PLACES[:2]:
            arm.go_down(*place, height_mm)
    told, there = np.array(seen).T
    np.testing.assert_allclose(told, np.linspace(SHIPPED.travel_height_mm, height_mm or SHIPPED.read_height_mm, 6)[:-1])
    np.testing.assert_allclose(there, told, atol=2.5)


def test_a_pose_that_the_arm_cannot_take_moves_nothing(bench):
    with bench.arm as arm:
        for place in ((-1.0, 100.0), (524.0, 519.0), (2.0, 2.0), (math.nan, 1.0)):
            with pytest.raises(ReachError, match="allowed: a place on the field"):
                arm.measure(Pose(*place))
        with pytest.raises(ReachError, match="at which this arm reads"):
            arm.measure(dataclasses.replace(bench.pose(500.0, 200.0), height_mm=40.0))
        with pytest.raises(ReachError, match="no wrist"):
            arm.measure(Pose(300.0, 200.0, 1.0))
        with pytest.raises(ReachError):
            arm.go_over(0.0, 2000.0)
    assert not bench.paper.drives()


def test_an_arm_can_be_brought_home_by_hand_or_by_itself(bench):
    with bench.arm as arm:
        arm.release()
        for motor, turned in zip(bench.paper.motors, (40, -25, 60), strict=True):
            motor.position += turned
        arm.set_home()
        arm.measure(bench.pose(*PLACES[0]))
        arm.home()
    assert [motor.position - motor.zero for motor in bench.paper.motors] == pytest.approx([0, 0, 0], abs=1)


@pytest.mark.parametrize("let_go", ["set_home", "release"])
def test_where_the_play_lies_is_unknown_after_hands_have_moved_the_joints(bench, let_go):
    """At home by the counters, every joint is at its home angle, whatever side it came from before."""
    with bench.arm as arm:
        arm.measure(bench.pose(*PLACES[0]))
        arm.release()
        getattr(arm, let_go)()
        counts = arm.machine.limits.last_counts
        joints = arm.geometry.joints
        expected = [joint.angle_at(counts[k], 0) for k, joint in enumerate(joints)]
        np.testing.assert_array_equal(arm.angles_rad, expected)


def test_a_rehearsal_of_homing_goes_to_the_stops_first():
    """The links before the base, so that the sensor is up when that turns."""
    stops = {"base": -193.0, "shoulder": 163.0, "elbow": 43.0}
    geometry = dataclasses.replace(
        SHIPPED, **{n: dataclasses.replace(getattr(SHIPPED, n), stop_rad=math.radians(a)) for n, a in stops.items()}
    )
    said = []
    with LegoArm(DryRun(geometry, said.append), geometry) as arm:
        arm.home()
    assert [line.split()[:4] for line in said[:3]] == [
        ["elbow", "up", "to", "its"],
        ["shoulder", "up", "to", "its"],
        ["base", "down", "to", "its"],
    ]
    assert "set to 0 the counters of elbow, shoulder, base" in said
    assert {line.split()[0] for line in said[3:6]} == {"base", "shoulder", "elbow"}


def test_a_stop_well_beyond_a_limit_is_found_from_the_other_limit(paper_brick, clock):
    geometry = dataclasses.replace(SHIPPED, base=dataclasses.replace(SHIPPED.base, stop_rad=math.radians(60.0)))
    motor = paper_brick.motors[0]
    motor.position = motor.target = round(21 * (-190.0 + 90.0))
    motor.blocked_at = round(21 * (60.0 + 90.0) + 21 * 0.3 / 2)  # the motor takes up half the play
    with BrickMachine(Brick(Link(paper_brick, clock=clock), clock=clock), geometry) as machine:
        machine.find_stop(0, 1)
        assert machine.limits.last_counts[0] == motor.position == motor.blocked_at


def test_a_joint_can_be_turned_alone_as_far_as_the_guard_allows(bench):
    with bench.arm as arm:
        start = arm.angles_rad
        arm.turn_joint(0, math.radians(20))
        np.testing.assert_allclose(arm.angles_rad - start, [math.radians(20), 0, 0], atol=2e-3)
        with pytest.raises(ReachError, match=r"base is '.* degrees'; allowed: -190 to 10 degrees"):
            arm.turn_joint(0, math.radians(200))
        with pytest.raises(ReachError, match="the sensor's height while the shoulder moves"):
            arm.turn_joint(1, math.radians(-100))
        with pytest.raises(ParameterError, match="by_rad is nan; allowed: a finite number"):
            arm.turn_joint(0, math.nan)


def test_fractions_are_kept_where_the_geometry_says_so(paper_brick, clock):
    fine = Bench(paper_brick, clock, dataclasses.replace(SHIPPED, whole_percent=False))
    with fine.arm as arm:
        assert arm.measure(fine.pose(*PLACES[0])).value == pytest.approx(100 * 582 / 1023)


def test_a_reading_that_is_there_is_not_lost_when_the_line_dies_on_the_way_up(paper_brick, clock):
    bench = Bench(paper_brick, clock, SHIPPED)

    def run():
        with bench.arm as arm:
            read = arm.machine.read_percent

            def then_cut():
                percent = read()
                paper_brick.is_cut = True
                return percent

            arm.machine.read_percent = then_cut
            readings.append(arm.measure(bench.pose(*PLACES[0])))
            arm.measure(bench.pose(*PLACES[1]))

    readings = []
    with pytest.raises(LinkError, match="cut"):
        run()
    assert [reading.value for reading in readings] == [56]


def test_a_brick_that_cannot_be_asked_at_the_start_is_let_go(paper_brick, clock):
    bench = Bench(paper_brick, clock, SHIPPED)
    paper_brick.is_cut = True
    with pytest.raises(LinkError):
        bench.arm.__enter__()
    assert not paper_brick.is_open


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_no_command_passes_the_guard(make_paper_brick, data):
    """Whatever is asked for, no motor ends outside its limits, and the sensor is never lower than allowed."""
    paper_brick = make_paper_brick()
    bench = Bench(paper_brick, paper_brick.clock, data.draw(st.sampled_from([SHIPPED, relative(SHIPPED)])))
    carry_out = bench.paper.carry_out
    coast = data.draw(st.floats(0.0, 0.4))

    def watched(opcode, body):
        answer = carry_out(opcode, body)
        assert bench.sensor_mm[2] > bench.geometry.lowest_mm - 1.0
        for joint in bench.geometry.joints:
            angle = joint.angle_at(bench.paper.motors[joint.port].position)
            assert joint.low_rad - 0.03 < angle < joint.high_rad + 0.03
        return answer

    for motor in bench.paper.motors:
        motor.coast = coast
    bench.paper.carry_out = watched
    asked = st.one_of(
        st.tuples(st.just("place"), st.floats(-100, 1148), st.floats(-100, 620)),
        st.tuples(st.just("turn"), st.integers(0, 2), st.floats(-3, 3)),
    )
    with bench.arm as arm:
        for what, first, second in data.draw(st.lists(asked, max_size=6)):
            try:
                if what == "place":
                    arm.go_down(first, second)
                else:
                    arm.turn_joint(first, second)
            except ReachError:
                pass


def test_the_guard_lets_a_joint_that_is_outside_come_back():
    limits = SoftLimits(SHIPPED)
    outside = SHIPPED.base.counts_at(SHIPPED.base.low_rad) - 50
    limits.record_present_count(0, outside)
    limits.require_allowed_move(0, outside, outside + 30)
    with pytest.raises(ReachError):
        limits.require_allowed_move(0, outside, outside - 1)


def test_the_seconds_that_a_reading_takes_grow_with_the_way(bench):
    places = np.array([[300.0, 200.0], [320.0, 200.0], [900.0, 200.0], [-900.0, 0.0]])
    seconds = bench.arm.travel_s(Pose(300.0, 200.0), places)
    assert seconds.shape == (4,)
    assert seconds[0] < seconds[1] < seconds[2]
    assert np.isnan(seconds[3])


def test_a_simulated_arm_takes_the_geometry_of_a_real_one():
    """Same reach, same orientation: a run on either asks for the same places."""
    arm = SimulatedArm(lambda pose, time_s, height_mm: 50.0, reach=SHIPPED)
    places = np.array(PLACES)
    np.testing.assert_array_equal(arm.reachable(places), SHIPPED.contains(places))
    np.testing.assert_array_equal(arm.orientation_rad(places), SHIPPED.orientation_rad(places))
    assert arm.measure(Pose(*PLACES[0])).value == 50
    with pytest.raises(ReachError, match="126 to 755 mm"):
        arm.measure(Pose(2.0, 2.0))
    plain = SimulatedArm(lambda pose, time_s, height_mm: 50.0)
    np.testing.assert_array_equal(plain.orientation_rad(places), 0.0)
