"""Surfaces, rays, readings and what ships: against closed forms, searches and themselves refined."""

import math
import pickle

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import multivariate_normal

from probewise.arm import ReadingScale, read_geometry, shipped_geometry_path
from probewise.cli._bench import plan_for_lego_arm
from probewise.errors import ParameterError, ShapeError
from probewise.recordings import (
    Disc,
    HalfPlane,
    Image,
    Polygon,
    Quadrant,
    Stripes,
    Uniform,
    paper_plan,
    read_recording,
    shipped,
    two_way_plan,
)
from probewise.world import (
    Blob,
    Oval,
    Reader,
    Spot,
    World,
    albedo_at,
    gaussian_spot,
    ridge_spot,
    seen_white_fraction,
    tailed_spot,
)
from probewise.world import concealed as known
from probewise.world.shipped import CANDIDATES, main, regenerate_recording, true_world
from probewise.world.stages import acts_at
from probewise.world.surfaces import common_edge_normal, distance_to_nearest_edge

SPOT = gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5), 0.15)], pixel_mm=0.5)
PLAN = two_way_plan()


def world(*concealed, **more):
    return World(SPOT, concealed=concealed, **more)


@pytest.fixture(scope="module")
def clean():
    return world().expected_readings(PLAN)


def test_one_reading_by_one_gives_the_same_as_the_whole_plan(clean):
    effects = world(
        known.backlash(1.0),
        known.albedo_patch(-0.2, 3.0, 1.0, 6.0),
        known.height_gradient(0.01),
        known.sensor_tilt(0.5, 0.2),
        known.halo(0.1, 15.0),
        known.edge_shadow(0.05, 4.0),
        known.gain_drift(0.1, 300.0),
        known.ambient_gradient(0.01, 0.02),
        known.saturation(50.0),
    )
    together = effects.expected_readings(PLAN)
    for k in range(0, len(PLAN), 53):
        alone = effects.read(
            PLAN.patterns[PLAN.pattern_names[PLAN.pattern[k]]],
            PLAN.x_mm[k],
            PLAN.y_mm[k],
            PLAN.orientation_rad[k],
            time_s=PLAN.time_s[k],
            rng=None,
            direction=tuple(PLAN.direction_of_motion[k]),
        )
        assert alone == pytest.approx(together[k], abs=1e-9)


def test_a_reader_remembers_its_way_and_its_readings():
    plan = PLAN.take(np.arange(40))
    effects = world(known.backlash(1.0), known.hysteresis(2.0), known.lag(1.0), noise_sd=0.0)
    surface, reader = plan.patterns[plan.pattern_names[plan.pattern[0]]], Reader(effects, seed=(1,))
    rows = zip(plan.x_mm, plan.y_mm, plan.orientation_rad, plan.time_s, strict=True)
    alone = [reader.read(surface, x, y, turn, time_s=time_s) for x, y, turn, time_s in rows]
    together = effects.expected_readings(plan)
    np.testing.assert_allclose(alone[20:], together[20:], atol=1e-6)  # of its first reading it knows no direction


def test_readings_are_rounded_to_the_step():
    readings = world(step=0.5).simulate(paper_plan(), rng=np.random.default_rng(7)).readings
    np.testing.assert_array_equal(readings * 2, np.round(readings * 2))


def test_an_effect_of_ones_own_is_one_short_function(clean):
    @acts_at("offset")
    def step(at_s):
        return lambda values, rows: values + (rows.time_s > at_s)

    assert step(100).name == "step"
    assert {step(100), step(at_s=100)} == {step(100)} != {step(99)}
    assert pickle.loads(pickle.dumps(known.saturation(45.0))) == known.saturation(45.0, softness=0.0)
    np.testing.assert_allclose(world(step(100)).expected_readings(PLAN) - clean, PLAN.time_s > 100, atol=1e-12)


def test_an_effect_at_no_known_stage_is_refused():
    with pytest.raises(ParameterError, match=r"stage"):
        acts_at("somewhere")


def test_what_lies_there_can_differ_from_what_the_plan_says():
    """A pattern that the description misplaces, or that only the world knows."""
    plan = paper_plan()
    moved = world().expected_readings(plan, surfaces={"boundary": HalfPlane(0.0, 1.0)})
    np.testing.assert_allclose(moved[1:101], world().expected_readings(plan)[0:100], atol=0.02)
    unknown = PLAN.take(np.arange(3))
    hidden = type(unknown)(**{**vars(unknown), "patterns": {}})
    with pytest.raises(ParameterError, match="boundary"):
        world().expected_readings(hidden)
    np.testing.assert_allclose(world().expected_readings(hidden, {"boundary": Uniform(1.0)}), 60)


