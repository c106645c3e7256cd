"""Every effect of the vocabulary keeps the contract of an effect; the priors are what they say."""

import dataclasses
import pickle
from dataclasses import replace

import numpy as np
import pytest

from probewise.diagnosis.light_sensor import _NOT_COLUMNS
from probewise.effects import EFFECTS, VOCABULARY, Extent, HeavyTailedPrior, LogHeavyTailedPrior
from probewise.effects.effect import sentence_from_samples
from probewise.effects.optics import distinct_scan_lines
from probewise.effects.reference import Origin, orientation_deg
from probewise.errors import ParameterError
from probewise.recordings import Disc, HalfPlane, Plan, Quadrant, Recording, Uniform, paper_plan, two_way_plan
from probewise.recordings.plans import with_jittered_times
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, FixedMixture, Poses, Stage
from probewise.world import concealed

PLAN = with_jittered_times(two_way_plan(), rng=np.random.default_rng(0))
EXTENT = Extent(10.0, 60.0, PLAN)


def plan_along(x_mm, y_mm, scan=None, every_s=1.0):
    """Readings at these places, one after the other."""
    n = len(x_mm)
    return Plan(
        x_mm=x_mm,
        y_mm=y_mm,
        orientation_rad=np.zeros(n),
        time_s=every_s * np.arange(n),
        scan=np.zeros(n, dtype=int) if scan is None else scan,
        scan_names=("out", "back")[: 1 if scan is None else 2],
        pattern=np.zeros(n, dtype=int),
        pattern_names=("edge",),
        patterns={"edge": HalfPlane(0.0, 0.0)},
    )


def there_and_back():
    return plan_along(np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0]), np.zeros(6), np.repeat([0, 1], 3), every_s=10.0)


def base():
    return Chain(
        FixedMixture([1.0], [[0.5, 1.5]], [[[16.0, 1.0], [1.0, 9.0]]]), FixedLevels(10, 60), KnownScene(PLAN.patterns)
    )


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_keeps_the_contract(name):
    effect = EFFECTS[name].for_extent(EXTENT)
    names = effect.prior.names
    assert effect.name == name
    assert EFFECTS[name].words
    assert isinstance(effect.stage, Stage)
    assert len(effect.units) == len(names)
    assert effect.covariates
    assert {*effect.covariates} <= {*_NOT_COLUMNS, "lattice", *PLAN.covariates}  # those along which residuals are seen
    for variant in (effect.variants()[0], effect.variants()[-1]):
        bank = variant.entries
        assert bank.ndim == 3
        assert bank.shape[2] == len(names)
        assert variant.prior.names == names
        assert np.isfinite(variant.prior.log_prob(bank.reshape(-1, len(names)))).all()
        said = variant.sentence(bank[0, 0], np.abs(bank[0, 0]) / 10 + 1e-6)
        assert said[0].islower()
        assert any(c.isdigit() for c in said)
        assert all(scan in said for scan in variant.scans)
    assert EFFECTS[name]().prior.names == names  # a sensor file needs its function only, whatever the prior's scale


def test_every_effect_has_a_counterpart_in_the_world_that_conceals():
    assert [name for name in VOCABULARY if not hasattr(concealed, name)] == []


