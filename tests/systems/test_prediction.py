"""Predictions of a fitted simulator, of recorded runs and new ones; and its file, read back bit for bit."""

import contextlib
import dataclasses
import json

import numpy as np
import pytest
from heater import ABOUT, SIMULATOR, TABLE, fitted, known_model, runs
from scipy.special import ndtri
from scipy.stats import norm

from probewise.errors import DoubtfulResultWarning, FileError, ParameterError
from probewise.systems import (
    FittedSystem,
    Law,
    Noise,
    RunTable,
    Simulator,
    System,
    predict_system,
    write_system_prediction,
)
from probewise.systems.forms import ReferenceFit, StoredFit, bind_forms, rebind_forms
from probewise.systems.prediction import as_recording

RNG = 7


def predicted(model, table):
    return predict_system(model, table, rng=np.random.default_rng(RNG))


def test_a_recorded_run_is_predicted_from_its_own_posterior():
    found = predicted(fitted(), runs())
    np.testing.assert_allclose(found.mean, runs().columns["temp_c"], atol=0.2)
    assert (found.sd < 0.6).all()


def _with_starts(*starts):
    """The heater with so many recorded runs, whose starts are known exactly; 20,000 samples."""
    model = fitted()
    names = ("tau_s", "gain", *(f"start_c[{k + 1}]" for k in range(len(starts))))
    samples = np.tile([15.0, 3.0, *starts], (20_000, 1))
    return dataclasses.replace(model, names=names, samples=samples, noise_sd=np.full(20_000, 0.05))


def test_a_new_run_starts_where_its_prior_says_beside_two_recorded_ones():
    """At time 0 the reading is the start, normal about 20 with sd 5, and noise of 0.05."""
    found = predicted(_with_starts(22.0, 23.0), runs((20.0,), names="9", n=4))
    np.testing.assert_allclose(found.mean[0], 20.0, atol=0.05)
    np.testing.assert_allclose(found.sd[0], 5.0, rtol=0.02)


def test_a_new_run_has_an_offset_as_those_of_the_recorded_runs_differ():
    """Three runs of mean 1 and sd 1: a Student-t of four degrees of freedom, sd sqrt(2 (1 + 1/3)) about 1."""
    model = fitted(("offset_per_run",))
    samples, names = np.array(model.samples), list(model.names)
    for name, value in zip("123", (0.0, 1.0, 2.0), strict=True):
        samples[:, names.index(f"offset_per_run.values[{name}]")] = value
    model = dataclasses.replace(model, samples=np.tile(samples, (40, 1)), noise_sd=np.full(20_000, 0.05))
    found = predicted(model, runs((20.0,), names="9", n=4))
    plain = predicted(_with_starts(20.0, 21.0, 19.0), runs((20.0,), names="9", n=4))
    np.testing.assert_allclose(found.mean[0] - plain.mean[0], 1.0, atol=0.1)
    np.testing.assert_allclose(np.sqrt(found.sd[0] ** 2 - plain.sd[0] ** 2), np.sqrt(8 / 3), rtol=0.15)


def test_a_row_that_lacks_a_column_is_not_predicted_and_the_others_are():
    table = runs()
    power = table.columns["power_w"].copy()
    power[3] = np.nan
    with pytest.warns(DoubtfulResultWarning, match=r"1 row .* first row 3"):
        found = predicted(fitted(), table.with_columns({"power_w": power}))
    assert np.flatnonzero(np.isnan(found.mean)).tolist() == [3]


def test_predictions_are_written_row_by_row_with_the_columns_of_the_table(tmp_path):
    write_system_prediction(predicted(fitted(), runs()), tmp_path / "p.csv")
    lines = (tmp_path / "p.csv").read_text().splitlines()
    assert lines[0] == "run,t_s,power_w,room_c,temp_c,mean,sd,log_density"
    assert len(lines) == 1 + len(runs())


