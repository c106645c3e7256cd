"""Starts of a simulator's fit, and its integration step."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from probewise.diagnosis import diagnose_system
from probewise.diagnosis.diagnose_simulator import (
    fit_system,
    notes_on_simulator,
    recording_from_table,
    with_step_for_likely_parameters,
)
from probewise.systems import Law, RunTable, Simulator, System
from probewise.systems.integrate import Integrations

SD = 0.05
TIMES = np.arange(60.0)
HEATED = np.where(TIMES % 20 < 10, 1.0, 0.0)
PRIORS = {"tau_s": ("log", 0.01, 100), "gain": (0, 10)}
LAW = Law({"x": 0.0}, lambda s, p, u: {"x": (p["gain"] * u["power"] - s["x"]) / p["tau_s"]})


def _readings(tau, gain):
    """Return the state at every second by the closed form: the power is held from row to row."""
    x = [0.0]
    for power in HEATED[:-1]:
        x.append(gain * power + (x[-1] - gain * power) * np.exp(-1.0 / tau))
    return np.array(x)


def _table(tau, seed):
    y = _readings(tau, 3.0) + SD * np.random.default_rng(seed).normal(size=len(TIMES))
    return RunTable({"t_s": TIMES, "power": HEATED, "y": y}, time="t_s", run=None)


def _simulator(law=LAW):
    return Simulator("y", "K", PRIORS, law=law, time="t_s")


@pytest.fixture(scope="module")
def stiff():
    table, simulator = _table(0.15, 3), _simulator()
    recording = recording_from_table(simulator, table)
    return table, recording, *fit_system(System.of(simulator, table), recording)


def test_the_step_serves_all_time_constants_that_the_readings_allow(stiff):
    table, _, system, _, _ = stiff
    assert system.stiff
    for tau in (0.011, 0.05, 0.2):  # with a tenth of a second they differ by less than the noise
        predicted = system.chain(table, ()).predict(np.array([[tau, 3.0]]), table)[0]
        np.testing.assert_allclose(predicted, _readings(tau, 3.0), atol=0.2 * SD)
    assert not system.integrations.too_stiff


def test_a_law_that_needs_more_steps_than_are_taken_says_so(stiff, monkeypatch):
    table, _, _, found, sd = stiff
    monkeypatch.setattr("probewise.systems.system._MOST_STEPS", 20)
    first = System.of(_simulator(), table)
    assert not first.integrations.too_stiff
    assert with_step_for_likely_parameters(first, table, found, sd).integrations.too_stiff


@pytest.mark.parametrize("sets_step", [True, False])
def test_a_search_that_was_cut_short_advises_a_larger_step_only_where_one_was_set(sets_step):
    law = SimpleNamespace(max_step_s=0.1 if sets_step else None)
    simulator = SimpleNamespace(law=law, noise=SimpleNamespace(sd=None))
    system = SimpleNamespace(caller=None, integrations=Integrations(cut_short=True), simulator=simulator)
    (note,) = notes_on_simulator(SimpleNamespace(system=system, evaluations_of_a_search=1000), None)
    assert "after 1,000 evaluations" in note
    assert ("max_step_s" in note) is sets_step


TIMES_OF_REPAIR = np.linspace(0.0, 8.0, 41)  # about five rows a period
SD_OF_REPAIR = 1e-4


@pytest.fixture(scope="module")
def swings():
    """A spring of stiffness 36 that hardens with 20 x^3, by scipy's own integrator."""
    noise = np.random.default_rng(3)
    exact = solve_ivp(
        lambda t, s: [s[1], -36.0 * s[0] - 20.0 * s[0] ** 3 - 0.1 * s[1]],
        (0.0, TIMES_OF_REPAIR[-1]),
        [1.0, 0.0],
        t_eval=TIMES_OF_REPAIR,
        rtol=1e-10,
        atol=1e-12,
    )
    return exact.y[0] + noise.normal(0.0, SD_OF_REPAIR, len(TIMES_OF_REPAIR))


@pytest.mark.slow
def test_a_law_that_needs_finer_steps_once_it_is_repaired_gets_them(swings):
    spring = Simulator(
        "x_m",
        "m",
        {"k": ("log", 10, 100), "c": (0, 1)},
        law=Law({"x": 1.0, "v": 0.0}, lambda s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"]}),
        time="t_s",
    )
    stages = []

    def told(stage, *numbers, **note):
        stages.append(stage)

    found = diagnose_system(
        spring, {"t_s": TIMES_OF_REPAIR, "x_m": swings}, rng=np.random.default_rng(1), progress=told
    )
    assert any("once more" in stage for stage in stages)
    assert found.verdict == "named"
    assert found.combination == ("cubic:v:x",)
    cubic = next(effect for effect in found.effects if effect.name == "cubic:v:x")
    a = cubic.parameters[0]
    assert a.mean == pytest.approx(20.0, abs=4 * a.sd)
    assert found.improvement.rms_after < 2 * SD_OF_REPAIR