@pytest.mark.parametrize("name", [name for name, kind in EFFECTS.items() if kind.stage is not Stage.NOISE])
def test_every_setting_of_every_bank_changes_finite_readings(name):
    """And what is an amplitude does nothing at zero."""
    effect = EFFECTS[name].for_extent(EXTENT)
    plain = base().predict(np.zeros((1, 0)), PLAN)
    changed = 0.0
    for variant in effect.variants()[:: max(len(effect.variants()) // 6, 1)]:
        settings = variant.entries.reshape(-1, len(variant.prior.names))[:40]
        chain = base().with_effects(variant)
        readings = chain.predict(settings, PLAN)
        assert readings.shape == (len(settings), len(PLAN))
        assert np.isfinite(readings).all()
        changed = max(changed, float(np.abs(readings - plain).max()))
        if effect.amplitudes:
            none = settings.copy()
            none[:, effect.amplitudes] = 0.0
            np.testing.assert_allclose(chain.predict(none, PLAN), np.repeat(plain, len(none), axis=0), atol=1e-9)
    assert changed > 1e-3


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_acts_alike_in_another_process(name):
    effect = EFFECTS[name].for_extent(EXTENT)
    values = np.full((1, len(PLAN)), 0.4)
    for variant in {effect, effect.variants()[0], effect.variants()[-1]}:
        copy = pickle.loads(pickle.dumps(variant))
        theta = variant.entries[0, :1]
        assert copy.sentence(theta[0], theta[0]) == variant.sentence(theta[0], theta[0])
        assert (copy.name, copy.scans, copy.patterns) == (variant.name, variant.scans, variant.patterns)
        np.testing.assert_array_equal(copy.entries, variant.entries)
        if effect.stage in (Stage.RESPONSE, Stage.GAIN, Stage.OFFSET, Stage.LAG, Stage.SATURATION):
            np.testing.assert_array_equal(copy.apply(values, theta, PLAN), variant.apply(values, theta, PLAN))
    assert pickle.loads(pickle.dumps(EFFECTS[name])) is EFFECTS[name]


@pytest.mark.parametrize("name", EFFECTS)
def test_a_prior_maps_the_unit_cube_to_its_own_density(name):
    """Route one: the density; route two: the determinant of the way back to the cube, by central differences."""
    prior = EFFECTS[name].for_extent(EXTENT).prior
    n_params = len(prior.names)
    u = np.random.default_rng(1).uniform(0.1, 0.9, (50, n_params))
    theta = prior.from_unit_cube(u)
    np.testing.assert_allclose(prior.to_unit_cube(theta), u, atol=1e-9)
    slopes = np.empty((50, n_params, n_params))
    for k in range(n_params):
        step = np.zeros_like(theta)
        step[:, k] = 1e-5 * np.abs(theta[:, k]) + 1e-9 * np.ptp(theta[:, k])
        rise = prior.to_unit_cube(theta + step) - prior.to_unit_cube(theta - step)
        slopes[:, :, k] = rise / (2 * step[:, k : k + 1])
    np.testing.assert_allclose(np.exp(prior.log_prob(theta)), np.abs(np.linalg.det(slopes)), rtol=2e-4)


@pytest.mark.parametrize("name", EFFECTS)
def test_every_mode_is_counted_as_often_as_the_prior_holds_it(name):
    """A phase has a prior over two turns: a whole turn on, within the prior, the readings are the same."""
    effect = EFFECTS[name].for_extent(EXTENT)
    names = effect.prior.names
    phase = next((k for k, own in enumerate(names) if own == "phase"), None)
    assert effect.n_peaks == (1 if phase is None else 2)
    if phase is not None:
        theta = effect.prior.from_unit_cube(np.full((1, len(names)), 0.3))
        turned = theta.copy()
        turned[:, phase] = effect.prior.from_unit_cube(np.full((1, len(names)), 0.8))[:, phase]  # half the prior on
        chain = base().with_effects(effect)
        np.testing.assert_allclose(chain.predict(turned, PLAN), chain.predict(theta, PLAN), atol=1e-9)
        assert effect.prior.log_prob(turned) == pytest.approx(effect.prior.log_prob(theta))


def test_lines_are_found_whichever_way_they_were_scanned():
    """The two-way plan goes along X, forth and back, and once along Y; a turned plan along its own line."""
    along_x, along_y = distinct_scan_lines(PLAN)
    assert (along_x.angle_rad, along_x.offset_mm, along_x.low_mm, along_x.high_mm) == (0.0, 0.0, -50.0, 50.0)
    assert along_y.angle_rad == pytest.approx(np.pi / 2)
    assert (along_y.offset_mm, along_y.low_mm, along_y.high_mm) == pytest.approx((5.0, -60.0, 60.0))
    line = paper_plan().take(np.arange(101))
    c, s = np.cos(0.4), np.sin(0.4)
    (found,) = distinct_scan_lines(replace(line, x_mm=c * line.x_mm - s * 7, y_mm=s * line.x_mm + c * 7))
    assert (found.angle_rad, found.offset_mm, found.length_mm) == pytest.approx((0.4, 7.0, 100.0))
    x, y = found.lab_coordinates_mm(np.array([3.0]), np.array([-2.0]))
    np.testing.assert_allclose(found.line_coordinates_mm(x, y), [[3.0], [-2.0]], atol=1e-12)


@pytest.mark.parametrize("jitter_mm", [1e-13, 0.05])
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0])
def test_a_line_is_found_once_where_the_places_scatter_about_it(angle_deg, jitter_mm):
    """Sorted by X, the first and the last place of a scan along Y are any two of its places."""
    rng = np.random.default_rng(0)
    along, angle = np.linspace(-50, 50, 60), np.radians(angle_deg)
    c, s = np.cos(angle), np.sin(angle)
    for _ in range(20):
        along_both, beside = np.append(along, along[::-1]), 5 + jitter_mm * rng.standard_normal(120)
        plan = plan_along(c * along_both - s * beside, s * along_both + c * beside, np.repeat([0, 1], 60))
        (line,) = distinct_scan_lines(plan)
        assert line.angle_rad == pytest.approx(angle, abs=1e-3)
        assert line.offset_mm == pytest.approx(5.0, abs=0.05)
        assert line.length_mm == pytest.approx(100.0, abs=0.1)


