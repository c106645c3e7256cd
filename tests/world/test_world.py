"""Readings, noise, and each concealed effect against its formula in the vocabulary."""

import numpy as np
import pytest

from probewise.errors import ParameterError
from probewise.recordings import Disc, HalfPlane, Uniform, paper_plan, two_way_plan
from probewise.world import (
    Blob,
    World,
    ambient_gradient,
    backlash,
    correlated_noise,
    gain_drift,
    gaussian_spot,
    nonlinearity,
    saturation,
    simulate,
)
from probewise.world.concealed import albedo_patch, edge_shadow, halo, height_gradient, sensor_tilt
from probewise.world.stages import acts_at

SPOT = gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5), 0.15)], pixel_mm=0.5)
PLAN = two_way_plan()


def world(*concealed, **more):
    return World(SPOT, concealed=concealed, **more)


@pytest.fixture(scope="module")
def clean():
    return world().expected_readings(PLAN)


def test_plain_black_and_white_read_the_two_levels(clean):
    names = np.array(PLAN.pattern_names)[PLAN.pattern]
    np.testing.assert_allclose(clean[names == "black"], 10)
    np.testing.assert_allclose(clean[names == "white"], 60)


def test_nothing_is_read_outside_the_levels(clean):
    assert clean.min() >= 10 - 1e-9
    assert clean.max() <= 60 + 1e-9


def test_the_shift_of_the_spot_parts_90_from_270_degrees(clean):
    """Paper, Fig. data: the transition of the two orientations is shifted by twice the SSF's centre."""
    at = {
        deg: np.interp(35, clean[rows], PLAN.x_mm[rows])
        for deg in (90, 270)
        for rows in [PLAN.rows_by_scan()[PLAN.scan_names.index(f"edge_{deg}_out")]]
    }
    assert at[90] == pytest.approx(1.5, abs=0.02)
    assert at[270] == pytest.approx(-1.5, abs=0.02)


def test_one_reading_by_one_gives_the_same_as_the_whole_plan(clean):
    effects = world(
        backlash(1.0),
        albedo_patch(-0.2, 3.0, 1.0, 6.0),
        height_gradient(0.01),
        sensor_tilt(0.5, 0.2),
        halo(0.1, 15.0),
        edge_shadow(0.05, 4.0),
        gain_drift(0.1, 300.0),
        ambient_gradient(0.01, 0.02),
        saturation(50.0),
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


def test_noise_is_white_with_the_sd_asked_for(clean):
    noise = simulate(PLAN, world(noise_sd=0.6), rng=np.random.default_rng(2)).readings - clean
    z = noise / 0.6
    n = len(z)
    # 4 sigma: a right program fails less than once in 10 000.
    assert abs(z.mean()) < 4 / np.sqrt(n)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / n)
    assert abs(np.mean(z[1:] * z[:-1])) < 4 / np.sqrt(n)


def test_a_seed_gives_the_same_recording_again():
    one, two = (simulate(paper_plan(), world(), rng=np.random.default_rng(7)).readings for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_readings_are_rounded_to_the_step():
    readings = simulate(paper_plan(), world(step=0.5), rng=np.random.default_rng(7)).readings
    np.testing.assert_array_equal(readings * 2, np.round(readings * 2))


def test_backlash_shifts_the_ways_out_and_back_apart():
    """Vocabulary: position - (width/2) direction, so the two ways differ by the width."""
    expected = world(backlash(2.0)).expected_readings(PLAN)
    at = {}
    for way in ("out", "back"):
        rows = PLAN.rows_by_scan()[PLAN.scan_names.index(f"edge_0_{way}")]
        order = np.argsort(expected[rows])
        at[way] = np.interp(35, expected[rows][order], PLAN.x_mm[rows][order])
    assert at["out"] - at["back"] == pytest.approx(2.0, abs=0.02)


def test_gain_drift_scales_the_signal_and_never_the_dark(clean):
    got = world(gain_drift(0.1, 300.0)).expected_readings(PLAN)
    np.testing.assert_allclose(got - 10, (clean - 10) * (1 + 0.1 * np.exp(-PLAN.time_s / 300)), atol=1e-12)


def test_an_ambient_gradient_is_a_plane_on_top(clean):
    got = world(ambient_gradient(0.01, -0.02)).expected_readings(PLAN)
    np.testing.assert_allclose(got - clean, 0.01 * PLAN.x_mm - 0.02 * PLAN.y_mm, atol=1e-12)


def test_saturation_cuts_and_soft_saturation_bends(clean):
    np.testing.assert_array_equal(world(saturation(50.0)).expected_readings(PLAN), np.minimum(clean, 50))
    soft = world(saturation(50.0, softness=1.0)).expected_readings(PLAN)
    assert soft.max() < 50
    np.testing.assert_allclose(soft[clean < 20], clean[clean < 20], atol=1e-6)
    np.testing.assert_allclose(
        world(saturation(50.0, softness=1e-3)).expected_readings(PLAN), np.minimum(clean, 50), atol=1e-3
    )


def test_nonlinearity_is_a_power_of_the_seen_fraction(clean):
    got = world(nonlinearity(1.2)).expected_readings(PLAN)
    np.testing.assert_allclose((got - 10) / 50, ((clean - 10) / 50) ** 1.2, rtol=1e-9, atol=1e-12)


def test_correlated_noise_is_ar1_within_a_scan_and_keeps_its_sd(clean):
    rho, n_runs = 0.5, 2
    effect = world(correlated_noise(rho), noise_sd=1.0)
    z = np.stack([effect.simulate(PLAN, rng=np.random.default_rng(s)).readings - clean for s in range(n_runs)])
    within = PLAN.scan[1:] == PLAN.scan[:-1]
    products = z[:, 1:] * z[:, :-1]
    n = n_runs * len(PLAN)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / n * (1 + rho**2) / (1 - rho**2))
    assert abs(products[:, within].mean() - rho) < 4 * np.sqrt(1.5 / n * 3)
    assert abs(products[:, ~within].mean()) < 4 / np.sqrt(products[:, ~within].size)


def test_effects_stack_in_the_order_of_the_chain_whatever_their_order_in_the_list():
    effects = (saturation(45.0), ambient_gradient(0.02, 0.0), gain_drift(0.1, 300.0), nonlinearity(1.1), backlash(1.0))
    np.testing.assert_array_equal(
        world(*effects).expected_readings(PLAN), world(*effects[::-1]).expected_readings(PLAN)
    )
    assert world(*effects).expected_readings(PLAN).max() == 45


def test_an_effect_of_ones_own_is_one_short_function(clean):
    @acts_at("offset")
    def step(at_s):
        return lambda values, rows: values + (rows.time_s > at_s)

    assert step(100).name == "step"
    np.testing.assert_allclose(world(step(100)).expected_readings(PLAN) - clean, PLAN.time_s > 100, atol=1e-12)


def test_an_effect_at_no_known_stage_is_refused():
    lost = acts_at("somewhere")(lambda: None)()
    with pytest.raises(ParameterError, match=r"stage"):
        world(lost)


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


def test_a_hidden_circle_is_bright_inside_dark_outside_and_half_on_its_edge():
    circle = Disc((500.0, 250.0), 80.0)
    inside, outside, edge = (world().read(circle, x, 250.0, time_s=0.0, rng=None) for x in (500.0, 300.0, 420.0))
    assert (inside, outside) == pytest.approx((60, 10), abs=1e-9)
    assert 25 < edge < 45
