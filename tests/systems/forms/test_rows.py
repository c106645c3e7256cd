"""Rows in no order of recording, or sorted by an input."""

import math

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.systems import Simulator, table_for
from probewise.systems.forms import sorting_column
from probewise.systems.forms.formulas import formula_forms
from probewise.systems.forms.reference import chance_of_sorted_readings, note_on_row_order

_SPEED = np.repeat(np.arange(4.0, 16.0), 4)


def _simulator(**more):
    return Simulator("way", "m", {"a": (0, 5)}, simulate=lambda p, u: p["a"] * u["speed"], **more)


def _sorted_within(speed, seed=0, scatter=3.0):
    way = 2 * speed + scatter * np.random.default_rng(seed).standard_normal(len(speed))
    return way[np.lexsort((way, speed))]


def _chance(way, speed=_SPEED, **more):
    simulator = _simulator(**{key: value for key, value in more.items() if key == "time"})
    columns = {key: value for key, value in more.items() if key != "time"}
    return chance_of_sorted_readings(simulator, table_for(simulator, {"speed": speed, "way": way, **columns}))


def test_the_chance_is_that_of_one_arrangement_of_each_group_or_its_reverse():
    way = _sorted_within(_SPEED)
    assert _chance(way) == pytest.approx(2 / math.factorial(4) ** 12)
    assert _chance(way[::-1], _SPEED[::-1]) == pytest.approx(2 / math.factorial(4) ** 12)
    tied = np.repeat([[1.0, 1.0, 2.0, 3.0]], 12, axis=0).ravel()
    assert _chance(tied) == pytest.approx(2 / (math.factorial(4) / 2) ** 12)


def test_rows_are_equal_whatever_the_last_digits_of_their_columns():
    last_digits = np.where(np.arange(48) % 3 == 0, np.nextafter(_SPEED, np.inf), _SPEED)
    assert _chance(_sorted_within(_SPEED), last_digits) == pytest.approx(2 / math.factorial(4) ** 12)
    part = np.repeat([1.0, np.nan], 24)  # a missing cell is equal to other missing ones
    way = np.tile(np.sort(np.random.default_rng(0).standard_normal(24)), 2)
    assert _chance(way, np.full(48, 3.0), part=part) == pytest.approx(2 / math.factorial(24) ** 2)


def test_rows_with_a_time_unsorted_ones_and_a_drift_keep_their_order():
    way = _sorted_within(_SPEED)
    assert _chance(way, t=np.arange(48.0), time="t") == 1.0
    swapped = way.copy()
    swapped[[5, 6]] = swapped[[6, 5]]
    assert _chance(swapped) == 1.0
    assert _chance(np.arange(48.0)) == 1.0
    assert _chance(way, number=np.arange(48.0)) == 1.0
    apart = np.tile(np.arange(4.0, 16.0), 4)  # equal rows whose readings rise as a jump or a drift makes them
    assert _chance(2 * apart + np.repeat(np.arange(4.0), 12), apart) == 1.0


def test_nothing_is_asked_that_needs_an_order():
    simulator = _simulator()
    prepared = prepare_system(simulator, table_for(simulator, {"speed": _SPEED, "way": _sorted_within(_SPEED)}))
    families = {name.split(":")[0] for name in prepared.effects}
    assert not families & {"offset_step", "steps", "hysteresis", "backlash", "correlated_noise", "random_walk"}
    assert {"nonlinearity", "sensitivity", "signal_dependent_noise"} <= families
    assert not any("sum over rows" in form.name for form in formula_forms(prepared.apparatus.about))
    (note,) = note_on_row_order(simulator, prepared.recording.plan)
    assert note in prepared.recording.notes


@pytest.mark.slow
def test_a_sorted_table_of_a_right_law_is_clean():
    """Before, "the change since the row before" was unknown beyond doubt."""
    simulator = _simulator()
    table = {"speed": _SPEED, "way": _sorted_within(_SPEED, seed=4)}
    assert diagnose_system(simulator, table, rng=np.random.default_rng(1)).verdict in ("clean", "noise")


_RNG = np.random.default_rng(3)
_X = np.sort(_RNG.uniform(0, 10, 50))


def _prepared(x=_X, *, time=None, run=None, **more):
    prior = {"a": (-5, 5), "b": (-5, 5)}
    simulator = Simulator("y", "V", prior, simulate=lambda p, u: p["a"] + p["b"] * u["x"], time=time, run=run)
    y = 1 + 2 * x + 0.1 * np.random.default_rng(4).standard_normal(len(x))
    return prepare_system(simulator, table_for(simulator, {"x": x, **more, "y": y}))


def test_only_a_column_that_drives_the_simulator_sorts_a_table_without_a_time():
    number = np.arange(50.0)
    about = _prepared().apparatus.about
    assert sorting_column(about) == "x"
    assert not any("sum over rows" in form.name for form in formula_forms(about))
    assert sorting_column(_prepared(_X[::-1]).apparatus.about) == "x"
    assert sorting_column(_prepared(_RNG.permutation(_X), number=number).apparatus.about) is None
    assert sorting_column(_prepared(time="t", t=number).apparatus.about) is None


@pytest.mark.parametrize(
    ("levels", "adds_up"), [(np.arange(10.0), False), (_RNG.permutation(10.0 * np.arange(10)), True)]
)
def test_nothing_adds_up_in_runs_that_a_column_sorts(levels, adds_up):
    about = _prepared(np.tile(levels, 5), run="tree", tree=np.repeat(list("abcde"), 10)).apparatus.about
    assert sorting_column(about) is None
    assert any("sum over rows" in form.name for form in formula_forms(about)) == adds_up


def test_a_jump_of_a_sorted_table_shows_in_the_column_and_says_so():
    prepared = _prepared()
    step = prepared.effects["offset_step"]
    assert step.covariates == ("x", "row")
    assert (
        "rows are sorted by x: what jumps or wanders from row to row may change with x instead"
        in prepared.recording.notes
    )