def test_a_scan_at_rest_has_no_line_whatever_the_last_digit_of_its_places():
    y_mm = 5.0 + np.spacing(5.0) * np.arange(60)
    assert distinct_scan_lines(plan_along(np.full(60, 3.0), y_mm)) == ()


def test_a_heavy_tail_is_exact_at_both_ends():
    prior = HeavyTailedPrior(0.5)
    u = np.array([1e-9, 1e-3, 0.2, 0.5, 0.8, 0.999, 1 - 1e-9])
    x = prior.from_unit(u)
    np.testing.assert_allclose(x, -x[::-1], rtol=1e-6, atol=1e-12)
    positive = HeavyTailedPrior(0.5, positive=True)
    np.testing.assert_allclose(positive.from_unit(np.array([0.6])), prior.from_unit(np.array([0.8])), rtol=1e-9)
    assert positive.log_prob(np.array([-1.0]))[0] == -np.inf
    # Twenty-five typical sizes are no surprise: the density there is far above a normal's.
    assert prior.log_prob(np.array([12.5]))[0] > -8
    assert LogHeavyTailedPrior(0.1).from_unit(np.array([0.5]))[0] == pytest.approx(1.0)
    np.testing.assert_allclose(LogHeavyTailedPrior(0.1).to_unit(np.array([-1.0, 0.0, 1.0])), [0.0, 0.0, 0.5])


def test_an_effect_that_could_not_show_is_not_built():
    """The paper's plan has no battery; one scan goes one way and has no other to differ from; a spot has no X."""
    plan = replace(paper_plan(), covariates={})
    one_way = Extent(10.0, 60.0, plan)
    missing = {name for name, kind in VOCABULARY.items() if kind.for_extent(one_way) is None}
    assert missing == {"battery_sag"}
    one_scan = Extent(10.0, 60.0, plan.take(np.arange(101)))
    missing = {name for name, kind in VOCABULARY.items() if kind.for_extent(one_scan) is None}
    assert missing == {"hysteresis", "battery_sag", "scan_misplacement", "scan_angle_error", "height_offset"}
    nowhere = Extent(10.0, 60.0, plan.take(np.arange(404, 405)))
    for name in ("periodic_position_error", "glint", "ambient_step", "missing_tooth"):
        assert EFFECTS[name].for_extent(nowhere) is None
    still = replace(there_and_back(), time_s=np.zeros(6))
    opposite = replace(there_and_back(), orientation_rad=np.repeat([0.3, 0.3 + np.pi], 3))
    turned = replace(there_and_back(), orientation_rad=np.repeat([0.3, 0.7], 3))
    for name, own, shows in (
        ("overshoot", still, False),
        ("polarisation", opposite, False),
        ("polarisation", turned, True),
    ):
        assert (EFFECTS[name].for_extent(Extent(10.0, 60.0, own)) is not None) is shows


