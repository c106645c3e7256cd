"""Audit of a table."""

import numpy as np
import pytest
from heater import heater, runs

from probewise.diagnosis import audit as system_audit
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


def test_rows_that_show_an_effect_grow_with_the_square_of_what_is_absorbed(audit):
    for effect in audit.effects:
        if effect.rows is not None:
            np.testing.assert_allclose(effect.rows, (8 / effect.share) ** 2, atol=1.0)


def test_a_gap_in_a_column_hides_nothing(audit):
    room = TABLE.columns["room_c"].copy()
    room[7] = np.nan
    found = audit_system(heater(), TABLE.with_columns({"room_c": room}))
    assert [e.name for e in found.effects] == [e.name for e in audit.effects]
    assert of(found, "sensitivity:room_c").detectability == of(audit, "sensitivity:room_c").detectability
    assert "gaps of room_c are interpolated" in found.assumed


def test_what_needs_a_time_says_so_where_none_was_recorded():
    simulator = heater(time=None, simulate=lambda p, data: p["start_c"] + p["gain"] * data["power_w"] * p["tau_s"])
    found = audit_system(simulator, {**TABLE.columns})
    assert of(found, "lag").reason == "no time was recorded"


def test_readings_that_change_nowhere_are_refused():
    simulator = heater(simulate=lambda p, data: p["start_c"] + 0.0 * data["t_s"], noise=Noise(sd=0.1), per_run=())
    with pytest.raises(ParameterError, match="the same in all rows"):
        audit_system(simulator, TABLE)


def test_a_plan_that_lacks_a_cell_is_told_in_which_row():
    """Before, its readings were said to be the same in all rows."""
    x = np.where(np.arange(40) == 7, np.nan, np.linspace(0.0, 1.0, 40))
    simulator = Simulator("y", "V", {"a": (0, 5)}, simulate=lambda p, u: p["a"] * u["x"])
    with pytest.raises(ParameterError, match="no finite reading in 1 of 40 rows, first in row 7"):
        audit_system(simulator, {"x": x})


@pytest.mark.parametrize("most", [100, 200])
def test_a_part_of_a_long_table_tells_the_sizes_that_all_of_it_shows(most, monkeypatch):
    whole = audit_system(heater(), runs(n=150))
    monkeypatch.setattr(system_audit, "_MOST_ROWS", most)
    part = {effect.name: effect.smallest for effect in audit_system(heater(), runs(n=150)).effects}
    ratios = [
        part[effect.name][0].amount / effect.smallest[0].amount
        for effect in whole.effects
        if effect.smallest and effect.smallest[0].amount and part[effect.name] and part[effect.name][0].amount
    ]
    assert len(ratios) > 10
    np.testing.assert_allclose(np.median(ratios), 1.0, atol=0.05)
    assert np.mean(np.abs(np.log(ratios)) < 0.2) > 0.8
