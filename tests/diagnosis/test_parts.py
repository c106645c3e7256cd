"""The parts of the diagnosis, each against a second route to the same number."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad

from probewise.arm import readings_of_recording, recording_of_readings
from probewise.diagnosis import templates as templates_module
from probewise.diagnosis.evidence import LEAST_VISIBLE, SCALES, Linearised
from probewise.diagnosis.fit import Fit, Model, effect_coordinates, effect_values
from probewise.diagnosis.light_sensor import LightSensorApparatus, rows_as_next_scan
from probewise.diagnosis.locate import Covariate, places_of_effect
from probewise.diagnosis.noise import NoiseLaw, noise_statistics, white_noise
from probewise.diagnosis.prepared import join, join_plans
from probewise.diagnosis.search.hypotheses import Refits
from probewise.diagnosis.sensors import default_sensor, sensor_from_samples, theta_to_natural, with_free_form
from probewise.diagnosis.templates import (
    EffectTemplates,
    TemplateBank,
    TemplateCache,
    log_bayes_factors_of_pairs,
    templates_of_effect,
)
from probewise.effects import VOCABULARY, Extent
from probewise.effects.effect import Where
from probewise.effects.reference import candidate_scan_groups
from probewise.errors import ParameterError
from probewise.recordings import HalfPlane, Plan, Recording, Uniform, read_recording, two_way_plan, write_recording
from probewise.recordings.plans import with_jittered_times
from probewise.sensor import footprint_of, mixture_parameter_names

EXTENT = Extent(10.0, 60.0, with_jittered_times(two_way_plan(), rng=np.random.default_rng(0)))


def line(n: int = 12, *, scans: int = 2, unit: str = "LEGO") -> Recording:
    plan = Plan.from_arrays(
        x_mm=np.tile(np.arange(n, dtype=float), scans),
        y_mm=0.0,
        scan=[f"s{k // n}" for k in range(n * scans)],
        patterns={"edge": HalfPlane(0.0, 0.0)},
        unit=unit,
    )
    return Recording(plan, np.linspace(1.0, 2.0, n * scans), source=f"{unit}.csv")


def declared(recording: Recording, name: str, covariates=None, **instrumentation) -> Recording:
    """The recording as that of a file, with what its description declares."""
    plan = replace(recording.plan, instrumentation=replace(recording.plan.instrumentation, **instrumentation))
    return Recording(replace(plan, covariates=covariates or {}), recording.readings, name)


def placed(effect, change, without, plan, covariates):
    shows_in = LightSensorApparatus().covariate_of_effect(effect, change, without, plan, covariates)
    scans = next((c for c in covariates if c.name == "scan"), None)
    return places_of_effect(effect, change, shows_in, scans, plan, change, p_value=0.001, size=8.0)


@pytest.mark.parametrize("n_gaussians", [1, 2, 3])
def test_sensor_coordinates_round_trip(n_gaussians):
    sensor = default_sensor(EXTENT, n_gaussians)
    z = np.random.default_rng(n_gaussians).normal(size=(50, sensor.n_params))
    theta = sensor.theta(z)
    assert theta.shape == (50, 6 * n_gaussians + 2)
    np.testing.assert_allclose(sensor.z(theta), z, atol=1e-8)
    # The footprint's own conversion gives the same shares and widths.
    footprint = footprint_of(theta[:, :-2], n_gaussians)
    np.testing.assert_allclose(footprint.weight.sum(axis=-1), 1.0)
    natural = theta_to_natural(theta, n_gaussians)
    blocks = natural[:, n_gaussians - 1 : -2].reshape(50, n_gaussians, 5)
    np.testing.assert_allclose(np.sqrt(footprint.var_u[:, 0]), np.exp(blocks[..., 2]))
    rho = footprint.cov_uv / np.sqrt(footprint.var_u * footprint.var_v)
    np.testing.assert_allclose(rho[:, 0], np.tanh(blocks[..., 4]))


def test_an_earlier_posterior_becomes_the_prior_of_the_same_spread():
    sensor = default_sensor(EXTENT, 1)
    rng = np.random.default_rng(0)
    theta = sensor.theta(0.02 * rng.normal(size=(4000, sensor.n_params)))
    names = ("a_1", "u_1", "v_1", "A_1", "B_1", "C_1", "I_min", "I_max", "backlash.width_mm")
    theta = np.concatenate([theta, np.ones((4000, 1))], axis=1)
    prior = sensor_from_samples(SimpleNamespace(names=names, samples=theta))
    drawn = prior.theta(rng.normal(size=(4000, 7)))
    np.testing.assert_allclose(drawn[:, 1:].std(axis=0), theta[:, 1:8].std(axis=0), rtol=0.06)
    with pytest.raises(ParameterError, match=r"sensor\.names"):
        sensor_from_samples(SimpleNamespace(names=("x",), samples=np.zeros((2, 1))))


def test_an_earlier_free_form_becomes_the_prior_of_the_same_spread():
    free = with_free_form(default_sensor(EXTENT, 1))
    rng = np.random.default_rng(0)
    z = 0.02 * rng.normal(size=(4000, free.n_params))
    theta = free.theta(z)
    np.testing.assert_allclose(free.z(theta), z, atol=1e-8)
    names = (*mixture_parameter_names(free.n_gaussians), "I_min", "I_max")
    prior = sensor_from_samples(SimpleNamespace(names=names, samples=theta))
    assert prior.is_free_form
    drawn = prior.theta(rng.normal(size=(4000, free.n_params)))
    spread = theta.std(axis=0)
    np.testing.assert_allclose(drawn.std(axis=0)[spread > 1e-9], spread[spread > 1e-9], rtol=0.08)


def test_templates_of_a_variant_are_what_its_scans_change():
    """Route one: in its own scans alone; route two: the whole plan with and without it."""
    plan = two_way_plan()
    sensor = default_sensor(EXTENT, 1)
    model = Model(sensor, (), plan)
    z = np.full(sensor.n_params, 0.2)
    predicted = model.predict(z[None, :])[0]
    usable = np.flatnonzero(np.arange(len(plan)) % 7)
    found = Fit(model, z, predicted[usable], np.zeros(len(usable)), np.zeros((len(usable), 7)), 1.0, 0.0)
    for name in ("scan_misplacement", "height_offset", "ambient_step", "lag", "edge_shadow"):
        effect = VOCABULARY[name].for_extent(EXTENT)
        templates = templates_of_effect(found, effect, usable)
        assert len(templates.columns) == len(templates.settings) == len(templates.choice)
        for at in range(0, len(templates.choice), 9):
            richer = model.with_effect(templates.variant_of_entry(at))
            theta = np.concatenate([sensor.theta(z[None, :]), templates.settings[at]], axis=1)
            change = richer.chain.predict(theta, plan)[0] - predicted
            np.testing.assert_allclose(templates.columns[at][:, 0], change[usable], atol=1e-7)


@pytest.mark.parametrize("name", VOCABULARY)
def test_effect_scores_invert_effect_values(name):
    effect = VOCABULARY[name].for_extent(EXTENT)
    z = np.random.default_rng(2).uniform(-4, 4, size=(20, len(effect.prior.names)))
    np.testing.assert_allclose(effect_coordinates(effect, effect_values(effect, z)), z, atol=1e-6)


def test_a_block_bayes_factor_is_the_integral_over_its_amplitude():
    """Route two: quadrature over the amplitude of the Student-t likelihood, for each scale."""
    rng = np.random.default_rng(3)
    n, p = 30, 2
    slopes = rng.normal(size=(n, p)) * 1e4  # so informative that the parameters' prior plays no part
    template = rng.normal(size=(n, 1))
    r = rng.normal(size=n) + 0.5 * template[:, 0]
    basis, _ = np.linalg.qr(np.concatenate([slopes, np.eye(p)]))
    augmented = np.concatenate([r, np.zeros(p)])
    residual = augmented - basis @ (basis.T @ augmented)
    problem = Linearised(basis, residual, white_noise(n), 1.0, n)
    found = TemplateBank.of([template], ["a"]).log_bayes_factors(problem)[0, 0]

    unit = problem.project(template / np.sqrt(np.mean(template**2)))[:, 0]
    rss = float(residual @ residual)
    total, gain = 0.0, float(unit @ unit)
    visible = SCALES[SCALES * math.sqrt(gain) >= LEAST_VISIBLE]
    assert 0 < len(visible) < len(SCALES)
    for scale in visible:
        # Amplitude in units of the noise sd, whose marginal makes the likelihood (1 + ...)^(-n/2) at fixed ratio.
        t = float(unit @ residual) / math.sqrt(gain)

        def density(log_s, t=t, gain=gain, scale=scale):
            s2 = math.exp(2 * log_s)
            spread = s2 * (1 + scale**2 * gain)
            log_l = -0.5 * (rss - t * t) / s2 - 0.5 * t * t / spread - (n - 1) * log_s - 0.5 * math.log(spread)
            return math.exp(log_l + 0.5 * n + 0.5 * n * math.log(rss / n))

        def null(log_s):
            return math.exp(-0.5 * rss / math.exp(2 * log_s) - n * log_s + 0.5 * n + 0.5 * n * math.log(rss / n))

        center = 0.5 * math.log(rss / n)
        total += quad(density, center - 3, center + 3)[0] / quad(null, center - 3, center + 3)[0]
    assert found == pytest.approx(math.log(total / len(visible)), abs=1e-6)


_ROW = np.arange(60)
_CARRY, _LOST = np.where(_ROW % 10 > 0, 0.3, 0.0), _ROW == 5  # memory within runs of ten, and a lost reading
_LAWS = {
    "memory": NoiseLaw(np.ones(60), _CARRY, _LOST),
    "memory of unlike readings": NoiseLaw(np.exp(0.2 * np.sin(_ROW)), _CARRY, _LOST),
    "memory within interleaved runs": NoiseLaw(
        np.ones(60), np.where(_ROW > 1, 0.3, 0.0), _LOST, before=np.maximum(_ROW - 2, 0)
    ),
    "a walk": NoiseLaw(np.ones(60), np.zeros(60), _LOST, walk=np.full(60, 0.2)),
}


def _problem_and_templates(law=_LAWS["memory of unlike readings"]):
    """Templates of one to three columns about a fit of four parameters."""
    rng = np.random.default_rng(4)
    n, p = 60, 4
    templates = [rng.normal(size=(n, k)) for k in (1, 2, 1, 3)]
    basis, _ = np.linalg.qr(rng.normal(size=(n + p, p)))
    residuals = rng.normal(size=(n + p, 3))
    residuals -= basis @ (basis.T @ residuals)
    return Linearised(basis, residuals[:, 0], law, 1.3, n), residuals, templates


@pytest.mark.parametrize("law", _LAWS.values(), ids=_LAWS)
def test_a_pair_weighs_as_one_template_of_all_its_columns(law):
    """Route one: columns that are whitened; route two: products that take the whitening's adjoint and precision."""
    problem, _, templates = _problem_and_templates(law)
    banks = {name: [template] for name, template in zip("abcd", templates, strict=True)}
    singles = {name: TemplateBank.of(own, [name]).log_bayes_factors(problem)[:, 0] for name, own in banks.items()}
    for (a, b), found in log_bayes_factors_of_pairs(problem, banks, singles).items():
        both = np.hstack([banks[a][0], banks[b][0]])
        assert found == pytest.approx(TemplateBank.of([both], ["both"]).log_bayes_factors(problem)[0, 0])