def _line_with(effect, **sizes):
    """Return y = 3 x with an effect of given size, about a table of x, the temperature and y."""
    t = np.arange(40.0)
    table = RunTable({"t": t, "x": np.sin(t / 5) + 2, "room": 20 + np.cos(t / 7), "y": 3 * (np.sin(t / 5) + 2)}, "t")
    simulator = Simulator("y", "V", {"a": (0, 10)}, simulate=lambda p, u: p["a"] * u["x"], time="t")
    values = {"a": 3.0, **{f"{effect}.{name}": size for name, size in sizes.items()}}
    return known_model(simulator, values, StoredFit(table, table.columns["y"], 0.1)), table


@pytest.mark.parametrize("column", [np.full(40, np.nan), np.array(["warm"] * 40)], ids=["empty", "texts"])
def test_a_column_without_numbers_that_an_effect_reads_is_refused_by_name(column):
    model, table = _line_with("sensitivity:room", a=1.0)
    with pytest.raises(ParameterError, match=r"room.*numbers in this column"):
        predicted(model, table.with_columns({"room": column}))


def test_a_column_named_like_a_state_is_not_needed_for_an_effect_on_the_state():
    t = np.linspace(0.0, 4.0, 40)
    a = np.exp(-t)
    table = RunTable({"t": t, "a": a + 0.1, "b": 1 - a}, "t")
    law = Law(
        {"a": 1.0, "b": 0.0}, lambda s, p, u: {"a": -p["k"] * s["a"], "b": p["k"] * s["a"]}, lambda s, p, u: s["b"]
    )
    simulator = Simulator("b", "mol", {"k": (0, 10)}, law=law, time="t")
    known = StoredFit(table, 1 - a, 0.1, {"a": a, "b": 1 - a})
    model = known_model(simulator, {"k": 1.0, "damping:a.a": 0.2}, known, max_step=0.1)
    found = predicted(model, RunTable({"t": t, "b": 1 - a}, "t"))
    np.testing.assert_allclose(found.mean, (1 - np.exp(-1.2 * t)) / 1.2, atol=1e-4)


def _formula_of_the_room_temperature():
    _, table = _line_with("sensitivity:room", a=1.0)
    middle = f"{np.mean(table.columns['room']):.6g}"
    return f"formula:reading:y:(room - {float(middle):.4g})^2"


def test_a_formula_needs_the_column_in_it_and_no_reading():
    model, table = _line_with(_formula_of_the_room_temperature(), a=1.0)
    bare = dataclasses.replace(table, columns={k: v for k, v in table.columns.items() if k != "y"})
    np.testing.assert_array_equal(predicted(model, bare).mean, predicted(model, table).mean)
    lacking = dataclasses.replace(table, columns={k: v for k, v in table.columns.items() if k != "room"})
    with pytest.raises(ParameterError, match="room"):
        predicted(model, lacking)


def test_a_model_with_a_lag_refuses_a_time_that_falls_within_a_run_and_one_without_predicts_it():
    model, table = _line_with("lag", tau_s=1.0)
    again = table.with_columns({"t": table.time_s % 20})
    with pytest.raises(ParameterError, match=r"in row 20 is 0.0; allowed: 19 or more.*begins anew"):
        predicted(model, again)
    drift, _ = _line_with("offset_drift", a=0.01)
    np.testing.assert_allclose(predicted(drift, again).mean, table.columns["y"] + 0.01 * again.time_s)


_STEP_AT = 24.5


def _step_without_a_time():
    """A constant of 1 that jumps by 2 after row 24 of 40, of a recording without a time: the fit without the jump."""
    rng = np.random.default_rng(4)
    x = rng.normal(size=40)
    table = RunTable({"x": x, "y": 1.0 + x + 2.0 * (np.arange(40) > _STEP_AT)})
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + u["x"])
    return ReferenceFit(System.of(simulator, table), table, np.zeros(1), 0.1)


def _model_with_a_step_at_a_row():
    about = _step_without_a_time()
    values = {"a": 1.0, "offset_step.a": 2.0, "offset_step.at_row": _STEP_AT}
    return known_model(about.system.simulator, values, about.stored), about.table


