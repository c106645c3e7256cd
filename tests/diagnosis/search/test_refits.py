"""Refits, and those that are spared."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from refitted import state_with_nulls

from probewise.diagnosis import posterior
from probewise.diagnosis import search as searching
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.search import search_with_formulas
from probewise.diagnosis.search.hypotheses import (
    Evidences,
    Refits,
    _amplitudes_in_residual,
    hypothesis_probabilities,
)
from probewise.effects import Extent
from probewise.effects.noise import correlated_noise, random_walk
from probewise.priors import LogUniform, Uniform
from probewise.systems import Law, RunTable, Simulator

_N = 120


@pytest.fixture(scope="module")
def prepared():
    """A straight line that leaves out the room's temperature, of lambda about 11."""
    rng = np.random.default_rng(7)
    force, room = 10 * rng.random(_N), 20 + np.cumsum(rng.normal(size=_N))
    y = 2.0 + 0.5 * force + 0.05 * (room - room.mean()) / room.std() + 0.05 * rng.normal(size=_N)
    table = RunTable({"t_s": np.arange(float(_N)), "force": force, "room": room, "y": y}, time="t_s", run=None)
    simulator = Simulator(
        "y", "V", {"zero": (-10, 10), "slope": (0, 2)}, simulate=lambda p, u: p["zero"] + p["slope"] * u["force"],
        time="t_s",
    )  # fmt: skip
    return prepare_system(simulator, table)


@pytest.fixture(scope="module")
def state(prepared):
    return _state(prepared)


def _state(prepared):
    extent = Extent.of(prepared.recording)
    return state_with_nulls(prepared, {kind.name: kind.for_extent(extent) for kind in (correlated_noise, random_walk)})


def test_only_a_fit_that_gains_is_weighed_under_every_noise(state):
    weighed = state.refits.refit_with_effect(state.null, state.effects["sensitivity:room"])[0]
    assert weighed.evidence[()].log_z > state.null.evidence[()].log_z + 20
    idle = state.refits.refit_with_effect(state.null, state.effects["input_offset:force"])[0]
    assert idle.evidence.keys() == state.null.evidence.keys()
    assert not idle.is_significantly_better(state.null)
    assert idle.log_z <= state.null.log_z + 0.02


def test_a_second_search_makes_hardly_a_refit_again(prepared, monkeypatch):
    fitted = []
    whole = Refits.fit_and_weigh
    monkeypatch.setattr(
        Refits, "fit_and_weigh", lambda self, model, *a, **k: fitted.append(model.names) or whole(self, model, *a, **k)
    )
    first = searching.search(prepared)
    made = list(fitted)
    fitted.clear()
    again = searching.search(prepared, after=first)
    # Only the null is fitted once more, from the leading fits of one effect.
    assert any(made)
    assert not any(fitted)
    assert again.posterior.marginal_over_noise == pytest.approx(first.posterior.marginal_over_noise, abs=1e-6)


def test_amounts_of_one_value_for_each_run_leave_what_they_have_in_common_to_the_parameter():
    """Of four runs a parameter takes up the mean all but a ten-thousandth; route two: differences from the mean.

    By least squares alone the trace that is left gets any size: here the noise along it makes all values 30 off.
    """
    runs = np.repeat(np.eye(4), 25, axis=0)
    common = np.full(4, 0.5)
    projected = runs - (1 - 1e-4) * (runs @ common)[:, None] * common[None, :]
    values = np.array([0.4, -0.3, 0.2, -0.3])
    trace = projected @ common
    residual = runs @ values + 6e-3 * trace / np.linalg.norm(trace)
    plain = np.linalg.lstsq(projected, residual)[0]
    assert np.abs(plain - values).max() > 3.0
    np.testing.assert_allclose(_amplitudes_in_residual(projected, residual), values, atol=0.02)


