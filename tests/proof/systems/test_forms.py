"""Effects that the world conceals in systems, within a law by hand; its noise; the owner's file.

Those that act row by row are held against the library's, in tests/systems/forms.
"""

from dataclasses import replace

import numpy as np
import pytest

from probewise.errors import NotConvergedError
from probewise.proof.sensors import Stratum
from probewise.proof.systems.cases import (
    KINDS,
    OTHER_NOISE,
    SystemCase,
    draw_system,
    make_noise,
    simulator_file_text,
    write_system_case,
)
from probewise.proof.systems.forms import behind_gear_play, direction_of_change, forms_of
from probewise.proof.systems.kinds import FLOW, SystemTable
from probewise.proof.systems.simulate import simulate_noise_free
from probewise.systems import System, read_run_table, read_simulator

from .conftest import T, small


def _rows(t, run=None, **columns):
    t = np.asarray(t, dtype=float)
    run = np.zeros(len(t), dtype=int) if run is None else np.asarray(run)
    return SystemTable({"t_s": t, **columns}, run, "t_s", int(run.max()) + 1)


def test_the_way_is_kept_at_rest_and_known_at_the_first_row():
    rows = _rows(range(6))
    np.testing.assert_array_equal(direction_of_change(np.array([0.0, 0, 1, 1, 0, 0]), rows), [1, 1, 1, 1, -1, -1])


def test_play_moves_nothing_until_it_is_taken_up():
    rows = _rows(range(7))
    found = behind_gear_play(np.array([0.0, 1, 2, 1.5, 1.2, 0, 1]), rows, {"width": 1.0})
    np.testing.assert_allclose(found, [-0.5, 0.5, 1.5, 1.5, 1.5, 0.5, 0.5])


SINCE = np.tile(T, 3)
FALLS = {"k": 0.0}  # of the law x' = u - k x from 2, so that only what was added acts
W = 2 * np.pi * 0.3
U = np.array([1.0, 0.0, 2.0, 0.0, -1.0, 0.5, 0.0])


def _begin(rows):
    return rows.t - rows.time_since_start


def _brought(between):
    """Integrate, over each run, a column that has these values between its rows."""
    return np.tile(np.concatenate([[0], np.cumsum(np.diff(T) * between)]), 3)


def _area_of_warm(rows):
    warm, area = rows.columns["warm"] - rows.columns["warm"].mean(), np.zeros(len(rows))
    for own in rows.rows_by_run:
        area[own[1:]] = np.cumsum(np.diff(rows.t[own]) * (warm[own[1:]] + warm[own[:-1]]) / 2)
    return area


def _after(rows, at_s):
    return np.where(rows.run == 1, np.maximum(rows.t - at_s, 0), np.where(rows.run > 1, SINCE, 0))


