"""Tables that are hardly tables."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system, fit_simulator
from probewise.diagnosis.diagnose_simulator import prepare_system, recording_from_table
from probewise.diagnosis.search.hypotheses import require_converged_fit
from probewise.errors import NotConvergedError, ParameterError
from probewise.systems import Law, Simulator, table_for

_N = 40
_X, _T = np.linspace(0.0, 1.0, _N), 0.5 * np.arange(_N)
_Y = 1.0 + 2.0 * _X + 0.05 * np.random.default_rng(0).standard_normal(_N)
_HALF = np.where(_X < 0.5, np.nan, _Y)


def _line(**more):
    return Simulator("y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"], **more)


_RUNS_AWAY = Simulator(
    "y", "V", {"a": (-3, 3)}, law=Law({"s": 0.5}, lambda s, p, u: {"s": p["a"] * s["s"] ** 2}), time="t"
)
_TABLES = {
    "all times equal": (_line(time="t"), {"t": np.zeros(_N), "x": _X, "y": _Y}),
    "repeated times": (_line(time="t"), {"t": np.repeat(_T[::4], 4), "x": _X, "y": _Y}),
    "runs of one row": (_line(run="r"), {"r": np.arange(float(_N)), "x": _X, "y": _Y}),
    "a run without a reading": (_line(run="r"), {"r": np.repeat([1.0, 2.0], _N // 2), "x": _X, "y": _HALF}),
    "a column of runs that nobody named": (_line(), {"x": _X, "run": np.repeat([1.0, 2.0], _N // 2), "y": _Y}),
    "columns named as covariates are": (_line(), {"x": _X, "time": _T, "level": _X**2, "previous": _X, "y": _Y}),
    "readings that are met exactly": (_line(time="t"), {"t": _T, "x": _X, "y": 1.0 + 2.0 * _X}),
    "one reading out of this world": (_line(), {"x": _X, "y": np.where(np.arange(_N) == 20, 1e9, _Y)}),
    "a law that runs away": (_RUNS_AWAY, {"t": 0.02 * _T, "y": 1 / (2 - 0.03 * _T) + 0.01 * (_Y - 1 - 2 * _X)}),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", _TABLES)
def test_an_odd_table_gets_a_verdict(name):
    simulator, table = _TABLES[name]
    diagnosis = diagnose_system(simulator, table, rng=np.random.default_rng(1))
    assert diagnosis.verdict in ("clean", "named", "noise", "cannot_tell", "unknown")
    assert sum(h.probability for h in diagnosis.hypotheses) == pytest.approx(1.0)


def _table_with_a_gap(*, law):
    time, heat = 0.5 * np.arange(60), 2.0 + np.sin(0.3 * np.arange(60))
    heat_with_gap = np.where(np.arange(60) == 12, np.nan, heat)
    noise = 0.02 * np.random.default_rng(2).standard_normal(60)
    if not law:
        simulator = Simulator("y", "V", {"a": (0, 5)}, simulate=lambda p, u: p["a"] * u["heat"], time="t")
        return simulator, {"t": time, "heat": heat_with_gap, "y": 3.0 * heat + noise, "run": np.repeat([1.0, 2.0], 30)}
    simulator = Simulator(
        "y",
        "V",
        {"a": (0, 5)},
        law=Law({"s": 1.0}, lambda s, p, u: {"s": p["a"] * u["heat"] - s["s"]}),
        time="t",
        run="run",
    )
    state = 3.0 * heat.mean() + np.cos(time) + noise
    return simulator, {"t": time, "heat": heat_with_gap, "y": state, "run": np.repeat([1.0, 2.0], 30)}


@pytest.mark.parametrize("law", [False, True])
def test_a_missing_input_leaves_out_its_readings_and_no_effect(law):
    simulator, table = _table_with_a_gap(law=law)
    whole = {**table, "heat": np.where(np.isnan(table["heat"]), 1.5, table["heat"])}
    with_gap, without = (prepare_system(simulator, table_for(simulator, each)) for each in (table, whole))
    assert set(with_gap.effects) == set(without.effects)
    assert np.flatnonzero(~with_gap.recording.usable).tolist() == (list(range(12, 30)) if law else [12])
    assert np.isfinite(with_gap.apparatus.about.predicted).all()


@pytest.mark.parametrize(("every", "n_left_out"), [(13, 4), (3, 0)])
def test_gaps_of_a_column_that_only_effects_read_move_no_effect(every, n_left_out):
    """A few readings are left out; of a column that is logged less often the values between are interpolated."""
    logged = np.where(np.arange(_N) % every if every == 3 else np.arange(_N) % every == 0, np.nan, _X)
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + 0.0 * u["t"], time="t")
    table = table_for(simulator, {"t": np.arange(_N), "side": logged, "y": 1.0 + 0.3 * _X + 0.01 * _Y})
    prepared = prepare_system(simulator, table)
    assert int((~prepared.recording.usable).sum()) == n_left_out
    assert any("column 'side' is missing" in note for note in prepared.recording.notes)
    plan, effect = prepared.recording.plan, prepared.effects["sensitivity:side"]
    changed = effect.apply(np.zeros((1, _N)), np.array([[1.0]]), plan)
    assert np.isfinite(changed).all()


def test_a_simulator_that_copes_with_a_missing_input_has_effects_of_that_column():
    """Before, its periodic error asked for a frequency of a range that is no number, and the diagnosis ended."""
    x = np.where(np.arange(_N) == 7, np.nan, _X)
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + 2.0 * np.nan_to_num(u["x"]))
    prepared = prepare_system(simulator, table_for(simulator, {"x": x, "y": 1.0 + 2.0 * np.nan_to_num(x) + _Y - 1}))
    assert {"periodic_error:x", "input_gain:x", "sensitivity:x"} <= set(prepared.effects)
    assert np.isfinite(prepared.effects["periodic_error:x"].entries).all()


@pytest.mark.parametrize(("gap", "n_variants"), [(100.0, 2), (0.0, 1)])
def test_a_drift_of_runs_that_follow_each_other_may_begin_again_in_each(gap, n_variants):
    """Without it, three days of a tank's level whose meter drifts from each morning on look like a wave of one day."""
    run = np.repeat([1.0, 2.0], _N // 2)
    time = np.tile(_T[: _N // 2], 2) + gap * (run - 1.0)
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + 0.0 * u["t"], time="t", run="run")
    prepared = prepare_system(simulator, table_for(simulator, {"t": time, "run": run, "y": _Y}))
    drift, plan = prepared.effects["offset_drift"], prepared.recording.plan
    assert len(drift.variants()) == n_variants
    last = drift.variants()[-1].entries[:, 0]
    expected = last[:, :1] * (np.tile(_T[: _N // 2], 2) if n_variants == 2 else time)
    np.testing.assert_allclose(drift.apply(np.zeros((1, _N)), last, plan), expected)
    assert ("in each run" in drift.sentence(last[0], 0.1 * last[0])) == (n_variants == 2)


@pytest.mark.parametrize(("gap", "n_notes"), [(0.0, 0), (500.0, 1)])
def test_a_time_that_jumps_where_no_run_is_named_is_noted(gap, n_notes):
    """Of a law, which goes on through the gap, so that readings after it look lost."""
    law = Simulator("y", "V", {"a": (-3, 3)}, law=Law({"s": "a"}, lambda s, p, u: {"s": -0.1 * s["s"]}), time="t")
    table = table_for(law, {"t": _T + gap * (_T >= 10.0), "y": np.exp(-0.1 * _T) + 0.01 * np.cos(7 * _T)})
    notes = prepare_system(law, table).recording.notes
    assert sum("jumps by 500.5 s after row 19" in note for note in notes) == n_notes
    assert sum("jumps by" in note for note in notes) == n_notes


def test_a_fit_that_explains_nothing_asks_for_units_and_runs():
    found = SimpleNamespace(
        z=np.zeros(1), predicted=np.sin(_X), residuals=60.0 * np.cos(9 * _X), slopes=np.ones((_N, 1))
    )
    problem = SimpleNamespace(absorbing_shift=lambda *_: np.ones(1), whiten=lambda slopes: slopes)
    with pytest.raises(NotConvergedError, match=r"did not converge: it explains hardly anything: the readings go from"):
        require_converged_fit(found, problem)


def test_where_all_times_are_equal_rows_count():
    simulator, table = _TABLES["all times equal"]
    about = prepare_system(simulator, table_for(simulator, table)).apparatus
    np.testing.assert_array_equal(about.covariate_values_by_name(_Y)["row"], np.arange(_N))


_SAME = "column same left out: it is the reading in another unit, and cannot be what the reading depends on"


@pytest.mark.parametrize(
    ("same", "options", "is_same"),
    [
        (1000 * _Y, {}, True),
        (np.round(32 + 1.8 * _Y, 2), {}, True),
        (_Y + 0.01 * np.cos(50 * _X), {}, False),  # of another sensor
        (np.round(_Y), {}, False),  # too coarse to tell
        (np.arange(_N), {"reading_of": 1.0 + 0.3 * np.arange(_N) + 0.01 * _Y}, False),  # a dial, with little noise
        (1000 * _Y, {"controls": ["same"]}, False),
        (1000 * _Y, {"simulate": lambda p, u: p["a"] + p["b"] * u["same"]}, False),
    ],
)
def test_a_column_that_is_the_reading_in_another_unit_explains_nothing(same, options, is_same):
    readings = options.get("reading_of", _Y)
    simulator = replace(_line(), **{k: v for k, v in options.items() if k != "reading_of"})
    prepared = prepare_system(simulator, table_for(simulator, {"x": _X, "same": same, "y": readings}))
    assert (_SAME in prepared.recording.notes) == is_same
    assert ("curve:same" in prepared.effects) != is_same


def test_a_table_that_was_pasted_twice_gets_a_note():
    """Its readings would count as twice as many."""

    def notes(rows):
        table = table_for(_line(), {"x": _X[rows], "y": _Y[rows]})
        return prepare_system(_line(), table).recording.notes

    (note,) = notes(np.tile(np.arange(_N), 2))
    assert note.startswith("each row is there 2 times")
    assert not notes(np.r_[:_N, :9])


def test_a_table_of_readings_alone_is_refused():
    constant = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"])
    with pytest.raises(ParameterError, match=r"columns is \['y'\]; allowed: a column besides the reading"):
        prepare_system(constant, table_for(constant, {"y": _Y}))


def test_a_row_that_no_reading_can_be_predicted_for_is_refused():
    """Without a reading too: no effect on the mean was looked for, since none had a finite change there."""
    x = np.where(np.arange(_N) < 5, -1.0, _X + 1)
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + np.log(u["x"]))
    table = table_for(simulator, {"x": x, "y": np.where(x < 0, np.nan, _Y)})
    with pytest.raises(ParameterError, match=r"no finite reading in 5 of 40 rows, first in row 0'"):
        prepare_system(simulator, table)
    assert prepare_system(simulator, table, with_effects=False).recording.usable.sum() == _N - 5


def test_a_missing_reading_is_no_reason_why_a_law_predicts_nothing_later_in_the_run():
    law = Law({"s": 0.0}, lambda s, p, u: {"s": p["a"] + 0 * s["s"]}, lambda s, p, u: s["s"] + np.sqrt(10 - u["t"]))
    simulator = Simulator("y", "V", {"a": (0, 1)}, law=law, time="t")
    table = table_for(simulator, {"t": _T, "y": np.where(np.arange(_N) == 2, np.nan, _Y)})
    with pytest.raises(ParameterError, match=r"rates is 'no finite reading in 19 of 40 rows, first in row 21'"):
        prepare_system(simulator, table)


@pytest.mark.parametrize(
    ("task", "n", "reading", "said"),
    [
        (diagnose_system, 1, 2.0, "the table is 'one row'; allowed: 12 rows or more"),
        (diagnose_system, 40, np.nan, "usable readings is 0; allowed: 12 or more"),
        (fit_simulator, 1, np.nan, "usable readings is 0; allowed: 3 or more"),
        (fit_simulator, 40, np.nan, "usable readings is 0; allowed: 3 or more"),
        (fit_simulator, 40, np.inf, "reading 'y' in row 0 is 'inf'; allowed: a number in each row"),
    ],
)
def test_a_table_of_one_row_or_without_a_reading_is_refused_before_any_fit(task, n, reading, said):
    """Warnings are errors here, and a fit to no reading gives some."""
    with pytest.raises(ParameterError, match=said):
        task(_line(), {"x": _X[:n], "y": np.full(n, reading)}, rng=np.random.default_rng(1))


def test_of_a_long_table_all_hours_are_used_and_a_note_says_how_many():
    day = np.arange(9600) / 24
    sun = np.maximum(0.0, np.sin(2 * np.pi * (day - 0.25)))
    simulator = Simulator("y", "K", {"a": (0, 5), "b": (0, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["sun"])
    recording = recording_from_table(simulator, table_for(simulator, {"sun": sun, "y": 1 + sun}))
    assert np.bincount(np.flatnonzero(recording.usable) % 24).min() > 50
    assert recording.notes == ("2,400 of 9,600 readings are used, in stretches of six spread over the whole table",)
