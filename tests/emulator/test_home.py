"""Home found by the joints' stops, on an arm that nobody has brought there."""

import dataclasses
import math

import numpy as np
import pytest

from probewise import arm
from probewise.arm.nxt import Brick, BrickMachine, Link, MotorError
from probewise.emulator import VirtualLine, read_geometry, set_up_bench
from probewise.recordings import Disc
from probewise.world.shipped import true_world

SHIPPED = arm.read_geometry(arm.shipped_geometry_path())
STOPS_DEG = {"base": -193.0, "shoulder": 163.0, "elbow": 43.0}  # 3 degrees outside the limits, as the emulator has them
HOME_DEG = 0.2 + 0.15  # half the play, and nearly two of the twelve counts to a degree


def with_stops(*names):
    return dataclasses.replace(
        SHIPPED, **{n: dataclasses.replace(getattr(SHIPPED, n), stop_rad=math.radians(STOPS_DEG[n])) for n in names}
    )


def lost(clock, **turned_deg):
    """Set up an arm whose joints were turned by hand while its counters showed 0."""
    bench = set_up_bench(
        read_geometry(arm.shipped_geometry_path()), true_world("paper"), Disc((600.0, 250.0), 80.0), clock, seed=1
    )
    names = ("base", "shoulder", "elbow")
    for joint, name in zip(bench.arm.joints, names, strict=True):
        joint.set_angle_by_hand(joint.numbers["home_deg"] + turned_deg.get(name, 0.0))
    clock.sleep(0.01)
    bench.radio.brick.advance()
    for port in bench.radio.brick.outputs.ports:
        port.rotation_count = 0
    return bench


def connected(bench, clock, geometry):
    machine = BrickMachine(Brick(Link(VirtualLine(bench.radio, clock), clock=clock), clock=clock), geometry)
    return arm.LegoArm(machine, geometry, clock=clock)


def lowest_while(bench):
    """Collect the sensor's height at each telegram from now on."""
    heights = []
    answer = bench.radio.brick.answer

    def watched(telegram):
        reply = answer(telegram)
        heights.append(bench.arm.sensor_pose().height_mm)
        return reply

    bench.radio.brick.answer = watched
    return heights


@pytest.mark.parametrize(
    "turned_deg", [{"base": 25.0, "shoulder": 20.0, "elbow": -12.0}, {"base": -60.0, "shoulder": -30.0, "elbow": 9.0}]
)
def test_an_arm_with_stops_comes_home_from_wherever_it_was(clock, turned_deg):
    bench = lost(clock, **turned_deg)
    heights = lowest_while(bench)
    geometry = with_stops("base", "shoulder", "elbow")
    with connected(bench, clock, geometry) as lego:
        lego.home()
        found = [math.degrees(joint.angle_rad) for joint in bench.arm.joints]
        np.testing.assert_allclose(found, [-90, 90, -20], atol=HOME_DEG)
        np.testing.assert_allclose(np.degrees(lego.angles_rad), [-90, 90, -20], atol=0.25)
        place = np.array([[300.0, 200.0]])
        lego.go_down(*place[0])
        stand = bench.arm.sensor_pose()
        assert math.dist((stand.x_mm, stand.y_mm), place[0]) < 3.0
        assert stand.height_mm == pytest.approx(14.0, abs=2.0)
    assert min(heights) > geometry.lowest_mm
    with connected(bench, clock, geometry) as lego:  # the counters on the brick are those of home
        truly = [math.degrees(joint.angle_rad) for joint in bench.arm.joints]
        np.testing.assert_allclose(np.degrees(lego.angles_rad), truly, atol=HOME_DEG)


@pytest.mark.parametrize("stop_deg", [-190.0, -205.0, 25.0])
def test_a_stop_stands_where_the_arm_s_file_has_it(tmp_path, clock, stop_deg):
    file = tmp_path / "arm.toml"
    text = arm.shipped_geometry_path().read_text(encoding="utf-8")
    file.write_text(text.replace("play_deg = 0.3", f"play_deg = 0.3\nstop_deg = {stop_deg}", 1), encoding="utf-8")
    bench = set_up_bench(read_geometry(file), true_world("paper"), Disc((600.0, 250.0), 80.0), clock, seed=1)
    with connected(bench, clock, arm.read_geometry(file)) as lego:
        lego.home()
        assert math.degrees(bench.arm.joints[0].angle_rad) == pytest.approx(-90.0, abs=HOME_DEG)


def test_joints_without_a_stop_keep_their_counters(clock):
    bench = lost(clock, base=30.0)
    with connected(bench, clock, with_stops("base")) as lego:
        lego.turn_joint(2, math.radians(10))
        lego.home()
    assert [round(math.degrees(joint.angle_rad)) for joint in bench.arm.joints] == [-90, 90, -20]


def test_a_stop_that_is_not_there_is_told_of(clock):
    bench = lost(clock)
    base = bench.arm.joints[0].motor
    base.stops_deg = (-math.inf, math.inf)
    with (
        connected(bench, clock, with_stops("base")) as lego,
        pytest.raises(MotorError, match="motor A met no stop within 4420 counts"),
    ):
        lego.home()
    bench.radio.brick.advance()
    assert not base.speed_deg_s
