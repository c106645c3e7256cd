"""Live points added where they count: counts by births and deaths, evidences against known ones, and what is gained."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from nested_sampling import problems
from scipy.stats import chi2, norm

from probewise.errors import ParameterError, ShapeError
from probewise.nested import Agreement, Goal, NestedResult, intensified, merge, n_alive_at_death, run
from probewise.priors import Normal, Product


@pytest.fixture(scope="module")
def first() -> NestedResult:
    return run(problems.problem("Gaussian 4-D"), rng=np.random.default_rng(3), n_live=60, max_cost=1.0)


@pytest.mark.parametrize("name", ["plateau", "Gaussian 4-D"])
@pytest.mark.parametrize("goal", ["posterior", "evidence"])
def test_the_result_is_a_run_with_more_points_alive_between_two_levels(name: str, goal: Goal) -> None:
    posed, rng = problems.problem(name), np.random.default_rng(4)
    before = run(posed, rng=rng, n_live=50, max_cost=1.0)
    after = intensified(before, posed, n_live=40, goal=goal, rng=rng)
    assert np.array_equal(np.lexsort((after.label, after.log_likelihood)), np.arange(after.n_dead))
    assert np.array_equal(
        n_alive_at_death(after.log_likelihood, after.label, after.log_birth, after.birth_label), after.n_at_death
    )
    assert 50 < after.n_at_death.max() <= 90  # a thread may start in the middle of a round
    assert math.isclose(np.exp(after.log_weight).sum(), 1.0)
    again = posed.log_likelihood(after.theta)
    np.testing.assert_allclose(again, after.log_likelihood, rtol=1e-9, atol=1e-9)
    # A parent is alive at the level above which its child was drawn.
    child = np.flatnonzero(after.parent >= 0)
    assert (after.log_likelihood[after.parent[child]] >= after.log_birth[child]).all()
    assert (after.log_birth[after.parent[child]] <= after.log_birth[child]).all()
    assert after.n_calls > before.n_calls
    assert after.warnings == before.warnings


def test_points_for_the_posterior_give_more_samples_for_an_evaluation_than_another_run(first: NestedResult) -> None:
    """Half of a run's nats hold nothing: over 30 seeds the ratio was 1.3 to 2.1."""
    posed, rng = problems.problem("Gaussian 4-D"), np.random.default_rng(5)
    after = intensified(first, posed, n_live=120, rng=rng)
    gained = (after.n_eff - first.n_eff) / (after.n_calls - first.n_calls)
    assert gained > first.n_eff / first.n_calls


def test_points_for_the_evidence_reduce_its_error(first: NestedResult) -> None:
    """Three times as many points from the start to the bulk: 0.58 of the error if they were everywhere."""
    after = intensified(
        first, problems.problem("Gaussian 4-D"), n_live=120, goal="evidence", rng=np.random.default_rng(6)
    )
    assert after.log_z_error < 0.8 * first.log_z_error


@pytest.mark.slow
@pytest.mark.parametrize("goal", ["posterior", "evidence"])
def test_evidences_scatter_by_their_errors(goal: Goal) -> None:
    """Mean and sum of squares of 40 z at a false-alarm rate of one in a thousand each."""
    posed, z = problems.problem("Gaussian 4-D"), []
    for rng in np.random.default_rng(7).spawn(40):
        before = run(posed, rng=rng, n_live=50, max_cost=1.0)
        after = intensified(before, posed, n_live=100, goal=goal, rng=rng)
        z.append((after.log_z - posed.log_z) / after.log_z_error)
    assert abs(np.mean(z)) * math.sqrt(40) < norm.isf(5e-4)
    assert chi2.ppf(5e-4, 40) < np.square(z).sum() < chi2.isf(5e-4, 40)


