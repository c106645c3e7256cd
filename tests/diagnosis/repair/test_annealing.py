"""Samples carried from a normal approximation to the density that it approximates, by moves and by weights."""

from __future__ import annotations

import numpy as np
import pytest

from probewise.diagnosis.posterior import draw_by_annealing, importance_resample


def normal(center, factor, n, rng):
    """Draw n times about a centre, the factor a square root of the covariance; and the density of that."""
    inverse = np.linalg.inv(factor)
    first = center + rng.standard_normal((n, len(center))) @ factor
    return first, lambda z: -0.5 * np.sum(((z - center) @ inverse) ** 2, axis=1)


def drawn(center, factor, log_p, seed, n_walkers=400, n_wanted=800):
    rng = np.random.default_rng(seed)
    first, log_q = normal(np.array(center), np.array(factor), n_walkers, rng)
    return draw_by_annealing(first, log_q, log_p, n_moves=6, n_wanted=n_wanted, rng=rng)


@pytest.mark.slow
def test_a_wrong_approximation_is_put_right():
    """Ten parameters, correlated by 0.8 in pairs; the approximation is off by an sd, too wide and uncorrelated."""
    n = 10
    covariance = np.eye(n)
    covariance[np.arange(0, n, 2), np.arange(1, n, 2)] = covariance[np.arange(1, n, 2), np.arange(0, n, 2)] = 0.8
    precision = np.linalg.inv(covariance)
    means, spreads = [], []
    for seed in range(20):
        z = drawn(np.ones(n), 1.5 * np.eye(n), lambda z: -0.5 * np.einsum("ij,jk,ik->i", z, precision, z), seed)
        means.append(z[:, 0].mean())
        spreads.append(z[:, 0].var())
    # Walkers remember: the scatter between runs says how much. Four of its errors: one false alarm in 16,000.
    for found, truth in ((means, 0.0), (spreads, 1.0)):
        assert abs(np.mean(found) - truth) < 4 * np.std(found, ddof=1) / np.sqrt(20) + 0.02
        assert np.std(found) < 0.25


def test_a_bent_density_keeps_its_moments():
    """Route two: quadrature. x is normal, y is normal about x^2 / 2."""

    def log_p(z):
        return -0.5 * z[:, 0] ** 2 - 2 * (z[:, 1] - z[:, 0] ** 2 / 2) ** 2

    x, y = np.meshgrid(np.linspace(-6, 6, 601), np.linspace(-4, 20, 1201), indexing="ij")
    weight = np.exp(log_p(np.stack([x.ravel(), y.ravel()], axis=1)))
    truth = np.average(y.ravel(), weights=weight), np.average(x.ravel() ** 2, weights=weight)
    assert truth == pytest.approx((0.5, 1.0), abs=1e-3)
    runs = [drawn([0.0, 0.0], np.diag([1.0, 0.5]), log_p, seed) for seed in range(20)]
    for found, value in (([z[:, 1].mean() for z in runs], truth[0]), ([np.mean(z[:, 0] ** 2) for z in runs], truth[1])):
        assert abs(np.mean(found) - value) < 4 * np.std(found, ddof=1) / np.sqrt(20) + 0.02


def test_what_cannot_be_is_left():
    def log_p(z):
        return np.where(z[:, 0] > 0, -0.5 * z[:, 0] ** 2, -np.inf)

    z = drawn([0.0], [[1.0]], log_p, 1)
    assert (z > 0).all()
    assert z.mean() == pytest.approx(np.sqrt(2 / np.pi), abs=0.2)


def test_weights_do_where_enough_of_them_count():
    """The density wanted is half as wide, its mean an sd aside; of more samples than wanted as many as it takes."""

    def log_p(z):
        return -2.0 * np.sum((z - 0.5) ** 2, axis=1)

    weighed = []

    def counted(z):
        weighed.append(len(z))
        return log_p(z)

    means, spreads = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        first, log_q = normal(np.zeros(3), np.eye(3), 5000, rng)
        z = importance_resample(first, log_q, counted, n_wanted=500, rng=rng)
        assert z.shape == (500, 3)
        means.append(z.mean(axis=0))
        spreads.append(z.var(axis=0))
    assert max(weighed) < 4000
    # Of 250 that count each: four errors of the mean of twenty runs in three parameters, one false alarm in 5,000.
    assert np.abs(np.mean(means, axis=0) - 0.5).max() < 4 * 0.5 / np.sqrt(20 * 200)
    assert np.abs(np.mean(spreads, axis=0) - 0.25).max() < 4 * 0.25 * np.sqrt(2) / np.sqrt(20 * 200)


def test_weights_are_refused_where_too_few_count():
    rng = np.random.default_rng(1)
    first, log_q = normal(np.zeros(8), np.eye(8), 1000, rng)
    assert (
        importance_resample(first, log_q, lambda z: -50 * np.sum((z - 1) ** 2, axis=1), n_wanted=500, rng=rng) is None
    )
    assert importance_resample(first, log_q, lambda z: np.full(len(z), -np.inf), n_wanted=500, rng=rng) is None
