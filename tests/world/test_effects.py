"""Every effect against its formula, or a closed form for one Gaussian: as it is modelled, and as the world conceals it.

Modelled by the library and concealed by the independent world are two implementations of one formula.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from probewise.effects import EFFECTS, Extent
from probewise.errors import ParameterError
from probewise.recordings import Disc, HalfPlane
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, FixedMixture, Stage
from probewise.world import Blob, World, gaussian_spot
from probewise.world import concealed as known

CENTER, SD, RHO = (0.4, 1.5), (4.0, 2.5), 0.2
COV = [[SD[0] ** 2, RHO * SD[0] * SD[1]], [RHO * SD[0] * SD[1], SD[1] ** 2]]
SPOT = gaussian_spot([Blob(1.0, CENTER, SD, RHO)], pixel_mm=0.4)
BLACK, SPAN = 10.0, 50.0


def read(plan, *effects, **more):
    return World(SPOT, black=BLACK, white=BLACK + SPAN, concealed=effects, **more).expected_readings(plan)


def concealed(plan, *effects):
    """Readings of the world with effects, each (name, values, scans)."""
    more = {"battery_sag": (8.0,)}  # V, at which the library's gain is one
    return read(plan, *(getattr(known, name)(*own, *more.get(name, ()), *scans) for name, own, *scans in effects))


def modelled(plan, *effects):
    """Readings of the library's model with effects, each (name, values, scans), alone as among other hypotheses."""
    values, variants = {}, []
    for name, own, *scans in effects:
        bound = EFFECTS[name].for_extent(Extent(BLACK, BLACK + SPAN, plan)) or EFFECTS[name]()
        names = tuple(np.ravel(scans)) if scans else ()
        variants.append(next(v for v in bound.variants() if not names or v.scans == names))
        values[name] = own
    ssf, levels = FixedMixture([1.0], [CENTER], [COV]), FixedLevels(BLACK, BLACK + SPAN)
    chain = Chain(ssf, levels, KnownScene(plan.patterns), variants)
    theta = np.array([[x for effect in chain.effects for x in values[effect.name]]])
    alone, among = chain.predict(theta, plan), chain.predict(np.concatenate([theta, 0.5 * theta, theta]), plan)
    np.testing.assert_allclose(among[::2], np.repeat(alone, 2, axis=0), atol=1e-7)
    return alone[0]


BOTH = pytest.mark.parametrize("of", [modelled, concealed])


@pytest.fixture(scope="module")
def clean(plan):
    return read(plan)


def places(plan):
    return np.stack([plan.x_mm, plan.y_mm], axis=-1)


def sent_to(plan, place_mm, **changes):
    """Send the sensor where it really stood: only what depends on the place changes."""
    return replace(plan, x_mm=place_mm[:, 0], y_mm=place_mm[:, 1], **changes)


def boundary(plan, *, shift=(0.0, 0.0), more_variance=0.0, scale=1.0, center=CENTER, covariance=None):
    """Seen fraction over the boundary by the normal integral, (n_points,); anything elsewhere."""
    edge = plan.patterns["boundary"]
    own = edge.normal_rad - plan.orientation_rad  # the normal in the sensor frame
    c, s = np.cos(own), np.sin(own)
    (vu, cuv), (_, vv) = covariance or COV
    sd = np.sqrt(scale**2 * (vu * c**2 + vv * s**2 + 2 * cuv * c * s) + more_variance)
    along = (plan.x_mm + shift[0]) * math.cos(edge.normal_rad) + (plan.y_mm + shift[1]) * math.sin(edge.normal_rad)
    return ndtr((along + scale * (center[0] * c + center[1] * s) - edge.offset_mm) / sd)


def on_boundary(plan):
    return plan.pattern == 0


@BOTH
def test_the_clean_reading_is_the_normal_integral(of, plan):
    rows = on_boundary(plan)
    np.testing.assert_allclose(of(plan)[rows], BLACK + SPAN * boundary(plan)[rows], atol=1e-3 * SPAN)


def _after(p, at_s):
    return np.where(p.time_s > at_s, 1.0, 0.0)


def _soft(y, level, softness):
    return level - softness * np.log1p(np.exp((level - y) / softness))