OF_MOUNTINGS = ("scan_angle_error", "height_offset")


@pytest.mark.parametrize(
    ("written_deg", "as_deg"),
    [
        ((0, 90, 360, -90), (0, 90, 0, -90)),
        ((180, 0, -180, 270), (-180, 0, -180, 270)),
        ((0.1, 45.3, 360.1, -314.7), (0.1, -314.7, 0.1, -314.7)),
        ((-1e-9, 720.2, 360, 0.2), (0, 0.2, 0, 0.2)),
    ],
)
def test_orientations_a_whole_turn_apart_are_one_mounting(written_deg, as_deg):
    plan = replace(paper_plan(), orientation_rad=np.zeros(408))
    names = plan.scan_names
    turned = replace(plan, orientation_rad=np.radians(np.array(written_deg, dtype=float))[plan.scan % 4])
    np.testing.assert_array_equal(orientation_deg(turned), np.array(as_deg, dtype=float)[plan.scan % 4])
    together = tuple(name for k, name in enumerate(names) if k % 4 in (0, 2))
    for name in OF_MOUNTINGS:
        groups = [variant.scans for variant in VOCABULARY[name].for_extent(Extent(10.0, 60.0, turned)).variants()]
        assert together in groups
        assert len(groups) == len(set(groups))
    once = replace(plan, orientation_rad=np.where(plan.scan == 1, 2 * np.pi, 0.0))
    every = [v.scans for v in VOCABULARY["scan_angle_error"].for_extent(Extent(10.0, 60.0, once)).variants()]
    assert every == [(name,) for name in names]  # all scans together are no mounting that could be off


def test_a_mounting_of_one_of_several_recordings_may_be_off_alone():
    """At an orientation of two recordings the sensor may have been mounted anew: 0 degrees of the first one alone."""
    plan = paper_plan()
    later = plan.take(np.arange(202))  # edge_0 and edge_90 again, as a second recording
    both = replace(
        plan,
        **{name: np.append(getattr(plan, name), getattr(later, name)) for name in ("x_mm", "y_mm", "orientation_rad")},
        time_s=np.append(plan.time_s, later.time_s + 1000.0),
        scan=np.append(plan.scan, later.scan + len(plan.scan_names)),
        scan_names=(*plan.scan_names, "later_0", "later_90"),
        pattern=np.append(plan.pattern, later.pattern),
        covariates={},
        sessions=(0,) * len(plan.scan_names) + (1, 1),
    )
    for name in OF_MOUNTINGS:
        groups = [variant.scans for variant in VOCABULARY[name].for_extent(Extent(10.0, 60.0, both)).variants()]
        at_0 = tuple(name for name in plan.scan_names if name in ("edge_0", "quadrants"))
        assert {at_0, (*at_0, "later_0"), plan.scan_names, ("later_0", "later_90")} <= set(groups)
        assert len(groups) == len(set(groups))


FAR = Origin(time_s=1.7e9, x_mm=2e4, y_mm=-3e5)


