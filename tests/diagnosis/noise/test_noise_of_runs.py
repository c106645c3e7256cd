"""Noise that walks or differs from run to run, against dense algebra and brute force."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gammaln, logsumexp

from probewise.diagnosis.noise_law import NoiseLaw, white_noise
from probewise.effects.noise import NoisePerRun, RandomWalk
from probewise.effects.noise_distribution import FittedReadings, reading_variance
from probewise.sensor import NoiseParameters


def test_a_walk_is_whitened_as_the_root_of_its_covariance_does():
    """Route two: the dense covariance of white noise of several sds and a walk, lost readings left out."""
    rng = np.random.default_rng(0)
    n = 40
    sd, walk, lost = np.exp(0.3 * rng.standard_normal(n)), 0.3 * rng.integers(1, 3, n), np.zeros(n, dtype=bool)
    lost[[5, 17, 18]] = True
    law = NoiseLaw(sd, np.zeros(n), lost, walk=walk)
    gone = np.cumsum(walk)
    covariance = (np.minimum(gone[:, None], gone) + np.diag(sd**2))[np.ix_(~lost, ~lost)]
    columns = rng.standard_normal((n, 3))
    exact = np.linalg.solve(np.linalg.cholesky(covariance), columns[~lost])
    np.testing.assert_allclose((law(columns) ** 2).sum(axis=0), (exact**2).sum(axis=0))
    assert law.half_log_det() == pytest.approx(0.5 * np.linalg.slogdet(covariance)[1])


def test_what_is_kept_of_a_walk_has_walked_over_what_is_left_out():
    rng = np.random.default_rng(1)
    walk = rng.uniform(0.1, 1.0, 20)
    law = NoiseLaw(np.ones(20), np.zeros(20), np.zeros(20, dtype=bool), walk=walk)
    kept = rng.random(20) < 0.6
    gone = np.cumsum(walk)[kept]
    covariance = np.minimum(gone[:, None], gone) + np.eye(kept.sum())
    assert law.take_readings(kept).half_log_det() == pytest.approx(0.5 * np.linalg.slogdet(covariance)[1])


def test_draws_of_a_walk_scatter_as_it_says():
    level = replace(
        RandomWalk(n_before=0).apply(
            NoiseParameters(np.array([[2.0]]), np.zeros((1, 1))), np.array([[0.3]]), range(50)
        ),
    )
    white, steps = np.random.default_rng(3).standard_normal((2, 2000, 50))
    draws = level.sd * (white + level.walk * np.cumsum(steps, axis=1))
    np.testing.assert_allclose(draws.var(axis=0), reading_variance(level)[0], rtol=5 * math.sqrt(2 / 2000))


def test_the_evidence_of_noise_per_run_is_that_of_brute_force():
    """Route two: values of the runs drawn from their prior, the overall sd integrated in closed form."""
    rng = np.random.default_rng(0)
    counts = (30, 40, 20)
    run = np.repeat([0, 1, 2], counts)
    residuals = rng.standard_normal(90) * np.array([1.0, 2.0, 0.7])[run]
    effect = NoisePerRun(("a", "b", "c"), counts)
    nodes, log_weights = effect.weighed_nodes(residuals, FittedReadings(0 * residuals, 1.0, run))

    def log_z(values):
        law = replace(white_noise(90), sd=values[run])
        whitened = law(residuals)[:, None]
        return (
            -law.minus_log_likelihood(whitened, law.likeliest_sigma(whitened))[0]
            - law.half_log_det()
            + 0.5 * math.log(math.pi / 90)
        )

    laplace = logsumexp([log_z(values) + weight for values, weight in zip(nodes, log_weights, strict=True)])
    squares, brute = np.bincount(run, residuals**2), []
    for spread in (0.1, 0.2, 0.4, 0.8, 1.6):
        logs = spread * rng.standard_normal((40_000, 3))
        left = (squares * np.exp(-2 * logs)).sum(axis=1)
        each = math.log(0.5) + gammaln(45) + 45 * np.log(2 / left) - logs @ np.array(counts, dtype=float)
        brute.append(logsumexp(each) - math.log(40_000))
    assert laplace == pytest.approx(logsumexp(brute) - math.log(5), abs=0.1)


def test_one_run_has_no_noise_per_run_to_tell():
    nodes, weights = NoisePerRun(("all",), (30,)).weighed_nodes(
        np.ones(30), FittedReadings(np.zeros(30), 1.0, np.zeros(30, dtype=np.int64))
    )
    assert len(nodes) == len(weights) == 0
