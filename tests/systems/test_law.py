"""Laws with effects and their steps, one by one and all at once, against closed forms and solvers."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from probewise.errors import ParameterError
from probewise.systems import Law, Noise, RunTable, Simulator, System
from probewise.systems.forms import ReferenceFit, bind_forms
from probewise.systems.integrate import Integrations, Stepper, integrate_from_known_trajectories, integrate_states
from probewise.systems.law import LawWithEffects, Limit, StepInputs, rosenbrock_step, runge_kutta_step, steps_for_table
from probewise.systems.system import with_converged_step


def _pendulum(s, p, u):
    return {"phi": s["omega"], "omega": -9.81 / p["l_m"] * np.sin(s["phi"]) - p["c"] * s["omega"]}


def _table(times, **columns):
    return RunTable({"t_s": np.asarray(times, dtype=float), "y": np.zeros(len(times)), **columns}, time="t_s")


def _states(motion, table, parameters, max_step):
    own = {name: np.full((1, 1), value) for name, value in parameters.items()}
    columns = {name: values for name, values in table.columns.items() if name != "y"}
    return {k: v[0] for k, v in integrate_states(motion, steps_for_table(table, max_step), own, columns).items()}


def test_a_body_breaks_loose_within_a_step_when_the_force_exceeds_its_friction():
    """Closed form: a force of 2 t exceeds a friction of 1 at 0.5, amid the first step, and v = (t - 0.5)^2 after it."""
    law = Law({"v": 0.0}, lambda s, p, u: {"v": 2 * u["t_s"] + 0 * s["v"]})
    table = _table(np.linspace(0, 4, 6))
    found = _states(LawWithEffects(law).plus(friction={"v": np.full((1, 1), 1.0)}), table, {}, 0.8)["v"]
    np.testing.assert_allclose(found, np.maximum(table.time_s - 0.5, 0) ** 2, atol=1e-12)


def test_what_a_tank_spills_into_the_next_one_is_there():
    """Closed forms: full from ln 2 / .5 on, it spills 1 - .5 * 1 of its inflow, of which the next one takes up .6.

    Beside it nothing flows out of the next one, so what both hold, and what went to waste, is what has flown in.
    """
    law = Law({"upper": 0.0, "lower": 0.0}, lambda s, p, u: {"upper": 1 - 0.5 * s["upper"], "lower": 0.5 * s["upper"]})
    table = _table(np.linspace(0, 6, 121))
    bound = Limit("upper", np.full((1, 1), 1.0), spilt={"lower": np.full((1, 1), 0.6)})
    found = _states(LawWithEffects(law).plus(limits=(bound,)), table, {}, 0.05)
    spilt = 0.5 * np.maximum(table.time_s - 2 * np.log(2), 0)
    np.testing.assert_allclose(found["upper"], np.minimum(2 * (1 - np.exp(-0.5 * table.time_s)), 1), atol=1e-3)
    np.testing.assert_allclose(found["upper"] + found["lower"] + 0.4 * spilt, table.time_s, atol=1e-3)


def test_time_that_falls_within_a_run_is_refused_with_the_row():
    with pytest.raises(ParameterError, match=r"in row 2 is .*allowed: .* does not fall"):
        steps_for_table(_table([0.0, 1.0, 0.5]), np.inf)


@pytest.mark.slow
def test_the_step_is_halved_until_readings_stand_still():
    simulator = Simulator(
        "y", "V", {"l_m": (0.1, 1.0), "c": (0.0, 0.1)}, law=Law({"phi": 1.0, "omega": 0.0}, _pendulum), time="t_s"
    )
    table = _table(np.linspace(0, 10, 30))
    system = System.of(simulator, table)
    still = with_converged_step(system, table, system.theta(system.starts[:1]), tolerance=1e-5)
    finer = System(simulator, system.runs, still.max_step / 16)
    theta = system.theta(system.starts[:1])
    far = np.abs(still.chain(table, ()).predict(theta, table) - finer.chain(table, ()).predict(theta, table))
    assert still.max_step < system.max_step
    assert far.max() < 1e-4


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


_RNG = np.random.default_rng(0)
_SPRING, _FRICTION, _START = 4.0, 0.3, 0.7
_TIMES = [np.cumsum(_RNG.uniform(0.05, 0.4, n)) for n in (36, 27)]
_FORCE = [np.repeat(_RNG.normal(0, 3, len(t) // 3), 3) for t in _TIMES]
_WARM = [np.cumsum(_RNG.normal(0, 1, len(t))) for t in _TIMES]
_ORDER = np.argsort(np.concatenate(_TIMES), kind="stable")  # the rows of both runs in turn
_ROWS = [np.argsort(_ORDER)[: len(_TIMES[0])], np.argsort(_ORDER)[len(_TIMES[0]) :]]
_MEAN_FORCE, _MEAN_WARM = (float(np.concatenate(columns).mean()) for columns in (_FORCE, _WARM))


def _in_order(parts):
    return np.concatenate(parts)[_ORDER]


TABLE = RunTable(
    {
        "t_s": _in_order(_TIMES),
        "run": _in_order([np.full(len(t), float(k)) for k, t in enumerate(_TIMES)]),
        "force": _in_order(_FORCE),
        "warm": _in_order(_WARM),
        "y": np.zeros(len(_ORDER)),
    },
    time="t_s",
    run="run",
)


def _about(law, parameters, table, values, *, sd=1e-3, max_step=0.03):
    """Return the reference fit at parameters `values`: uniform from 0 to twice each, so that they are in the middle."""
    priors = {name: (0.0, 2 * value) for name, value in zip(parameters, values, strict=True)}
    simulator = Simulator(
        "y", "m", priors, law=replace(law, max_step_s=max_step), time="t_s", run=table.run, noise=Noise(sd=sd)
    )
    system = System.of(simulator, table)
    return ReferenceFit(system, table, np.zeros(system.n_params), sd)


def _spring_about(hold):
    law = Law(
        {"x": _START, "v": 0.0},
        lambda s, p, u: {"x": s["v"], "v": u["force"] - p["k"] * s["x"] - p["c"] * s["v"]},
        hold=hold,
    )
    return _about(law, ("k", "c"), TABLE, (_SPRING, _FRICTION))


@pytest.fixture(scope="module")
def about_of():
    """The spring of which the force is held, or on straight lines, by the word of the law."""
    return {hold: _spring_about(hold) for hold in ("previous", "linear")}


@pytest.fixture(scope="module")
def forms_of(about_of):
    return {hold: bind_forms(about) for hold, about in about_of.items()}


def _predicted(about, form, settings):
    theta = np.concatenate([np.repeat(about.theta, len(settings), axis=0), settings], axis=1)
    return about.system.chain(about.table, (form,)).predict(theta, about.table)


def _column(times, values, at, hold):
    """Return a column at a time; before the first one, its first value."""
    if hold == "linear":
        return np.interp(at, times, values)
    return values[max(np.searchsorted(times, at, side="right") - 1, 0)]


def _integrated(rates, start, times):
    """Integrate rates(t, s, middle) from row to row; `middle` is that of the interval."""
    states = [np.asarray(start, dtype=float)]
    for low, high in pairwise(times):
        if high - low < 1e-12:
            states.append(states[-1])
            continue
        middle = 0.5 * (low + high)
        solved = solve_ivp(
            lambda t, s, middle=middle: rates(t, s, middle),
            (low, high),
            states[-1],
            method="DOP853",
            rtol=1e-10,
            atol=1e-12,
        )
        states.append(solved.y[:, -1])
    return np.array(states)


def _spring_by_solve_ivp(hold, *, spring):
    """Return x at all rows; `spring` is a function of the time, the middle of the interval and the run."""
    out = np.empty(len(TABLE))
    for k, (times, force) in enumerate(zip(_TIMES, _FORCE, strict=True)):

        def rates(t, s, middle, k=k, times=times, force=force):
            push = _column(times, force, middle if hold == "previous" else t, hold)
            return [s[1], push - spring(t, middle, k) * s[0] - _FRICTION * s[1]]

        out[_ROWS[k]] = _integrated(rates, [_START, 0.0], times)[:, 0]
    return out


def _spring_of_column(hold, columns, mean, a):
    def spring(t, middle, k):
        return _SPRING + a * (_column(_TIMES[k], columns[k], middle if hold == "previous" else t, hold) - mean)

    return spring


CASES = {
    "depends:k:force": ([0.3], lambda hold: _spring_of_column(hold, _FORCE, _MEAN_FORCE, 0.3)),
    "depends:k:warm": ([0.3], lambda hold: _spring_of_column(hold, _WARM, _MEAN_WARM, 0.3)),
    "drifts:k": ([0.2], lambda hold: _spring_of_column(hold, _TIMES, 0.0, 0.2)),
    "steps:k": ([1.0, 4.01], lambda hold: _spring_of_column(hold, [1.0 * (t > 4.01) for t in _TIMES], 0.0, 1.0)),
    "differs:k": (
        [[0.5, -0.8][int(name)] for name in TABLE.scan_names],
        lambda hold: lambda t, middle, k: _SPRING + [0.5, -0.8][k],
    ),
}


@pytest.mark.parametrize("hold", ["previous", "linear"])
@pytest.mark.parametrize("name", CASES)
def test_an_input_goes_on_between_rows_as_what_moves_it(name, hold, about_of, forms_of):
    """What an effect makes of a parameter at the rows is held, or on straight lines, as the law says."""
    setting, how = CASES[name]
    about = about_of[hold]
    found = _predicted(about, forms_of[hold][name], np.array([setting]))[0]
    expected = _spring_by_solve_ivp(hold, spring=how(hold))
    size = np.abs(expected - about.predicted).max()
    assert size > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-5 * size)


def test_a_late_column_that_is_held_conserves_what_it_brings():
    """x' = u: what came until the last row is all that the column brought until one dead time before."""
    times = np.cumsum(np.random.default_rng(5).choice([0.2, 1.0, 3.0], 40))
    flow = np.repeat([0.0, 4.0, 1.0, 6.0], 10)
    table = RunTable({"t_s": times, "flow": flow, "y": np.zeros(40)}, time="t_s")
    law = Law({"x": 0.0}, lambda s, p, u: {"x": p["gain"] * u["flow"] + 0 * s["x"]})
    about = _about(law, ("gain",), table, (1.0,), max_step=1.0)
    taus = np.array([[0.0], [0.07], [0.9], [4.4]])
    found = _predicted(about, bind_forms(about)["input_delay:flow"], taus)
    for x, tau in zip(found, taus[:, 0], strict=True):
        brought = np.diff(np.clip(times, None, times[-1] - tau)) @ flow[:-1]
        assert x[-1] == pytest.approx(brought + tau * flow[0], rel=1e-9)


