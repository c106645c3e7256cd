"""Densities of readings, rounded or at an end of the range, against quadrature."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad
from scipy.stats import norm

from probewise.effects.noise_distribution import PredictiveMixture, limited_mean, log_rounding_cell_density
from probewise.sensor.stages import NoiseParameters


@pytest.mark.parametrize("z", [-30.0, -3.0, -0.1, 0.0, 0.2, 4.0, 25.0])
@pytest.mark.parametrize("step", [0.1, 1.0, 7.0])
def test_the_cell_density_is_the_mean_of_the_density_over_the_cell(z, step):
    """By quadrature, in units that keep the integrand near one."""
    sd = 0.8
    got = log_rounding_cell_density(np.array([z * sd]), np.array([0.0]), np.array([sd]), step)[0]
    nearest = max(0.0, abs(z * sd) - step / 2)
    top = stats.norm.logpdf(nearest, 0, sd)
    low, high = z * sd - step / 2, z * sd + step / 2
    inside = [0.0] if low < 0 < high else []
    mass, _ = quad(lambda y: math.exp(stats.norm.logpdf(y, 0, sd) - top), low, high, points=inside, epsrel=1e-12)
    assert got == pytest.approx(top + math.log(mass / step), rel=1e-8, abs=1e-8)


def test_an_uncertain_offset_is_scored_at_the_rows_that_have_a_reading():
    """Beside a tail it is no wider: a mixture of two normal distributions, each of the sum of two variances."""
    offset, readings = np.array([[0.5, 1.0, 2.0]]), np.array([0.1, np.nan, -0.2])
    mixture = PredictiveMixture(readings, np.isfinite(readings))
    mixture.add(np.zeros((1, 3)), replace(OUTLIERS, offset_sd=offset))
    _, sd, scores = mixture.mean_sd_and_log_density()
    np.testing.assert_allclose(sd**2, offset[0] ** 2 + SD**2 * (0.8 + 0.2 * 4.0**2))
    own, wide = (norm(0.0, np.hypot(offset[0], size)).pdf(readings) for size in (SD, 4 * SD))
    np.testing.assert_allclose(scores, np.log(0.8 * own + 0.2 * wide))


LOW, HIGH, SD = 0.0, 10.0, 2.0
OUTLIERS = NoiseParameters(
    np.full((1, 1), SD), np.zeros((1, 1)), wide_share=np.full((1, 1), 0.2), wide_times=np.full((1, 1), 4.0)
)


@pytest.mark.parametrize("signal", [-1000.0, -1.0, 0.5, 5.0, 9.0, 10.0, 13.0, 1e6])
def test_the_mean_of_a_limited_reading_is_that_of_its_noise_cut_off_at_the_ends(signal):
    """By quadrature of the part within the range, and the masses beyond."""
    mean = 0.0
    for share, sd in ((0.8, SD), (0.2, 4 * SD)):
        own = norm(signal, sd)
        mean += share * (quad(lambda y, own=own: y * own.pdf(y), LOW, HIGH)[0] + HIGH * own.sf(HIGH))
    found = limited_mean(OUTLIERS, np.array([[signal]]), LOW, HIGH)
    np.testing.assert_allclose(found, [[mean]], rtol=1e-6, atol=1e-9)


def _scored(readings, signal, **given):
    mixture = PredictiveMixture(readings, np.isfinite(readings), **given)
    for each in signal:
        mixture.add(np.full((1, len(readings)), each), OUTLIERS)
    return mixture.mean_sd_and_log_density()


def test_the_probabilities_at_both_ends_and_the_density_between_sum_to_1():
    readings = np.concatenate([[LOW, HIGH], np.linspace(LOW, HIGH, 2003)[1:-1]])
    _, _, scores = _scored(readings, (-1.0, 9.5), ends=(LOW, HIGH))
    within = np.exp(scores[2:]).sum() * (HIGH - LOW) / 2002
    assert abs(np.exp(scores[:2]).sum() + within - 1) < 1e-3


def test_a_reading_at_an_open_end_or_without_ends_has_the_usual_density():
    readings = np.array([LOW, 3.0, HIGH])
    for given in ({}, {"ends": (-np.inf, np.inf)}):
        np.testing.assert_array_equal(_scored(readings, (4.0,), **given)[2], _scored(readings, (4.0,))[2])
    open_above = _scored(readings, (4.0,), ends=(LOW, np.inf))
    np.testing.assert_allclose(open_above[2][1:], _scored(readings, (4.0,))[2][1:])
    assert open_above[2][0] != _scored(readings, (4.0,))[2][0]


def test_a_rounded_reading_at_an_end_holds_the_half_step_within():
    """Step 1: a reading of 10 is all from 9.5 up."""
    _, _, scores = _scored(np.array([HIGH]), (9.0,), ends=(LOW, HIGH), step=1.0)
    expected = 0.8 * norm.sf(0.5 / SD) + 0.2 * norm.sf(0.5 / (4 * SD))
    np.testing.assert_allclose(scores, [np.log(expected)])
