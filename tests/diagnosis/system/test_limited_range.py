"""An instrument with a declared range, which reads an end of it where the signal and its noise are beyond."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import Linearised, laplace_evidence
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.held_out import held_out_gain
from probewise.diagnosis.left_out import readings_near_ends, recording_from_table
from probewise.diagnosis.noise_law import white_noise, white_noise_of_recording
from probewise.diagnosis.noise_models import NoiseModel
from probewise.effects import Extent
from probewise.effects.noise import CorrelatedNoise, Dropouts
from probewise.errors import ParameterError
from probewise.systems import FittedSystem, RunTable, Simulator, System, predict_system, table_for

FULL, BACK, EXPONENT, SD, HIGH = 1250.0, 12.0, 2.0, 6.0, 1000.0
TRUE = np.array([FULL, BACK, EXPONENT])
LAMP = Simulator(
    "lux",
    "lx",
    {"full": (0, 5000), "back": (0, 100), "expo": (1, 3)},
    simulate=lambda p, u: p["back"] + p["full"] / u["d_m"] ** p["expo"],
    noise={"sd": SD, "range": (0, HIGH)},
)
WITHOUT_RANGE = replace(LAMP, noise={"sd": SD})


def _lamp(seed=1, n=150, most=HIGH):
    rng = np.random.default_rng(seed)
    d = rng.uniform(0.8, 4.0, n)
    return RunTable({"d_m": d, "lux": np.clip(BACK + FULL / d**EXPONENT + rng.normal(0, SD, n), 0, most)})


def _fitted(simulator, table):
    prepared = prepare_system(simulator, table, with_effects=False)
    about = prepared.apparatus.about
    law = white_noise_of_recording(prepared.recording)
    found = fit(Model(about.system, (), prepared.recording.plan), prepared.recording, about.z, law)
    return prepared, found, law


def test_readings_at_a_declared_end_do_not_bend_the_fit_or_widen_its_noise():
    prepared, found, law = _fitted(LAMP, _lamp())
    theta = prepared.null.theta(found.z[None, :])[0]
    covariance = np.linalg.inv(found.slopes.T @ found.slopes / found.sd**2 + np.eye(3))
    off = found.z - _coordinates_of(prepared.null, TRUE)
    assert off @ np.linalg.solve(covariance, off) < 21.1  # chi-square of 3 at 1e-4
    assert abs(theta[2] - EXPONENT) < 0.1
    assert abs(found.sd / SD - 1) < 4 / np.sqrt(2 * law.n_kept)
    recording = recording_from_table(WITHOUT_RANGE, _lamp())
    bent = fit(Model(System.of(WITHOUT_RANGE, _lamp()), (), recording.plan), recording, found.z, white_noise(150))
    assert abs(bent.model.sensor.theta(bent.z[None, :])[0, 2] - EXPONENT) > 0.3


def _coordinates_of(system, theta):
    return ndtri(system.prior.to_unit_cube(theta[None, :]))[0]


def test_readings_at_an_end_are_no_lost_readings():
    """Once 7 % of such readings were dropouts of probability .99."""
    prepared, found, law = _fitted(LAMP, _lamp())
    dropouts = Dropouts.for_extent(Extent.of(prepared.recording))
    white, lost = (laplace_evidence(found, NoiseModel(own, prepared.recording)) for own in ((), (dropouts,)))
    assert law.n_kept < len(found.residuals)
    assert not lost.nodes.laws or lost.log_z < white.log_z


def test_a_lost_reading_that_is_at_an_end_is_still_found_lost():
    table = _lamp()
    lux, far = np.array(table.columns["lux"]), np.flatnonzero(table.columns["d_m"] > 2)[:5]
    lux[far] = HIGH
    prepared, found, _ = _fitted(LAMP, table.with_columns({"lux": lux}))
    found = fit(found.model, prepared.recording, _coordinates_of(prepared.null, TRUE), _without(prepared, far))
    dropouts = Dropouts.for_extent(Extent.of(prepared.recording))
    white, lost = (laplace_evidence(found, NoiseModel(own, prepared.recording)) for own in ((), (dropouts,)))
    assert lost.log_z > white.log_z + 10


def _without(prepared, rows):
    lost = np.isin(prepared.usable_rows, rows)
    return replace(white_noise_of_recording(prepared.recording), lost=lost)


def test_a_signal_that_rests_at_an_end_has_no_offset():
    """By night half of the noise is cut off; what is left has a mean of 0.4 sds, which is no signal."""
    rng = np.random.default_rng(3)
    light = 800 * np.maximum(0.0, np.sin(np.arange(300) / 12))
    lux = np.maximum(0.0, 0.1 * light + rng.normal(0, 3.0, 300))
    meter = Simulator(
        "lux",
        "lx",
        {"gain": (0, 1), "offset": ("normal", 0, 10)},
        simulate=lambda p, u: p["offset"] + p["gain"] * u["light"],
        noise={"sd": 3.0, "range": (0, None)},
    )
    prepared, found, _ = _fitted(meter, RunTable({"light": light, "lux": lux}))
    _, offset = prepared.null.theta(found.z[None, :])[0]
    covariance = np.linalg.inv(found.slopes.T @ found.slopes / found.sd**2 + np.eye(2))
    assert abs(offset) < 4 * 10 * np.sqrt(covariance[1, 1])
    assert abs(found.sd / 3.0 - 1) < 4 / np.sqrt(2 * 150)
    assert any(
        "left out near an end of the declared range, which cuts off the noise" in note
        for note in prepared.recording.notes
    )


def test_readings_that_stand_below_the_declared_end_stay():
    """Those of a meter that stops at 900 lx: the fit does not explain them by the end at 1000 lx."""
    table = _lamp(most=900.0)
    recording = recording_from_table(LAMP, table)
    system = System.of(LAMP, table)
    model, law = Model(system, (), recording.plan), white_noise_of_recording(recording)
    found = fit(model, recording, _coordinates_of(system, TRUE), law, max_steps=0)
    assert (table.columns["lux"] == 900.0).sum() > 10
    assert not readings_near_ends(system, found, SD, recording)[table.columns["lux"] == 900.0].any()


@pytest.mark.parametrize(("reading", "expected"), [(np.nan, HIGH), (HIGH, HIGH), (1000.4, 1000.4), (700.0, 1262.0)])
def test_a_prediction_beyond_an_end_is_limited_unless_a_reading_within_was_recorded(reading, expected):
    """With a step of 1, the reading of 1000.4 is at the end, and the residual there is 0."""
    lamp = replace(LAMP, noise={"range": (0, HIGH), "step": 1.0})
    table = RunTable({"d_m": np.array([1.0, 2.0]), "lux": np.array([reading, 300.0])})
    predicted = System.of(lamp, table).chain(table, ()).predict(TRUE[None, :], table)
    np.testing.assert_allclose(predicted, [[expected, BACK + FULL / 4]])


def test_an_advised_row_beyond_the_range_tells_nothing():
    plan = RunTable({"d_m": np.array([0.9, 1.0, 2.0])})
    system = System.of(LAMP, plan)
    _, slopes = Model(system, (), plan).predict_and_differentiate(_coordinates_of(system, TRUE))
    assert not slopes[:2].any()
    assert slopes[2].all()


def test_a_reading_beyond_an_end_takes_no_change_that_is_added():
    _, found, law = _fitted(LAMP, _lamp())
    problem = Linearised.of(found, law)
    beyond = found.residuals == 0
    assert beyond.sum() > 5
    assert not problem.whiten(np.ones((len(beyond), 1)))[beyond].any()
    assert problem.whiten(np.ones((len(beyond), 1)))[~beyond].all()


def test_a_predicted_mean_is_within_the_range_and_a_reading_at_its_end_is_sure_there():
    samples = np.tile(TRUE, (500, 1))
    model = FittedSystem(LAMP, ("full", "back", "expo"), samples, np.full(500, SD))
    table = RunTable({"d_m": np.array([0.8, 1.0, 2.0]), "lux": np.array([HIGH, 700.0, 320.0])})
    found = predict_system(model, table, rng=np.random.default_rng(1))
    np.testing.assert_allclose(found.mean, [HIGH, HIGH, BACK + FULL / 4])
    np.testing.assert_allclose(found.log_density[0], 0.0, atol=1e-9)
    assert found.log_density[1] < -1000
    assert (found.sd > 0).all()


def test_a_reading_half_a_step_beyond_an_end_is_at_it_and_a_farther_one_is_an_error_code():
    lamp = replace(LAMP, noise={"range": (0, HIGH), "step": 1.0})
    table = RunTable({"d_m": np.arange(1.0, 6.0), "lux": np.array([HIGH, 1000.4, 999.4, 1001.0, 9999.0])})
    recording = recording_from_table(lamp, table)
    assert recording.usable.tolist() == [True, True, True, False, False]
    assert recording.censored.tolist() == [True, True, False, False, False]


def test_the_noise_of_a_reading_at_an_end_is_correlated_with_none():
    prepared, found, _ = _fitted(LAMP, _lamp())
    effect = CorrelatedNoise.for_extent(Extent.of(prepared.recording))
    (law,) = NoiseModel((effect,), prepared.recording).laws_at(np.array([[0.5]]), found.predicted)
    at_end = np.flatnonzero(law.censored)
    assert at_end.size > 5
    assert not law.carry[at_end].any()
    assert not law.carry[at_end[at_end < len(law.carry) - 1] + 1].any()
    assert (law.carry == 0.5).any()


@pytest.mark.parametrize("carry", [0.0, 0.5], ids=["white", "correlated"])
def test_a_held_out_reading_at_an_end_gains_nothing_by_another_noise(carry):
    """Beyond the end the probability to read it is 1 whatever the noise."""
    prepared, found, law = _fitted(LAMP, _lamp())
    law = replace(law, carry=np.where(law.censored | np.append(True, law.censored[:-1]), 0.0, carry))
    with_tail = replace(law, share=0.2, times=5.0)
    parts = (found.residuals == 0).astype(np.int64), ("others", "at the end")
    gain = held_out_gain(found, found, prepared.recording, with_tail, parts, law_of_null=law)
    assert abs(dict(gain.by_scan)["at the end"]) < 1e-12


def test_readings_that_are_all_at_the_ends_are_refused():
    table = _lamp().with_columns({"lux": np.where(np.arange(150) % 2, HIGH, 0.0)})
    with pytest.raises(ParameterError, match="readings within the declared range is 0; allowed: 12 or more"):
        prepare_system(LAMP, table)


def test_an_end_that_no_reading_reaches_leaves_nothing_out_however_wrong_the_simulator_is():
    rng = np.random.default_rng(2)
    x, w = rng.uniform(0, 10, 300), rng.uniform(0, 6, 300)
    line = {"y": 10 + 4 * x + 28 * np.sin(w) + rng.normal(0, 0.2, 300), "x": x}
    simulator = Simulator(
        "y", "V", {"a": (-50, 50), "b": (0, 10)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"],
        noise={"range": (-30, 90)},
    )  # fmt: skip
    assert prepare_system(simulator, table_for(simulator, line), with_effects=False).recording.usable.all()


def test_a_walk_is_no_explanation_of_readings_at_an_end_that_the_simulator_does_not_predict_there():
    rng = np.random.default_rng(0)
    x, w = np.tile(np.linspace(0, 10, 60), 2), np.repeat([0.0, 1.0], 60)
    y = np.minimum(2 + x + 6 * w * (x > 6) + rng.normal(0, 0.3, 120), 12.5)
    simulator = Simulator(
        "y", "V", {"a": (-10, 10), "b": (0, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"],
        noise={"sd": 0.3, "range": (0, 12.5)},
    )  # fmt: skip
    prepared = prepare_system(simulator, table_for(simulator, {"x": x, "w": w, "y": y}))
    assert prepared.recording.censored.sum() > 10
    assert "random_walk" not in prepared.effects


def test_too_few_readings_within_the_range_are_refused_in_one_line():
    rng = np.random.default_rng(4)
    x = np.linspace(0, 10, 60)
    y = np.where(np.arange(60) < 5, 1 + rng.random(60), 0.0)
    simulator = Simulator(
        "y", "V", {"a": (-10, 10), "b": (0, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"],
        noise={"range": (0, None)},
    )  # fmt: skip
    with pytest.raises(ParameterError, match="readings within the declared range is 5; allowed: 12 or more"):
        prepare_system(simulator, table_for(simulator, {"x": x, "y": y}))


def test_a_rounded_reading_at_a_declared_end_is_no_stop():
    rng = np.random.default_rng(5)
    x = np.linspace(0, 10, 300)
    y = np.round(np.minimum(1 + 0.5 * x + rng.normal(0, 0.05, 300), 4.0951), 2)
    simulator = Simulator(
        "y", "V", {"a": (-10, 10), "b": (0, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"],
        noise={"range": (0, 4.0951), "step": 0.01},
    )  # fmt: skip
    prepared = prepare_system(simulator, table_for(simulator, {"x": x, "y": y}), with_effects=False)
    assert prepared.apparatus.stop is None
    assert prepared.recording.censored.sum() > 50