@pytest.mark.parametrize("rows", [(5, 20), (20, 40), (39, 40), (0, 1)], ids=["middle", "second file", "last", "first"])
def test_a_part_of_the_recording_is_predicted_where_it_is_in_it(rows):
    """Rows 5 to 19 were predicted as what comes after the recording, with the step on."""
    model, table = _model_with_a_step_at_a_row()
    part = table.take(np.arange(*rows))
    np.testing.assert_allclose(predicted(model, part).mean, part.columns["y"])
    cut = RunTable({**part.columns, "y": np.append(part.columns["y"][:-1], np.nan)})
    later = predicted(model, cut).mean - cut.columns["x"]  # a reading that the recording has is missing: other rows
    np.testing.assert_allclose(later, 3.0)


def test_a_new_table_comes_after_the_step_at_a_row_of_the_recording():
    """The machine jumped and stayed there; before, a new table began anew, ahead of the jump."""
    model, table = _model_with_a_step_at_a_row()
    x = np.random.default_rng(5).normal(size=30)
    for new in ({"x": x, "y": x}, {"x": x}, {"x": table.columns["x"]}):
        np.testing.assert_allclose(predicted(model, new).mean, 3.0 + new["x"])


def _with_missing_power(table, *rows):
    power = table.columns["power_w"].copy()
    power[list(rows)] = np.nan
    return table.with_columns({"power_w": power})


@pytest.mark.parametrize("effect", ["lag", "delay", "hysteresis", "backlash:power_w", "input_delay:power_w"])
def test_an_effect_with_a_memory_goes_on_after_a_row_that_lacks_an_input(effect):
    """The power is on a straight line there, so that all other rows are as if it were there."""
    table = runs().with_columns({"power_w": np.tile([1.0, 2, 3, 4, 5, 6, 7, 6, 5, 4, 3, 2], 3)})
    about = dataclasses.replace(ABOUT, table=table)
    form = bind_forms(about)[effect]
    model = fitted()
    names = (*model.names, *(f"{effect}.{name}" for name in form.prior.names))
    setting = np.tile(form.entries[0, 0], (500, 1))
    model = dataclasses.replace(
        model,
        names=names,
        samples=np.concatenate([model.samples, setting], axis=1),
        effects=(effect,),
        known=about.stored,
    )
    whole = predicted(model, table).mean
    with pytest.warns(DoubtfulResultWarning, match=r"1 row .* first row 3"):
        found = predicted(model, _with_missing_power(table, 3))
    assert np.flatnonzero(np.isnan(found.mean)).tolist() == [3]
    others = np.arange(len(table)) != 3
    np.testing.assert_allclose(found.mean[others], whole[others], rtol=1e-12)
    assert np.isfinite(found.log_density[others]).all()
    assert np.isnan(found.table.columns["power_w"][3])


def test_a_table_of_which_no_row_has_what_it_needs_is_refused():
    table = runs((20.0,), names="1", n=4)
    law = Law({"temp_c": "start_c"}, lambda s, p, u: {"temp_c": p["gain"] * u["power_w"] - s["temp_c"] / p["tau_s"]})
    observed = dataclasses.replace(law, observe=lambda s, p, u: s["temp_c"] + 0.0 * u["power_w"])
    model = dataclasses.replace(fitted(), simulator=dataclasses.replace(SIMULATOR, simulate=None, law=observed))
    with pytest.raises(ParameterError, match=r"'power_w' is .*no number in row 0"):
        predicted(model, _with_missing_power(table, 0))


@pytest.mark.parametrize("name", ["drifting_noise.growth", "lag.shape"])
def test_an_effect_or_a_parameter_that_no_model_keeps_is_refused(name):
    """Noise that changes in time is a nuisance of the search; a lag has no shape."""
    model = fitted(("lag",))  # a model that keeps its recording
    model = dataclasses.replace(
        model,
        names=(*model.names, name),
        samples=np.concatenate([model.samples, np.ones((len(model.samples), 1))], axis=1),
        effects=tuple(dict.fromkeys(("lag", name.split(".")[0]))),
    )
    with pytest.raises(ParameterError, match=name.split(".")[1 if "lag" in name else 0]):
        predicted(model, runs())


