"""Input of a diagnosis, of long recordings a part."""

from dataclasses import replace

import numpy as np
import pytest
from function_null import FunctionNull
from hand_made import sensor_of

from probewise.calibration import predict
from probewise.diagnosis import SensorAndShape, audit_plan, diagnose
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.prepared import prepare, rows_to_diagnose
from probewise.diagnosis.samples import ModelSamples
from probewise.effects import VOCABULARY, Extent
from probewise.priors import Normal, Product
from probewise.recordings import HalfPlane, Instrumentation, Plan, Recording, paper_plan
from probewise.report.covariates import covariate_values
from probewise.scene import Circle

SENSOR: Apparatus = LightSensorApparatus()
RNG = np.random.default_rng(4)


def recording(n=408):
    plan = paper_plan()
    readings = 30.0 + np.sin(plan.x_mm)
    return Recording(plan, readings).take(np.arange(n))


def test_a_covariate_that_is_the_reading_in_another_unit_is_left_out_but_not_what_was_commanded():
    bare = recording()
    columns = {name: 5 * bare.readings + 100 for name in ("adc", "led")}
    prepared = prepare(replace(bare, plan=replace(bare.plan, covariates=columns)), apparatus=SENSOR)
    assert list(prepared.recording.plan.covariates) == ["led"]
    assert "column adc left out: it is the reading in another unit" in prepared.recording.notes[-1]


@pytest.mark.parametrize("lost", [{}, {31: 999.0}, {0: -1000.0, 50: 1e9}])
@pytest.mark.parametrize("step", [1, 7])
def test_readings_too_far_out_for_noise_are_left_out_and_scale_nothing(lost, step):
    """Of 408 readings, or of about 60 with seven times the distance between them."""
    plan = replace(paper_plan().take(np.arange(0, 408, step)), instrumentation=Instrumentation())
    readings = 40 + 15 * np.tanh(plan.x_mm / 9) * np.cos(plan.orientation_rad) + 0.4 * RNG.standard_normal(len(plan))
    bare = prepare(Recording(plan, readings), apparatus=SENSOR)
    readings[list(lost)] = list(lost.values())
    prepared = prepare(Recording(plan, readings), apparatus=SENSOR)
    assert prepared.recording.left_out == tuple(lost)
    assert prepared.everything.readings[list(lost)].tolist() == list(lost.values())
    assert Extent.of(prepared.recording).span == pytest.approx(Extent.of(bare.recording).span, rel=0.2)
    known = prepared.effects["dropouts"].known
    assert (known is None) == (not lost)
    assert known is None or known[1] in lost.values()


def test_too_little_is_few_readings_or_equal_ones():
    whole = recording()
    assert not prepare(whole, apparatus=SENSOR).has_too_little_data
    assert prepare(recording(20), apparatus=SENSOR).has_too_little_data
    assert prepare(replace(whole, readings=np.full(408, 5.0)), apparatus=SENSOR).has_too_little_data


def test_readings_that_a_given_sensor_predicts_worse_than_their_mean_are_noted():
    theta = np.array([1.0, 0.5, 1.5, 0.03, 0.08, -0.005, 11.0, 58.0])
    samples = theta + 1e-3 * RNG.standard_normal((500, 8))
    sensor = sensor_of(samples, noise_sd=np.full(500, 0.5), instrumentation=paper_plan().instrumentation)
    own = predict(sensor, paper_plan()).mean
    for readings, n_notes in ((own, 0), (own + 9.0 * RNG.standard_normal(len(own)), 0), (69.0 - own, 1)):
        found = prepare(Recording(paper_plan(), readings), sensor=sensor, apparatus=SENSOR)
        assert sum("worse than their mean" in note for note in found.recording.notes) == n_notes