SWINGS = LawWithEffects(Law({"x": 1.0, "v": 0.0}, lambda s, p, u: {"x": s["v"], "v": -s["x"] + 0 * u["t"]}))


def _between(gap, **parameters):
    """Return the inputs in a gap of this time, from time 0 on."""
    return StepInputs("t", (parameters, {"t": np.zeros(np.shape(gap))}), ({}, {"t": np.asarray(gap)}))


def _error(method, n_steps):
    """Return the error of a swing of 4 rad, of which the closed form is a cosine."""
    stepper = Stepper(SWINGS, method, _between([[4.0]]))
    s = np.array([[[1.0]], [[0.0]]])
    for k in range(n_steps):
        s = stepper.step(s, k / n_steps, 1 / n_steps)
    return float(np.hypot(s[0] - np.cos(4.0), s[1] + np.sin(4.0))[0, 0])


@pytest.mark.parametrize(("method", "order"), [(runge_kutta_step, 4), (rosenbrock_step, 3)])
def test_the_error_falls_with_the_order_of_the_method(method, order):
    assert np.log2(_error(method, 12) / _error(method, 24)) == pytest.approx(order, abs=0.5)


END = 2.0


def _after(law, n_steps):
    """Return the states after a gap in a number of steps."""
    stepper = Stepper(LawWithEffects(law), rosenbrock_step, _between([[END]]))
    s = np.array([[[float(value)]] for value in law.states.values()])
    with np.errstate(all="ignore"):
        for k in range(n_steps):
            s = stepper.step(s, k / n_steps, 1 / n_steps)
    return s


