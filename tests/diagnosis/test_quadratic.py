"""Predictions to second order about a point."""

from __future__ import annotations

import numpy as np
import pytest

from probewise.diagnosis.quadratic import Quadratic

RNG = np.random.default_rng(3)
CENTER = np.array([0.3, -0.2, 1.0])
STEPS = np.array([[0.4, 0.1, 0.0], [0.0, 0.3, -0.2], [0.0, 0.0, 0.5]])
PLACES = np.linspace(0.0, 3.0, 40)


def curve(z):
    """A bell of free height, place and width: no polynomial of its parameters."""
    return z[:, :1] * np.exp(-0.5 * ((PLACES - 1 - z[:, 1:2]) / z[:, 2:3]) ** 2)


def test_what_is_quadratic_is_met_everywhere():
    slopes, bends = RNG.standard_normal((3, 40)), RNG.standard_normal((3, 3, 40))

    def predict(z):
        return 2.0 + z @ slopes + np.einsum("ni,nj,ijk->nk", z, z, bends)

    found = Quadratic.of(predict, CENTER, STEPS, 1e-9)
    z = CENTER + RNG.standard_normal((50, 3))
    np.testing.assert_allclose(found(z), predict(z), atol=1e-8)


def test_the_steps_and_their_sums_are_met():
    found = Quadratic.of(curve, CENTER, STEPS, 1e-9)
    asked = CENTER + np.concatenate([np.zeros((1, 3)), STEPS, -STEPS, STEPS[[0]] + STEPS[[1]], STEPS[[1]] + STEPS[[2]]])
    np.testing.assert_allclose(found(asked), curve(asked), atol=1e-9)


@pytest.mark.parametrize("sd", [0.01, 1.0])
def test_what_makes_no_difference_is_left_out(sd):
    """All readings together, what is left out is less than a fiftieth of the noise for each of the nine terms."""
    full, thin = Quadratic.of(curve, CENTER, STEPS, 1e-9), Quadratic.of(curve, CENTER, STEPS, sd)
    assert thin.changes.shape[0] < full.changes.shape[0] <= 9
    asked = CENTER + STEPS
    assert np.linalg.norm(full(asked) - thin(asked), axis=1).max() < 9 * 0.02 * sd