def moved_by(plan, time_s, x_mm, y_mm):
    """The same plan with its patterns at another place, and on another clock."""

    def moved(pattern):
        if isinstance(pattern, HalfPlane):
            along_normal = x_mm * np.cos(pattern.normal_rad) + y_mm * np.sin(pattern.normal_rad)
            return replace(pattern, offset_mm=pattern.offset_mm + along_normal)
        if isinstance(pattern, Quadrant):
            return replace(pattern, corner_mm=(pattern.corner_mm[0] + x_mm, pattern.corner_mm[1] + y_mm))
        if isinstance(pattern, Disc):
            return replace(pattern, center_mm=(pattern.center_mm[0] + x_mm, pattern.center_mm[1] + y_mm))
        return pattern

    return replace(
        plan,
        x_mm=plan.x_mm + x_mm,
        y_mm=plan.y_mm + y_mm,
        time_s=plan.time_s + time_s,
        patterns={name: moved(pattern) for name, pattern in plan.patterns.items()},
    )


def over(plan):
    return replace(base(), scene=KnownScene(plan.patterns))


FROM_ORIGIN = [name for name, kind in EFFECTS.items() if getattr(kind, "counts", "")]


@pytest.mark.parametrize("name", FROM_ORIGIN)
def test_an_effect_means_the_same_on_a_recording_far_from_0(name):
    """Its prior, its bank and what each entry does to the readings, as on the recording with clock and place at 0."""
    first_s = PLAN.time_s.min()
    x_mm, y_mm = ((axis.min() + axis.max()) / 2 for axis in (PLAN.x_mm, PLAN.y_mm))
    at_0, there = moved_by(PLAN, -first_s, -x_mm, -y_mm), moved_by(PLAN, *dataclasses.astuple(FAR))
    near, far = (EFFECTS[name].for_extent(Extent(10.0, 60.0, plan)) for plan in (at_0, there))
    assert near.binding.where.origin == Origin()
    expected = (FAR.time_s + first_s, FAR.x_mm + x_mm, FAR.y_mm + y_mm)
    assert dataclasses.astuple(far.binding.where.origin) == pytest.approx(expected)
    np.testing.assert_allclose(far.entries, near.entries, rtol=1e-6)
    u = np.random.default_rng(0).random((50, len(near.prior.names)))
    np.testing.assert_allclose(far.prior.from_unit_cube(u), near.prior.from_unit_cube(u), rtol=1e-6)
    entries = near.entries.reshape(-1, len(near.prior.names))[:40]
    found = over(there).with_effects(far).predict(entries, there)
    np.testing.assert_allclose(found, over(at_0).with_effects(near).predict(entries, at_0), atol=1e-4)
    said, plainly = (sentence_from_samples(effect, entries[:1]) for effect in (far, near))
    assert said.startswith(plainly)
    assert said.removeprefix(plainly).startswith(" (time" if "time" in far.covariates else " (X and Y")


@pytest.mark.parametrize(
    ("start_s", "start_mm", "origin"),
    [
        (0.0, -50.0, Origin()),
        (-999.0, 999.0, Origin()),
        (1001.0, 0.0, Origin(time_s=1001.0)),
        (0.0, 1001.0, Origin(x_mm=1051.0)),
        (-1001.0, -1001.0, Origin()),  # it ends within ten lengths of 0
        (-1101.0, -1101.0, Origin(time_s=-1101.0, x_mm=-1051.0)),
    ],
)
def test_a_recording_within_ten_of_its_lengths_of_0_counts_from_0(start_s, start_mm, origin):
    plan = paper_plan().take(np.arange(101))
    plan = replace(plan, time_s=start_s + np.arange(101.0), x_mm=start_mm + np.arange(101.0), y_mm=np.full(101, 7.0))
    assert Origin.of(plan) == origin
    assert Origin.of(plan.take([3])) == Origin()  # one reading has no length