FORMULAS = {
    "ambient_gradient": ((0.01, -0.02), lambda y, p: y + 0.01 * p.x_mm - 0.02 * p.y_mm),
    "ambient_step": ((2.0, 40.0), lambda y, p: y + 2.0 * _after(p, 40)),
    "offset_drift": ((30.0,), lambda y, p: y + 30 * p.time_s / 3600),
    "dark_level": ((1.5,), lambda y, p: y + 1.5),
    "gain": ((0.1,), lambda y, p: 10 + 1.1 * (y - 10)),
    "gain_drift": ((0.1, 50.0), lambda y, p: 10 + (y - 10) * (1 + 0.1 * np.exp(-p.time_s / 50))),
    "battery_sag": ((0.4,), lambda y, p: 10 + (y - 10) * (1 + 0.4 * (p.covariates["battery_mv"] - 8000) / 1000)),
    "flicker": ((1.5, 0.07, 0.3), lambda y, p: y + 1.5 * np.sin(2 * np.pi * 0.07 * p.time_s + 0.3)),
    "saturation": ((45.0, 1.0), lambda y, p: _soft(y, 45.0, 1.0)),
    "nonlinearity": ((1.3,), lambda y, p: 10 + 50 * ((y - 10) / 50) ** 1.3),
    "hysteresis": ((0.8,), lambda y, p: y + 0.8 * np.array([1.0, -1.0, 1.0, 1.0])[p.scan]),
    "glint": ((3.0, 4.0, 1.0, 5.0), lambda y, p: y + 3 * np.exp(-((p.x_mm - 4) ** 2 + (p.y_mm - 1) ** 2) / 50)),
}
"""By name its values, and the readings from those without it and the plan."""

MODELLED = {
    "gain_jump": ((0.1, 40.0), lambda y, p: 10 + (y - 10) * (1 + 0.1 * _after(p, 40))),
    "polarisation": (  # the law of Malus: a polarised share p of the light gives 1 - p + 2 p cos^2(psi - phi)
        (0.05 * np.cos(1.6), 0.05 * np.sin(1.6)),
        lambda y, p: 10 + (y - 10) * (0.95 + 0.1 * np.cos(p.orientation_rad - 0.8) ** 2),
    ),
    "overshoot": ((0.2, 5.0), lambda y, p: _overshot(y, p)),
}
"""The same of what the library models alone."""

CONCEALED = {
    "saturation": ((45.0,), lambda y, p: np.where(y > 45, 45.0, y)),
    "thermal_gain": (
        (0.05, 200.0, (0.1, 1.0, 2.0)),
        lambda y, p: 10 + (y - 10) * (1 + 0.05 * _waves(p.time_s, 200, (0.1, 1.0, 2.0))),
    ),
    "cross_talk": ((0.1, 0.3), lambda y, p: 10 + (y - 10) * (1 + 0.1 * np.cos(2 * p.orientation_rad + 0.3))),
    "floor": ((0.2,), lambda y, p: np.where(y - 10 < 0.2 * 50, 10.0, y)),
    "peak_memory": (
        (0.1,),
        lambda y, p: y + 0.1 * np.array([(y[: k + 1][p.scan[: k + 1] == p.scan[k]] - 10).max() for k in range(len(y))]),
    ),
    "gain_loss": ((0.02, 2.0), lambda y, p: 10 + (y - 10) * np.clip(1 - 0.01 * p.time_s, 0, None)),
}
"""The same of what the world conceals alone."""


def _overshot(y, p):
    """Every rise leaves a fifth of it, which decays in 5 s; falls leave nothing, and the time between scans counts."""
    out = y.copy()
    for k in range(1, len(y)):
        out[k:] += 0.2 * max(y[k] - y[k - 1], 0.0) * np.exp(-(p.time_s[k:] - p.time_s[k]) / 5.0)
    return out


def _waves(t, longest_s, phases):
    """Waves with power in proportion to their period."""
    each = [math.sqrt(1 / k) * np.cos(2 * math.pi * k * t / longest_s + phase) for k, phase in enumerate(phases, 1)]
    return sum(each) * math.sqrt(2 / sum(1 / k for k in range(1, len(phases) + 1)))


def cases(both, model, world):
    """Every name of a table with its readings: modelled and concealed, or one of them alone."""
    each = [(both, modelled), (both, concealed), (model, modelled), (world, concealed)]
    return [(of, name, *own) for table, of in each for name, own in table.items()]


