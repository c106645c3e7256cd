"""The integration of a law, against closed forms and an integrator of another kind."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from probewise.errors import FileError, ParameterError
from probewise.systems import Law, RunTable, Simulator, System
from probewise.systems.law import LawWithEffects, Limit, integrate_states
from probewise.systems.step import RowsInRuns, steps_for_table
from probewise.systems.system import with_converged_step


def _pendulum(s, p, u):
    return {"phi": s["omega"], "omega": -9.81 / p["l_m"] * np.sin(s["phi"]) - p["c"] * s["omega"]}


def _table(times, **columns):
    return RunTable({"t_s": np.asarray(times, dtype=float), "y": np.zeros(len(times)), **columns}, time="t_s")


def _states(motion, table, parameters, max_step):
    own = {name: np.full((1, 1), value) for name, value in parameters.items()}
    columns = {name: values for name, values in table.columns.items() if name != "y"}
    return {k: v[0] for k, v in integrate_states(motion, steps_for_table(table, max_step), own, columns).items()}


def test_a_pendulum_swings_as_an_adaptive_integrator_says():
    """Route two: DOP853 of SciPy at rtol 1e-10."""
    times = np.sort(np.random.default_rng(1).uniform(0, 5, 60))
    table = _table(times)
    found = _states(Law({"phi": 1.0, "omega": 0.0}, _pendulum), table, {"l_m": 0.7, "c": 0.3}, 0.005)

    def rates(t, y):
        out = _pendulum({"phi": y[0], "omega": y[1]}, {"l_m": 0.7, "c": 0.3}, {})
        return [out["phi"], out["omega"]]

    exact = solve_ivp(rates, (times[0], times[-1]), [1.0, 0.0], t_eval=times, method="DOP853", rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found["phi"], exact.y[0], atol=1e-7)


@pytest.mark.parametrize(("hold", "expected"), [("previous", 2.0), ("linear", 3.0)])
def test_an_input_between_rows_is_held_or_runs_straight(hold, expected):
    """The integral of an input of 1, 3 from t = 0 to 1 and of 1 before: 1 s of 1, then 1 s of 1 or of 1 to 3."""
    table = _table([0.0, 1.0, 2.0], u=np.array([1.0, 1.0, 3.0]))
    law = Law({"x": 0.0}, lambda s, p, u: {"x": u["u"] + 0 * s["x"]}, hold=hold)
    found = _states(law, table, {}, 0.1)["x"]
    assert found[-1] == pytest.approx(expected, abs=1e-12)


def test_runs_go_on_side_by_side_as_each_would_alone():
    rng = np.random.default_rng(3)
    law = Law({"phi": 1.0, "omega": 0.0}, _pendulum)
    times = [np.sort(rng.uniform(0, 3, n)) for n in (20, 7)]
    both = RunTable(
        {"t_s": np.concatenate(times), "y": np.zeros(27), "run": np.repeat([1.0, 2.0], [20, 7])}, time="t_s", run="run"
    )
    together = _states(law, both, {"l_m": 0.7, "c": 0.3}, 0.01)["phi"]
    alone = np.concatenate([_states(law, _table(t), {"l_m": 0.7, "c": 0.3}, 0.01)["phi"] for t in times])
    np.testing.assert_allclose(together, alone, atol=1e-7)


def test_dry_friction_brings_a_body_to_rest_after_the_time_that_its_speed_lasts():
    """v = v0 - a t until 0, then it sticks."""
    motion = LawWithEffects(Law({"v": 1.0}, lambda s, p, u: {"v": 0.0 * s["v"]})).with_friction(
        "v", np.full((1, 1), 0.5)
    )
    table = _table(np.linspace(0, 4, 81))
    found = _states(motion, table, {}, 0.05)["v"]
    np.testing.assert_allclose(found, np.maximum(1 - 0.5 * table.time_s, 0), atol=0.03)
    assert np.all(found[table.time_s > 2.1] == 0)


def test_a_body_at_rest_sticks_until_the_force_is_larger_than_its_friction():
    law = Law({"v": 0.0}, lambda s, p, u: {"v": u["force"] + 0 * s["v"]}, hold="linear")
    table = _table(np.linspace(0, 4, 401), force=np.linspace(0, 4, 401))
    found = _states(LawWithEffects(law).with_friction("v", np.full((1, 1), 2.0)), table, {}, 0.01)["v"]
    assert np.all(found[table.time_s < 1.99] == 0)
    assert found[-1] == pytest.approx(0.5 * 2.0**2, abs=0.05)


def test_a_body_breaks_loose_within_a_step_when_the_force_exceeds_its_friction():
    """Closed form: a force of 2 t exceeds a friction of 1 at 0.5, amid the first step, and v = (t - 0.5)^2 after it."""
    law = Law({"v": 0.0}, lambda s, p, u: {"v": 2 * u["t_s"] + 0 * s["v"]})
    table = _table(np.linspace(0, 4, 6))
    found = _states(LawWithEffects(law).with_friction("v", np.full((1, 1), 1.0)), table, {}, 0.8)["v"]
    np.testing.assert_allclose(found, np.maximum(table.time_s - 0.5, 0) ** 2, atol=1e-12)


def test_a_coarse_step_is_split_where_friction_brings_a_damped_body_to_rest():
    """Closed form: of v' = -v - 0.5 from 1, v is 0 at ln 3, and the way is 1 - 0.5 ln 3.

    The error of the same steps without friction is the scale: the way is then 1 - exp(-2).
    """
    law = Law({"x": 0.0, "v": 1.0}, lambda s, p, u: {"x": s["v"], "v": -s["v"]})
    table = _table(np.linspace(0, 2, 5))
    free = _states(law, table, {}, 0.5)["x"][-1] - (1 - np.exp(-2))
    found = _states(LawWithEffects(law).with_friction("v", np.full((1, 1), 0.5)), table, {}, 0.5)["x"][-1]
    assert abs(found - (1 - 0.5 * np.log(3))) < 2 * abs(free)


@pytest.mark.parametrize("size", [0.0, 1e-9])
def test_friction_that_vanishes_holds_nothing_at_rest(size):
    law = Law({"x": 0.0, "v": 0.0}, lambda s, p, u: {"x": 1 - s["x"], "v": s["x"] - s["v"]})
    table = _table(np.linspace(0, 5, 11))
    held = _states(LawWithEffects(law).with_friction("v", np.full((1, 1), size)), table, {}, 0.5)["v"]
    np.testing.assert_allclose(held, _states(law, table, {}, 0.5)["v"], atol=1e-8)


def test_a_tank_that_overflows_stays_full_and_empties_at_once_when_the_inflow_ends():
    law = Law({"level": 0.0}, lambda s, p, u: {"level": u["inflow"] - 0.5 * s["level"]})
    times = np.linspace(0, 10, 201)
    table = _table(times, inflow=np.where(times < 5, 1.0, 0.0))
    found = _states(LawWithEffects(law).with_limit(Limit("level", np.full((1, 1), 1.2))), table, {}, 0.05)["level"]
    assert found.max() == pytest.approx(1.2)
    after = times >= 5
    np.testing.assert_allclose(found[after], 1.2 * np.exp(-0.5 * (times[after] - 5)), atol=1e-3)


def test_what_a_tank_spills_into_the_next_one_is_there():
    """Closed forms: full from ln 2 / .5 on, it spills 1 - .5 * 1 of its inflow, of which the next one takes up .6.

    Beside it nothing flows out of the next one, so what both hold, and what went to waste, is what has flown in.
    """
    law = Law({"upper": 0.0, "lower": 0.0}, lambda s, p, u: {"upper": 1 - 0.5 * s["upper"], "lower": 0.5 * s["upper"]})
    table = _table(np.linspace(0, 6, 121))
    bound = Limit("upper", np.full((1, 1), 1.0), spilt={"lower": np.full((1, 1), 0.6)})
    found = _states(LawWithEffects(law).with_limit(bound), table, {}, 0.05)
    spilt = 0.5 * np.maximum(table.time_s - 2 * np.log(2), 0)
    np.testing.assert_allclose(found["upper"], np.minimum(2 * (1 - np.exp(-0.5 * table.time_s)), 1), atol=1e-3)
    np.testing.assert_allclose(found["upper"] + found["lower"] + 0.4 * spilt, table.time_s, atol=1e-3)


def test_time_that_falls_within_a_run_is_refused_with_the_row():
    with pytest.raises(ParameterError, match=r"in row 4 is .*allowed: .* does not fall"):
        _ = RowsInRuns(_table([0.0, 1.0, 0.5])).row_by_position_and_run


@pytest.mark.slow
def test_the_step_is_halved_until_readings_stand_still():
    simulator = Simulator(
        "y",
        "V",
        {"l_m": _uniform(0.1, 1.0), "c": _uniform(0.0, 0.1)},
        law=Law({"phi": 1.0, "omega": 0.0}, _pendulum),
        time="t_s",
    )
    table = _table(np.linspace(0, 10, 30))
    system = System.of(simulator, table)
    still = with_converged_step(system, table, system.theta(system.starts[:1]), tolerance=1e-5)
    finer = System(simulator, system.runs, still.max_step / 16)
    theta = system.theta(system.starts[:1])
    far = np.abs(still.chain(table, ()).predict(theta, table) - finer.chain(table, ()).predict(theta, table))
    assert still.max_step < system.max_step
    assert far.max() < 1e-4


def _uniform(low, high):
    from probewise.priors import Uniform

    return Uniform(low, high)


def test_rates_may_change_what_they_are_given():
    """They get copies, as `simulate` does: otherwise each call would go on from what the last one left."""

    def plain(s, p, u):
        return {"x": u["force"] - 2 * p["k"] * s["x"]}

    def changing(s, p, u):
        p["k"] = 2 * p["k"]
        u["force"] = u["force"] + 1
        u["net"] = u["force"] - 1
        return {"x": u["net"] - p["k"] * s["x"]}

    table = _table([0.0, 1.0, 2.0, 3.0], force=np.array([1.0, 2.0, 0.0, 0.0]))
    expected, found = (_states(Law({"x": 1.0}, rates), table, {"k": 0.3}, 0.1)["x"] for rates in (plain, changing))
    np.testing.assert_array_equal(found, expected)


def _pendulum_with_changes_in_place(s, p, u):
    speed, damping, turn = s["omega"], p["c"], u["turn"]
    damping /= 60
    speed += turn
    turn *= 0
    return {"phi": speed, "omega": -9.81 / p["l_m"] * np.sin(s["phi"]) - 60 * damping * s["omega"]}


def _turned_pendulum(s, p, u):
    return _pendulum({**s, "omega": s["omega"] + u["turn"]}, p, u) | {
        "omega": -9.81 / p["l_m"] * np.sin(s["phi"]) - p["c"] * s["omega"]
    }


def _degrees_in_place(s, p, u):
    angle, turn = s["phi"], u["turn"]
    angle *= 180
    turn += 1
    return angle / np.pi


@pytest.mark.parametrize("hold", ["previous", "linear"])
def test_what_a_law_changes_in_place_is_its_own(hold):
    """Route two: the same law with new arrays. Steps one after another, then all at once from a known trajectory."""
    table = _table(np.linspace(0, 3, 40), turn=np.linspace(-1, 1, 40))
    prior = {"l_m": (0.5, 1.0), "c": (0.1, 1.0)}
    predicted = []
    for rates, observe in (
        (_pendulum_with_changes_in_place, _degrees_in_place),
        (_turned_pendulum, lambda s, p, u: s["phi"] * 180 / np.pi),
    ):
        law = Law({"phi": 1.0, "omega": 0.0}, rates, observe, hold=hold)
        system = System.of(Simulator("y", "deg", prior, law=law, time="t_s"), table)
        theta = system.theta(system.starts)
        predicted.append([system.chain(table, ()).predict(theta * k, table) for k in (1.0, 1.0, 1.001)])
    np.testing.assert_allclose(*predicted, rtol=1e-9, atol=1e-9)


def test_a_parameter_changed_in_place_to_an_array_of_more_runs_is_a_clear_mistake():
    def rates(s, p, u):
        rate = p["c"]
        rate *= s["phi"]
        return {"phi": -rate}

    columns = {"t_s": np.arange(12.0), "y": np.zeros(12), "run": np.repeat(["a", "b"], 6)}
    table = RunTable(columns, "t_s", "run")
    simulator = Simulator("y", "V", {"c": (0.1, 1.0)}, law=Law({"phi": 1.0}, rates), time="t_s", run="run")
    with pytest.raises(FileError, match=r"allowed: k = k \* x in place of k \*= x"):
        System.of(simulator, table)