def test_a_row_that_no_sample_predicts_is_told():
    simulator = Simulator("y", "V", {"a": (0, 1)}, simulate=lambda p, u: p["a"] + np.log(u["x"]))
    model = known_model(simulator, {"a": 0.5})
    with pytest.raises(ParameterError, match=r"simulate is 'no finite reading in 1 of 3 rows, first in row 2'"):
        predicted(model, {"x": [1.0, 2.0, -1.0]})


def test_a_prediction_over_longer_gaps_does_not_run_away_with_the_fastest_samples():
    """A step of 2.5 s that served rows 10 s apart and a time constant of 2 s runs away at 0.5 s; closed form."""
    law = Law({"x": 0.0}, lambda s, p, u: {"x": (u["drive"] - s["x"]) / p["tau_s"]})
    simulator = Simulator("x", "K", {"tau_s": ("log", 0.1, 100)}, law=law, time="t_s", noise=Noise(sd=0.01))
    tau = np.geomspace(0.5, 3.0, 500)
    fitted = FittedSystem(simulator, ("tau_s",), tau[:, None], np.full(500, 0.01), max_step=2.5)
    table = {"t_s": 30.0 * np.arange(12), "drive": np.tile([1.0, 0.0, 2.0], 4)}
    found = predict_system(fitted, table, rng=np.random.default_rng(1))
    held = table["drive"][:-1]
    np.testing.assert_allclose(found.mean[1:], held, atol=2e-3)  # after 30 s, ten time constants, the drive is reached


_DECAY = Law({"x": 8.0}, lambda s, p, u: {"x": -p["k"] * s["x"]})


def _decaying(known, **effects):
    """x' = -k x from 8, and an offset; a recording of the first half, from 0 to 1.9 s."""
    simulator = Simulator("x", "K", {"k": (0, 10)}, law=_DECAY, time="t", run="run")
    t = np.arange(0.0, 4.0, 0.1)
    whole = RunTable({"t": t, "x": 8 * np.exp(-0.5 * t), "run": np.full(40, "a")}, "t", "run")
    early = whole.take(t < 1.95)
    stored = StoredFit(early, early.columns["x"], 0.1, {"x": early.columns["x"]}) if known else None
    return known_model(simulator, {"k": 0.5, **effects}, stored, max_step=0.1), whole


@pytest.mark.parametrize("rows", [slice(20, 40), slice(30, 35), slice(5, 12)], ids=["next", "later", "within"])
def test_later_rows_of_a_recorded_run_go_on_from_its_recorded_state(rows):
    model, whole = _decaying(known=True, **{"offset_drift.a": 1.0})
    part = whole.take(np.arange(40)[rows])
    found = predicted(model, part.with_columns({"humidity": np.ones(len(part))}))
    np.testing.assert_allclose(found.mean, part.columns["x"] + part.time_s, atol=1e-5)
    assert (len(found.table), found.notes) == (len(part), ())


_RECORDED_ROWS = np.array([0, 1, 2, 3, 5, 6, 8, 9])  # two readings of the run are missing, and no row
_SIGMA, _RHO, _STEP = 0.4, -0.6, 0.7


def _flat(**parameters):
    """A constant level of 3 and noise with a memory, known exactly; ten rows of run a, each a second, two missing."""
    simulator = Simulator("y", "K", {"level": (0, 10)}, lambda p, data: p["level"] + 0 * data["t"], time="t", run="run")
    t, readings = np.arange(10.0), np.full(10, np.nan)
    readings[_RECORDED_ROWS] = 3 + np.random.default_rng(RNG).normal(0, 1, len(_RECORDED_ROWS))
    recorded = RunTable({"t": t, "y": readings, "run": np.full(10, "a")}, "t", "run")
    stored = StoredFit(recorded, np.full(10, 3.0), _SIGMA)
    model = known_model(simulator, {"level": 3.0, **parameters}, stored, sd=_SIGMA)
    return model, readings[_RECORDED_ROWS] - 3