@pytest.mark.parametrize(("of", "name", "values", "formula"), cases(FORMULAS, MODELLED, CONCEALED))
def test_an_effect_on_the_reading_follows_its_formula(of, name, values, formula, plan):
    np.testing.assert_allclose(of(plan, (name, values)), formula(of(plan), plan), atol=1e-9)


STANDS = {
    "backlash": ((2.0,), lambda p: places(p) - np.array([[1, 0], [-1, 0], [1, 0], [0, 1]])[p.scan]),
    "position_scale": ((0.1, -0.2), lambda p: places(p) * [1.1, 0.8]),
    "periodic_position_error": (
        (0.5, 7.0, 0.4),
        lambda p: _moved_along_x(p, 0.5 * np.sin(2 * np.pi * p.x_mm / 7 + 0.4)),
    ),
    "sensor_tilt": ((0.6, -0.3), lambda p: places(p) + np.array([0.6, -0.3])),
}
"""By name its values, and where the arm really stands."""

STANDS_MODELLED = {
    "bent_rails": (
        (1.5, -2.0, 1.0, -0.5),
        lambda p: places(p) + places(p) ** 2 * [0.015, 0.01] - places(p) ** 3 * [0.002, 0.0005],
    ),
    "missing_tooth": ((0.7, 2.0, 0.0), lambda p: _moved_along_x(p, np.where(p.x_mm > 2, 0.7, 0))),
    "arm_knock": ((0.9, -1.3, 0.0, 40.0), lambda p: places(p) + np.outer(_after(p, 40), [0.9, -1.3])),
}

STANDS_CONCEALED = {
    "bent_rail": ((0.5,), lambda p: _moved_along_x(p, 0.005 * p.x_mm**2)),
    "twisted_rail": ((0.5,), lambda p: _moved_along_x(p, 0.0005 * p.x_mm**3)),
    "place_step": ((0.5, 1.0), lambda p: _moved_along_x(p, np.where(p.x_mm > 1, 0.5, 0))),
    "stick_slip": ((0.5, 8.0, 0.25), lambda p: _moved_along_x(p, np.mod(p.x_mm + 2, 8) / 8 - 0.5)),
    "play_of_axes": ((2.0, 1.0), lambda p: places(p) - np.array([[1, 0], [-1, 0], [1, 0], [0, 0.5]])[p.scan]),
}


def _moved_along_x(plan, by_mm):
    return places(plan) + np.stack([by_mm, 0 * by_mm], axis=-1)


@pytest.mark.parametrize(("of", "name", "values", "stands"), cases(STANDS, STANDS_MODELLED, STANDS_CONCEALED))
def test_an_effect_on_the_place_reads_what_a_right_arm_reads_there(of, name, values, stands, plan):
    np.testing.assert_allclose(of(plan, (name, values)), of(sent_to(plan, stands(plan))), atol=1e-9)


TURNS = {
    "scan_angle_error": ((25.0,), ("back", "white")),
    "orientation_error": ((25.0,),),
    "slow_turn": ((900.0,),),
    "arm_knock": ((0.0, 0.0, 25.0, 40.0),),
}


@pytest.mark.parametrize("name", TURNS)
def test_an_angle_error_reads_what_a_turned_sensor_reads(name, plan):
    by_deg = {
        "scan_angle_error": 25.0 * np.isin(plan.scan, (1, 2)),
        "orientation_error": np.full(len(plan), 25.0),
        "slow_turn": 0.25 * plan.time_s,
        "arm_knock": 25.0 * _after(plan, 40),
    }
    turned = replace(plan, orientation_rad=plan.orientation_rad + np.radians(by_deg[name]))
    for of in (modelled, concealed) if hasattr(known, name) else (modelled,):
        np.testing.assert_allclose(of(plan, (name, *TURNS[name])), of(turned), atol=1e-9)


@BOTH
def test_a_tilt_shifts_what_is_seen_and_not_where_the_sensor_stands(of, plan):
    """The ambient light is that of the sensor's own place."""
    light, tilt = ("ambient_gradient", (0.05, 0.0)), ("sensor_tilt", (0.6, -0.3))
    np.testing.assert_allclose(of(plan, tilt, light) - of(plan, tilt), 0.05 * plan.x_mm, atol=1e-9)


