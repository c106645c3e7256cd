"""Importance refinement and updates against evidences known by another route."""

from __future__ import annotations

import numpy as np
import pytest
from nested_sampling.problems import problem
from scipy.stats import chi2, norm

from probewise.nested import NestedResult, pareto_k, refine, run, update

FALSE_ALARM = 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plateau", "Rosenbrock 2-D", "Gaussian 4-D"])
def test_the_refined_evidence_scatters_as_it_says(name: str) -> None:
    """Mean and spread of twelve standardised errors, each with a false-alarm rate of 1e-4."""
    known, n_seeds = problem(name), 12
    z, sharper = [], []
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        result = run(known, rng=rng, n_live=150)
        found = refine(result, known, rng=rng, n_draws=2000)
        if not found.sound:
            continue  # it says so itself, and the run's own evidence stands
        z.append((found.log_z - known.log_z) / found.log_z_error)
        sharper.append(found.log_z_error / result.log_z_error)
    assert len(z) > n_seeds / 2
    assert abs(np.sum(z)) < norm.isf(FALSE_ALARM / 2) * np.sqrt(len(z))
    assert np.sum(np.square(z)) < chi2.isf(FALSE_ALARM, len(z))
    assert np.median(sharper) < 0.5


def test_the_shape_of_a_tail_is_found() -> None:
    """Weights with a Pareto tail of shape k have P(weight > w) = w**(-1/k)."""
    u = np.random.default_rng(4).random(100_000)
    for k in (0.3, 0.6, 1.0):
        assert pareto_k(-k * np.log(u)) == pytest.approx(k, abs=0.15)


def test_a_tail_of_equal_weights_has_a_shape_too() -> None:
    """Then one of the tail's candidate shapes is the exponential's, where the formula is nought over nought."""
    weights = np.concatenate([np.zeros(1890), np.full(110, np.log(2.0))])
    assert np.isfinite(pareto_k(weights))


@pytest.mark.slow
def test_an_update_agrees_with_a_run_from_scratch() -> None:
    before, after = problem("Gaussian 2-D"), problem("Rosenbrock 2-D")
    fell_back = []

    def fall_back() -> NestedResult:
        fell_back.append(True)
        return run(after, rng=np.random.default_rng(9), n_live=200)

    rng = np.random.default_rng(5)
    posterior = run(before, rng=rng, n_live=300)
    found = update(posterior, after, rng=rng, fall_back=fall_back, n_draws=4000, prior_share=0.3)
    assert found.sound
    assert abs(found.log_z - after.log_z) < 4.5 * found.log_z_error
    again = update(found, after, rng=rng, fall_back=fall_back)
    assert abs(again.log_z - after.log_z) < 4.5 * again.log_z_error
    assert len(fell_back) <= 1
