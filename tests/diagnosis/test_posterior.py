"""Draws from a posterior: by annealing, and through predictions to second order about a point."""

import dataclasses

import numpy as np
import pytest

from probewise.diagnosis.noise import NoiseLaw
from probewise.diagnosis.posterior import (
    draw_by_annealing,
    log_likelihood_marginal_over_sigma,
    quadratic_predictions,
    surrogate_log_density,
)


def normal(center, factor, n, rng):
    """Draw n times about a centre, the factor a square root of the covariance; and the density of that."""
    inverse = np.linalg.inv(factor)
    first = center + rng.standard_normal((n, len(center))) @ factor
    return first, lambda z: -0.5 * np.sum(((z - center) @ inverse) ** 2, axis=1)


def drawn(center, factor, log_p, seed, n_walkers=400, n_wanted=800):
    rng = np.random.default_rng(seed)
    first, log_q = normal(np.array(center), np.array(factor), n_walkers, rng)
    return draw_by_annealing(first, log_q, log_p, n_moves=6, n_wanted=n_wanted, rng=rng)


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


CENTER = np.array([0.3, -0.2, 1.0])
STEPS = np.array([[0.4, 0.1, 0.0], [0.0, 0.3, -0.2], [0.0, 0.0, 0.5]])
PLACES = np.linspace(0.0, 3.0, 40)


def curve(z):
    """A bell of free height, place and width: no polynomial of its parameters."""
    return z[:, :1] * np.exp(-0.5 * ((PLACES - 1 - z[:, 1:2]) / z[:, 2:3]) ** 2)


def predicted(quadratic, e):
    center, coefficients, changes = quadratic
    return center + coefficients(e) @ changes


CARRY = np.where(np.arange(40) % 20 > 0, 0.4, 0.0)
LOST = np.arange(40) == 7
LAW = NoiseLaw(np.linspace(0.8, 1.2, 40), np.where(LOST | np.roll(LOST, 1), 0.0, CARRY), LOST)


def noisy(sd, seed=5, law=LAW):
    """Readings at the centre, with noise that the law makes independent."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal(40) * np.where(rng.random(40) < law.share, law.times, 1.0)
    own = np.zeros(40)
    for k in range(40):
        own[k] = law.carry[k] * own[k - 1] + np.sqrt(1 - law.carry[k] ** 2) * white[k]
    return curve(CENTER[None, :])[0] + sd * law.sd * own


def about_the_center(e):
    return curve(CENTER + e @ STEPS)


def test_the_density_is_that_of_its_predictions():
    """Route two: readings predicted one by one and whitened; it looks at a few sums alone."""
    quadratic, readings = quadratic_predictions(about_the_center, 3, 1e-9), noisy(0.05)
    e = np.random.default_rng(5).standard_normal((30, 3))
    z = CENTER + e @ STEPS
    residuals = (readings - predicted(quadratic, e)).T
    expected = log_likelihood_marginal_over_sigma(LAW, LAW(residuals)) - 0.5 * np.sum(z**2, axis=1)
    near = surrogate_log_density(curve, CENTER, STEPS, readings, LAW, 1e-9)
    np.testing.assert_allclose(near(e), expected, rtol=1e-9)
    assert near(np.full((1, 3), 100.0))[0] == -np.inf


def test_under_a_tail_the_density_falls_off_as_it_should():
    """By the mean of the true fall over the noise: one reading's says little, and thousands differ by chance."""
    tailed = dataclasses.replace(LAW, share=0.1, times=5.0)
    e = 0.3 * np.random.default_rng(6).standard_normal((20, 3))
    quadratic = quadratic_predictions(about_the_center, 3, 1e-9)
    falls = []
    for seed in range(60):
        readings = noisy(0.1, seed, tailed)
        near = surrogate_log_density(curve, CENTER, STEPS, readings, tailed, 1e-9)
        true = [
            log_likelihood_marginal_over_sigma(tailed, tailed((readings - predicted(quadratic, at)).T))
            for at in (e, np.zeros((1, 3)))
        ]
        prior = 0.5 * np.sum((CENTER + e @ STEPS) ** 2, axis=1) - 0.5 * np.sum(CENTER**2)
        falls.append([true[1] - true[0], near(np.zeros((1, 3))) - near(e) - prior])
    true, found = np.mean(falls, axis=0)
    np.testing.assert_allclose(found, true, rtol=0.25, atol=0.3)
    assert true.max() > 5