@BOTH
def test_a_misplaced_edge_is_a_pattern_that_lies_elsewhere(of, plan):
    """Across the edge for a boundary, along X for a disc."""
    moved = {**plan.patterns, "boundary": HalfPlane(0.1, 0.7 + 0.9), "disc": Disc((1.3 + 0.9, -0.4), 12.0)}
    expected = of(replace(plan, patterns=moved))
    np.testing.assert_allclose(of(plan, ("edge_misplacement", (0.9,))), expected, atol=1e-9)
    one = of(plan, ("scan_misplacement", (0.9,), "back"))
    np.testing.assert_allclose(one, np.where(plan.scan == 1, expected, of(plan)), atol=1e-9)


@BOTH
def test_lag_is_an_exponential_memory_within_the_scan(of, plan):
    """Second route: the weights of all earlier readings, written out."""
    clean, got = of(plan), of(plan, ("lag", (2.5,)))
    for k in range(len(plan)):
        rows = np.flatnonzero((plan.scan == plan.scan[k]) & (np.arange(len(plan)) <= k))
        forgotten = 1 - np.exp(-np.diff(plan.time_s[rows]) / 2.5)
        weights = np.concatenate([[1.0], forgotten]) * np.exp(-(plan.time_s[k] - plan.time_s[rows]) / 2.5)
        assert weights.sum() == pytest.approx(1)
        assert got[k] == pytest.approx(weights @ clean[rows], abs=1e-9)


def test_coarse_rounding_is_to_multiples_of_the_step(plan, clean):
    got = World(SPOT, concealed=(known.quantisation(3.0),)).simulate(plan, rng=None).readings
    np.testing.assert_allclose(got, 3 * np.round(clean / 3))
    noisy = World(SPOT, concealed=(known.quantisation(3.0),)).simulate(plan, rng=np.random.default_rng(1)).readings
    np.testing.assert_array_equal(noisy % 3, 0)


@BOTH
def test_a_blurred_edge_adds_its_variance(of, plan):
    rows = on_boundary(plan)
    for sd_mm in (0.3, 3.0):
        expected = BLACK + SPAN * boundary(plan, more_variance=sd_mm**2)[rows]
        np.testing.assert_allclose(of(plan, ("edge_blur", (sd_mm,)))[rows], expected, atol=1e-3 * SPAN)


@BOTH
def test_a_halo_is_a_share_of_a_wide_gaussian_about_the_spots_middle(of, plan):
    rows = on_boundary(plan)
    skirt = boundary(plan, covariance=((225.0, 0.0), (0.0, 225.0)))
    expected = BLACK + SPAN * (0.8 * boundary(plan) + 0.2 * skirt)[rows]
    np.testing.assert_allclose(of(plan, ("halo", (0.2, 15.0)))[rows], expected, atol=1e-3 * SPAN)


def test_one_gaussian_more_is_a_share_of_it(plan):
    rows = on_boundary(plan)
    more = boundary(plan, center=(-3.0, 4.0), covariance=((4.0, 0.0), (0.0, 4.0)))
    expected = BLACK + SPAN * (0.7 * boundary(plan) + 0.3 * more)[rows]
    np.testing.assert_allclose(read(plan, known.ssf_order(0.3, -3.0, 4.0, 2.0))[rows], expected, atol=1e-3 * SPAN)


HEIGHTS = {
    "height_gradient": ((0.05,), lambda p: 0.05 * p.x_mm),
    "height_offset": ((-3.0,), lambda p: np.where(p.scan == 0, -3.0, 0.0), ("out",)),
    "slow_sinking": ((30.0,), lambda p: 14 * 30 * p.time_s / 3600),
}


@pytest.mark.parametrize("is_commanded", [False, True])
@pytest.mark.parametrize("name", HEIGHTS)
def test_height_scales_the_footprint_and_dims_by_the_inverse_square(name, is_commanded, plan):
    """Of the description's height, or of one that is commanded."""
    values, added, *scans = HEIGHTS[name]
    rows, white = on_boundary(plan), plan.pattern == 1
    height = np.linspace(9.0, 20.0, len(plan)) if is_commanded else np.full(len(plan), 14.0)
    scale = (height + added(plan)) / 14
    there = replace(plan, covariates={**plan.covariates, "height_mm": height}) if is_commanded else plan
    expected = BLACK + SPAN * boundary(plan, scale=scale) / scale**2
    for of in (modelled, concealed) if hasattr(known, name) else (modelled,):
        got = of(there, (name, values, *scans))
        np.testing.assert_allclose(got[rows], expected[rows], atol=1.5e-3 * SPAN)
        np.testing.assert_allclose(got[white], BLACK + SPAN / scale[white] ** 2, atol=1e-9)