def _grows(s, p, u):  # x = tan(t / 2 + 1/4) has this rate; y = sin(t) that one
    return {"x": 0.5 * (1 + s["x"] ** 2), "y": np.cos(u["t"]) - 3.0 * (s["y"] - np.sin(u["t"]))}


def test_the_error_falls_by_the_third_order_in_a_bent_law_with_an_input_in_time():
    law = Law({"x": np.tan(0.25), "y": 0.0}, _grows)

    def error(n_steps):
        s = _after(law, n_steps)
        return s[:, 0, 0] - [np.tan(1.25), np.sin(END)]

    orders = np.log2(np.abs(error(16) / error(32)))
    assert (orders > 2.6).all()
    assert np.abs(error(32)).max() < 1e-4


def test_a_run_that_ended_stands_still_and_one_that_runs_away_leaves_the_others():
    def rates(s, p, u):
        return {"x": s["x"] ** 2 * p["k"] - s["x"]}

    between = _between([[1.0, 0.0, 2.0]], k=np.array([[0.0], [1e200]]))
    stepper = Stepper(LawWithEffects(Law({"x": 1.0}, rates)), rosenbrock_step, between)
    s = np.array([[[1.0, 7.0, 1.0], [1.0, 7.0, 1e200]]])
    with np.errstate(all="ignore"):
        for k in range(10):
            s = stepper.step(s, k / 10, 0.1)
    np.testing.assert_allclose(s[0][0], [np.exp(-1.0), 7.0, np.exp(-2.0)], rtol=1e-3)
    assert s[0][1, 1] == 7.0
    assert not np.isfinite(s[0][1, 2])


