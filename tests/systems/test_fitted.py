"""repaired.json: what is written is read back bit for bit, and only for the simulator that it was made with."""

import dataclasses
import json

import numpy as np
import pytest
from heater import ABOUT, SIMULATOR, TABLE, fitted

from probewise.errors import FileError, ParameterError
from probewise.systems import FittedSystem, Law, RunTable, Simulator
from probewise.systems.forms import bind_forms
from probewise.systems.forms.rebinding import StoredFit, extract_stored_fit, rebind_forms


def test_what_is_written_is_read_back_bit_for_bit():
    text = fitted(("lag", "sensitivity:room_c", "nonlinearity")).to_json()
    assert FittedSystem.from_json(text, SIMULATOR).to_json() == text


def test_the_file_is_strict_json():
    def refuse(name):
        raise AssertionError(name)

    json.loads(fitted(("offset_drift",)).to_json(), parse_constant=refuse)


def test_the_file_of_another_simulator_is_refused():
    other = dataclasses.replace(SIMULATOR, fingerprint="def")
    with pytest.raises(FileError, match=r"fingerprint abc.*has def"):
        FittedSystem.from_json(fitted().to_json(), other)


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


def test_a_parameter_may_have_brackets_in_its_name():
    simulator = Simulator("y", "V", {"c[0]": (0, 1), "c[1]": (0, 1)}, simulate=lambda p, data: p["c[0]"] * data["x"])
    made = FittedSystem(simulator, names=("c[0]", "c[1]"), samples=np.full((500, 2), 0.5), noise_sd=np.ones(500))
    assert made.names == ("c[0]", "c[1]")
    with pytest.raises(ParameterError, match=r"c\[1\] is missing"):
        dataclasses.replace(made, names=("c[0]",), samples=made.samples[:, :1])


def test_every_form_that_is_bound_again_does_what_it_did():
    """About the fit and from what is in the file, with any parameters: the same readings, to the last bit."""
    forms = bind_forms(ABOUT)
    again = rebind_forms(forms, SIMULATOR, extract_stored_fit(ABOUT))
    assert again.keys() == forms.keys()
    rng = np.random.default_rng(3)
    for name, form in forms.items():
        own = form.bank()[len(form.bank()) // 2][:1] * (1 + 0.1 * rng.random())
        theta = np.concatenate([ABOUT.theta, own], axis=1)
        first, second = (ABOUT.system.chain(TABLE, [f]).predict(theta, TABLE) for f in (form, again[name]))
        np.testing.assert_array_equal(first, second, err_msg=name)


def test_forms_are_bound_again_without_a_call_of_rates():
    """They were called at the middle of the prior, where they may raise."""

    def rates(s, p, u):
        raise ValueError("no such tank")

    law = Law({"upper": 0.0, "lower": 0.0}, rates)
    simulator = Simulator("y", "V", {"a": (0, 1)}, law=law, time="t")
    level = np.linspace(0.0, 1.0, 20)
    table = RunTable({"t": np.arange(20.0), "y": level}, "t")
    known = StoredFit(table, level, {"upper": level, "lower": level**2})
    assert rebind_forms(["limit:upper"], simulator, known).keys() == {"limit:upper"}
