"""repaired.json: what is written is read back bit for bit, and only for the simulator that it was made with."""

import contextlib
import dataclasses
import json

import numpy as np
import pytest
from heater import ABOUT, SIMULATOR, TABLE, fitted
from scipy.special import ndtri

from probewise.errors import FileError, ParameterError
from probewise.systems import FittedSystem, RunTable, Simulator, System
from probewise.systems.forms import ReferenceFit, bind_forms, extract_stored_fit, rebind_forms
from probewise.systems.forms.reference import StoredFit


def test_what_is_written_is_read_back_bit_for_bit():
    def refuse(name):
        raise AssertionError(name)

    text = fitted(("lag", "sensitivity:room_c", "nonlinearity", "offset_drift")).to_json()
    json.loads(text, parse_constant=refuse)
    assert FittedSystem.from_json(text, SIMULATOR).to_json() == text


def _places(value, at=()):
    """Every place of a JSON value: all entries of its objects, the first of its lists."""
    yield at
    inner = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, item in inner:
        yield from _places(item, (*at, key))


@pytest.mark.parametrize("wrong", [None, [], {}, "x", -1, 1e300, True, [["x"]]], ids=repr)
def test_a_value_of_a_wrong_kind_anywhere_is_refused_in_one_line_or_does_no_harm(wrong):
    text = dataclasses.replace(fitted(("gain_drift",)), notes=("doubtful",)).to_json()
    for at in _places(json.loads(text)):
        spoilt = {"all": json.loads(text)}
        *way, last = ("all", *at)
        inner = spoilt
        for key in way:
            inner = inner[key]
        inner[last] = wrong
        with contextlib.suppress(FileError):
            model = FittedSystem.from_json(json.dumps(spoilt["all"]), SIMULATOR)
            assert "parameter" in model.summary(), at
            assert "".join((*model.names, *model.effects, *model.notes)), at


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"format": "system/1"}', '{"format": "sensor/1"}', '{"format": "system/9"}']
)
def test_a_damaged_file_is_refused_in_one_line(text):
    with pytest.raises(FileError, match="allowed") as refusal:
        FittedSystem.from_json(text, SIMULATOR)
    assert "\n" not in str(refusal.value)


def test_fewer_than_500_samples_are_refused():
    whole = fitted()
    with pytest.raises(ParameterError, match="500 or more"):
        dataclasses.replace(whole, samples=whole.samples[:499], noise_sd=whole.noise_sd[:499])


def test_every_form_that_is_bound_again_does_what_it_did():
    """About the fit and from what is in the file, with any parameters: the same readings, to the last bit."""
    forms = bind_forms(ABOUT)
    again = rebind_forms(forms, SIMULATOR, extract_stored_fit(ABOUT))
    assert again.keys() == forms.keys()
    rng = np.random.default_rng(3)
    for name, form in forms.items():
        own = form.entries[len(form.entries) // 2][:1] * (1 + 0.1 * rng.random())
        theta = np.concatenate([ABOUT.theta, own], axis=1)
        first, second = (ABOUT.system.chain(TABLE, [f]).predict(theta, TABLE) for f in (form, again[name]))
        np.testing.assert_array_equal(first, second, err_msg=name)


def test_a_bend_that_is_bound_again_ends_where_it_did_whatever_the_unit():
    """Outlying readings are left out of the range that is expected, by the sd of a reading."""
    x = np.linspace(0.0, 1.0, 200)
    readings = 3 * x + 0.3 * x**3 + np.random.default_rng(1).normal(0.0, 0.02, 200)
    readings[::40] += 2
    table = RunTable({"x": x, "y": readings})
    simulator = Simulator("y", "V", {"a": (0, 10)}, simulate=lambda p, u: p["a"] * u["x"], noise={"sd": 0.02})
    system = System.of(simulator, table)
    about = ReferenceFit(system, table, np.clip(ndtri(np.array([0.3])), -5, 5), 0.02)
    theta = np.array([[3.0, 0.1, 3.0]])
    known = extract_stored_fit(about)
    first = bind_forms(about)["nonlinearity"]
    (second,) = rebind_forms(["nonlinearity"], simulator, known).values()
    predicted, again = (system.chain(table, [form]).predict(theta, table) for form in (first, second))
    np.testing.assert_array_equal(predicted, again)
    (other,) = rebind_forms(["nonlinearity"], simulator, dataclasses.replace(known, sd=1.0)).values()
    assert np.abs(system.chain(table, [other]).predict(theta, table) - predicted).max() > 0.01


def test_predictions_that_are_no_number_are_stored():
    """In a row without a reading a simulator may predict none."""
    predicted = np.where(np.arange(len(TABLE)) == 3, np.nan, ABOUT.predicted)
    given = StoredFit(TABLE, predicted, 0.07, {"warm": predicted})
    known = FittedSystem.from_json(dataclasses.replace(fitted(), known=given).to_json(), SIMULATOR).known
    np.testing.assert_array_equal(known.predicted, predicted)
    np.testing.assert_array_equal(known.states["warm"], predicted)
    assert known.sd == 0.07
