"""How a person's function is called: whatever it takes, the same readings."""

import pickle
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor

import numpy as np
import pytest

from probewise.errors import FileError, NotConvergedError, ParameterError, ShapeError
from probewise.priors import Uniform
from probewise.systems import Law, RunTable, Simulator, System, read_simulator
from probewise.systems.calls import Caller, SpreadCalls, progress_with_call_count

X = np.linspace(0, 1, 11)


def _system(simulate, parameters=("a", "b"), **options):
    table = RunTable({"x": X, "y": np.zeros(11)})
    simulator = Simulator("y", "V", {name: Uniform(0.5, 2.0) for name in parameters}, simulate=simulate, **options)
    return System.of(simulator, table), table


def _elementwise(p, data):
    return p["a"] * np.exp(-p["b"] * data["x"])


def _with_a_loop(p, data):
    out = np.empty(len(data["x"]))
    for k, x in enumerate(data["x"]):
        out[k] = float(p["a"]) * np.exp(-float(p["b"]) * x)
    return out


def test_a_function_that_broadcasts_is_called_once_for_all_samples():
    system, table = _system(_elementwise)
    system.caller.n_calls = 0
    system.chain(table, ()).predict(system.theta(system.starts), table)
    assert system.caller.n_calls == 1


def test_a_caller_is_pickled_without_the_progress_that_it_tells():
    caller = Caller(_elementwise, broadcasts=True)
    progress_with_call_count(lambda *told: None, caller)("fitting")
    again = pickle.loads(pickle.dumps(caller))
    parameters = {"a": np.array([[1.3]]), "b": np.array([[1.1]])}
    np.testing.assert_array_equal(again(parameters, {"x": X}), caller(parameters, {"x": X}))


def test_a_parameter_that_varies_by_row_is_interpolated_where_a_function_takes_only_numbers():
    """Between Chebyshev nodes of five values a smooth function is known to a millionth of its range here."""
    loop, _ = _system(_with_a_loop)
    quick, _ = _system(_elementwise)
    parameters = {"a": np.full((1, 1), 1.2), "b": (1.0 + 0.1 * X)[None, :]}
    np.testing.assert_allclose(loop.caller(parameters, {"x": X}), quick.caller(parameters, {"x": X}), atol=1e-6)
    assert loop.caller.interpolated == {"b"}


def test_calls_that_are_spread_over_processes_give_the_same_readings_in_as_many_calls(tmp_path):
    """Threads stand for the processes; of some samples the function raises an error."""
    text = "import math\nreading, unit, parameters = 'y', 'V', {'a': (0, 2), 'b': (0, 2)}\n"
    text += "def simulate(p, data):\n    return [math.sqrt(p['a'] - 1.4) * math.exp(-p['b'] * x) for x in data['x']]\n"
    (tmp_path / "own.py").write_text(text)
    simulate = read_simulator(tmp_path / "own.py").simulate
    with ThreadPoolExecutor(2) as executor:
        spread = SpreadCalls(simulate, tmp_path / "own.py", executor, 2)
        here, there = (Caller(function, broadcasts=False) for function in (simulate, spread))
        parameters = {"a": np.array([[1.3], [1.5], [1.8]]), "b": np.outer([1.0, 1.1, 1.2], 1 + 0.1 * X)}
        both = [caller(parameters, {"x": X}) for caller in (here, there)]
    np.testing.assert_array_equal(*both)

    assert (here.n_calls, here.n_failed) == (there.n_calls, there.n_failed) == (11, 1)


def test_a_process_that_dies_is_said_in_words_and_is_no_error_of_the_function(tmp_path):
    """As one that the system ends for want of memory."""

    class Dead(ThreadPoolExecutor):
        def map(self, *_, **__):
            raise BrokenExecutor

    with pytest.raises(NotConvergedError, match="a worker process that called simulate has died"):
        _system(SpreadCalls(_with_a_loop, tmp_path / "own.py", Dead(1), 2))


