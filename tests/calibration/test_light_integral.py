from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.calibration import default_prior
from probewise.calibration.light_integral import FaintGaussianLikelihoodRatio, bridge_log_z_ratio
from probewise.calibration.order_problems import ProblemsByOrder
from probewise.calibration.whole_coordinates import FAINT
from probewise.recordings import Recording


def _near_truth(truth: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
    """Three Gaussians at most: the true one, and lighter ones."""
    others = [[0.05, -3.0, 2.0, 0.05, 0.02, 0.0], [0.02, 5.0, 0.0, 0.1, 0.08, 0.01]]
    theta = np.tile(np.concatenate([truth[:6], *others[: n - 1], truth[6:]]), (4, 1))
    return np.asarray(theta * (1.0 + 0.02 * rng.standard_normal(theta.shape)))


def _by_grid(recording: Recording, theta: FloatArray, k: int) -> float:
    """Integrate the likelihood over the light of Gaussian k, by problems of N and of N - 1 on a fine grid."""
    n = (len(theta) - 2) // 6
    problems = ProblemsByOrder(recording, default_prior)
    g = theta[:-2].reshape(n, 6)
    light = g[:, 0] / np.sqrt(g[:, 3] * g[:, 4] - g[:, 5] ** 2)
    most = np.delete(light, k).max()
    t = np.geomspace(1e-7, FAINT, 3_000)
    many = np.tile(theta, (len(t), 1))
    many[:, 6 * k] *= t * most / light[k]
    log_likelihood = problems.problem(n).log_likelihood(many)
    log_cell = np.log(t * np.log(t[1] / t[0]))
    log_cell[[0, -1]] -= np.log(2.0)
    without = problems.problem(n - 1).log_likelihood(np.delete(theta, slice(6 * k, 6 * k + 6))[None])[0]
    return float(logsumexp(log_likelihood + log_cell) + np.log((n - 1) / n) - without)


@pytest.mark.parametrize("n", [2, 3])
def test_light_is_integrated_as_on_a_fine_grid(recording: Recording, truth: FloatArray, n: int) -> None:
    theta = _near_truth(truth, n, np.random.default_rng(4))
    removal = FaintGaussianLikelihoodRatio(
        default_prior(recording, n), ProblemsByOrder(recording, default_prior).problem(1), 1
    )
    taken = removal.log_likelihood_ratios_of_faint_gaussians(theta)
    for k in range(1, n):
        assert taken[0, k - 1] == pytest.approx(_by_grid(recording, theta[0], k), abs=5e-3)


def test_adding_is_taking_away_seen_from_below(recording: Recording, truth: FloatArray) -> None:
    theta = _near_truth(truth, 3, np.random.default_rng(5))
    removal = FaintGaussianLikelihoodRatio(
        default_prior(recording, 3), ProblemsByOrder(recording, default_prior).problem(1), 1
    )
    added = removal.log_likelihood_ratio_of_added_gaussian(np.delete(theta, slice(12, 18), axis=1), theta[:, 12:18])
    np.testing.assert_allclose(added, removal.log_likelihood_ratios_of_faint_gaussians(theta)[:, 1], atol=1e-9)


def test_a_bridge_finds_the_ratio_of_two_normal_densities() -> None:
    """One above the other by e^2.5, a standard deviation apart; four errors of a bridge between 20,000 draws each."""
    rng = np.random.default_rng(7)

    def log_ratio(x: FloatArray) -> FloatArray:
        return np.asarray(2.5 - 0.5 * (x - 1.0) ** 2 + 0.5 * x**2)

    below, above = rng.standard_normal(20_000), 1.0 + rng.standard_normal((20_000, 1))
    found, share = bridge_log_z_ratio(log_ratio(below), log_ratio(above))
    assert found == pytest.approx(2.5, abs=0.04)
    assert share > 0.5


def test_a_bridge_without_ground_says_so() -> None:
    _, share = bridge_log_z_ratio(np.array([*np.full(99, -50.0), 0.0]), np.full((100, 1), 40.0))
    assert share < 0.05