def _pendulum_of_all_steps(s, p, u):
    return {"phi": s["omega"], "omega": -9.81 / p["l_m"] * np.sin(s["phi"]) - p["c"] * s["omega"] + u["push"]}


LAW = Law({"phi": "phi0", "omega": 0.0}, _pendulum_of_all_steps, hold="linear")
MIDDLE = np.array([0.7, 0.3, 0.8])  # l_m, c, phi0


def _table_of_all_steps(n_runs=2, n_rows=40):
    rng = np.random.default_rng(5)
    times = np.sort(rng.uniform(0, 3, (n_runs, n_rows)), axis=1).ravel()
    run = np.repeat(np.arange(n_runs, dtype=float), n_rows)
    columns = {"t_s": times, "run": run, "push": rng.normal(size=len(run)), "y": np.zeros(len(run))}
    return RunTable(columns, time="t_s", run="run")


def _plain(motion, theta):
    return motion


def _rubbed(motion, theta):
    return motion.plus(friction={"omega": 0.2 + 0 * theta[:, :1]})


def _stopped(motion, theta):
    return motion.plus(limits=(Limit("phi", 0.9 * theta[:, 2:3]),))


def _forced(motion, theta):
    force = ("omega", lambda s, p, u: 0.3 * np.sin(4 * u["t_s"]) - theta[:, :1] * s["phi"] ** 3)
    return motion.plus(terms=(force,))


class _Case:
    """A table, a law with an effect, and both ways of integrating samples theta (n_samples, 3)."""

    def __init__(self, effect=_plain, law=LAW, table=None):
        self.table, self.effect, self.law = _table_of_all_steps() if table is None else table, effect, law
        self.columns = {k: v for k, v in self.table.columns.items() if k not in ("y", "run")}
        self.memory = Integrations()

    def problem(self, theta):
        def of_some(samples):
            own = dict(zip(("l_m", "c", "phi0"), theta[samples].T[:, :, None], strict=True))
            return self.effect(LawWithEffects(self.law), theta[samples]), own, self.columns

        return of_some

    def near(self, theta):
        steps = steps_for_table(self.table, 0.02)
        return integrate_from_known_trajectories(
            self.problem(theta), steps, self.memory, effects="effects", theta=theta, n_own=3
        )

    def stepped(self, theta):
        motion, own, columns = self.problem(theta)(np.arange(len(theta)))
        return integrate_states(motion, steps_for_table(self.table, 0.02), own, columns)