@pytest.mark.parametrize(
    "simulate",
    [
        lambda p, data: data["x"] * (1.0 if p["a"] > 1 else 2.0) + p["b"],
        lambda p, data: p["a"] * data["x"] / np.max(p["b"] + data["x"]),
    ],
    ids=["branches", "looks at all rows"],
)
def test_a_function_that_branches_or_looks_at_all_rows_is_called_sample_by_sample(simulate):
    assert not _system(simulate)[0].caller.broadcasts


def _raises(p, data):
    raise KeyError("powr_w")


@pytest.mark.parametrize(
    ("simulate", "error", "said"),
    [
        (_raises, FileError, "simulate raises KeyError: 'powr_w'"),
        (lambda p, data: float(p["a"]) * data["x"][1:], ShapeError, r"shape \(10,\)"),
        (lambda p, data: np.full(11, np.nan), ParameterError, "not finite at any of the"),
    ],
)
def test_a_simulator_that_never_gives_readings_is_refused(simulate, error, said):
    with pytest.raises(error, match=said):
        _system(simulate)


def test_the_same_call_is_made_once():
    """Effects on the reading leave the simulator as it was: their derivatives cost no further calls."""
    system, table = _system(_with_a_loop)
    theta = system.theta(system.starts)
    first = system.chain(table, ()).predict(theta, table)
    n_calls = system.caller.n_calls
    np.testing.assert_array_equal(system.chain(table, ()).predict(theta, table), first)
    assert system.caller.n_calls == n_calls


def test_a_law_that_raises_for_some_parameters_is_counted_and_the_others_are_integrated():
    def rates(s, p, u):
        if np.any(p["k"] > 1.0):
            raise ZeroDivisionError
        return {"y": -p["k"] * s["y"]}

    table = RunTable({"t": X, "y": np.zeros(11)}, "t")
    simulator = Simulator("y", "V", {"k": Uniform(0.5, 2.0)}, law=Law({"y": 1.0}, rates), time="t")
    system = System.of(simulator, table)
    found = system.chain(table, ()).predict(np.array([[0.8], [1.5]]), table)
    np.testing.assert_allclose(found[0], np.exp(-0.8 * X), rtol=1e-5)
    assert np.isnan(found[1]).all()
    assert system.integrations.n_failed == 1


@pytest.mark.parametrize("vectorized", [False, True])
@pytest.mark.parametrize(
    "simulate",
    [
        lambda p, data: p["a"] * (data["x"] - data["x"][0]) + p["b"],
        lambda p, data: p["a"] * (data["x"] - data["x"].mean()) + p["b"],
        lambda p, data: p["a"] * np.cumsum(data["x"]) + p["b"],
    ],
    ids=["first row", "mean", "running sum"],
)
def test_a_function_that_looks_at_all_rows_of_a_column_sees_those_of_one_sample_where_an_effect_changes_them(
    simulate, vectorized
):
    system, _ = _system(simulate, vectorized=vectorized)
    parameters = {"a": np.array([[1.0], [2.0], [3.0]]), "b": np.array([[0.0], [1.0], [0.5]])}
    changed = X + np.array([[0.0], [0.1], [0.2]]) * X**2
    apart = [simulate({name: v[k] for name, v in parameters.items()}, {"x": changed[k]}) for k in range(3)]
    np.testing.assert_allclose(system.caller(parameters, {"x": changed}), apart)