def test_templates_about_the_latest_fit_alone_are_remembered_where_they_are_many(monkeypatch):
    def four(found, effect, usable):
        return EffectTemplates((np.ones((4, 1)),), (np.ones((1, 1)),), (effect,), np.zeros(1, dtype=np.int64))

    monkeypatch.setattr(templates_module, "templates_of_effect", four)
    monkeypatch.setattr(templates_module, "_MOST_REMEMBERED", 4)
    cache, effects = TemplateCache(np.arange(4)), [VOCABULARY["offset_drift"].for_extent(EXTENT)]
    for about in (first := object(), second := object()):
        bank = cache.coarse_bank(about, effects)
        assert cache.coarse_bank(about, effects) is bank
        assert first in cache.known or about is second
    assert [*cache.known] == [about for about, _ in cache.banks] == [second]
    passing = [each.labels for each in cache.passing_banks(second, effects)]
    assert passing == [bank.labels]


def test_the_refit_of_a_null_under_the_simplest_noise_serves_the_nulls_that_are_no_better():
    def weighed(log_z):
        return SimpleNamespace(evidence={(): SimpleNamespace(log_z=log_z)})

    refits = Refits(None, SimpleNamespace(certain=()), TemplateCache(np.arange(4)), plain=[weighed(-10.0)])
    assert refits.null_under_simplest_noise(weighed(-11.0)) is refits.plain[0]


