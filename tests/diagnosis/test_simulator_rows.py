"""A simulator over a table: columns, effects, runs to record next."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from heater import ABOUT, runs

from probewise.diagnosis.advice import Rival, measurement_separating_rivals
from probewise.diagnosis.diagnose_simulator import diagnose_system, prepare_system
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Model
from probewise.diagnosis.locate import Covariate, places_of_effect, significant_places
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.outlying import FAR_OUT, clustering_log_bayes_factors
from probewise.diagnosis.simulator_rows import SimulatorApparatus, candidate_runs
from probewise.diagnosis.unknown_bases import bank_of_unknown_effects
from probewise.recordings import Plan
from probewise.systems import (
    Law,
    RunTable,
    Simulator,
    System,
    as_recording,
    concatenate_tables,
    table_for,
)
from probewise.systems.forms import ReferenceFit, bind_forms
from probewise.systems.forms.formulas import formula_forms
from probewise.systems.table import covariate_of_column

TABLE = runs()


def offered(controls=("power_w",), table=TABLE, by_law=True):
    simulator = SimpleNamespace(reading="temp_c", controls=controls, time_unit="s", law=by_law or None)
    commands = candidate_runs(table, simulator)
    return {command.plan.scan_names[0]: command for command in commands}


def test_a_function_of_the_time_is_not_asked_what_no_recorded_run_shows():
    """A step response holds while the power is constant: a switched power would be diagnosed as a delay."""
    assert {"1 power_w low", "1 power_w high"} <= set(offered(by_law=False))
    assert not {"1 power_w up", "1 power_w steps"} & set(offered(by_law=False))
    power = np.where(np.arange(len(TABLE)) == 0, 2.5, TABLE.columns["power_w"])
    assert "1 power_w steps" in offered(table=TABLE.with_columns({"power_w": power}), by_law=False)


def test_a_control_is_swept_held_and_switched_between_its_ends():
    found = offered()
    power = {name: command.plan.columns["power_w"] for name, command in found.items()}
    np.testing.assert_allclose(power["1 power_w up"][[0, -1]], [2.0, 4.0])
    np.testing.assert_allclose(power["1 power_w down"][[0, -1]], [4.0, 2.0])
    assert set(power["1 power_w steps"].tolist()) == {2.0, 4.0}
    assert set(power["1 power_w middle"].tolist()) == {3.0}


@pytest.mark.parametrize("run", [None, "run"])
def test_what_is_planned_is_what_a_diagnosis_of_both_tables_predicts(run):
    """A warming block that starts at 20: of a FILE.py without runs a table is one run, so only one is planned."""
    time, power = 10.0 * np.arange(34), np.where(np.arange(34) // 8 % 2 == 0, 60.0, 0.0)
    columns = {"t_s": time, "power_w": power, "temp_c": 20.0 + 0 * time}
    law = Law({"temp": 20.0}, lambda s, p, u: {"temp": (20 + p["gain"] * u["power_w"] - s["temp"]) / p["tau"]})
    prior = {"gain": (0.1, 2), "tau": ("log", 10, 1000)}
    simulator = Simulator("temp_c", "degC", prior, law=law, time="t_s", run=run, controls=("power_w",))
    table = RunTable(columns | ({} if run is None else {run: np.full(34, "1")}), "t_s", run)
    system = System.of(simulator, table)
    rivals = [
        Rival(f"{z}", Model(system, (), table), np.array([z, z]), 0.01 * np.eye(2), 0.5) for z in (0.0, 0.1)
    ]  # 0.1 apart: more than one run is needed
    apparatus = SimulatorApparatus(ReferenceFit(system, table, np.zeros(2), 6.0))
    asked = measurement_separating_rivals(rivals, 6.0, cast(Plan, table), apparatus)
    assert asked is not None
    plan = cast(RunTable, asked.plan)
    assert (len(plan.scan_names) == 1) == (run is None)
    both, _ = concatenate_tables([table, RunTable(plan.columns, "t_s", run)], ["first.csv", "next.csv"])
    theta = system.theta(np.zeros((1, 2)))
    predicted = [system.chain(rows, ()).predict(theta, rows)[0] for rows in (plan, both)]
    np.testing.assert_allclose(predicted[0], predicted[1][34:], rtol=1e-9)


_N = 60
_T = 0.5 * np.arange(_N)
_RNG = np.random.default_rng(8)
_X = _RNG.normal(size=_N)
_OWN = {name: _RNG.normal(size=_N) for name in ("level", "time", "run", "previous", "scan", "state:s", "room_c")}


def _prepared(more, **options):
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + u["x"], time="t_s", **options)
    y = 1.0 + _X + 0.1 * np.random.default_rng(9).normal(size=_N)
    return prepare_system(simulator, table_for(simulator, {"t_s": _T, "x": _X, **more, "y": y}))


@pytest.mark.parametrize("name", ["level", "time", "run", "previous", "scan", "state:s", "room_c"])
def test_every_effect_of_a_column_shows_in_it(name):
    about = _prepared({name: _OWN[name]}).apparatus.about
    known = set(_prepared({name: _OWN[name]}).apparatus.covariate_values_by_name(about.predicted))
    for form in (bind_forms(about)[f"sensitivity:{name}"], *(p for p in formula_forms(about) if name in p.name)):
        assert covariate_of_column(name) in form.covariates or "time" in form.covariates
        assert set(form.covariates) <= known


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
    (of_effect,) = places_of_effect(effect, bump, covariate, None, plan, residual, p_value=0.001, size=8.0)
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


YEARS = np.arange(1871.0, 1971.0)


@pytest.fixture(scope="module")
def flow():
    """A river that carries 250 less from 1899 on; noise with sd 130."""
    return 1100.0 - 250.0 * (YEARS > 1898) + np.random.default_rng(11).normal(0.0, 130.0, len(YEARS))


def in_closed_form(readings):
    """Mean and sd of the change point: flat priors of both levels, log-uniform of the sd; marginal likelihood by gap.

    Each half has n levels about its own mean: (n1 n2)^(-1/2) S^(-(n - 2) / 2), S the sum of squares about both.
    """
    log_p, n = [], len(readings)
    for k in range(1, n):
        before, after = readings[:k], readings[k:]
        about = ((before - before.mean()) ** 2).sum() + ((after - after.mean()) ** 2).sum()
        log_p.append(-0.5 * np.log(k * (n - k)) - 0.5 * (n - 2) * np.log(about))
    p = np.exp(np.array(log_p) - max(log_p))
    p /= p.sum()
    middle = 0.5 * (YEARS[1:] + YEARS[:-1])
    mean = float(p @ middle)
    return mean, float(np.sqrt(p @ (middle - mean) ** 2 + 1 / 12))  # it is uniform within a gap


def test_a_step_that_correlated_noise_imitates_is_as_well_known_as_by_the_closed_form(flow):
    river = Simulator(
        "volume",
        "1e8 m3",
        {"mean": ("normal", 1000, 300)},
        simulate=lambda p, data: p["mean"] + 0 * data["year"],
        time="year",
        time_unit="year",
    )
    found = diagnose_system(river, {"year": YEARS, "volume": flow}, rng=np.random.default_rng(1))
    step = next(effect for effect in found.effects if effect.name == "offset_step")
    at = next(parameter for parameter in step.parameters if parameter.name == "at_s")
    mean, sd = in_closed_form(flow)
    assert sd < 3.0
    assert at.mean == pytest.approx(mean, abs=0.5 * sd)
    assert at.sd == pytest.approx(sd, rel=0.4)


def test_what_comes_next_is_the_last_fifth_of_the_readings_of_each_run():
    recording = as_recording(ABOUT.system.simulator, TABLE)
    recording = recording.with_readings(np.where(np.arange(36) < 2, np.nan, recording.readings))
    part, names = SimulatorApparatus(ABOUT).what_comes_next(recording)
    assert (np.flatnonzero(part == 0) + 2).tolist() == [10, 11, 22, 23, 34, 35]
    assert (names, set(part)) == (("the last fifth",), {-1, 0})
    timeless = replace(recording, plan=replace(TABLE, time=None))
    assert SimulatorApparatus(ABOUT).what_comes_next(timeless) is None
