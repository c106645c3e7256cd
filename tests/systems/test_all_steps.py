"""All steps of a law solved at once, against stepping through them: the same equations, so the same states."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.systems import Law, RunTable
from probewise.systems.integrate import Integrations, integrate_from_known_trajectories, integrate_states
from probewise.systems.law import LawWithEffects, Limit, steps_for_table


def _pendulum(s, p, u):
    return {"phi": s["omega"], "omega": -9.81 / p["l_m"] * np.sin(s["phi"]) - p["c"] * s["omega"] + u["push"]}


LAW = Law({"phi": "phi0", "omega": 0.0}, _pendulum, hold="linear")
MIDDLE = np.array([0.7, 0.3, 0.8])  # l_m, c, phi0


def _table(n_runs=2, n_rows=40):
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
        self.table, self.effect, self.law = _table() if table is None else table, effect, law
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
    case, rng = _Case(table=_table(1, 5)), np.random.default_rng(0)
    for _ in range(40):
        case.near(MIDDLE * (1 + 0.3 * rng.normal(size=(4, 3))))
    assert 1 < len(case.memory.known) <= 48
