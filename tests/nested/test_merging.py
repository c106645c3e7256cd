"""Merged runs: counts by births and deaths against counts kept by the sampler, evidences against known ones."""

import dataclasses
import math

import numpy as np
import pytest
from nested_sampling import problems

from probewise.errors import DoubtfulResultWarning, ParameterError
from probewise.nested import merge, run
from probewise.nested.result import n_alive_at_death
from probewise.priors import Product, Uniform

N_ERRORS = 3.9


def several(problem, n_runs, *, n_live=50, seed=5, max_cost=5.0):
    spawned = np.random.default_rng(seed).spawn(n_runs)
    return [run(problem, rng=rng, n_live=n_live, max_cost=max_cost) for rng in spawned]


@pytest.fixture(scope="module")
def terraces():
    return several(problems.plateau(), 8)


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def alive(result):
    return n_alive_at_death(result.log_likelihood, result.label, result.log_birth, result.birth_label)


@pytest.mark.parametrize("name", ["plateau", "naive steps", "Rosenbrock 2-D"])
@pytest.mark.parametrize("n_replaced", [pytest.param(1, marks=pytest.mark.slow), 7])
def test_births_and_deaths_alone_give_the_count_that_the_sampler_kept(name, n_replaced):
    result = run(problems.PROBLEMS[name](), rng=np.random.default_rng(1), n_live=20, n_replaced=n_replaced)
    assert np.array_equal(alive(result), result.n_at_death)


def test_merged_runs_are_one_run_with_the_live_points_of_all(terraces, rng):
    merged = merge(terraces, rng=rng)
    assert merged.n_live == 400 == merged.n_at_death[0]
    assert merged.n_dead == sum(r.n_dead for r in terraces)
    assert merged.n_calls == sum(r.n_calls for r in terraces)
    order = np.lexsort((merged.label, merged.log_likelihood))
    assert np.array_equal(order, np.arange(merged.n_dead))
    assert np.exp(merged.log_weight).sum() == pytest.approx(1.0)
    assert np.array_equal(alive(merged), merged.n_at_death)
    assert not merged.warnings
    assert merged.memory == pytest.approx(np.mean([r.memory for r in terraces]))


def test_the_possible_share_of_the_prior_is_pooled(rng):
    """A ball in a box: a pooled share of found over drawn, and the evidence is the share."""
    prior = Product({"x": Uniform(-1, 1), "y": Uniform(-1, 1)})
    disc = problems.Known(prior, lambda t: np.where((t**2).sum(axis=1) < 0.5, 0.0, -np.inf), math.log(math.pi / 8))
    runs = [run(disc, rng=np.random.default_rng(n), n_live=n) for n in (100, 300)]
    merged = merge(runs, rng=rng)
    drawn = [r.n_live / math.exp(r.log_start) for r in runs]
    share = 400 / sum(drawn)
    assert math.exp(merged.log_start) == pytest.approx(share)
    assert merged.log_start_error == pytest.approx(math.sqrt((1 - share) / 400))
    assert abs(merged.log_z - disc.log_z) < N_ERRORS * merged.log_z_error
    assert "of the prior" in merged.summary()


def test_runs_that_disagree_say_so_and_widen_the_error(terraces, rng):
    far = [terraces[0], terraces[1], dataclasses.replace(terraces[2], log_z=terraces[2].log_z + 3)]
    with pytest.warns(DoubtfulResultWarning, match="3 runs disagree more than their errors"):
        merged = merge(far, rng=rng)
    assert merged.log_z_error == pytest.approx(np.std([r.log_z for r in far], ddof=1))
    assert "disagree" in merged.warnings[0]
    assert "doubtful: the 3 runs disagree" in merged.summary()


def test_what_is_no_independent_run_of_the_same_problem_is_refused(terraces, rng):
    one, two = terraces[:2]
    with pytest.raises(ParameterError, match="1 runs"):
        merge([one], rng=rng)
    with pytest.raises(ParameterError, match="seed_state of run 2"):
        merge([one, one], rng=rng)
    with pytest.raises(ParameterError, match="names of run 2"):
        merge([one, dataclasses.replace(two, names=("a", "b"))], rng=rng)
    with pytest.raises(ParameterError, match="n_at_death of run 2"):
        merge([one, dataclasses.replace(two, n_at_death=two.n_at_death + 1)], rng=rng)
    bare = [dataclasses.replace(r, names=(), theta=np.empty((r.n_dead, 0))) for r in (one, two)]
    with pytest.raises(ParameterError, match="without parameters"):
        merge(bare, rng=rng)
