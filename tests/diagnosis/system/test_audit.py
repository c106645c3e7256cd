"""What a table could not show for a person's simulator."""

import dataclasses

import numpy as np
import pytest
from heater import heater, runs

from probewise.diagnosis import audit_system
from probewise.errors import ParameterError
from probewise.systems import Noise, Simulator

TABLE = runs()


@pytest.fixture(scope="module")
def audit():
    return audit_system(heater(), TABLE)


def of(audit, name):
    return next(effect for effect in audit.effects if effect.name == name)


def test_a_start_of_its_own_absorbs_an_offset_of_each_run(audit):
    """Both add a constant to every row of a run."""
    assert of(audit, "offset_per_run").detectability == "invisible"


def test_an_offset_by_a_column_that_is_constant_in_runs_is_invisible_too(audit):
    assert of(audit, "sensitivity:room_c").detectability == "invisible"


def test_effects_that_are_the_same_are_one_class(audit):
    """The start is added to every reading: a jump of the one is a jump of the other."""
    assert any({"offset_step", "steps:start_c"} <= set(names) for names in audit.classes)


def test_rows_that_show_an_effect_grow_with_the_square_of_what_is_absorbed(audit):
    for effect in audit.effects:
        if effect.rows is not None:
            np.testing.assert_allclose(effect.rows, (8 / effect.share) ** 2, atol=1.0)


def test_the_readings_play_no_part(audit):
    bare = dataclasses.replace(TABLE, columns={k: v for k, v in TABLE.columns.items() if k != "temp_c"})
    assert audit_system(heater(), bare).effects == audit.effects


def test_what_needs_a_time_says_so_where_none_was_recorded():
    simulator = heater(time=None, simulate=lambda p, data: p["start_c"] + p["gain"] * data["power_w"] * p["tau_s"])
    found = audit_system(simulator, {**TABLE.columns})
    assert of(found, "lag").reason == "no time was recorded"


def test_readings_that_change_nowhere_are_refused():
    simulator = heater(simulate=lambda p, data: p["start_c"] + 0.0 * data["t_s"], noise=Noise(sd=0.1), per_run=())
    with pytest.raises(ParameterError, match="one reading in all rows"):
        audit_system(simulator, TABLE)


def test_a_time_that_falls_within_a_run_is_refused_as_in_a_diagnosis():
    simulator = Simulator("y", "V", {"a": (0, 10)}, simulate=lambda p, u: p["a"] * u["x"], time="t")
    with pytest.raises(ParameterError, match="begins anew"):
        audit_system(simulator, {"x": np.arange(20.0), "t": np.arange(20.0) % 10})
