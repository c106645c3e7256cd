"""Times and columns far from 0, as seconds of the epoch are: effects are what they are on a clock that starts at 0."""

import numpy as np
import pytest
from heater import known_model

from probewise.diagnosis import diagnose_system
from probewise.effects import name_without_copy_suffix
from probewise.effects.effect import sentence_from_samples
from probewise.systems import FittedSystem, Law, RunTable, Simulator, System, predict_system
from probewise.systems.forms import ReferenceFit, bind_forms
from probewise.systems.forms.formulas import formula_forms

EPOCH = 1.7e9  # s, a multiple of 2^-20 away from any of the times
N_ROWS = 60
COUNTS_TIME = (
    "offset_drift", "gain_drift", "drifts:gain", "drifts:offset", "interference", "clock_drift", "periodic_forcing:s",
)  # fmt: skip
_T = np.tile(0.125 * np.arange(N_ROWS // 2), 2)
_DRIVE = np.round(512 * (np.sin(_T) + 0.3 * np.sin(3.1 * _T))) / 512


def _table(shift, far=0.0):
    return RunTable(
        {"t_s": _T + shift, "run": np.repeat([1.0, 2.0], N_ROWS // 2), "drive": _DRIVE + far, "y": 1.0 + 2.0 * _DRIVE},
        time="t_s",
        run="run",
    )


def _function(far):
    return {"simulate": lambda p, u: p["offset"] + p["gain"] * (u["drive"] - far)}


def _law(far):
    law = Law({"s": "offset"}, lambda s, p, u: {"s": p["gain"] * (u["drive"] - far) - s["s"]})
    return {"law": law}


def _about(shift, far, how):
    simulator = Simulator(
        reading="y", unit="V", parameters={"offset": (-5, 5), "gain": (0, 4)}, time="t_s", run="run", **how(far)
    )
    table = _table(shift, far)
    system = System.of(simulator, table)
    return ReferenceFit(system, table, np.zeros(system.n_params), 0.01)


def _readings(about, form, setting):
    theta = np.concatenate([about.theta[0], setting])[None, :]
    return about.system.chain(about.table, [form]).predict(theta, about.table)[0]


@pytest.mark.parametrize("how", [_function, _law])
def test_every_form_of_a_recording_by_the_epoch_is_that_of_the_same_recording_from_0(how):
    near, later = (_about(shift, 0.0, how) for shift in (0.0, EPOCH))
    expected, found = bind_forms(near), bind_forms(later)
    assert found.keys() == expected.keys()
    for name, form in expected.items():
        setting = form.entries[len(form.entries) // 3, 0]
        if name.startswith(("offset_step", "gain_step", "steps")):  # in time as printed
            assert found[name].change_points.at == tuple(at + EPOCH for at in form.change_points.at)
            continue
        clock = name == "clock_drift"  # its trial changes of times are a hundred times the precision of such times
        np.testing.assert_allclose(found[name].entries, form.entries, rtol=1e-2 if clock else 1e-6, err_msg=name)
        readings = _readings(later, found[name], setting)
        np.testing.assert_allclose(readings, _readings(near, form, setting), atol=1e-5, err_msg=name)


def test_every_formula_of_a_recording_by_the_epoch_is_that_of_the_same_recording_from_0():
    near, later = (_about(shift, 0.0, _function) for shift in (0.0, EPOCH))
    expected, found = (list(formula_forms(about)) for about in (near, later))
    assert len(found) == len(expected)
    for one, other in zip(expected, found, strict=True):
        setting = one.entries[len(one.entries) // 3, 0]
        readings = _readings(later, other, setting)
        np.testing.assert_allclose(readings, _readings(near, one, setting), atol=0.1 * 0.01, err_msg=one.name)


@pytest.mark.parametrize(
    ("how", "name"), [*((_function, name) for name in COUNTS_TIME[:-2]), *((_law, name) for name in COUNTS_TIME[-2:])]
)
def test_what_counts_from_a_far_time_says_so_and_nothing_else_does(how, name):
    """The drift of a gain is 0 at the first time: without that time its size alone says nothing."""
    near, later = (bind_forms(_about(shift, 0.0, how)) for shift in (0.0, EPOCH))
    setting = near[name].entries[:1, 0]
    plain = sentence_from_samples(near[name], setting)
    assert sentence_from_samples(later[name], setting) == f"{plain} (t_s counts from 1700000000 s)"
    assert not [each for each, form in near.items() if form.binding.counted_from]
    counting = {name_without_copy_suffix(each) for each, form in later.items() if form.binding.counted_from}
    assert counting <= set(COUNTS_TIME)


def test_a_model_keeps_the_origin_of_its_recording_for_other_tables_and_through_its_file():
    about = _about(EPOCH, 0.0, _function)
    values = {"offset": 1.0, "gain": 2.0, "interference.a": 0.5, "interference.hz": 0.3, "interference.phase": 0.4}
    values |= {"offset_drift.a": 0.1}
    model = known_model(about.system.simulator, values, about.stored, sd=0.01)
    later = _table(EPOCH + 1e5)  # its own origin would be another one
    since = later.columns["t_s"] - EPOCH
    expected = 1.0 + 2.0 * _DRIVE + 0.5 * np.sin(2 * np.pi * 0.3 * since + 0.4) + 0.1 * since
    found = predict_system(model, later, rng=np.random.default_rng(0))
    np.testing.assert_allclose(found.mean, expected, rtol=1e-9)
    read = FittedSystem.from_json(model.to_json(), about.system.simulator)
    again = predict_system(read, later, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(again.mean, found.mean)
    np.testing.assert_array_equal(again.log_density, found.log_density)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["drift", "wave"])
def test_a_recording_by_the_epoch_has_the_diagnosis_of_the_same_recording_from_0(kind):
    rng = np.random.default_rng(3)
    t, u = 5.0 * np.arange(240), np.repeat(rng.uniform(1, 5, 24), 10)
    lacks = 2e-4 * t if kind == "drift" else 0.06 * np.sin(2 * np.pi * t / 173 + 0.7)
    y = 1.0 + 2.0 * u + lacks + 0.05 * rng.normal(size=240)
    simulator = Simulator(
        "y",
        "V",
        {"g": (0, 10), "o": (-5, 5)},
        simulate=lambda p, d: p["g"] * d["u"] + p["o"],
        time="t_s",
        vectorized=True,
    )
    near, later = (
        diagnose_system(simulator, {"t_s": t + shift, "u": u, "y": y}, rng=np.random.default_rng(1))
        for shift in (0.0, EPOCH)
    )
    expected, found = ({h.effects: h.probability for h in d.hypotheses} for d in (near, later))
    assert later.verdict == near.verdict
    assert {"drift": ("offset_drift",), "wave": ("interference",)}[kind] in list(found)[:2]
    for effects, probability in expected.items():
        if probability > 0.01:
            assert found[effects] == pytest.approx(probability, abs=2e-3)