@pytest.mark.parametrize(("vectorized", "one"), [(False, np.any), (True, np.any), (False, float)])
def test_a_sample_for_which_a_function_raises_leaves_the_others_as_they_are(vectorized, one):
    def simulate(p, data):
        if one(p["a"] > 1.2):
            raise ValueError("too large")
        return p["a"] + p["b"] * data["x"]

    system, table = _system(simulate, vectorized=vectorized)
    theta = np.array([[1.0, 1.0], [1.8, 1.0], [0.7, 1.0], [0.6, 1.0], [1.9, 1.0]])
    system.caller.n_failed = 0
    readings = system.chain(table, ()).predict(theta, table)
    np.testing.assert_allclose(readings[[0, 2, 3]], theta[[0, 2, 3], :1] + X)
    assert np.isnan(readings[[1, 4]]).all()
    assert system.caller.n_failed == 2


def _in_place(p, data):
    rate, x = p["b"], data["x"]
    rate /= 60
    x *= 60
    return p["a"] * np.exp(-rate * x + 0 * p.get("b")) + 60 * rate - p["b"]  # p["b"] is what it was


def _in_place_with_a_loop(p, data):
    rate = p["b"]
    rate /= 60
    return np.array([float(p["a"]) * np.exp(-float(rate) * 60 * x) for x in data["x"]])


def _in_place_with_a_branch(p, data):
    return _in_place(p, data) if float(p["a"]) > 0 else data["x"]


@pytest.mark.parametrize(
    ("simulate", "options"),
    [
        (_in_place, {}),
        (_in_place, {"vectorized": True}),
        (_in_place_with_a_loop, {}),
        (_in_place_with_a_branch, {"per_run": ("b",)}),
    ],
)
def test_what_a_function_changes_in_place_is_its_own(simulate, options):
    """To a user p["b"] is a number, which k = p["b"]; k /= 60 leaves as it is."""
    table = RunTable({"x": X, "y": np.zeros(11), "run": np.zeros(11)}, run="run")
    prior = {"a": Uniform(0.5, 2.0), "b": Uniform(0.5, 2.0)}
    own, plain = (
        System.of(Simulator("y", "V", prior, simulate=each, run="run", **options), table)
        for each in (simulate, _elementwise)
    )
    theta = own.theta(own.starts)
    before = theta.copy()
    for _ in range(2):
        np.testing.assert_allclose(
            own.chain(table, ()).predict(theta, table), plain.chain(table, ()).predict(theta, table), rtol=1e-9
        )
    np.testing.assert_array_equal(theta, before)


@pytest.mark.parametrize("run", [None, "cup"], ids=["no run is named", "the function knows the runs"])
def test_a_loop_over_the_rows_does_not_run_on_into_the_next_recording_where_no_run_is_named(run):
    """Two cups of coffee in two tables: each is as hot as the first one was when its own recording begins."""

    def cooling(p, data):
        out, temperature = [], p["start_c"]
        for k in range(len(data["t_min"])):
            if k and run is not None and data["cup"][k] != data["cup"][k - 1]:
                temperature = p["start_c"]
            out.append(temperature)
            temperature -= 0.1 * (temperature - 20)
        return np.array(out)

    minutes = np.arange(5.0)
    both = RunTable(
        {"t_min": np.tile(minutes, 2), "cup": np.repeat(["first", "second"], 5), "temp_c": np.zeros(10)},
        time="t_min",
        run="cup",
    )
    simulator = Simulator("temp_c", "degC", {"start_c": Uniform(80, 95)}, simulate=cooling, time="t_min", run=run)
    system = System.of(simulator, both)
    theta = np.array([[85.0], [90.0]])
    expected = 20 + (theta - 20) * 0.9 ** np.tile(minutes, 2)
    np.testing.assert_allclose(system.chain(both, ()).predict(theta, both), expected)


@pytest.mark.parametrize("vectorized", [False, True])
def test_a_function_that_draws_random_numbers_is_refused(vectorized):
    rng = np.random.default_rng(5)

    def noisy(p, data):
        return p["a"] * data["x"] + p["b"] + rng.normal(0, 0.1, len(data["x"]))

    with pytest.raises(ParameterError, match=r"simulate.*called again.*no random numbers"):
        _system(noisy, vectorized=vectorized)