@pytest.mark.parametrize("effect", [_plain, _rubbed, _stopped, _forced])
@pytest.mark.parametrize("apart", [1e-5, 0.02, 0.5])
def test_all_steps_at_once_lead_where_stepping_leads(effect, apart):
    case, rng = _Case(effect), np.random.default_rng(2)
    case.near(MIDDLE[None, :])
    theta = MIDDLE * (1 + apart * rng.normal(size=(6, 3)))
    found = case.near(theta)
    for state, expected in case.stepped(theta).items():
        np.testing.assert_allclose(found[state], expected, atol=1e-9)


def test_near_a_known_trajectory_a_derivative_costs_a_fraction_of_stepping():
    """Forward differences with a step of 1e-5: to the rounding of either way, 1e-9."""
    case = _Case()
    case.near(MIDDLE[None, :])
    case.memory.n_evaluations = 0
    theta = MIDDLE + np.concatenate([np.zeros((1, 3)), 1e-5 * np.eye(3)])
    found = case.near(theta)
    slopes, expected = (np.diff(v["phi"], axis=0) / 1e-5 for v in (found, case.stepped(theta)))
    np.testing.assert_allclose(slopes, expected, atol=1e-5)
    steps = steps_for_table(case.table, 0.02)
    assert case.memory.n_evaluations < 0.2 * len(steps.gap) * 4


@pytest.mark.parametrize("effect", [_plain, _rubbed, _stopped, _forced])
@pytest.mark.parametrize("max_step", [0.02, 0.2])
def test_the_cost_is_how_often_the_rates_are_evaluated(effect, max_step):
    """Exactly where nothing splits a step; friction splits those in which a state comes to rest."""
    n_calls = 0

    def rates(s, p, u):
        nonlocal n_calls
        n_calls += 1
        return LAW.rates(s, p, u)

    case = _Case(effect, law=replace(LAW, rates=rates))
    theta = MIDDLE * (1 + 0.1 * np.random.default_rng(2).normal(size=(6, 3)))
    steps = steps_for_table(case.table, max_step)
    integrate_from_known_trajectories(case.problem(theta), steps, case.memory, effects="effects", theta=theta, n_own=3)
    assert case.memory.n_evaluations == pytest.approx(n_calls, rel=0.5 if effect is _rubbed else 0.01)


def test_a_sample_that_diverges_is_as_infinite_as_in_steps():
    case = _Case(law=Law({"phi": "phi0", "omega": 0.0}, lambda s, p, u: {"phi": s["phi"] ** 2, "omega": 0 * u["push"]}))
    case.near(MIDDLE[None, :] * 0.1)
    theta = np.array([[0.7, 0.3, 0.08], [0.7, 0.3, 900.0]])
    found = case.near(theta)
    expected = case.stepped(theta)["phi"]
    assert not np.isfinite(expected[1]).all()
    np.testing.assert_array_equal(np.isfinite(found["phi"]), np.isfinite(expected))
    np.testing.assert_allclose(found["phi"][0], expected[0], rtol=1e-9)


def test_a_column_that_a_law_reads_later_only_is_there():
    """Not at the first rows: it is pushed from the first second on."""

    def rates(s, p, u):
        push = np.where(u["t_s"] > 1, u["push"], 0.0) if np.max(u["t_s"]) > 1 else 0.0
        return {**LAW.rates(s, p, {"push": 0.0}), "omega": -9.81 * np.sin(s["phi"]) + push}

    case = _Case(law=replace(LAW, rates=rates))
    theta = np.stack([MIDDLE, 1.01 * MIDDLE])
    found = case.stepped(theta)["phi"]
    assert np.isfinite(found).all()
    for _ in range(2):
        again = case.near(theta)
        np.testing.assert_allclose(again["phi"], found, rtol=1e-8, atol=1e-10)


def test_the_memory_of_trajectories_does_not_grow_without_end():
    case, rng = _Case(table=_table_of_all_steps(1, 5)), np.random.default_rng(0)
    for _ in range(40):
        case.near(MIDDLE * (1 + 0.3 * rng.normal(size=(4, 3))))
    assert 1 < len(case.memory.known) <= 48