def _correlated(rows):
    return _SIGMA**2 * _RHO ** np.abs(np.subtract.outer(rows, rows))


def _walking(rows):
    return _SIGMA**2 * (np.eye(len(rows)) + _STEP**2 * (np.minimum.outer(rows, rows) + 1))


@pytest.mark.parametrize(
    ("effect", "parameter", "value", "covariance"),
    [("correlated_noise", "rho", _RHO, _correlated), ("random_walk", "sd_per_row", _STEP, _walking)],
)
@pytest.mark.parametrize("first", [10, 13], ids=["next", "after three seconds without a row"])
def test_noise_with_a_memory_is_predicted_given_the_recorded_residuals(effect, parameter, value, covariance, first):
    """The exact conditional distribution of jointly normal readings; of a run without recorded rows, the marginal."""
    model, residuals = _flat(**{f"{effect}.{parameter}": value})
    rows = np.arange(first, first + 6)
    after = predicted(model, {"t": rows.astype(float), "run": ["a"] * 6})
    both = covariance(np.append(_RECORDED_ROWS, rows))
    gain = np.linalg.solve(both[:8, :8], both[:8, 8:]).T
    np.testing.assert_allclose(after.mean, 3 + gain @ residuals, rtol=1e-9)
    np.testing.assert_allclose(after.sd, np.sqrt(np.diag(both[8:, 8:] - gain @ both[:8, 8:])), rtol=1e-9)
    new = predicted(model, {"t": rows.astype(float), "run": ["b"] * 6})
    np.testing.assert_allclose(new.mean, 3.0)
    np.testing.assert_allclose(new.sd, np.sqrt(np.diag(covariance(np.arange(10, 16)))))


def test_a_recorded_reading_that_may_be_wide_tells_less_of_a_walk():
    """One reading, narrow or wide: the walk after it has the moments of a mixture of two normal distributions."""
    share, times = 0.3, 8.0
    of = {"outliers.share": share, "outliers.size": times, "random_walk.sd_per_row": _STEP}
    model, residuals = _flat(**of)
    one = model.known.table.with_columns({"y": np.append(model.known.table.columns["y"][0], np.full(9, np.nan))})
    model = dataclasses.replace(model, known=dataclasses.replace(model.known, table=one))
    found = predicted(model, {"t": [10.0, 11.0], "run": ["a", "a"]})
    walk, own = (_SIGMA * _STEP) ** 2, _SIGMA**2 * np.array([1.0, times**2])
    weight = np.array([1 - share, share]) * norm(0, np.sqrt(walk + own)).pdf(residuals[0])
    weight, mean = weight / weight.sum(), walk / (walk + own) * residuals[0]
    at = weight @ mean
    variance = weight @ (walk * own / (walk + own) + (mean - at) ** 2)
    np.testing.assert_allclose(found.mean, 3 + at)
    of_own = _SIGMA**2 * (1 + share * (times**2 - 1))
    np.testing.assert_allclose(found.sd**2, variance + walk * np.array([10, 11]) + of_own)


def test_later_rows_are_said_to_start_again_where_the_model_has_no_recorded_rows():
    model, whole = _decaying(known=False)
    found = predicted(model, whole.take(np.arange(20, 40)))
    np.testing.assert_allclose(found.mean[0], 8.0)
    assert "note: run a: started again at its first row here" in found.summary()
    assert predicted(model, whole).notes == ()  # it begins at 0


def test_an_infinite_reading_is_refused_with_its_row():
    """The table keeps a column with such a cell as text; its first cells are numbers all the same."""
    table = RunTable({"power_w": [1.0, 2.0, 3.0], "temp_c": ["20.1", "", "inf"]}, time=None, run=None)
    with pytest.raises(ParameterError, match=r"in row 2 is 'inf'; allowed: a number in each row"):
        as_recording(
            Simulator("temp_c", "degC", {"gain": (0, 1)}, simulate=lambda p, u: p["gain"] * u["power_w"]), table
        )


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
    again = rebind_forms(forms, SIMULATOR, ABOUT.stored)
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
    known = about.stored
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
