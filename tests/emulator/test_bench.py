"""The arm on the brick: from motor counts to a place over the field, and what the sensor sees there."""

import math
from dataclasses import replace

import numpy as np
import pytest

from probewise.arm import shipped_geometry_path
from probewise.emulator import EmulatedArm, LightModel, SensorPose, Tabletop, parse_scene, read_geometry
from probewise.errors import ParameterError
from probewise.recordings import Disc, HalfPlane, Polygon, Quadrant, Uniform
from probewise.world import Blob, Oval, World, gaussian_spot

WORLD = World(gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))]), black=10.0, white=60.0, noise_sd=0.6)
CIRCLE = Disc((524.0, 300.0), 100.0)


@pytest.fixture
def geometry():
    return read_geometry(shipped_geometry_path())


def posed(geometry, *angles_deg):
    """Bring an arm's base, shoulder and elbow to these angles by hand."""
    arm = EmulatedArm(geometry)
    for joint, angle_deg in zip(arm.joints, angles_deg, strict=True):
        joint.set_angle_by_hand(angle_deg)
    return arm.sensor_pose()


def test_the_arm_stands_where_two_links_over_a_turning_base_lead(geometry):
    """rho = r0 + L1 cos a + L2 cos b + d, z = h0 + L1 sin a + L2 sin b - hs; worked out with complex numbers."""
    stand = posed(geometry, -70.0, 50.0, -40.0)
    base, links, sensor = (geometry[name] for name in ("base", "links", "sensor"))
    upper, lower = links["upper_mm"], links["lower_mm"]
    tip = (
        complex(base["shoulder_forward_mm"], base["shoulder_height_mm"])
        + upper * np.exp(1j * math.radians(50))
        + lower * np.exp(-1j * math.radians(40))
        + complex(sensor["forward_mm"], -sensor["drop_mm"])
    )
    place = complex(base["x_mm"], base["y_mm"]) + tip.real * np.exp(-1j * math.radians(70))
    assert (stand.x_mm, stand.y_mm, stand.height_mm) == pytest.approx((place.real, place.imag, tip.imag))
    assert stand.orientation_rad == pytest.approx(math.radians(sensor["mounting_deg"] - 70 - 90))


def test_play_leaves_the_joint_behind_on_the_side_it_came_from(geometry):
    arm = EmulatedArm(geometry)
    joint = geometry["joints"]["base"]
    motor = arm.motors()["ABC".index(joint["port"])]
    angles = []
    for way in (1, -1):
        while way * motor.angle_deg < 70:
            motor.step(1e-3, 40 * way, brake=False, battery_mv=7400)
        angles.append(arm.sensor_pose().orientation_rad - math.radians(motor.angle_deg / joint["gear_ratio"]))
    assert math.degrees(angles[1] - angles[0]) == pytest.approx(joint["play_deg"])


def sight(stand, clock, *, albedo=1.0):
    world = replace(WORLD, noise_sd=0.0)
    return LightModel(world, Tabletop(Uniform(albedo)), lambda: stand, read_height_mm=14.0, seed=3, clock=clock)


@pytest.mark.parametrize(
    ("height_mm", "albedo", "lit", "shown"),
    [(14.0, 1.0, True, 60.5), (14.0, 0.0, True, 10.5), *((h, 1.0, False, 30.25) for h in (5.0, 14.0, 60.0))],
)
def test_what_the_brick_shows_with_the_led_and_with_the_rooms_half_alone(clock, height_mm, albedo, lit, shown):
    assert sight(SensorPose(0, 0, height_mm, 0), clock, albedo=albedo)(lit) == pytest.approx(shown)


def test_the_first_reading_at_the_nth_stand_has_the_nth_noise(clock):
    """As on the simulated arm with the same seed, however often it is read at one stand."""
    at = [SensorPose(0, 0, 14.0, 0)]
    look = LightModel(WORLD, Tabletop(Uniform(1.0)), lambda: at[0], read_height_mm=14.0, seed=7, clock=clock)
    for number in range(4):
        at[0] = SensorPose(10.0 * number, 0, 14.0, 0)
        expected = 60.5 + 0.6 * np.random.default_rng([7, number]).standard_normal()
        assert look(True) == pytest.approx(expected)
        assert look(True) != pytest.approx(expected)


def test_a_person_turns_the_sensor_and_changes_what_lies_there(clock):
    """Over an edge the spot's centre, 6 mm along v, is on the white side, then on the black one."""
    table = Tabletop(HalfPlane(math.pi / 2, 0.0))
    world = World(gaussian_spot([Blob(1.0, (0.0, 6.0), (1.0, 1.0))]), noise_sd=0.0)
    look = LightModel(world, table, lambda: SensorPose(0.0, 0.0, 14.0, 0.0), read_height_mm=14.0, seed=1, clock=clock)
    assert look(True) == pytest.approx(60.5)
    table.carry_out_line("turn 180")
    assert look(True) == pytest.approx(10.5)
    table.carry_out_line("uniform:0.5")
    assert look(True) == pytest.approx(35.5)


def test_what_a_person_cannot_do_changes_nothing():
    table = Tabletop(CIRCLE)
    for wish in ("turn", "turn round", "turn nan", "hexagon", ""):
        with pytest.raises(ParameterError, match="turn DEGREES"):
            table.carry_out_line(wish)
    assert table == Tabletop(CIRCLE)


@pytest.mark.parametrize(
    ("text", "surface"),
    [
        ("524,300,100", CIRCLE),
        ("circle:524,300,100", CIRCLE),
        ("ellipse:1,2,3,4,90", Oval((1.0, 2.0), (3.0, 4.0), math.pi / 2)),
        ("polygon:0,0,10,0,0,10", Polygon(((0.0, 0.0), (10.0, 0.0), (0.0, 10.0)))),
        ("edge:180,-500", HalfPlane(math.pi, -500.0)),
        ("corner:500,250,1,-1", Quadrant((500.0, 250.0), (1, -1))),
        ("uniform:0.5", Uniform(0.5)),
    ],
)
def test_a_scene_is_read_from_a_text(text, surface):
    assert parse_scene(text) == surface


@pytest.mark.parametrize(
    "text", ["", "1,2", "1,2,0", "1,2,nan", "blob:1,2,3", "polygon:1,2,3,4", "corner:1,2,0,1", "uniform:2", "a,b,c"]
)
def test_a_scene_of_no_form_is_refused_with_all_forms(text):
    with pytest.raises(ParameterError, match="ellipse:X,Y,A,B,ANGLE"):
        parse_scene(text)
