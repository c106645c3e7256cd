"""What is to be diagnosed, before anything is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.light_sensor.sensor import LightSensor
from probewise.diagnosis.prepared import prepare
from probewise.effects import VOCABULARY
from probewise.errors import ParameterError
from probewise.recordings import Recording, paper_plan

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


def test_no_reading_is_refused():
    with pytest.raises(ParameterError, match="usable readings"):
        prepare(replace(recording(), readings=np.full(408, np.nan)), apparatus=SENSOR)


def test_an_effect_of_ones_own_stands_beside_the_vocabulary():
    own = LightSensor({"backlash": VOCABULARY["backlash"]}).effects(recording(), None)
    assert "backlash" in own
    assert "lag" not in own
