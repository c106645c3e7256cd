"""A simulator over a table: columns, effects, runs to record next."""

from typing import cast

import numpy as np
import pytest

from probewise.diagnosis.advice import Rival, measurement_separating_rivals
from probewise.diagnosis.diagnose_simulator import diagnose_system, prepare_system
from probewise.diagnosis.fit import Model
from probewise.diagnosis.simulator_rows import SimulatorApparatus, candidate_runs
from probewise.recordings import Plan
from probewise.systems import Law, RunTable, Simulator, System, concatenate_tables, table_for
from probewise.systems.forms import ReferenceFit, bind_forms
from probewise.systems.forms.formulas import formula_forms
from probewise.systems.table import covariate_of_column


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


def test_what_was_the_same_throughout_each_of_several_runs_stays_so_in_a_new_one():
    columns = {"t_s": np.tile(np.arange(8.0), 2), "load_kg": np.repeat([1.0, 2.0], 8), "run": np.repeat(["a", "b"], 8)}
    law = Law({"x": 0.0}, lambda s, p, u: {"x": p["gain"] * u["load_kg"]})
    own = Simulator("x_mm", "mm", {"gain": (0, 1)}, law=law, time="t_s", run="run", controls=("load_kg",))
    planned = candidate_runs(RunTable(columns, "t_s", "run"), own)
    assert all(np.ptp(each.plan.columns["load_kg"]) == 0 for each in planned)
    assert "take a new run like run a with load_kg held at 2" in [each.description for each in planned]


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