@pytest.mark.parametrize("name", ["ambient_step", "arm_knock", "gain_jump"])
def test_gates_open_what_each_variant_acts_on(name):
    """Route one: everywhere, and the gate; route two: each variant by itself."""
    effect = EFFECTS[name].for_extent(EXTENT).with_fewer_variants()
    always, opened = effect.variant_masks(PLAN)
    plain = base().predict(np.zeros((1, 0)), PLAN)
    everywhere = base().with_effects(effect).predict(always, PLAN) - plain
    for k in (0, 7, len(opened) - 1):
        variant = effect.variants()[k]
        own = base().with_effects(variant).predict(variant.entries[0], PLAN) - plain
        np.testing.assert_allclose(everywhere * opened[k], own, atol=1e-12)


def test_a_reflection_is_the_same_scene_seen_from_beside():
    reflection = EFFECTS["reflection"].for_extent(EXTENT)
    share, dx_mm, dy_mm = 0.3, 4.0, -2.5
    seen = base().with_effects(reflection).predict(np.array([[share, dx_mm, dy_mm]]), PLAN)
    beside = replace(PLAN, x_mm=PLAN.x_mm + dx_mm, y_mm=PLAN.y_mm + dy_mm)
    nothing = np.zeros((1, 0))
    expected = (1 - share) * base().predict(nothing, PLAN) + share * base().predict(nothing, beside)
    np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_a_slide_that_sticks_lags_ever_more_and_jumps_once_a_period():
    slide = EFFECTS["stick_slip"].for_extent(EXTENT)
    amp_mm, period_mm, phase = 0.8, 20.0, 0.15
    x_mm = np.linspace(-30, 30, 6001)
    poses = Poses(x_mm[None], np.zeros((1, len(x_mm))), np.zeros((1, 1)))
    off = slide.apply(poses, np.array([[amp_mm, period_mm, phase]]), PLAN).x_mm[0] - x_mm
    turns = x_mm / period_mm + phase
    since = turns - np.floor(turns)
    sticks = (since > 0.15) & (since < 0.85)
    np.testing.assert_allclose(off[sticks], amp_mm * (1 - 2 * since[sticks]), atol=0.08 * amp_mm)
    once_more = off[x_mm <= 10.0], off[x_mm >= -10.0]  # a period apart
    np.testing.assert_allclose(*once_more, atol=1e-9)
    assert np.abs(off).max() < 1.05 * amp_mm


def test_places_that_differ_in_the_last_digit_are_one_place():
    """A forward and a backward scan of one line may compute the same places in two ways."""
    out = -50 + 0.1 * np.arange(1001)
    back = np.nextafter(out[::-1], np.inf)
    both = Extent(0.0, 1.0, plan_along(np.append(out, back), np.zeros(2002), np.repeat([0, 1], 1001)))
    for name in ("periodic_position_error", "stick_slip"):
        prior = EFFECTS[name].for_extent(both).prior
        assert prior.from_unit_cube(np.array([[0.5, 0.0, 0.5]]))[0, 1] == pytest.approx(0.3)
    alone = Extent(0.0, 1.0, plan_along(out, np.zeros(1001)))
    there, here = (EFFECTS["missing_tooth"].for_extent(extent).variants() for extent in (both, alone))
    np.testing.assert_allclose([v.entries[0, 0] for v in there], [v.entries[0, 0] for v in here], atol=1e-12)


