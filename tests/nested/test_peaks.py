"""Peaks that a run missed are found, then weighed and won back by its check; where there are none, little is spent."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from nested_sampling import hard, problems

from probewise.nested import SliceMove
from probewise.nested.check import check_and_repeat, find_missed_peaks
from probewise.nested.clusters import Clusters
from probewise.nested.problem import Bound, Evaluator
from probewise.nested.sampler import run_once

SHARE = 0.6


@dataclass(frozen=True)
class Two:
    """Two Gaussians of sd 0.02 in [-1, 1]^4, of mass 0.4 and 0.6; the second one is cut off at `veil`."""

    veil: float = math.inf

    @property
    def prior(self):
        return problems.box(4, -1, 1)

    @property
    def log_z(self):
        return -4 * math.log(2.0)

    def log_likelihood(self, theta):
        norm = -4 * (math.log(0.02) + 0.5 * problems.LOG_2PI)
        first, second = (-0.5 * ((theta - at) ** 2).sum(axis=1) / 0.02**2 + norm for at in (-0.4, 0.5))
        return np.asarray(np.logaddexp(first + math.log(1 - SHARE), np.minimum(second + math.log(SHARE), self.veil)))


@pytest.fixture(scope="module")
def robbed():
    """A run that saw the second mode up to 60 nats below its top, from where on there were no live points in it."""
    return run_once(Two(veil=-50.0), rng=np.random.default_rng(1), n_live=100)


def missing_from(run, problem):
    """Samples about the peaks that a run has missed, and the evaluations that they cost."""
    evaluate = Evaluator(problem)
    found = find_missed_peaks(run, evaluate, max_calls=10 * run.n_calls, rng=np.random.default_rng(2))
    return found, evaluate.n_calls


def checked(run, problem, max_cost):
    rng = np.random.default_rng(3)
    return check_and_repeat(
        run, Evaluator(problem), SliceMove(), run_once, max_cost=max_cost, max_calls=None, least_live=20, rng=rng
    )


def share_of_second(run):
    return float(run.weight[run.theta.mean(axis=1) > 0.05].sum())


def test_a_mode_without_live_points_is_found_as_wide_as_it_is(robbed):
    assert share_of_second(robbed) < 1e-6
    (theta,), n_calls = missing_from(robbed, Two())
    assert np.allclose(theta.mean(axis=0), 0.5, atol=0.01)
    assert np.allclose(theta.std(axis=0), 0.02, rtol=0.4)
    assert n_calls < robbed.n_calls / 3


def test_a_lost_mode_is_won_back_by_hops_to_it(robbed):
    result = checked(robbed, Two(), 5.0)
    assert not result.warnings
    assert abs(result.log_z - Two().log_z) < 3.9 * result.log_z_error
    # Hops hold the share of the live points in each mode: it scatters as that of independent ones.
    assert abs(share_of_second(result) - SHARE) < 3.9 * math.sqrt(SHARE * (1 - SHARE) * result.information / 100)
    assert result.n_calls <= 5 * robbed.n_calls


def test_a_lost_mode_that_cannot_be_won_back_within_the_limit_is_a_doubt(robbed):
    """By a second estimate of the whole, whose posterior has 0.6 in the mode; its log Z is right to its error."""
    result = checked(robbed, Two(), 1.9)
    assert result.log_z == robbed.log_z
    assert result.check is not None
    assert abs(result.check.log_z - Two().log_z) < 3.9 * result.check.log_z_error
    (said,) = (note for note in result.warnings if "have lost or never met has a log Z of about" in note)
    weighed = float(said.split("about ")[1].split(",")[0])
    assert weighed == pytest.approx(result.check.log_z + math.log(SHARE), abs=0.5)
    assert result.n_calls <= 1.9 * robbed.n_calls


@pytest.mark.slow
def test_a_spike_that_no_live_point_met_is_found_and_doubts_the_run():
    """Nine of ten such spikes are found, so that all three seeds miss theirs once in a thousand."""
    known = hard.spike_on_slab()
    right = []
    for seed in range(3):
        run = run_once(known, rng=np.random.default_rng([seed, 20]), n_live=300)
        assert run.log_z < known.log_z - 3  # not met by the run
        result = checked(run, known, 2.0)
        said = any("never met" in note for note in result.warnings)
        right.append(said and result.check is not None and abs(result.check.log_z - known.log_z) < 1.5)
    assert any(right)


def test_hops_hold_the_share_of_each_mode_and_reach_it_from_another():
    """Above a bound two squares' areas are known: 0.04 and 0.01 of 0.05. Four sds, one false alarm in 16,000 each."""

    def function(theta):
        large, small = (np.abs(theta - at).max(axis=1) < half for at, half in ((0.3, 0.1), (0.8, 0.05)))
        return np.where(large | small, 0.0, -1.0)

    evaluate = Evaluator(problems.Known(problems.box(2, 0, 1), function, 0.0))
    rng = np.random.default_rng(6)
    modes = Clusters.from_groups(
        [0.3 + 0.1 * rng.standard_normal((300, 2)), 0.8 + 0.05 * rng.standard_normal((300, 2))]
    )
    move = SliceMove(hops=0, differences=0.0, modes=modes)
    now = evaluate(rng.uniform(0.2, 0.4, (2000, 2)), rng)
    for _ in range(6):
        now, tally = move.draw(now, Bound(-0.5, 0.0), now.u, evaluate, rng)
    small = now.u[:, 0] > 0.6
    assert abs(small.mean() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / 2000)
    assert (now.log_likelihood == 0.0).all()
    assert tally.n_evaluated > 2000
    inside = now.u[small] - 0.75
    assert abs(inside.mean() - 0.05) < 4 * 0.1 / math.sqrt(12 * inside.size)
