"""A mode that died out among the live points is found, weighed and won back; where none did, little is spent."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from nested_sampling import problems
from scipy.special import logsumexp

from probewise.nested import NestedResult, SliceMove, refine
from probewise.nested.check import check_and_repeat
from probewise.nested.clusters import Clusters
from probewise.nested.missed import MissedHills, find_missed_hills, log_evidence_of_unmet_hills
from probewise.nested.moves import HoppingMove
from probewise.nested.problem import Bound, Evaluator, Samplable
from probewise.nested.sampler import run_once

SHARE = 0.6


@dataclass(frozen=True)
class Two:
    """Two Gaussians of sd 0.02 in [-1, 1]^4, of mass 0.4 and 0.6; the second one is cut off at `veil`."""

    veil: float = math.inf

    @property
    def prior(self) -> problems.Product:
        return problems.box(4, -1, 1)

    @property
    def log_z(self) -> float:
        return -4 * math.log(2.0)

    def log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        norm = -4 * (math.log(0.02) + 0.5 * problems.LOG_2PI)
        first, second = (-0.5 * ((theta - at) ** 2).sum(axis=1) / 0.02**2 + norm for at in (-0.4, 0.5))
        return np.asarray(np.logaddexp(first + math.log(1 - SHARE), np.minimum(second + math.log(SHARE), self.veil)))


@pytest.fixture(scope="module")
def robbed() -> NestedResult:
    """A run that saw the second mode up to 60 nats below its top, from where on there were no live points in it."""
    return run_once(Two(veil=-50.0), rng=np.random.default_rng(1), n_live=100)


def missing_from(run: NestedResult, problem: Samplable, max_calls: float) -> MissedHills:
    return find_missed_hills(run, problem, max_calls=max_calls, rng=np.random.default_rng(2))


def share_of_second(run: NestedResult) -> float:
    return float(run.weight[run.theta.mean(axis=1) > 0.05].sum())


def test_a_mode_without_live_points_is_found_and_weighed(robbed: NestedResult) -> None:
    """Log Z by weighted draws, within 0.5 of the mass that the mode was given: their scatter is below 0.1."""
    assert share_of_second(robbed) < 1e-6
    missing = missing_from(robbed, Two(), 10 * robbed.n_calls)
    assert len(missing.lost) == 1
    assert log_evidence_of_unmet_hills(missing.lost, robbed) == pytest.approx(Two().log_z + math.log(SHARE), abs=0.5)
    assert np.allclose(missing.lost[0].theta.mean(axis=0), 0.5, atol=0.02)
    assert missing.n_calls < robbed.n_calls / 3


def test_a_refinement_of_a_run_that_was_not_checked_looks_for_lost_modes_itself(robbed: NestedResult) -> None:
    """The look leaves the refined evidence as it was."""
    found, without = (
        refine(robbed, Two(), rng=np.random.default_rng(8), n_draws=1000, look=look) for look in (True, False)
    )
    assert found.log_z == without.log_z
    assert without.sound
    assert "a part of the posterior that the live points have lost has a log Z of about" in found.doubts[-1]
    assert 0 < found.n_calls - without.n_calls < robbed.n_calls / 2


def check(robbed: NestedResult, max_cost: float) -> NestedResult:
    return check_and_repeat(
        robbed,
        Two(),
        SliceMove(),
        run_once,
        max_cost=max_cost,
        max_calls=None,
        least_live=10,
        rng=np.random.default_rng(3),
    )


def test_a_lost_mode_is_won_back_by_hops_to_it(robbed: NestedResult) -> None:
    result = check(robbed, 5.0)
    assert not result.warnings
    assert abs(result.log_z - Two().log_z) < 3.9 * result.log_z_error
    # Hops hold the share of the live points in each mode: it scatters as that of independent ones.
    assert abs(share_of_second(result) - SHARE) < 3.9 * math.sqrt(SHARE * (1 - SHARE) * result.information / 100)
    assert result.n_calls <= 5 * robbed.n_calls


def test_a_lost_mode_that_cannot_be_won_back_within_the_limit_is_a_doubt(robbed: NestedResult) -> None:
    result = check(robbed, 1.5)
    assert result.log_z == robbed.log_z
    assert any(
        "a part of the posterior that the live points have lost has a log Z of about" in note
        for note in result.warnings
    )
    assert result.n_calls <= 1.5 * robbed.n_calls


@pytest.mark.parametrize("name", ["Gaussian 4-D", "circle", "shells 2-D", "eggbox"])
def test_where_no_mode_was_lost_none_is_doubted_for_a_third_of_the_cost(name: str) -> None:
    known = problems.problem(name)
    run = run_once(known, rng=np.random.default_rng(4), n_live=100)
    missing = missing_from(run, known, 10 * run.n_calls)
    assert not missing.doubts(run)  # of the eggbox's eighteen peaks a small one may have lost half of its points
    assert missing.n_calls < run.n_calls / 3


def test_without_evaluations_left_nothing_is_looked_for(robbed: NestedResult) -> None:
    missing = missing_from(robbed, Two(), 5)
    assert not missing.lost
    assert missing.n_calls <= 5


def test_hops_hold_the_share_of_each_mode_and_reach_it_from_another() -> None:
    """Above a bound two squares' areas are known: 0.04 and 0.01 of 0.05. Four sds, one false alarm in 16,000 each."""

    def function(theta: np.ndarray) -> np.ndarray:
        large, small = (np.abs(theta - at).max(axis=1) < half for at, half in ((0.3, 0.1), (0.8, 0.05)))
        return np.where(large | small, 0.0, -1.0)

    evaluate = Evaluator(problems.Known(problems.box(2, 0, 1), function, 0.0))
    rng = np.random.default_rng(6)
    modes = Clusters.from_groups(
        [0.3 + 0.1 * rng.standard_normal((300, 2)), 0.8 + 0.05 * rng.standard_normal((300, 2))]
    )
    move = HoppingMove(SliceMove(hops=0, differences=0.0), modes)
    now = evaluate(rng.uniform(0.2, 0.4, (2000, 2)), rng)
    for _ in range(6):
        now, tally = move.draw(now, Bound(-0.5, 0.0), now.u, evaluate, rng)
    small = now.u[:, 0] > 0.6
    assert abs(small.mean() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / 2000)
    assert (now.log_likelihood == 0.0).all()
    assert tally.n_evaluated > 2000
    inside = now.u[small] - 0.75
    assert abs(inside.mean() - 0.05) < 4 * 0.1 / math.sqrt(12 * inside.size)


