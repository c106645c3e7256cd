"""What is to be diagnosed, before anything is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.calibration import FittedSensor
from probewise.diagnosis import audit_plan
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.light_sensor.sensor import LightSensor
from probewise.diagnosis.prepared import prepare
from probewise.effects import VOCABULARY
from probewise.errors import ParameterError
from probewise.recordings import Recording, paper_plan
from probewise.sensor import SSFField, mixture_names

SENSOR: Apparatus = LightSensor()


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


def test_too_little_is_few_readings_or_equal_ones():
    whole = recording()
    assert not prepare(whole, apparatus=SENSOR).has_too_little_data
    assert prepare(recording(20), apparatus=SENSOR).has_too_little_data
    assert prepare(replace(whole, readings=np.full(408, 5.0)), apparatus=SENSOR).has_too_little_data


def test_values_of_usable_readings_are_spread_over_all_rows():
    whole = recording(30)
    holes = replace(whole, readings=np.where(np.arange(30) % 2, np.nan, whole.readings))
    spread = prepare(holes, apparatus=SENSOR).expand_to_all_rows(np.arange(15.0))
    np.testing.assert_array_equal(spread[::2], np.arange(15.0))
    assert np.isnan(spread[1::2]).all()


def test_readings_at_another_height_than_the_sensors_calibration_are_at_theirs():
    """As readings of the calibration's height that command it: a sensor that hangs higher sees more, and dimmer."""
    names, theta = (*mixture_names(1), "I_min", "I_max"), [1.0, 0.5, 1.5, 0.03, 0.08, -0.005, 11.0, 58.0]
    sensor = FittedSensor(
        names=names,
        samples=theta + 1e-3 * np.random.default_rng(0).standard_normal((500, 8)),
        n_gaussians=1,
        noise_sd=np.full(500, 0.5),
        field=SSFField(np.ones((1, 1)), 1.0, (0.0, 0.0)),
        instrumentation=replace(paper_plan().instrumentation, height_mm=14.0),
    )
    whole = recording()
    high = replace(whole, plan=replace(whole.plan, instrumentation=replace(whole.plan.instrumentation, height_mm=20.0)))
    plan = prepare(high, sensor=sensor, apparatus=SENSOR).recording.plan
    assert plan.instrumentation.height_mm == 14.0
    np.testing.assert_array_equal(plan.covariates["height_mm"], 20.0)
    assert prepare(high, apparatus=SENSOR).recording is high
    audited = audit_plan(high.plan.take(np.arange(40)), sensor=sensor, effects={"lag": VOCABULARY["lag"]})
    np.testing.assert_array_equal(audited.plan.covariates["height_mm"], 20.0)


def test_no_reading_is_refused():
    with pytest.raises(ParameterError, match="usable readings"):
        prepare(replace(recording(), readings=np.full(408, np.nan)), apparatus=SENSOR)


def test_an_effect_of_ones_own_stands_beside_the_vocabulary():
    own = LightSensor({"backlash": VOCABULARY["backlash"]}).effects(recording(), None)
    assert "backlash" in own
    assert "lag" not in own
