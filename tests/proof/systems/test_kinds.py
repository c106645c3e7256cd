"""The library and the world make the same of the owner's file; what a case is made of."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.proof.sensors import Stratum
from probewise.proof.systems.cases import (
    KINDS,
    SystemCase,
    draw_system,
    make_noise,
    simulator_file_text,
    write_system_case,
)
from probewise.proof.systems.forms import forms_of
from probewise.proof.systems.kinds import FLOW
from probewise.systems import System, read_run_table, read_simulator


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