def test_a_sensor_of_another_height_reads_the_plan_at_the_height_it_declares():
    """As readings of the calibration's height that command it; the plan itself stays as it was declared."""
    theta = np.array([1.0, 0.5, 1.5, 0.03, 0.08, -0.005, 11.0, 58.0])
    sensor = sensor_of(
        theta + 1e-3 * np.random.default_rng(0).standard_normal((500, 8)),
        noise_sd=np.full(500, 0.5),
        instrumentation=replace(paper_plan().instrumentation, height_mm=16.0),
    )
    whole = recording()
    controls = ("height_mm",)
    high, calibrated = (
        replace(whole.plan, instrumentation=replace(whole.plan.instrumentation, height_mm=height, controls=controls))
        for height in (20.0, 16.0)
    )
    commanded = replace(calibrated, covariates={**calibrated.covariates, "height_mm": np.full(len(calibrated), 20.0)})
    prepared = prepare(replace(whole, plan=high), sensor=sensor, apparatus=SENSOR)
    assert prepared.recording.plan is high
    effect = VOCABULARY["sensor_tilt"].for_extent(Extent(10.0, 60.0, high))
    chain = prepared.null.chain(high, (effect,), n_nodes=16)
    of_calibration = replace(chain, calibrated_height_mm=None)
    tilted = np.concatenate([prepared.null.theta(np.zeros((1, 7))), [[0.3, 0.2]]], axis=1)
    expected = of_calibration.predict(tilted, commanded)
    np.testing.assert_array_equal(chain.predict(tilted, high), expected)
    np.testing.assert_array_equal(chain.predict(tilted, commanded), expected)
    view = chain.simulated_view(tilted, high)
    np.testing.assert_array_equal(chain.readings_from_simulated_view(view, tilted, high), expected)
    np.testing.assert_array_equal(chain.poses(tilted, high).x_mm, of_calibration.poses(tilted, commanded).x_mm)
    assert np.abs(expected - of_calibration.predict(tilted, high)).max() > 1.0
    samples = ModelSamples(chain, np.tile(tilted, (500, 1)), np.full(500, 0.5), 1)
    repaired = samples.fitted_sensor(replace(whole, plan=high), rng=np.random.default_rng(0))
    np.testing.assert_allclose(predict(repaired, high).mean, expected[0])
    over_shape = SensorAndShape.over(prepared.null, Circle(), np.zeros((1, 3))).chain(high, (), n_nodes=16)
    circled = np.concatenate([prepared.null.theta(np.zeros((1, 7))), [[5.0, 5.0, 30.0]]], axis=1)
    np.testing.assert_array_equal(over_shape.predict(circled, high), over_shape.predict(circled, commanded))
    offered = SENSOR.candidate_measurements(high)
    assert {scan.plan.instrumentation.height_mm for scan in offered} == {20.0}
    for scan in offered:
        np.testing.assert_array_equal(scan.plan.covariates.get("height_mm", 25.0), 25.0)
    assert "take scan edge_0 with the sensor at 25 mm" in {scan.description for scan in offered}
    first, lag = np.arange(101), {"lag": VOCABULARY["lag"]}
    audited, as_commanded = (audit_plan(plan.take(first), sensor=sensor, effects=lag) for plan in (high, commanded))
    assert audited.effects == as_commanded.effects
    assert audited.plan.instrumentation.height_mm == 20.0
    assert "height_mm" not in audited.plan.covariates
    assert {cure.plan.instrumentation.height_mm for cure in audited.cures} <= {20.0}


def long_recording(n_scans: int, per_scan: int) -> Recording:
    n = n_scans * per_scan
    plan = Plan.from_arrays(
        x_mm=np.tile(np.linspace(-50, 50, per_scan), n_scans),
        y_mm=0.0,
        scan=[f"s{k // per_scan}" for k in range(n)],
        patterns={"edge": HalfPlane(0.0, 0.0)},
        unit="LEGO",
    )
    return Recording(plan, np.sin(plan.x_mm))


def test_places_of_a_thinned_recording_are_drawn_over_all_of_it_and_scans_have_their_own_numbers():
    """A page of more than 2,400 readings could not be written."""
    whole = long_recording(30, 100)
    noise = np.random.default_rng(0).standard_normal(3000)
    noise[5] = np.nan
    whole = Recording(whole.plan, noise + 2.0 * (whole.plan.scan >= 20))
    level = FunctionNull(lambda p, plan: p["level"] * np.ones((1, len(plan))), Product({"level": Normal(0.0, 10.0)}))
    known = {"ambient_step": VOCABULARY["ambient_step"]}
    found = diagnose(whole, null=level, effects=known, rng=np.random.default_rng(0))
    rows = rows_to_diagnose(whole)
    rows = rows[whole.usable[rows]]
    assert f"(From {len(rows)} of 2999 readings, evenly spread.)" in found.reason
    (time,) = (place for place in found.where if place.figure_name == "witness_time.svg")
    np.testing.assert_array_equal(covariate_values(found, time)[rows], whole.plan.time_s[rows])
    (scan,) = (place for place in found.where if place.covariate == "scan")
    np.testing.assert_array_equal(covariate_values(found, scan)[rows], whole.plan.scan[rows])
    assert np.isfinite(covariate_values(found, scan)).sum() == len(rows)
    np.testing.assert_array_equal(scan.curve_at, np.unique(whole.plan.scan[rows]))
