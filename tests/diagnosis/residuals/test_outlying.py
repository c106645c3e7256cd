"""Readings far out that lie together, by a second route: the beta integrals as sums."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import betabinom

from probewise.diagnosis import diagnose
from probewise.diagnosis.locate import Covariate, window_columns_and_bounds
from probewise.diagnosis.noise_law import NoiseLaw
from probewise.diagnosis.outlying import clustering_log_bayes_factors, outlier_probabilities
from probewise.recordings import Recording, paper_plan
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

N = 120
PLACE = Covariate("place", np.linspace(-50, 50, N), np.arange(N))


def tailed(n: int = N) -> NoiseLaw:
    return NoiseLaw(np.ones(n), np.zeros(n), np.zeros(n, dtype=bool), share=0.05, times=6.0)


def test_the_evidence_is_that_of_two_beta_binomials_against_one():
    """Of given numbers in and out of a window, the order within each being even."""
    far_out = np.zeros(N)
    far_out[[3, 5, 8, 70]] = 1.0
    columns, _ = window_columns_and_bounds(PLACE, N)
    one = betabinom(N, 0.5, 0.5).logpmf(4) - np.log(_choose(N, 4))
    expected = []
    for column in columns.T:
        n, k = int(column.sum()), int(far_out @ column)
        inside = betabinom(n, 0.5, 0.5).logpmf(k) - np.log(_choose(n, k))
        rest = betabinom(N - n, 0.5, 0.5).logpmf(4 - k) - np.log(_choose(N - n, 4 - k))
        expected.append(inside + rest - one)
    found = clustering_log_bayes_factors(far_out, [PLACE])
    assert found == {"place, far out": pytest.approx(float(np.log(np.mean(np.exp(expected)))))}


def _choose(n: int, k: int) -> float:
    return float(np.prod([(n - i) / (k - i) for i in range(k)])) if k else 1.0


def test_together_speaks_for_it_and_scattered_against_it():
    together, scattered = np.zeros(N), np.zeros(N)
    together[100:108] = 1.0
    scattered[np.arange(7, N, 15)] = 1.0
    assert clustering_log_bayes_factors(together, [PLACE])["place, far out"] > 8
    assert clustering_log_bayes_factors(scattered, [PLACE])["place, far out"] < 0


def test_what_is_in_the_tail_follows_bayes_rule():
    law = tailed()
    residuals = np.random.default_rng(2).standard_normal(N)
    residuals[10] = 9.0
    sigma = float(law.likeliest_sigma(law(residuals)[:, None])[0])
    odds = (0.05 / 6) * np.exp(-0.5 * (residuals / sigma / 6) ** 2) / (0.95 * np.exp(-0.5 * (residuals / sigma) ** 2))
    np.testing.assert_allclose(outlier_probabilities(residuals, law), odds / (1 + odds))
    assert outlier_probabilities(residuals, law)[10] > 0.999
    residuals[10] = 1e6  # where both densities are nothing
    assert outlier_probabilities(residuals, law)[10] == 1.0


def spotted(rows: np.ndarray) -> Recording:
    """A clean recording with a dozen readings far out."""
    plan = paper_plan()
    world = World(gaussian_spot([Blob(1.0, (0.4, -0.3), (5.0, 3.5), 0.3)], pixel_mm=0.5))
    rng = np.random.default_rng(11)
    readings = world.expected_readings(plan) + 0.4 * rng.standard_normal(len(plan))
    readings[rows] += 5.0 * rng.choice([-1.0, 1.0], len(rows))
    return Recording(plan, readings)


@pytest.mark.slow
def test_outliers_anywhere_are_noise_and_at_one_end_of_a_scan_they_are_not():
    anywhere = diagnose(spotted(np.random.default_rng(4).choice(404, 12, replace=False)), rng=np.random.default_rng(0))
    assert anywhere.verdict == "noise"
    at_one_end = np.concatenate([np.arange(k, k + 12, 4) for k in (86, 187, 288, 389)])
    found = diagnose(spotted(at_one_end), rng=np.random.default_rng(0))
    assert found.verdict == "unknown"
    assert "Outlying readings cluster in place" in found.reason
    assert found.where