def test_an_effect_is_where_it_has_half_its_strength():
    """Along the scan that it was seen in, not along the one that went across it."""
    x_mm, there = np.arange(-50.0, 51.0), np.zeros(101)
    both = np.concatenate([x_mm, there]), np.concatenate([there, x_mm])
    plan = replace(line(101).plan, x_mm=both[0], y_mm=both[1])
    change = 2.0 * np.exp(-0.5 * ((both[0] - 10) ** 2 + both[1] ** 2) / 8**2)
    change[101:] *= 0.9
    glint = VOCABULARY["glint"].for_extent(EXTENT)
    across = Covariate("place", both[1][101:], np.arange(101, 202))
    (found,) = placed(glint, change, 0 * change, plan, [across])
    half = 8 * math.sqrt(2 * math.log(2))
    assert (found.covariate, found.scan) == ("place", None)
    assert found.start == pytest.approx(10 - half, abs=1)
    assert found.end == pytest.approx(10 + half, abs=1)


def test_what_sets_in_at_a_level_is_at_what_would_be_read_without_it():
    """Readings from 10 to 60 that never rise above 50: a model without a ceiling, fitted to them, tops at some 52."""
    without = np.linspace(10.0, 60.0, 101)
    change = np.minimum(without, 50.0) - without
    level = Covariate("level", np.minimum(without, 52.0), np.arange(101))
    effect = VOCABULARY["saturation"].for_extent(EXTENT)
    plan = line(101, scans=1).plan
    (found,) = placed(effect, change, without, plan, [level])
    assert found.covariate == "level"
    assert found.without_effect
    np.testing.assert_array_equal(found.values, without)
    assert found.start == pytest.approx(50.5, abs=0.6)
    assert found.end == pytest.approx(60.0, abs=1e-9)