@pytest.mark.parametrize(
    "effect", [known.height_gradient(0.05), known.height_offset(2.0, ("out",)), known.sensor_tilt(0.7, -0.4)]
)
def test_a_plan_that_commands_heights_is_read_as_the_arm_reads_at_them(effect, plan):
    """Row by row through `World.read`; a row without a height, or without a state of the LED, is as usual."""
    rows = np.array([3, 20, 31, 44])
    plan = plan.take(rows)
    heights, led = np.array([9.0, np.nan, 20.0, 25.0]), np.array([1.0, 1.0, np.nan, 0.5])
    commanded = replace(plan, covariates={"height_mm": heights, "led": led})
    world = World(SPOT, black=BLACK, white=BLACK + SPAN, concealed=(effect,))
    if effect.name == "height_offset":
        # A single reading belongs to a scan without a name.
        world = replace(world, concealed=(known.height_offset(2.0, ("", *plan.scan_names)),))
    alone = [
        world.read(
            plan.patterns[plan.pattern_names[plan.pattern[k]]],
            plan.x_mm[k],
            plan.y_mm[k],
            plan.orientation_rad[k],
            time_s=plan.time_s[k],
            rng=None,
            height_mm=None if np.isnan(heights[k]) else heights[k],
        )
        for k in range(len(plan))
    ]
    expected = BLACK + np.where(np.isnan(led), 1.0, led) * (np.array(alone) - BLACK)
    np.testing.assert_allclose(world.expected_readings(commanded), expected, atol=1e-9)
    assert np.abs(world.expected_readings(commanded) - world.expected_readings(plan)).max() > 1.0


@BOTH
def test_a_tilt_moves_the_spot_of_a_raised_sensor_farther(of, plan):
    """At twice the height by twice as much: as a pattern that is moved back by that."""
    raised = replace(plan, covariates={"height_mm": np.full(len(plan), 28.0)})
    shifted = replace(raised, x_mm=plan.x_mm + 2 * 0.7, y_mm=plan.y_mm - 2 * 0.4)
    np.testing.assert_allclose(of(raised, ("sensor_tilt", (0.7, -0.4))), of(shifted), atol=1e-9)


def test_effects_of_scene_footprint_and_pose_stack_as_physics_does(plan):
    """A graded and stained scene under a raised, tilted and lagging sensor, over a boundary and over a disc."""
    scene = [("albedo_gradient", (0.004, -0.007)), ("albedo_patch", (-0.3, 3.0, -2.0, 5.0))]
    effects = [("lag", (2.0,)), ("sensor_tilt", (0.9, -1.3)), ("height_offset", (1.5,), ("out",)), *scene]
    np.testing.assert_allclose(modelled(plan, *effects), concealed(plan, *effects), atol=1e-3 * SPAN)


def test_no_effect_on_the_mean_is_left_out():
    """Those with a formula here, with a closed form, and with a test elsewhere."""
    here = {*FORMULAS, *MODELLED, *STANDS, *STANDS_MODELLED, *TURNS, *HEIGHTS}
    closed = {"edge_misplacement", "scan_misplacement", "lag", "edge_blur", "halo", "albedo_gradient", "albedo_patch"}
    on_mean = {name for name, kind in EFFECTS.items() if kind.stage is not Stage.NOISE}
    assert here | closed | {"edge_shadow"} == on_mean - {"reflection", "stick_slip"}


def test_a_sensor_on_the_table_is_refused(plan):
    with pytest.raises(ParameterError, match="height_mm"):
        read(plan, known.height_offset(-14.0, ("out",)))


def middle(plan):
    """Lab place of the spot's mean, (n_points, 2)."""
    c, s = np.cos(plan.orientation_rad), np.sin(plan.orientation_rad)
    return places(plan) + np.stack([c * CENTER[0] - s * CENTER[1], s * CENTER[0] + c * CENTER[1]], axis=-1)


