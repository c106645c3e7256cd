"""A column may have any name, also that of a covariate that is no column: each keeps its own values."""

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.diagnosis import diagnosis_json
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.locate import Covariate, places_of_effect, significant_places
from probewise.diagnosis.noise_law import white_noise
from probewise.diagnosis.outlying import FAR_OUT, clustering_log_bayes_factors
from probewise.diagnosis.samples import ModelSamples
from probewise.diagnosis.unknown_bases import bank_of_unknown_effects
from probewise.systems import Law, Simulator, table_for
from probewise.systems.forms import bind_forms
from probewise.systems.forms.formulas import formula_forms
from probewise.systems.table import covariate_of_column, published_covariate

_N = 60
_T = 0.5 * np.arange(_N)
_RNG = np.random.default_rng(8)
_X = _RNG.normal(size=_N)
_OWN = {name: _RNG.normal(size=_N) for name in ("level", "time", "run", "previous", "scan", "state:s", "room_c")}


def _prepared(more, **options):
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + u["x"], time="t_s", **options)
    y = 1.0 + _X + 0.1 * np.random.default_rng(9).normal(size=_N)
    return prepare_system(simulator, table_for(simulator, {"t_s": _T, "x": _X, **more, "y": y}))


def test_covariates_that_are_no_columns_keep_their_values_beside_columns_of_that_name():
    prepared = _prepared({**_OWN, "days": np.repeat([1.0, 2.0], _N // 2)}, run="days")
    predicted = np.linspace(0.0, 1.0, _N) ** 2
    found = prepared.apparatus.covariate_values_by_name(predicted)
    np.testing.assert_array_equal(found["level"], predicted)
    np.testing.assert_array_equal(found["time"], _T)
    np.testing.assert_array_equal(found["run"], np.repeat([0.0, 1.0], _N // 2))
    np.testing.assert_allclose(found["previous"][1 : _N // 2], np.diff(predicted)[: _N // 2 - 1])
    for name, values in _OWN.items():
        np.testing.assert_array_equal(found[covariate_of_column(name)], values)
    assert covariate_of_column("room_c") == "room_c"


@pytest.mark.parametrize("name", ["level", "time", "run", "previous", "scan", "state:s", "room_c"])
def test_every_effect_of_a_column_shows_in_it(name):
    about = _prepared({name: _OWN[name]}).apparatus.about
    known = set(_prepared({name: _OWN[name]}).apparatus.covariate_values_by_name(about.predicted))
    for form in (bind_forms(about)[f"sensitivity:{name}"], *(p for p in formula_forms(about) if name in p.name)):
        assert covariate_of_column(name) in form.covariates or "time" in form.covariates
        assert set(form.covariates) <= known


def test_a_formula_of_time_shows_in_time():
    about = _prepared({}).apparatus.about
    (square,) = (
        form for form in formula_forms(about) if form.expression.startswith("a (t_s - ") and "^2" in form.name[-3:]
    )
    assert square.covariates == ("time",)


def test_results_name_a_column_as_it_is_unless_that_means_something_else():
    assert published_covariate(covariate_of_column("scan")) == "scan"
    assert published_covariate(covariate_of_column("level")) == "column:level"
    assert published_covariate("level") == "level"
    words = _prepared({}).apparatus.words
    assert words.covariate_in_words("level") == "predicted y"
    assert words.covariate_in_words("column:level") == "column level"
    assert words.covariate_in_words("slope") == "slope"
    assert words.covariate_in_words("state:s") == "state s"


@pytest.mark.parametrize(("name", "published"), [("scan", "scan"), ("level", "column:level"), ("room_c", "room_c")])
def test_a_place_and_a_family_of_unknown_effects_have_the_name_that_results_have(name, published):
    """Before, a place had "column:scan" in Python and "scan" in diagnosis.json."""
    prepared, rows = _prepared({name: _OWN[name]}), np.arange(_N)
    covariate = Covariate(covariate_of_column(name), _OWN[name], rows)
    bump = np.exp(-0.5 * ((_OWN[name] - 1) / 0.3) ** 2)
    ones = np.ones((_N, 1)) / np.sqrt(_N)
    residual = 3 * (bump - ones @ (ones.T @ bump[:, None])[:, 0]) + 0.3 * (_X - _X.mean())
    problem = Linearised(ones, residual, white_noise(_N), 1.0, _N)
    draws = problem.draw_null_residuals(199, rng=np.random.default_rng(0))
    (place,) = significant_places(problem, [covariate], ("all",), residual, draws)
    effect, plan = bind_forms(prepared.apparatus.about)[f"sensitivity:{name}"], prepared.recording.plan
    (of_effect,) = places_of_effect(effect, bump, covariate, None, plan, residual, p_value=0.001, size=8.0, sd=1.0)
    assert place.covariate == of_effect.covariate == published
    bank = bank_of_unknown_effects([covariate], _X - _X.min(), _X, np.zeros(_N, dtype=int))
    assert set(bank.labels) <= {published, f"{published}, locally", "what was seen before", "ends of scans"}
    assert published in bank.labels
    assert list(clustering_log_bayes_factors(bump, [covariate])) == [f"{published}{FAR_OUT}"]


def test_a_column_with_the_name_of_a_state_is_no_second_variable_of_that_name():
    law = Law({"s": 0.5}, lambda s, p, u: {"s": -p["a"] * s["s"]})
    simulator = Simulator("y", "V", {"a": (0.01, 1)}, law=law, time="t_s")
    y = 0.5 * np.exp(-0.1 * _T) + 0.001 * _X
    about = prepare_system(simulator, table_for(simulator, {"t_s": _T, "s": 3.0 + _X, "y": y})).apparatus.about
    of_rate = [form for form in formula_forms(about) if form.name.startswith("formula:rate")]
    assert of_rate
    assert all(set(form.covariates) <= {"state:s", "time"} for form in of_rate)


@pytest.mark.slow
def test_a_reading_that_depends_on_a_column_called_scan_is_found_in_it():
    """Before, the column was taken for numbers of scans, and the diagnosis ended in an IndexError."""
    scan = _RNG.normal(20, 2, _N)
    y = 1.0 + _X + 0.2 * (scan - 20) + 0.1 * _RNG.normal(size=_N)
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + u["x"], time="t_s")
    found = diagnose_system(simulator, {"t_s": _T, "x": _X, "scan": scan, "y": y}, rng=np.random.default_rng(1))
    assert found.where[0].covariate == diagnosis_json(found)["where"][0]["covariate"] == "scan"


def test_samples_of_an_effect_are_its_own_beside_a_column_whose_name_goes_on_with_a_point():
    """As "x.1", which is how data frames name the second of two columns: their average ended in a traceback."""
    prepared = _prepared({"x.1": _RNG.normal(size=_N)})
    table, system = prepared.recording.plan, prepared.apparatus.system
    effects = [prepared.effects[name] for name in ("sensitivity:x", "sensitivity:x.1")]
    samples = ModelSamples(system.chain(table, effects), np.array([[1.0, 2.0, 3.0]]), np.ones(1), (), 0)
    alone = ModelSamples(system.chain(table, effects[1:]), np.array([[1.0, 3.0]]), np.ones(1), (), 0)
    assert [samples.effect_samples(effect.name).tolist() for effect in effects] == [[[2.0]], [[3.0]]]
    assert alone.effect_samples("sensitivity:x").shape == (1, 0)