@pytest.mark.parametrize("changes", [{"noise_sd": -1.0}, {"noise_sd": np.nan}, {"step": 0.0}])
def test_a_world_without_sense_is_refused(changes):
    with pytest.raises(ParameterError):
        world(**changes)


SURFACES = {
    "half plane": HalfPlane(0.7, 1.3),
    "quadrant": Quadrant((1.0, 2.0), (-1, 1)),
    "disc": Disc((3.0, -2.0), 6.3),
    "oval": Oval((0.0, 1.0), (7.0, 4.0), 0.4),
    "polygon": Polygon(((-6.0, -5.0), (7.0, -3.0), (2.0, 6.0))),
    "stripes": Stripes(0.2, 7.0, 0.4, 1.0),
}


@pytest.mark.parametrize("name", SURFACES)
def test_the_distance_is_that_to_the_nearest_change_of_albedo(name):
    surface, rng = SURFACES[name], np.random.default_rng(2)
    x, y = rng.uniform(-8, 8, (2, 8))
    distance = distance_to_nearest_edge(surface, x, y)
    # Along rays in all directions, how far the albedo stays what it is at the place.
    turn, radius = np.arange(600) * (2 * math.pi / 600), np.linspace(0, 16, 801)
    for k in range(len(x)):
        ray_x = x[k] + radius[:, None] * np.cos(turn)
        ray_y = y[k] + radius[:, None] * np.sin(turn)
        changed = albedo_at(surface, ray_x, ray_y) != albedo_at(surface, x[k : k + 1], y[k : k + 1])
        nearest = radius[np.flatnonzero(changed.any(axis=1))[0]]
        assert distance[k] == pytest.approx(nearest, abs=0.04)


def test_across_is_the_normal_of_straight_edges_and_x_elsewhere():
    assert common_edge_normal(HalfPlane(0.7, 1.3)) == pytest.approx((math.cos(0.7), math.sin(0.7)))
    assert common_edge_normal(Stripes(0.2, 7.0, 0.4, 1.0)) == pytest.approx((math.cos(0.2), math.sin(0.2)))
    assert common_edge_normal(Disc((0, 0), 1.0)) == (1.0, 0.0)