def test_an_effect_of_one_mounting_is_in_the_scans_that_feel_it_the_strongest_first():
    """A scan over white looks the same from any angle: nothing shows there, though its mounting is turned too."""
    plan = line(6, scans=3).plan
    scan = Covariate("scan", np.repeat([0.0, 1.0, 2.0], 6), np.arange(18), groups=True)
    effect = VOCABULARY["scan_angle_error"].for_extent(EXTENT)
    effect = replace(effect, binding=replace(effect.binding, where=Where(scans=plan.scan_names)))
    change = np.repeat([0.5, 0.001, -2.0], 6)
    found = placed(effect, change, 0 * change, plan, [scan])
    assert [place.scan for place in found] == ["s2", "s0"]


def test_noise_statistics_see_memory_tails_and_level():
    rng = np.random.default_rng(0)
    n = 2000
    level = np.linspace(0, 1, n)
    plain = rng.normal(size=n)
    memory = np.convolve(plain, [1, 0.5], mode="same")
    tails = rng.standard_t(3, size=n)
    louder = plain * (1 + 3 * level)
    lag, kurtosis, tilt = noise_statistics(np.stack([plain, memory, tails, louder], axis=1), np.arange(n) - 1, level)
    assert abs(lag[0]) < 0.1 < lag[1]
    assert abs(kurtosis[0]) < 0.5 < kurtosis[2]
    assert abs(tilt[0]) < 5 < tilt[3]


def test_joined_recordings_keep_scans_and_patterns_apart():
    first, second = line(4), line(3)
    other = replace(second.plan, patterns={"edge": Uniform(1.0)})
    third = Recording(first.plan, first.readings + 1.0)
    joined = join([first, Recording(other, second.readings), third])
    assert len(joined) == 8 + 6 + 8
    assert joined.plan.scan_names == ("s0", "s1", "s0 (2)", "s1 (2)", "s0 (3)", "s1 (3)")
    assert joined.plan.pattern_names == ("edge", "edge (2)")
    np.testing.assert_array_equal(joined.plan.pattern, [0] * 8 + [1] * 6 + [0] * 8)
    assert joined.plan.patterns["edge (2)"] == Uniform(1.0)
    assert joined.plan.sessions == (0, 0, 1, 1, 2, 2)
    assert join([joined, line(2)]).plan.sessions == (0, 0, 1, 1, 2, 2, 3, 3)
    assert joined.plan.take(joined.plan.scan == 3).sessions == (1,)
    assert join([first]) is first


