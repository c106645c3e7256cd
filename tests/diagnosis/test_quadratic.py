"""Predictions to second order about a point, and the posterior that they make."""

from __future__ import annotations

import numpy as np
import pytest

from probewise.diagnosis.joint import log_likelihood_of_whitened
from probewise.diagnosis.noise import NoiseLaw
from probewise.diagnosis.quadratic import Quadratic
from probewise.diagnosis.surrogate import Surrogate

CENTER = np.array([0.3, -0.2, 1.0])
STEPS = np.array([[0.4, 0.1, 0.0], [0.0, 0.3, -0.2], [0.0, 0.0, 0.5]])
PLACES = np.linspace(0.0, 3.0, 40)


def curve(z):
    """A bell of free height, place and width: no polynomial of its parameters."""
    return z[:, :1] * np.exp(-0.5 * ((PLACES - 1 - z[:, 1:2]) / z[:, 2:3]) ** 2)


def predicted(quadratic, e):
    return quadratic.center + quadratic.amounts(e) @ quadratic.changes


def about_the_center(e):
    return curve(CENTER + e @ STEPS)


def test_what_is_quadratic_is_met_everywhere():
    rng = np.random.default_rng(3)
    slopes, bends = rng.standard_normal((3, 40)), rng.standard_normal((3, 3, 40))

    def predict(e):
        return 2.0 + e @ slopes + np.einsum("ni,nj,ijk->nk", e, e, bends)

    e = rng.standard_normal((50, 3))
    np.testing.assert_allclose(predicted(Quadratic.of(predict, 3, 1e-9), e), predict(e), atol=1e-8)


def test_the_steps_and_their_sums_are_met():
    one = np.eye(3)
    asked = np.concatenate([np.zeros((1, 3)), one, -one, one[[0]] + one[[1]], one[[1]] + one[[2]]])
    found = Quadratic.of(about_the_center, 3, 1e-9)
    np.testing.assert_allclose(predicted(found, asked), about_the_center(asked), atol=1e-9)


@pytest.mark.parametrize("sd", [0.01, 1.0])
def test_what_makes_no_difference_is_left_out(sd):
    """All readings together, what is left out is less than a fiftieth of the noise for each of the nine terms."""
    full, thin = Quadratic.of(about_the_center, 3, 1e-9), Quadratic.of(about_the_center, 3, sd)
    assert thin.changes.shape[0] < full.changes.shape[0] <= 9
    one = np.eye(3)
    assert np.linalg.norm(predicted(full, one) - predicted(thin, one), axis=1).max() < 9 * 0.02 * sd


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_the_density_is_that_of_its_predictions(share):
    """Route two: readings predicted one by one and whitened; under normal noise it looks at a few sums alone."""
    rng = np.random.default_rng(5)
    carry = np.where(np.arange(40) % 20 > 0, 0.4, 0.0)
    lost = np.arange(40) == 7
    law = NoiseLaw(np.linspace(0.8, 1.2, 40), np.where(lost | np.roll(lost, 1), 0.0, carry), lost, share, 5.0)
    quadratic = Quadratic.of(about_the_center, 3, 1e-9)
    readings = curve(CENTER[None, :])[0] + 0.05 * rng.standard_normal(40)
    e = rng.standard_normal((30, 3))
    z = CENTER + e @ STEPS
    expected = log_likelihood_of_whitened(law, law((readings - predicted(quadratic, e)).T), 1e-3) - 0.5 * np.sum(
        z**2, axis=1
    )
    found = Surrogate.of(quadratic, CENTER, STEPS, readings, law, 1e-3).log_density(e)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    far = Surrogate.of(quadratic, CENTER, STEPS, readings, law, 1e-3).log_density(np.full((1, 3), 100.0))
    assert far[0] == -np.inf