@pytest.fixture(scope="module")
def made_again(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    main([str(folder)])
    return folder


@pytest.mark.parametrize("name", ["paper", "concealed"])
@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_the_shipped_files_are_made_again_byte_for_byte(made_again, name, suffix):
    assert (made_again / f"{name}{suffix}").read_bytes() == shipped(name).with_suffix(suffix).read_bytes()


def test_the_files_do_not_tell_what_they_conceal():
    text = shipped("concealed").with_suffix(".json").read_text()
    assert not any(effect.name in text for effect in CANDIDATES)


def test_the_paper_recording_is_what_the_arm_records():
    """Whole LEGO units from 1 to 100, declared as the arm declares them."""
    recording = read_recording(shipped("paper"))
    scale = ReadingScale()
    np.testing.assert_array_equal(recording.readings, [scale.clip_and_round(r) for r in recording.readings])
    of_arm = plan_for_lego_arm(paper_plan(), read_geometry(shipped_geometry_path())).instrumentation
    ours = recording.plan.instrumentation
    assert (ours.min, ours.max, ours.step) == (of_arm.min, of_arm.max, of_arm.step) == (1.0, 100.0, 1.0)


def test_a_recording_that_does_not_ship_cannot_be_made():
    with pytest.raises(ParameterError):
        regenerate_recording("other")


def test_the_paper_recording_conceals_nothing_and_the_other_one_thing():
    assert true_world("paper").concealed == ()
    assert len(true_world("concealed").concealed) == 1


BLOB = Blob(1.0, (0.0, 1.5), (4.0, 2.5), 0.15)
SPOTS = {
    "gaussian": lambda pixel_mm: gaussian_spot([BLOB], pixel_mm=pixel_mm),
    "two gaussians": lambda pixel_mm: gaussian_spot([BLOB, Blob(0.5, (3, -2), (1.5, 2), -0.5)], pixel_mm=pixel_mm),
    "ridge": lambda pixel_mm: ridge_spot(
        9.0, center_mm=(0.0, 1.5), lobes=0.35, ridge_mm=-3.0, ridge_width_mm=1.2, shadow=0.6, pixel_mm=pixel_mm
    ),
    "tailed": lambda pixel_mm: tailed_spot((1.5, 1.0), center_mm=(0.0, 1.5), skew=0.4, pixel_mm=pixel_mm),
}
SURFACES_OF_RAYS = {
    "half plane": HalfPlane(0.0, 0.0),
    "slanted half plane": HalfPlane(0.7, 1.3),
    "quadrant": Quadrant((1.0, 2.0), (-1, 1)),
    "disc": Disc((3.0, -2.0), 11.3),
    "oval": Oval((0.0, 4.0), (14.0, 6.0), 0.4),
    "polygon": Polygon(((-9.0, -7.0), (12.0, -3.0), (2.0, 10.0))),
    "stripes": Stripes(0.2, 7.0, 0.4, 1.0),
}


def poses(n=40):
    rng = np.random.default_rng(3)
    # Whole millimetres and right angles are the hard case: edges run along pixel borders.
    x, y = rng.integers(-12, 13, n).astype(float), rng.integers(-12, 13, n).astype(float)
    turn = np.where(np.arange(n) % 2, rng.uniform(0, 6.28, n), rng.integers(0, 4, n) * np.pi / 2)
    return x, y, turn


@pytest.mark.parametrize(("spot", "surface"), list(zip([*SPOTS, *SPOTS], SURFACES_OF_RAYS, strict=False)))
def test_refining_pixels_and_rays_changes_less_than_a_thousandth(spot, surface):
    coarse = seen_white_fraction(SURFACES_OF_RAYS[surface], SPOTS[spot](0.25), *poses(6))
    fine = seen_white_fraction(SURFACES_OF_RAYS[surface], SPOTS[spot](0.125), *poses(6), n_rays=100)
    assert np.abs(coarse - fine).max() < 1e-3


def test_a_half_plane_is_the_normal_integral():
    """A Gaussian spot over a straight edge: the distribution function of its distance to the edge."""
    x, _, turn = poses(200)
    normal, offset = 0.7, 1.3
    direction = normal - turn  # the edge's normal in the sensor frame
    c, s = np.cos(direction), np.sin(direction)
    sd = np.sqrt(16 * c**2 + 6.25 * s**2 + 2 * 0.15 * 10 * c * s)
    expected = ndtr((x * math.cos(normal) + 1.5 * s - offset) / sd)
    got = seen_white_fraction(HalfPlane(normal, offset), gaussian_spot([BLOB]), x, np.zeros(200), turn)
    assert np.abs(got - expected).max() < 3e-4


@pytest.mark.parametrize(
    ("corner", "direction"), [((0, 0), (1, 1)), ((0, 0), (-1, 1)), ((4, 4), (1, 1)), ((-4, 4), (-1, 1))]
)
def test_a_quadrant_is_the_bivariate_normal_integral(corner, direction):
    (cx, cy), (dx, dy) = corner, direction
    cov = [[16, 1.5 * dx * dy], [1.5 * dx * dy, 6.25]]
    expected = multivariate_normal(mean=[0, 0], cov=cov).cdf([dx * (0 - cx), dy * (1.5 - cy)])
    got = seen_white_fraction(Quadrant(corner, direction), gaussian_spot([BLOB]), *np.zeros((3, 1)))[0]
    assert abs(got - expected) < 3e-4


def test_a_disc_under_a_round_spot_is_the_rayleigh_integral():
    spot = gaussian_spot([Blob(1.0, (0.0, 0.0), (3.0, 3.0))])
    got = seen_white_fraction(Disc((5.0, 5.0), 4.0), spot, np.array([5.0]), np.array([5.0]), np.array([1.0]))[0]
    assert abs(got - (1 - math.exp(-16 / 18))) < 3e-4


def test_an_image_shows_nothing_outside_and_has_its_first_row_on_top():
    photo = Image(np.array([[0.1, 0.2], [0.3, 0.4]]), 2.0, (10.0, 20.0), "photo.npy")
    x, y = np.array([11.0, 13.0, 11.0, 13.0, 9.9, 14.1]), np.array([23.0, 23.0, 21.0, 21.0, 21.0, 21.0])
    np.testing.assert_array_equal(albedo_at(photo, x, y), [0.1, 0.2, 0.3, 0.4, 0, 0])


@pytest.mark.parametrize(
    ("weights", "pixel_mm", "error"),
    [
        (np.zeros((2, 2)), 1.0, ParameterError),
        ([[1.0, -1.0]], 1.0, ParameterError),
        ([[1.0, np.nan]], 1.0, ParameterError),
        ([[1.0]], 0.0, ParameterError),
        ([1.0], 1.0, ShapeError),
    ],
)
def test_a_spot_without_light_is_refused(weights, pixel_mm, error):
    with pytest.raises(error):
        Spot(np.array(weights), pixel_mm, (0.0, 0.0))