def test_mountings_stay_apart_through_a_file_and_whoever_reads_on_mounts_anew(tmp_path):
    joined = join([line(12), replace(line(12), readings=np.linspace(1.0, 3.0, 24))])
    write_recording(joined, tmp_path / "recording.csv")
    back = read_recording(tmp_path / "recording.csv")
    groups = candidate_scan_groups(joined.plan)
    assert ("s0 (2)", "s1 (2)") in groups
    assert candidate_scan_groups(back.plan) == groups
    assert candidate_scan_groups(replace(joined.plan, sessions=())) != groups
    more = rows_as_next_scan(joined.plan, np.arange(24, 36), "more")
    assert more.sessions == ()
    assert join_plans([joined.plan, more]).sessions == (0, 0, 1, 1, 2)
    assert join_plans([more, more]).sessions == ()
    readings = readings_of_recording(joined)
    assert recording_of_readings(joined.plan, readings).plan.sessions == ()


def test_a_recording_is_not_counted_twice():
    with pytest.raises(ParameterError, match=r"number 1\) and .* \(number 3"):
        join([line(4), line(3), line(4)])


def test_a_covariate_that_a_later_recording_lacks_stays_as_it_was_last_known():
    first, second = line(4), line(3)
    battery = np.append(np.linspace(8300.0, 8290.0, len(first) - 1), np.nan)
    warm = declared(second, "two.csv", {"heat_c": np.full(len(second), 21.0)})
    joined = join([declared(first, "one.csv", {"battery_mv": battery}), warm])
    assert (joined.plan.covariates["battery_mv"][len(first) :] == 8290.0).all()
    assert np.isnan(joined.plan.covariates["battery_mv"][len(first) - 1])
    assert set(joined.plan.covariates) == {"battery_mv"}
    assert [note.split(":")[0] for note in joined.notes] == [
        "two.csv has no column battery_mv",
        "column heat_c of two.csv left out",
    ]


def test_a_range_or_height_that_a_later_recording_declares_in_another_way_is_told():
    low, high = declared(line(4), "one.csv", max=5.0), declared(line(3), "two.csv", max=None, height_mm=20.0)
    assert join([low, high]).notes == (
        "two.csv declares no value for max: taken is 5, that of one.csv",
        "two.csv declares 20 for height_mm: taken is none, as one.csv",
    )
    assert join([low, replace(low, readings=low.readings + 0.1)]).notes == ()


def test_recordings_of_other_heights_are_joined_each_at_its_own():
    """The second as a plan of the first's height that commands 20 mm, except where it commands a height itself."""
    first, second = line(4), line(3)
    lifted = np.where(np.arange(len(second)) < 4, 25.0, np.nan)
    low = declared(first, "one.csv", height_mm=14.0)
    high = declared(second, "two.csv", {"height_mm": lifted}, height_mm=20.0)
    joined = join([low, high])
    assert joined.plan.instrumentation.height_mm == 14.0
    np.testing.assert_array_equal(
        joined.plan.covariates["height_mm"],
        np.concatenate([np.full(len(first), np.nan), np.where(np.isnan(lifted), 20.0, lifted)]),
    )
    told = "two.csv declares 20 for height_mm, one.csv 14: readings are taken to be at the height of each"
    assert joined.notes == (told,)
    other_way = join([high, low]).plan
    assert other_way.instrumentation.height_mm == 20.0
    np.testing.assert_array_equal(other_way.covariates["height_mm"][len(second) :], 14.0)
    assert "height_mm" not in join([low, replace(low, readings=low.readings + 0.1)]).plan.covariates


def test_recordings_of_other_units_are_not_joined():
    with pytest.raises(ParameterError, match="volt"):
        join([line(), line(unit="volt")])