@BOTH
def test_a_gradient_of_albedo_weights_the_seen_half_of_a_boundary(of, plan):
    """E[n . p ; beyond the edge] of a normal variable: m F(z) + s f(z)."""
    rows, k = on_boundary(plan), 0.01
    straight = replace(plan, patterns={**plan.patterns, "boundary": HalfPlane(0.0, 0.7)})
    c, s = np.cos(plan.orientation_rad), -np.sin(plan.orientation_rad)
    mean = middle(plan)[:, 0]
    sd = np.sqrt(SD[0] ** 2 * c**2 + SD[1] ** 2 * s**2 + 2 * RHO * SD[0] * SD[1] * c * s)
    z = (mean - 0.7) / sd
    beyond = mean * ndtr(z) + sd * np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
    got = of(straight, ("albedo_gradient", (k, 0.0)))
    np.testing.assert_allclose(got[rows], (BLACK + SPAN * (ndtr(z) + k * beyond))[rows], atol=1e-3 * SPAN)


@BOTH
def test_a_patch_is_seen_through_the_spot(of, plan):
    """Two Gaussians convolved: covariances add."""
    effect = "albedo_patch", (-0.3, 2.0, 1.0, 5.0)
    c, s = np.cos(plan.orientation_rad), np.sin(plan.orientation_rad)
    turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    covariance = turn @ np.array(COV) @ turn.transpose(0, 2, 1) + 25 * np.eye(2)
    apart = middle(plan) - [2.0, 1.0]
    squared = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(covariance), apart)
    seen = -0.3 * 25 / np.sqrt(np.linalg.det(covariance)) * np.exp(-squared / 2)
    np.testing.assert_allclose(of(plan, effect) - of(plan), SPAN * seen, atol=1e-3 * SPAN)


@BOTH
def test_an_edge_casts_its_shadow_by_the_distance_of_the_sensor(of, plan):
    along = plan.x_mm * math.cos(0.1) + plan.y_mm * math.sin(0.1) - 0.7
    rim = np.hypot(plan.x_mm - 1.3, plan.y_mm + 0.4) - 12
    distance = np.where(plan.pattern == 0, along, np.where(plan.pattern == 1, np.inf, rim))
    expected = of(plan) - SPAN * 0.1 * np.exp(-(distance**2) / (2 * 9))
    np.testing.assert_allclose(of(plan, ("edge_shadow", (0.1, 3.0))), expected, atol=1e-9)


def test_a_sagging_battery_needs_its_voltage(plan):
    with pytest.raises(ParameterError, match="battery_mv"):
        read(replace(plan, covariates={}), known.battery_sag(0.4))


def test_slipped_paper_lies_elsewhere_from_then_on(plan, clean):
    at_s = float(plan.time_s[30])
    moved = read(replace(plan, patterns={**plan.patterns, "boundary": HalfPlane(0.1, 1.5)}))
    got = read(plan, known.slipped_paper(0.8, at_s))
    boundary = plan.pattern == 0
    expected = np.where(plan.time_s > at_s, moved, clean)
    np.testing.assert_allclose(got[boundary], expected[boundary], atol=1e-9)


def test_a_ghost_is_a_faint_second_look_from_elsewhere(plan, clean):
    beside = read(replace(plan, x_mm=plan.x_mm + 6.0, y_mm=plan.y_mm - 2.0))
    np.testing.assert_allclose(read(plan, known.ghost(0.1, 6.0, -2.0)), 0.9 * clean + 0.1 * beside, atol=1e-9)


def test_each_rise_is_followed_by_a_pulse_that_dies_off(plan, clean):
    got = read(plan, known.after_glow(4.0, 6.0, 35.0))
    expected = clean.copy()
    for k in range(1, len(plan)):
        if clean[k - 1] <= 35 < clean[k]:
            later = np.arange(len(plan)) >= k
            expected[later] += 4 * np.exp(-(plan.time_s[later] - plan.time_s[k]) / 6)
    assert np.abs(expected - clean).max() >= 4
    np.testing.assert_allclose(got, expected)


def test_a_chirp_swings_ever_faster(plan, clean):
    """The phase is the integral of the frequency: summed up in small steps."""
    effect = known.chirp(2.0, 0.01, 0.0005, 0.4)
    fine = np.linspace(0, plan.time_s[-1], 200_001)
    hz = 0.01 + 0.0005 * fine
    turns = np.concatenate([[0.0], np.cumsum((hz[1:] + hz[:-1]) / 2 * np.diff(fine))])
    phase = 2 * math.pi * np.interp(plan.time_s, fine, turns) + 0.4
    np.testing.assert_allclose(read(plan, effect) - clean, 2 * np.sin(phase), atol=1e-5)
