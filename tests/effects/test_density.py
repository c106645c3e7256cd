from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from probewise.effects.noise_distribution import log_gaussian_density, log_rounding_cell_density


def test_the_gaussian_density_is_that_of_scipy() -> None:
    readings, mean, sd = np.array([1.0, 2.0]), np.array([[0.5, 2.5], [1.0, 2.0]]), np.array([[0.3], [2.0]])
    np.testing.assert_allclose(log_gaussian_density(readings, mean, sd), stats.norm.logpdf(readings, mean, sd))


@pytest.mark.parametrize("z", [-30.0, -3.0, -0.1, 0.0, 0.2, 4.0, 25.0])
@pytest.mark.parametrize("step", [0.1, 1.0, 7.0])
def test_the_cell_density_is_the_mean_of_the_density_over_the_cell(z: float, step: float) -> None:
    """By quadrature, in units that keep the integrand near one."""
    sd = 0.8
    got = log_rounding_cell_density(np.array([z * sd]), np.array([0.0]), np.array([sd]), step)[0]
    nearest = max(0.0, abs(z * sd) - step / 2)
    top = stats.norm.logpdf(nearest, 0, sd)
    low, high = z * sd - step / 2, z * sd + step / 2
    inside = [0.0] if low < 0 < high else []
    mass, _ = quad(lambda y: math.exp(stats.norm.logpdf(y, 0, sd) - top), low, high, points=inside, epsrel=1e-12)
    assert got == pytest.approx(top + math.log(mass / step), rel=1e-8, abs=1e-8)


def test_a_reading_far_beyond_every_prediction_keeps_a_finite_density() -> None:
    out = log_rounding_cell_density(np.array([1e6, -1e6]), np.zeros(2), np.full(2, 1e-3), 1.0)
    assert np.isfinite(out).all()
    assert out[0] == pytest.approx(out[1])


def test_the_masses_of_all_cells_sum_to_one() -> None:
    cells = np.arange(-60, 61) * 0.5
    total = (
        np.exp(log_rounding_cell_density(cells, np.full(cells.size, 0.123), np.full(cells.size, 0.9), 0.5)).sum() * 0.5
    )
    assert total == pytest.approx(1.0, abs=1e-12)