def test_first_live_points_forget_the_few_possible_draws_at_which_they_began() -> None:
    """One of 5,040 draws is possible. Means of 50 points scatter between 20 seeds as those of independent points.

    A ratio of variances above 3 has a probability of 1e-5 (chi-square of 19 degrees of freedom); of points that stayed
    with the three or four draws it would be above ten.
    """

    def function(theta: np.ndarray) -> np.ndarray:
        return np.where((np.diff(theta, axis=1) > 0).all(axis=1), 0.0, -np.inf)

    known = problems.Known(problems.box(7, 0, 1), function, 0.0)
    middle = []
    for seed in range(20):
        run = run_once(known, rng=np.random.default_rng([7, seed]), n_live=50, stop=lambda _: "at once")
        first = run.theta[run.log_birth == -np.inf]
        middle.append(first[:, 3].mean())
    # The fourth of seven ordered uniforms is Beta(4, 4), of variance 1/36.
    assert np.var(middle, ddof=1) * 36 * 50 < 3.0


def test_the_mixture_s_evidence_is_one() -> None:
    """The other route to `Two.log_z`: midpoints on a line through both modes, times the widths across it."""
    line = np.linspace(-1, 1, 20001)
    each = -0.5 * ((line[:, None] - np.array([-0.4, 0.5])) / 0.02) ** 2 - math.log(0.02) - 0.5 * problems.LOG_2PI
    mass = logsumexp(each, axis=0) + math.log(line[1] - line[0])
    total = logsumexp(4 * mass + np.log([1 - SHARE, SHARE])) - 4 * math.log(2.0)
    assert total == pytest.approx(Two().log_z, abs=1e-6)