@pytest.mark.slow
def test_the_posterior_is_that_of_the_problem() -> None:
    """The mean square of Gaussian samples, in units of its variance: each run's sd is sqrt(2 / (4 n_eff))."""
    z = []
    for rng in np.random.default_rng(8).spawn(30):
        posed = problems.problem("Gaussian 4-D")
        after = intensified(run(posed, rng=rng, n_live=50, max_cost=1.0), posed, n_live=200, rng=rng)
        centred = after.theta - after.mean()
        spread = np.linalg.slogdet((centred * after.weight[:, None]).T @ centred)[1]
        plain = run(posed, rng=rng, n_live=400, max_cost=1.0)
        other = np.linalg.slogdet(plain.covariance())[1]
        z.append((spread - other) / math.sqrt(2 * 4 * (1 / after.n_eff + 1 / plain.n_eff)))
    # Chains that remember widen the scatter; a bias in the weights would show in the mean.
    assert abs(np.mean(z)) < 3.3 * max(1.0, float(np.std(z, ddof=1))) / math.sqrt(30)


def test_it_can_be_done_again_and_merged(first: NestedResult) -> None:
    posed, rng = problems.problem("Gaussian 4-D"), np.random.default_rng(9)
    twice = intensified(intensified(first, posed, n_live=30, rng=rng), posed, n_live=30, rng=rng)
    assert 90 < twice.n_at_death.max() <= 120
    other = run(posed, rng=np.random.default_rng(10), n_live=60, max_cost=1.0)
    assert 150 < merge([twice, other], rng=rng).n_at_death.max() <= 180


def test_the_error_of_merged_runs_that_disagree_stays_as_wide_as_their_scatter(first: NestedResult) -> None:
    apart = Agreement((-9.0, -5.0), (0.1, 0.1), 800.0, 0.0)
    merged = dataclasses.replace(first, agreement=apart, log_z_error=apart.log_z_sd)
    more = intensified(merged, problems.problem("Gaussian 4-D"), n_live=20, rng=np.random.default_rng(3))
    assert more.log_z_error == apart.log_z_sd


def test_the_same_seed_gives_the_same_points(first: NestedResult, tmp_path) -> None:
    posed = problems.problem("Gaussian 4-D")
    one, two = (intensified(first, posed, n_live=30, rng=np.random.default_rng(11)) for _ in range(2))
    assert np.array_equal(one.theta, two.theta)
    one.save(tmp_path / "run.npz")
    assert np.array_equal(NestedResult.load(tmp_path / "run.npz").theta, one.theta)


def test_max_calls_ends_the_new_points_early_and_the_result_is_whole(first: NestedResult) -> None:
    posed = problems.problem("Gaussian 4-D")
    short = intensified(first, posed, n_live=100, max_calls=6000, rng=np.random.default_rng(12))
    assert short.n_calls - first.n_calls <= 6000
    assert short.n_dead > first.n_dead + 100
    assert abs(short.log_z - posed.log_z) < 4 * short.log_z_error


def test_what_cannot_be_added_to_is_refused(first: NestedResult) -> None:
    posed, rng = problems.problem("Gaussian 4-D"), np.random.default_rng(13)
    with pytest.raises(ParameterError, match="n_live is 5; allowed: 10 or more"):
        intensified(first, posed, n_live=5, rng=rng)
    with pytest.raises(ParameterError, match="goal is 'both'"):
        intensified(first, posed, n_live=20, goal="both", rng=rng)
    with pytest.raises(ParameterError, match="incomplete run"):
        intensified(dataclasses.replace(first, complete=False, stop_reason="interrupted"), posed, n_live=20, rng=rng)
    with pytest.raises(ShapeError, match="allowed: those of the run"):
        intensified(first, problems.problem("plateau"), n_live=20, rng=rng)

    @dataclasses.dataclass
    class Other:
        prior = Product({name: Normal(0.0, 1.0) for name in first.names})

        def log_likelihood(self, theta):
            return -theta.sum(axis=1)

    with pytest.raises(ParameterError, match="as in the run"):
        intensified(first, Other(), n_live=20, rng=rng)