def test_a_slope_that_differs_from_run_to_run_is_fitted_as_well_as_one_straight_line_for_each():
    """Route two: least squares with a slope of its own for each of six runs."""
    rng = np.random.default_rng(3)
    force, run = 10 * rng.random(_N), np.repeat(np.arange(6.0), _N // 6)
    slope = 0.5 + np.array([0.006, -0.008, 0.003, -0.005, 0.008, -0.004])[run.astype(int)]
    y = 2.0 + slope * force + 0.05 * rng.normal(size=_N)
    table = RunTable({"force": force, "run": run, "y": y}, time=None, run="run")
    simulator = Simulator(
        "y", "V", {"zero": Uniform(-10, 10), "slope": LogUniform(0.01, 10)},
        simulate=lambda p, u: p["zero"] + p["slope"] * u["force"], run="run",
    )  # fmt: skip
    state = _state(prepare_system(simulator, table))
    found = state.refits.refit_with_effect(state.null, state.effects["differs:slope"])[0].found
    lines = np.column_stack([np.ones(_N), force[:, None] * (run[:, None] == np.arange(6.0))])
    best = y - lines @ np.linalg.lstsq(lines, y)[0]
    assert np.sum(found.residuals**2) == pytest.approx(np.sum(best**2), rel=0.02)
    assert np.abs(found.z).max() < 3.0


_N_RUNS, _N_SPARED = 3, 30


def _line(change, **more):
    """Three runs of a straight line with a change that it leaves out, and a start of its own in each run."""
    rng = np.random.default_rng(11)
    run = np.repeat(np.arange(float(_N_RUNS)), _N_SPARED)
    columns = {
        "t_s": np.tile(np.arange(float(_N_SPARED)), _N_RUNS),
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
def prepared_line():
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


def test_a_fit_that_would_stay_above_what_matters_is_given_up(decaying):
    model, law = Model(decaying.null, (), decaying.recording.plan), white_noise(len(decaying.recording))
    far = decaying.null.starts[0] + 1.5
    whole = fit(model, decaying.recording, far, law)
    asked = fit(model, decaying.recording, far, law, hopeless_above=whole.objective - 1e6)
    assert whole.settled
    assert not asked.settled
    assert asked.objective > whole.objective
    assert np.isfinite(asked.slopes).all()


def test_a_start_of_its_own_in_each_run_does_not_make_every_effect_be_refitted(prepared_line, monkeypatch):
    refitted = set()
    whole = Refits.refit_with_effect

    def noted(self, parent, effect, *more):
        refitted.add((*parent.names, effect.name))
        return whole(self, parent, effect, *more)

    monkeypatch.setattr(Refits, "refit_with_effect", noted)
    searched = searching.search(prepared_line)
    alone = {names for names in refitted if len(names) == 1}
    assert ("sensitivity:room",) in alone
    assert len(alone) < (len(prepared_line.effects) - len(prepared_line.noise_effect_names)) / 2
    assert max(searched.posterior.marginal_over_noise.items(), key=lambda kv: kv[1])[0] == ("sensitivity:room",)


def test_a_formula_is_searched_for_where_a_name_explains_a_part(monkeypatch):
    """0.3 of the room's deviation, and its product with the force, of lambda about 10, which has no name."""

    def change(u):
        room = u["room"] - u["room"].mean()
        return 0.3 * room + 0.02 * room * (u["force"] - u["force"].mean())

    searched = searching.search(_line(change))
    asked = []
    monkeypatch.setattr(searching, "search", lambda more, **k: asked.append(more.effects) or searched)
    search_with_formulas(searched)
    assert asked
    assert any(name.startswith("formula:") and "room" in name for name in asked[0])


def _refit_favoured(state):
    def posterior():
        own = Evidences(state.candidates, state.screened_log_evidences())
        return hypothesis_probabilities(own, state.prior, certain=())

    searching._refit_favoured_by_screening(state, posterior)


def test_a_pair_that_screening_about_the_null_favours_is_screened_about_its_part_first(prepared_line):
    """About the null the pair promises 500 nats; about the fit with one of the two it promises nothing."""
    searched = searching.search(prepared_line)
    state = searching.SearchState(
        {n: e for n, e in prepared_line.effects.items() if n not in prepared_line.noise_effect_names},
        searched.prior, searched.refits,
    )  # fmt: skip
    state.candidates |= {key: f for key, f in searched.evidences.fits.items() if key[1] in ((), ("sensitivity:room",))}
    pair = ("offset_drift", "sensitivity:room")
    state.about_null[pair, ()] = state.null.log_z + 500.0

    _refit_favoured(state)
    assert pair not in state.refitted_combinations | state.undetected
    (part,) = state.candidates_of_combination(("sensitivity:room",))
    assert state.screened_log_evidences()[pair, ()] < part.log_z + 3.0


def test_what_was_not_refitted_promises_no_more_than_the_refits_kept(prepared):
    """Eight pairs promise 500 nats by screening, of which six are refitted and keep nothing: the others fall, too."""
    state = _state(prepared)
    promised = state.null.log_z + 500.0
    pairs = list(itertools.combinations(sorted(state.effects), 2))[:8]
    state.about_null |= {(tuple(sorted(pair)), ()): promised for pair in pairs}

    _refit_favoured(state)
    left = {
        names: value for (names, _), value in state.screened_log_evidences().items() if names not in state.undetected
    }
    assert len(left) >= 2
    assert all(value < max(c.log_z for c in state.candidates.values()) + 3.0 for value in left.values())
    assert state.optimism > 400


@pytest.mark.parametrize(("best", "least"), [(150.0, 75.0), (60.0, 20.0)], ids=["half as much", "40 nats less"])
def test_an_effect_is_outdone_that_promises_half_as_much_and_40_nats_less(best, least):
    null, leader = (SimpleNamespace(names=names, log_z=log_z) for names, log_z in (((), 3.0), (("a",), 3.0 + best)))
    prior = SimpleNamespace(log_prior_on_mean=lambda names: 0.0)
    state = searching.SearchState({}, prior, None, candidates={(1, ()): null, (1, ("a",)): leader})
    for apart in (-1.0, 1.0):
        proposal = searching.Proposal(null.log_z + least + apart, null, "b")
        assert searching._is_outdone(state, null, proposal) is (apart < 0)


def test_pairs_are_screened_by_the_templates_whose_scores_they_have(prepared_line, monkeypatch):
    """Of a change point fewer places are screened than are refitted."""
    seen = []
    monkeypatch.setattr(
        searching, "log_bayes_factors_of_pairs", lambda _, templates, singles: seen.append((templates, singles)) or {}
    )
    state = state_with_nulls(prepared_line)
    searching._screen_pairs(state, state.null)
    templates, singles = seen[0]
    assert {name: len(templates[name]) for name in singles} == {name: len(own) for name, own in singles.items()}


def test_draws_begin_at_the_mode_under_their_noise_and_go_on_from_a_sound_proposal(prepared_line, monkeypatch):
    state = state_with_nulls(prepared_line)
    null, (_, evidence) = state.null.found, next(state.null.leading_noises())
    away, seen = replace(null, z=null.z + 0.3), []
    whole = posterior.draw_by_importance

    def noted(problem, fits, law, *, sizes, **more):
        seen.extend(fits)
        return whole(problem, fits, law, sizes=(*sizes[:3], 1.0 * sizes[0]), **more)

    monkeypatch.setattr(posterior, "draw_by_importance", noted)
    monkeypatch.setattr(posterior._Ridge, "kernels_beside", lambda *_: pytest.fail("other kernels"))
    draws = posterior.posterior_draws(away, evidence, prepared_line.recording, 500, rng=np.random.default_rng(1))
    assert np.abs(seen[0].z - null.z).max() < 0.05
    assert np.abs(draws.mean(axis=0) - null.z).max() < 0.1