SOLUTIONS = {
    "nothing": ("damping:x", {"a": 0.0}, {}, lambda rows: 2 * np.exp(-0.5 * SINCE)),
    "damping beside a decay": ("damping:x", {"a": 0.3}, {}, lambda rows: 2 * np.exp(-0.8 * SINCE)),
    "damping": ("damping:x", {"a": 0.4}, FALLS, lambda rows: 2 * np.exp(-0.4 * SINCE)),
    "drag": ("drag:x", {"a": 0.4}, FALLS, lambda rows: 2 / (1 + 0.8 * SINCE)),
    "a square": ("quadratic:x:x", {"a": 0.4}, FALLS, lambda rows: 2 / (1 + 0.8 * SINCE)),
    "a cube": ("cubic:x:x", {"a": 0.4}, FALLS, lambda rows: 2 / np.sqrt(1 + 3.2 * SINCE)),
    "a constant force": ("forcing:x", {"a": 0.4}, FALLS, lambda rows: 2 + 0.4 * SINCE),
    "dry friction, until it rests": ("friction:x", {"a": 0.9}, FALLS, lambda rows: np.maximum(2 - 0.9 * SINCE, 0)),
    "rest, until a force of 2 leaves 1.2 of it": (
        "friction:x",
        {"a": 0.8},
        {"k": 0.0, "x0": 0.0, "u": [0.5, 0.5, 0.5, 2.0, 2.0, 2.0, 2.0]},
        lambda rows: 1.2 * np.maximum(SINCE - 1.9, 0),
    ),
    "a bound, which lets go at once": (
        "limit:x",
        {"level": 2.5},
        {"k": 0.0, "u": [1, 1, 1, 1, -2, -2, -2]},
        lambda rows: np.where(SINCE <= 2.4, np.minimum(2 + SINCE, 2.5), 2.5 - 2 * (SINCE - 2.4)),
    ),
    "a periodic force": (
        "periodic_forcing:x",
        {"a": 0.6, "hz": 0.3, "phase": 0.4},
        FALLS,
        lambda rows: 2 + 0.6 / W * (np.cos(W * _begin(rows) + 0.4) - np.cos(W * rows.t + 0.4)),
    ),
    "a drift": (
        "drifts:k", {"a": 0.02}, {}, lambda rows: 2 * np.exp(-0.5 * SINCE - 0.01 * (rows.t**2 - _begin(rows) ** 2))
    ),
    "a step between two rows": (
        "steps:k", {"a": 0.3, "at_s": 11.45}, {}, lambda rows: 2 * np.exp(-0.5 * SINCE - 0.3 * _after(rows, 11.45))
    ),
    "a logged column on straight lines": (
        "depends:k:warm", {"a": 0.2}, {}, lambda rows: 2 * np.exp(-0.5 * SINCE - 0.2 * _area_of_warm(rows))
    ),
    "an input held as in the row before": (
        "damping:x", {"a": 0.0}, {"k": 0.0, "u": U}, lambda rows: 2 + _brought(U[:-1])
    ),
    "an input on straight lines": (
        "damping:x", {"a": 0.0}, {"k": 0.0, "u": U, "linear": True}, lambda rows: 2 + _brought((U[:-1] + U[1:]) / 2)
    ),
    "an input that is felt beyond a dead zone": (
        "dead_zone:u",
        {"width": 0.4},
        {"k": 0.0, "u": U},
        lambda rows: 2 + _brought(np.sign(U[:-1]) * np.maximum(np.abs(U[:-1]) - 0.4, 0)),
    ),
    "a late input, which jumps between the rows": (
        "input_delay:u",
        {"tau_s": 0.25},
        {"k": 0.0, "u": [0, 0, 1, 1, 1, 1, 1]},
        lambda rows: 2 + np.maximum(SINCE - 1.25, 0),
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", SOLUTIONS)
def test_what_is_added_to_a_law_solves_as_by_hand(solve, what):
    name, numbers, options, solution = SOLUTIONS[what]
    found, rows, _ = solve(name, numbers, **options)
    np.testing.assert_allclose(found, solution(rows), rtol=1e-6, atol=1e-7 if name != "input_delay:u" else 1e-6)


def test_a_law_that_runs_away_between_two_rows_is_refused():
    kind, rows, _ = small()
    runaway = replace(kind, text=kind.text.replace('u["u"] - p["k"] * s["x"]', 'p["k"] * 50 * s["x"] ** 2'))
    with np.errstate(all="ignore"), pytest.raises(NotConvergedError, match="runs away"):
        simulate_noise_free(runaway, rows, {"k": 0.9})


DRAWN = draw_system(KINDS[3], rng=np.random.default_rng(4))
CLEAN, ROWS, SD = DRAWN.true_system.readings, DRAWN.diagnosed_table, 0.03


def drawn(name, n, seed=0):
    """Return n draws of a noise, in sds, (n, n_points)."""
    noise, rng = make_noise(name, CLEAN, ROWS, SD, rng=np.random.default_rng(seed)), np.random.default_rng(2)
    return np.array([noise.draw(CLEAN, ROWS, rng) - CLEAN for _ in range(n)]) / SD


def gained(variances):
    """Return the expected gain in nats of the true variances over the best constant one, of which lambda^2 is twice."""
    return 0.5 * (len(variances) * np.log(variances.mean()) - np.log(variances).sum())


@pytest.mark.parametrize("name", OTHER_NOISE)
def test_every_kind_of_noise_is_drawn_about_the_readings(name):
    assert np.median(np.abs(drawn(name, 1))) < 10


def test_correlated_noise_gains_what_its_pairs_tell():
    rows = ROWS.rows_by_run[0]
    found = np.mean([np.corrcoef(e[rows[:-1]], e[rows[1:]])[0, 1] for e in drawn("correlated_noise", 60)])
    pairs = len(CLEAN) - len(ROWS.rows_by_run)
    assert found == pytest.approx(np.sqrt(1 - np.exp(-144.0 / pairs)), abs=0.06)


@pytest.mark.parametrize("name", ["signal_dependent_noise", "noise_per_run"])
def test_noise_of_several_variances_gains_as_an_effect_of_lambda_12_does(name):
    """The variances are those of many draws; chance adds half a nat a row over their number."""
    n = 4000
    assert gained(drawn(name, n).var(axis=0)) == pytest.approx(72.0 + 0.5 * len(CLEAN) / n, rel=0.05)


def test_a_walk_goes_on_from_run_to_run():
    """Its variance grows with the row, to a step's for each row; the gain is that of its spectrum."""
    q2 = drawn("random_walk", 400).var(axis=0) - 1
    assert np.polyfit(np.arange(len(q2)), q2, 1)[0] == pytest.approx(q2[-20:].mean() / len(q2), rel=0.2)


def test_rounding_is_declared():
    assert make_noise("quantised", CLEAN, ROWS, SD, rng=np.random.default_rng(0)).step == pytest.approx(0.05)


def _case(kind, said='noise = {"sd": 0.5}', seed=5):
    rng = np.random.default_rng(seed)
    drawn = draw_system(kind, rng=rng)
    noise_free = drawn.simulate_all_rows([])
    noise = make_noise("white", noise_free[drawn.diagnosed_row_numbers], drawn.diagnosed_table, kind.sd, rng=rng)
    labels = tuple(f"r{k}" for k in range(drawn.table.n_runs))
    return SystemCase(Stratum("clean"), drawn, (), noise, said, labels, noise_free, np.round(noise_free, 9))


@pytest.mark.parametrize(
    "kind",
    [*KINDS[:4], *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[4:])],
    ids=lambda kind: kind.name,
)
def test_the_owners_file_predicts_what_the_world_does(kind, tmp_path):
    case = _case(kind)
    file, path, *_ = write_system_case(case, tmp_path)
    simulator = read_simulator(file)
    table = read_run_table(path, time=simulator.time, run=simulator.run)
    system = System.of(simulator, table)
    values = {**case.drawn.shared}
    for name in kind.per_run:
        values |= {f"{name}[{label}]": v for label, v in zip(case.labels, case.drawn.by_run[name], strict=True)}
    theta = np.array([[values[name] for name in system.marginals]])
    if simulator.law is not None:
        system = replace(system, max_step=system.max_step / 16)
    predicted = system.chain(table, ()).predict(theta, table)[0]
    assert 140 <= len(table) <= 520
    np.testing.assert_allclose(predicted, case.noise_free[case.drawn.diagnosed_row_numbers], atol=2e-3 * kind.sd)


@pytest.mark.parametrize("said", ["", 'noise = {"sd": 0.5, "step": 0.1}'])
def test_the_owner_says_of_the_noise_what_they_know(said, tmp_path):
    case = _case(KINDS[0], said)
    assert simulator_file_text(case).count("noise") == (1 if said else 0)
    assert read_simulator(write_system_case(case, tmp_path)[0]).noise.step == (0.1 if said else None)


def test_there_are_both_ways_in_with_and_without_time_and_runs():
    assert {kind.law is None for kind in KINDS} == {True, False}
    assert {kind.time is None for kind in KINDS} == {True, False}
    assert {kind.run is None for kind in KINDS} == {True, False}
    assert {kind.restarts_time for kind in KINDS} == {True, False}
    assert any("for k in range" in kind.text for kind in KINDS)
    assert len(KINDS) >= 10
    assert all(kind.logged for kind in KINDS)


def test_what_is_kept_back_is_two_runs_and_the_last_goes_further():
    drawn = draw_system(FLOW, rng=np.random.default_rng(2))
    flow = drawn.table.columns["flow_lpm"]
    assert flow[drawn.table.run == drawn.table.n_runs - 1].max() > 1.2 * flow[drawn.diagnosed_row_numbers].max()


def test_nothing_settles_in_runs_that_a_table_does_not_name():
    (kind,) = [kind for kind in KINDS if kind.run is None]
    names = {form.name for form in forms_of(draw_system(kind, rng=np.random.default_rng(4)).true_system)}
    assert "interference" in names
    assert "settling" not in names
