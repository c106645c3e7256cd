"""A search brought to a finer integration step without searching again."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.diagnosis import diagnose_simulator as finer_step
from probewise.diagnosis.diagnose_simulator import prepare_system, searched_at_step
from probewise.diagnosis.search.search import search
from probewise.systems import Law, RunTable, Simulator

N, SD = 40, 1e-3
TIMES = np.linspace(0.0, 4.0, N)
KEPT = ("drag:v", "damping:v", "forcing:v", "gain_drift", "correlated_noise")


@pytest.fixture(scope="module")
def prepared():
    """A speed that falls by damping and drag, of which the law has the damping; a few of the effects."""
    k, a, v0 = 0.4, 0.5, 20.0  # v' = -k v - a v^2
    exact = k / ((k / v0 + a) * np.exp(k * TIMES) - a)
    y = exact + SD * np.random.default_rng(4).normal(size=N)
    table = RunTable({"t_s": TIMES, "v_mps": y}, time="t_s", run=None)
    law = Law({"v": "v0"}, lambda s, p, u: {"v": -p["k"] * s["v"]}, max_step_s=0.1)
    simulator = Simulator("v_mps", "m/s", {"k": (0, 2), "v0": (10, 30)}, law=law, time="t_s")
    every = prepare_system(simulator, table)
    return replace(every, effects={name: every.effects[name] for name in KEPT if name in every.effects})


def at_step(prepared, max_step):
    return replace(prepared, null=replace(prepared.null, max_step=max_step))


@pytest.fixture(scope="module")
def first(prepared):
    return search(at_step(prepared, 0.02))


def test_what_has_a_chance_is_refitted_and_is_as_probable_as_by_another_search(prepared, first):
    stages = []
    found = searched_at_step(first, 0.01, progress=lambda stage, *numbers, **note: stages.append(stage))
    again = search(at_step(prepared, 0.01)).posterior.marginal_over_noise
    by_mean = found.posterior.marginal_over_noise
    assert max(by_mean, key=by_mean.get) == ("drag:v",)
    for names, p in again.items():
        assert by_mean.get(names, 0.0) == pytest.approx(p, abs=0.02)
    finer = [names for (_, names), fit in found.evidences.fits.items() if fit.found.model.sensor.max_step == 0.01]
    assert {(), ("drag:v",)} <= set(finer)
    assert len(stages) == len(finer) < len(first.evidences.fits)
    assert found.prepared.null.max_step == found.prepared.apparatus.system.max_step == 0.01
    assert all(null.max_step == 0.01 for null in found.nulls.values())
    # Effects were bound to the predictions of the coarser step, and are stored with them.
    assert found.prepared.apparatus.about is first.prepared.apparatus.about


def test_a_search_that_errors_of_the_integration_may_have_led_is_made_again(prepared):
    """One step of fourth order between rows 0.1 s apart, in which the drag at first halves the speed."""
    first = search(at_step(prepared, 0.2))
    assert searched_at_step(first, 0.01) is None


def test_a_null_without_a_chance_may_move_by_more(first, monkeypatch):
    assert first.posterior.marginal_over_noise[()] < 1e-9
    refitted = finer_step._refitted

    def moved(searched, held, system):
        return refitted(searched, held, system).with_log_evidence_shifted(0.0 if held.names else -5.0)

    monkeypatch.setattr(finer_step, "_refitted", moved)
    found = searched_at_step(first, 0.01)
    assert found.evidences.fits[0, ()].log_z < first.evidences.fits[0, ()].log_z - 4.0
