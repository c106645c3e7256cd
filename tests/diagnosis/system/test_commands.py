"""What a person could record next."""

from typing import cast

import numpy as np
import pytest
from heater import runs

from probewise.diagnosis.advice import Rival, measurement_separating_rivals
from probewise.diagnosis.fit import Model
from probewise.diagnosis.simulator_rows import (
    SimulatorApparatus,
    _minutes_of_runs,
    plan_of_alternatives,
    plan_of_sequence,
    possible_run_commands,
)
from probewise.recordings import Plan
from probewise.systems import Law, RunTable, Simulator, System, concatenate_tables
from probewise.systems.forms import ReferenceFit

TABLE = runs()


def offered(controls=("power_w",), table=TABLE):
    return {c.table.scan_names[0]: c for c in possible_run_commands(table, "temp_c", controls, "s")}


def test_without_controls_recorded_runs_are_taken_again():
    assert list(offered(())) == ["1 again", "2 again", "3 again"]


def test_a_control_is_swept_held_and_switched_between_its_ends():
    found = offered()
    power = {name: command.table.columns["power_w"] for name, command in found.items()}
    np.testing.assert_allclose(power["1 power_w up"][[0, -1]], [2.0, 4.0])
    np.testing.assert_allclose(power["1 power_w down"][[0, -1]], [4.0, 2.0])
    assert set(power["1 power_w steps"].tolist()) == {2.0, 4.0}
    assert set(power["1 power_w middle"].tolist()) == {3.0}


def test_a_control_is_swept_in_values_that_can_be_set():
    """In thousandths of its range, from 2 to 4 W: two decimals would be too few, sixteen cannot be set."""
    swept = offered()["1 power_w up"].table.columns["power_w"]
    np.testing.assert_array_equal(swept, np.round(swept, 3))
    np.testing.assert_allclose(swept, np.linspace(2.0, 4.0, len(swept)), atol=0.0005)
    assert len(np.unique(swept)) == len(swept)


def test_a_slow_run_takes_twice_the_time():
    time = offered()["1 slow"].table.time_s
    np.testing.assert_allclose(np.ptp(time), 2 * np.ptp(TABLE.time_s[:12]))


def test_what_is_yet_to_be_read_is_empty():
    assert all(np.isnan(command.table.columns["temp_c"]).all() for command in offered().values())


def test_time_that_begins_anew_in_each_run_does_so_in_the_next():
    assert offered()["2 again"].table.time_s[0] == 0.0


def test_time_that_goes_on_is_later_than_all_that_was_recorded():
    time = np.arange(float(len(TABLE)))
    table = TABLE.with_columns({"t_s": time})
    commands = list(offered((), table).values())
    asked = cast(RunTable, plan_of_sequence(commands[:2], table))
    assert (np.diff(asked.time_s) > 0).all()
    assert asked.time_s[0] > time[-1]


def test_commands_set_behind_each_other_are_runs_of_their_own():
    together = cast(RunTable, plan_of_alternatives(list(offered().values())[:3], TABLE))
    assert len(together.scan_names) == 3
    assert set(together.like.values()) <= set(TABLE.scan_names)


def test_no_command_has_more_than_102_readings():
    long = runs((20.0,), n=1000)
    assert max(len(command.table) for command in offered(table=long).values()) <= 102


def test_a_run_that_was_taken_as_advised_does_not_lend_its_name_to_the_next():
    table = runs((20.0, 21.0), names=("1", "1 again"))
    assert list(offered((), table)) == ["1 again (2)", "1 again again"]


def test_runs_that_differ_in_a_small_control_are_each_taken_again():
    table = TABLE.with_columns({"power_w": 1e-10 * TABLE.columns["power_w"]})
    assert offered(table=table).keys() == offered().keys()


@pytest.mark.parametrize(("unit", "minutes"), [("s", 1 / 60), ("min.", 1.0), ("Month", 43_830.0), ("fortnight", None)])
def test_the_time_that_runs_take_is_in_the_unit_of_the_table(unit, minutes):
    """Half a minute before each run; of an unknown unit a second a reading."""
    taken = _minutes_of_runs(TABLE, unit)
    of_rows = len(TABLE) / 60 if minutes is None else np.ptp(TABLE.time_s) * minutes
    assert taken == pytest.approx(0.5 + of_rows)


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


def test_when_time_begins_anew_does_not_depend_on_the_order_of_rows():
    interleaved = TABLE.take(np.lexsort((TABLE.scan, TABLE.time_s)))
    assert offered((), interleaved)["2 again"].table.time_s[0] == 0.0
    goes_on = TABLE.with_columns({"t_s": np.arange(float(len(TABLE)))})
    last_first = goes_on.take(np.argsort(-goes_on.scan, kind="stable"))
    assert offered((), last_first)["2 again"].table.time_s[0] > len(TABLE) - 1
