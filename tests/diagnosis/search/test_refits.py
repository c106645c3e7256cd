"""Refits, and those that are spared."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from refitted import state_with_nulls

from probewise.diagnosis import search as searching
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.search.hypotheses import Evidences, hypothesis_probabilities
from probewise.effects import Extent
from probewise.effects.noise import correlated_noise, random_walk
from probewise.priors import LogUniform, Uniform
from probewise.systems import RunTable, Simulator

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


def test_an_effect_that_a_refit_shows_to_be_insignificant_promises_nothing_under_any_noise(prepared):
    state = _state(prepared)
    single = state.refit_with_effect(state.null, "sensitivity:room")
    improbable = replace(single.evidence["random_walk",], log_z=single.log_z - 10.0)
    single = state.store_candidate(replace(single, evidence={**single.evidence, ("random_walk",): improbable}))
    pair = ("offset_drift", "sensitivity:room")
    state.about_parts |= {(pair, noise): single.log_z + 500.0 for noise in single.evidence}
    assert state.refit_with_effect(single, "offset_drift") is None
    assert pair in state.undetected
    assert max(value for (names, _), value in state.screened_log_evidences().items() if names == pair) < single.log_z
