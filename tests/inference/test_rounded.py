"""Readings that are rounded have the probability of their cell."""

import numpy as np
import pytest
from scipy.stats import norm

from probewise.arm import ReadingScale
from probewise.errors import ParameterError
from probewise.inference import GaussianKnown, Rounded

PREDICTED = np.linspace(0.0, 110.0, 221)[:, None]


@pytest.mark.parametrize("reading", [1.0, 2.0, 47.0, 99.0, 100.0])
def test_a_reading_has_the_mass_of_its_cell(reading):
    upper = np.inf if reading == 100 else reading + 0.5
    lower = -np.inf if reading == 1 else reading - 0.5
    mass = norm.cdf(upper, PREDICTED, 1.2) - norm.cdf(lower, PREDICTED, 1.2)
    far = mass < 1e-8
    found = Rounded(1.2, 1.0, 1.0, 100.0).log_prob(np.array([reading]), PREDICTED)
    np.testing.assert_allclose(found[~far[:, 0]], np.log(mass[~far]), atol=2e-4)
    assert np.isfinite(found).all()
    assert (found[far[:, 0]] < -18).all()


@pytest.mark.parametrize(
    ("low", "high", "step"),
    [(1.0, 100.0, 3.0), (2.0, 101.0, 3.0), (-0.7, 4.9, 0.2), (0.0, 1.0, 0.3), (0.5, 3.5, 1.0), (1.5, 4.5, 1.0)],
)
@pytest.mark.parametrize("sd", [0.3, 1.5])
def test_a_step_that_does_not_divide_the_scale_leaves_the_masses_those_of_the_sensor(low, high, step, sd):
    """By brute force: the readings that the arm's scale makes of noisy values, about and beyond its ends too."""
    scale, rounded = ReadingScale(low, high, step), Rounded(sd * step, step, low, high)
    noise = norm.ppf((np.arange(4000) + 0.5) / 4000) * sd * step
    predicted = np.concatenate([low + step * np.linspace(-2.0, 3.0, 7), high + step * np.linspace(-3.0, 2.0, 7)])
    possible = np.unique([scale.clip_and_round(v) for v in np.linspace(low - 5 * step, high + 5 * step, 3001)])
    masses = np.exp([rounded.log_prob(np.array([r]), predicted[:, None]) for r in possible])
    for mass, level in zip(masses.T, predicted, strict=True):
        read = np.array([scale.clip_and_round(v) for v in level + noise])
        shares = [(np.abs(read - r) < 1e-9).mean() for r in possible]
        np.testing.assert_allclose(mass, shares, atol=1e-3)
        assert mass.sum() == pytest.approx(1.0, abs=1e-3)


def test_an_unrounded_reading_at_the_end_of_the_scale_covers_all_beyond():
    """The cells' width only says how finely the others are told apart."""
    fine = Rounded(1.0, 0.03, 0.0, 10.0, whole_steps=False)
    found = fine.log_prob(np.array([10.0, 9.99]), np.array([[11.0, 10.5]]))
    assert found == pytest.approx(norm.logcdf(1.015) + norm.logpdf(0.51) + np.log(0.03), abs=1e-3)


def test_fine_steps_are_a_density_times_the_step():
    readings, predicted = np.array([30.0, 31.0]), np.array([[30.4, 29.0], [31.0, 31.0]])
    density = GaussianKnown(2.0).log_prob(readings, predicted) + 2 * np.log(0.01)
    np.testing.assert_allclose(Rounded(2.0, 0.01).log_prob(readings, predicted), density, atol=1e-3)


def test_far_readings_fall_off_like_the_gaussians_tail():
    rounded = Rounded(0.1)
    found = rounded.log_prob(np.array([50.0]), np.array([[10.0], [25.0]]))
    np.testing.assert_allclose(found, norm.logsf([395.0, 245.0]), rtol=1e-6)


@pytest.mark.parametrize("change", [{"sd": 0.0}, {"step": -1.0}, {"low": 3.0, "high": 1.0}])
def test_options_out_of_range_are_refused(change):
    with pytest.raises(ParameterError):
        Rounded(**{"sd": 1.0, **change})