def test_the_time_of_a_step_is_spread_over_the_readings_between_which_it_may_lie():
    step = VOCABULARY["ambient_step"].for_extent(Extent(0.0, 1.0, there_and_back()))
    theta = np.full((4000, 2), [1.5, 5.0])
    weights = np.array([0.0, 0.25, 0.75, 0.0, 0.0])
    found = step.variants()[2].redraw_by_variant(theta, weights, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(found[:, 0], 1.5)
    assert (found[:, 1].min() > 10.0, found[:, 1].max() < 30.0) == (True, True)
    assert np.mean(found[:, 1] < 20.0) == pytest.approx(0.25, abs=0.03)
    plain = VOCABULARY["backlash"]().redraw_by_variant(theta[:, :1], np.ones(1), rng=np.random.default_rng(0))
    np.testing.assert_array_equal(plain, theta[:, :1])


@pytest.mark.parametrize("name", ["flicker", "periodic_position_error"])
def test_sine_and_cosine_join_into_amplitude_and_phase(name):
    effect = VOCABULARY[name].for_extent(EXTENT)
    entry = effect.entries[3]
    start = effect.start(entry, np.array([1.2, -0.5]))
    rate = entry[0, 1]
    x = np.linspace(0, 7, 50)
    w = 2 * np.pi * (rate if name == "flicker" else 1 / rate)
    both = entry[0, 0] * (1.2 * np.sin(w * x) - 0.5 * np.cos(w * x))
    np.testing.assert_allclose(start[0] * np.sin(w * x + start[2]), both, atol=1e-12)


def test_a_missing_voltage_of_the_battery_is_that_of_the_readings_around_it():
    """At 8 V the gain would jump where the logging stops, and that jump would be the range of the voltages."""
    plan = plan_along(np.arange(8.0), np.zeros(8))
    with_gaps = np.array([np.nan, 7500.0, np.nan, 7400.0, np.nan, np.nan, 7100.0, np.nan])
    plan = replace(plan, covariates={"battery_mv": with_gaps})
    effect = VOCABULARY["battery_sag"].for_extent(Extent(0.0, 1.0, plan))
    assert effect.entries[0, 0, 0] == pytest.approx(0.02 / 0.4)
    below = np.array([0.5, 0.5, 0.55, 0.6, 0.7, 0.8, 0.9, 0.9])
    out = effect.apply(np.full((1, 8), 40.0), np.array([[0.1]]), plan)
    np.testing.assert_allclose(out[0], 40 * (1 - 0.1 * below))
    backwards = plan.take(np.arange(8)[::-1])
    np.testing.assert_allclose(effect.apply(np.full((1, 8), 40.0), np.array([[0.1]]), backwards), out[:, ::-1])
    constant = replace(plan, covariates={"battery_mv": np.where(np.isnan(with_gaps), np.nan, 7500.0)})
    assert VOCABULARY["battery_sag"].for_extent(Extent(0.0, 1.0, constant)) is None


def test_the_extent_of_a_recording_is_its_range_length_and_duration():
    plan = there_and_back()
    extent = Extent.of(Recording(plan, [1.0, 2.0, 5.0, np.nan, 3.0, 2.0]))
    assert (extent.low, extent.high, extent.length_mm, extent.duration_s, extent.gap_s) == (1.0, 5.0, 2.0, 50.0, 10.0)
    with pytest.raises(ParameterError, match="usable readings"):
        Extent.of(Recording(plan, np.full(6, np.nan)))
    with pytest.raises(ParameterError, match="low < high"):
        Extent(2.0, 2.0, plan)


@pytest.mark.parametrize(
    ("x_mm", "said"),
    [
        ([0, 1, 2, 9, 2, 1, 0], "of forward motion are 6.00 ± 0.40 V higher than those of backward motion"),
        ([0, 1, 2, 9], "of forward motion are 3.00 ± 0.20 V higher than those at rest"),
        ([2, 1, 0, 9], "at rest are 3.00 ± 0.20 V higher than those of backward motion"),
    ],
)
def test_hysteresis_compares_the_directions_that_the_recording_has(x_mm, said):
    """The reading at 9 mm is a scan of its own, at rest."""
    scan = ["rest" if x == 9 else "back" if k > 3 else "forth" for k, x in enumerate(x_mm)]
    table = {"x_mm": x_mm, "y_mm": 0.0, "reading": np.arange(len(x_mm)), "scan": scan}
    recording = Recording.from_table(table, patterns=Uniform(0.5), unit="V")
    effect = VOCABULARY["hysteresis"].for_extent(Extent.of(recording))
    assert said in effect.sentence(np.array([3.0]), np.array([0.2]))
