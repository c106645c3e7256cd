"""Refits that are not made, or given up: of what screening about a near fit refuses, or stays far behind."""

from __future__ import annotations

import math

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.search import search as searching
from probewise.diagnosis.search.refits import Refits
from probewise.diagnosis.search.search import search_with_formulas
from probewise.diagnosis.search.searched import Evidences, posterior_of
from probewise.progress import silent
from probewise.systems import Law, RunTable, Simulator

_N_RUNS, _N = 3, 30


def _line(change, **more):
    """Three runs of a straight line with a change that it leaves out, and a start of its own in each run."""
    rng = np.random.default_rng(11)
    run = np.repeat(np.arange(float(_N_RUNS)), _N)
    columns = {
        "t_s": np.tile(np.arange(float(_N)), _N_RUNS),
        "run": run,
        "force": 10 * rng.random(len(run)),
        "room": 20 + rng.normal(size=len(run)),
    }
    y = 2.0 + 0.1 * run + 0.5 * columns["force"] + change(columns) + 0.05 * rng.normal(size=len(run))
    table = RunTable({**columns, "y": y}, time="t_s", run="run")
    simulator = Simulator(
        "y", "V", {"zero": ("normal", 0, 5), "slope": (0, 2)}, per_run=["zero"],
        simulate=lambda p, u: p["zero"] + p["slope"] * u["force"], time="t_s", run="run", **more,
    )  # fmt: skip
    return prepare_system(simulator, table)


@pytest.fixture(scope="module")
def prepared():
    return _line(lambda u: 0.3 * (u["room"] - u["room"].mean()))


@pytest.fixture(scope="module")
def decaying():
    """A cup that cools, read each minute: a law of which the room's drift is left out."""
    rng = np.random.default_rng(3)
    t = np.arange(40.0)
    y = 20 + 60 * np.exp(-t / 12) + 0.2 * t + 0.1 * rng.normal(size=len(t))
    law = Law({"c": "start"}, lambda s, p, u: {"c": (20 - s["c"]) / p["tau"]})
    simulator = Simulator("y", "C", {"start": (40, 120), "tau": ("log", 1, 100)}, law=law, time="t_min")
    return prepare_system(simulator, RunTable({"t_min": t, "y": y}, time="t_min", run=None))


@pytest.fixture(scope="module")
def searched_line(prepared):
    return searching.search(prepared)


@pytest.fixture(scope="module")
def searched_cup(decaying):
    return searching.search(decaying)


def _far_start(prepared):
    return prepared.null.starts[0] + 1.5


def test_a_fit_that_would_stay_above_what_matters_is_given_up(decaying, searched_cup):
    model = Model(decaying.null, (), decaying.recording.plan)
    law = searched_cup.null.law
    whole = fit(model, decaying.recording, _far_start(decaying), law)
    asked = fit(model, decaying.recording, _far_start(decaying), law, hopeless_above=whole.objective - 1e6)
    assert whole.settled
    assert not asked.settled
    assert asked.objective > whole.objective
    assert np.isfinite(asked.slopes).all()


def test_a_fit_that_may_still_come_down_is_not(decaying, searched_cup):
    model = Model(decaying.null, (), decaying.recording.plan)
    law = searched_cup.null.law
    whole = fit(model, decaying.recording, _far_start(decaying), law)
    same = fit(model, decaying.recording, _far_start(decaying), law, hopeless_above=whole.objective + 1.0)
    np.testing.assert_array_equal(same.z, whole.z)


def test_only_fits_of_a_law_are_given_up(decaying, searched_cup, prepared, searched_line):
    for ready, searched, spared in ((decaying, searched_cup, True), (prepared, searched_line, False)):
        refits = searched.refits
        best = min(candidate.found.objective for candidate, _ in refits.known.values())
        limit = refits._hopeless_above(Model(ready.null, (), ready.recording.plan))
        assert limit == (best + 40.0 if spared else math.inf)


def test_a_start_of_its_own_in_each_run_does_not_make_every_effect_be_refitted(prepared, monkeypatch):
    refitted = set()
    whole = Refits.refit_with_effect

    def noted(self, parent, effect, *more):
        refitted.add((*parent.names, effect.name))
        return whole(self, parent, effect, *more)

    monkeypatch.setattr(Refits, "refit_with_effect", noted)
    searched = searching.search(prepared)
    alone = {names for names in refitted if len(names) == 1}
    assert ("sensitivity:room",) in alone
    assert len(alone) < (len(prepared.effects) - len(prepared.noise_effect_names)) / 2
    assert max(searched.posterior.marginal_over_noise.items(), key=lambda kv: kv[1])[0] == ("sensitivity:room",)


def test_no_formula_is_searched_for_beside_a_name_that_explains_everything(searched_line, monkeypatch):
    monkeypatch.setattr(searching, "search", lambda *a, **k: pytest.fail("searched once more"))
    assert search_with_formulas(searched_line) is searched_line


def test_a_formula_is_searched_for_where_a_name_explains_a_part(monkeypatch):
    """0.3 of the room's deviation, and a curve of its square of lambda about 10, which has no name here."""

    def change(u):
        room = u["room"] - u["room"].mean()
        return 0.3 * room + 0.05 * (room**2 - np.mean(room**2))

    searched = searching.search(_line(change))
    asked = []
    monkeypatch.setattr(searching, "search", lambda more, **k: asked.append(more.effects) or searched)
    search_with_formulas(searched)
    assert asked
    assert any(name.startswith("formula:") and "room" in name for name in asked[0])


def test_a_pair_that_screening_about_the_null_favours_is_screened_about_its_part_first(prepared):
    """About the null the pair promises 500 nats; about the fit with one of the two it promises nothing."""
    searched = searching.search(prepared)
    state = searching.SearchState(
        {n: e for n, e in prepared.effects.items() if n not in prepared.noise_effect_names},
        searched.prior, searched.refits.noises, searched.refits.templates, searched.refits,
    )  # fmt: skip
    state.sensors |= searched.nulls
    state.candidates |= {key: f for key, f in searched.evidences.fits.items() if key[1] in ((), ("sensitivity:room",))}
    pair = ("offset_drift", "sensitivity:room")
    state.about_null[pair, ()] = state.null.log_z + 500.0

    def posterior():
        return posterior_of(
            Evidences(state.candidates, state.screened_log_evidences()), state.prior, certain=(), n_forms=1
        )

    searching._refit_favoured_by_screening(state, posterior, silent)
    assert pair not in state.refitted_combinations | state.undetected
    (part,) = state.candidates_of_combination(("sensitivity:room",))
    assert state.screened_log_evidences()[pair, ()] < part.log_z + 3.0
