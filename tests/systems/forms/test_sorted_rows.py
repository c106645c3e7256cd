"""A table sorted by an input: a jump at a row may as well be one where the input passes a value, and this is said."""

import math

import numpy as np

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.systems import Simulator, table_for
from probewise.systems.forms.binding import names_of_jumps_in_sorted_rows, sorting_column

_RNG = np.random.default_rng(3)
_X = np.sort(_RNG.uniform(0, 10, 50))


def _prepared(x=_X, *, time=None, **more):
    simulator = Simulator(
        "y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"], time=time
    )
    y = 1 + 2 * x + 0.1 * np.random.default_rng(4).standard_normal(len(x))
    return prepare_system(simulator, table_for(simulator, {"x": x, **more, "y": y}))


def test_only_a_column_that_drives_the_simulator_sorts_a_table_without_a_time():
    number = np.arange(50.0)
    assert sorting_column(_prepared().apparatus.about) == "x"
    assert sorting_column(_prepared(_X[::-1]).apparatus.about) == "x"
    assert sorting_column(_prepared(_RNG.permutation(_X), number=number).apparatus.about) is None
    assert sorting_column(_prepared(time="t", t=number).apparatus.about) is None


def test_a_jump_of_a_sorted_table_shows_in_the_column_and_says_so():
    prepared = _prepared()
    step = prepared.effects["offset_step"]
    assert step.covariates == ("x", "row")
    said = step.sentence(np.array([0.5, 20.5]), np.array([0.1, 0.3]))
    assert said.endswith(f"rows are sorted by x, so it may be where x passes {_X[20]:.4g} instead")
    assert (
        "rows are sorted by x: what jumps or wanders from row to row may change with x instead"
        in prepared.recording.notes
    )


def test_a_jump_of_a_sorted_table_has_a_tenth_of_the_prior():
    prepared = _prepared()
    jumps = names_of_jumps_in_sorted_rows(prepared.effects)
    assert jumps == {"offset_step", "gain_step", "steps:a", "steps:b"}
    odds = prepared.apparatus.prior_odds(prepared.effects)
    apart = odds.log_prior_on_mean(("nonlinearity",)) - odds.log_prior_on_mean(("offset_step",))
    assert math.isclose(apart, math.log(10))
    assert not names_of_jumps_in_sorted_rows(_prepared(_RNG.permutation(_X)).effects)
