"""What is to be diagnosed, before anything is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.calibration import FittedSensor, predict
from probewise.diagnosis import SensorAndShape, audit_plan
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.prepared import prepare
from probewise.diagnosis.samples import ModelSamples
from probewise.effects import VOCABULARY, Extent
from probewise.errors import ParameterError
from probewise.recordings import Instrumentation, Recording, paper_plan
from probewise.scene import Circle
from probewise.sensor import SSFField, mixture_parameter_names

SENSOR: Apparatus = LightSensorApparatus()
RNG = np.random.default_rng(4)


def recording(n=408):
    plan = paper_plan()
    readings = 30.0 + np.sin(plan.x_mm)
    return Recording(plan, readings).take(np.arange(n))


def test_effects_are_those_that_could_show_here():
    prepared = prepare(recording(), apparatus=SENSOR)
    assert "backlash" in prepared.effects
    assert "arm_knock" in prepared.effects  # out of vocabulary, by its formula
    assert "orientation_error" not in prepared.effects  # the SSF takes it up
    assert prepared.noise_effect_names >= {"outliers", "drifting_noise"}
    assert not prepared.is_thinned


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
    known = getattr(prepared.effects["dropouts"], "lost", ())
    assert known == tuple(lost.values())


def test_too_little_is_few_readings_or_equal_ones():
    whole = recording()
    assert not prepare(whole, apparatus=SENSOR).has_too_little_data
    assert prepare(recording(20), apparatus=SENSOR).has_too_little_data
    assert prepare(replace(whole, readings=np.full(408, 5.0)), apparatus=SENSOR).has_too_little_data


def test_values_of_usable_readings_are_spread_over_all_rows():
    whole = recording(30)
    holes = replace(whole, readings=np.where(np.arange(30) % 2, np.nan, whole.readings))
    spread = prepare(holes, apparatus=SENSOR).expand_usable_to_all_rows(np.arange(15.0))
    np.testing.assert_array_equal(spread[::2], np.arange(15.0))
    assert np.isnan(spread[1::2]).all()


def test_a_sensor_of_another_height_reads_the_plan_at_the_height_it_declares():
    """As readings of the calibration's height that command it; the plan itself stays as it was declared."""
    names, theta = (
        (*mixture_parameter_names(1), "I_min", "I_max"),
        np.array([1.0, 0.5, 1.5, 0.03, 0.08, -0.005, 11.0, 58.0]),
    )
    sensor = FittedSensor(
        names=names,
        samples=theta + 1e-3 * np.random.default_rng(0).standard_normal((500, 8)),
        n_gaussians=1,
        noise_sd=np.full(500, 0.5),
        field=SSFField(np.ones((1, 1)), 1.0, (0.0, 0.0)),
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
    samples = ModelSamples(chain, np.tile(tilted, (500, 1)), np.full(500, 0.5), ("sensor_tilt",), 1)
    repaired = samples.fitted_sensor(replace(whole, plan=high), rng=np.random.default_rng(0))
    np.testing.assert_allclose(predict(repaired, high).mean, expected[0])
    over_shape = SensorAndShape(prepared.null, Circle(), np.zeros((1, 10))).chain(high, (), n_nodes=16)
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


def test_no_reading_is_refused():
    with pytest.raises(ParameterError, match="usable readings"):
        prepare(replace(recording(), readings=np.full(408, np.nan)), apparatus=SENSOR)


def test_an_effect_of_ones_own_stands_beside_the_vocabulary():
    own = LightSensorApparatus({"backlash": VOCABULARY["backlash"]}).effects(recording(), None)
    assert "backlash" in own
    assert "lag" not in own
