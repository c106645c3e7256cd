"""What a reading promises, against closed forms and against sums over every sample."""

import math

import numpy as np
import pytest
from scipy.special import logsumexp

from probewise.inquiry import ReadingNoise
from probewise.inquiry.predictive import readings_given_noise
from probewise.priors import LogUniform


def given(predicted, scale, noise):
    return readings_given_noise(predicted, scale, np.full(len(predicted), 1 / len(predicted)), noise)


def linear(slopes, *, n=4000, seed=1, noise_sd=1.0, **law):
    """Predictions slope * x of standard normal x: (x, weights given readings)."""
    x = np.random.default_rng(seed).standard_normal(n)
    x = (x - x.mean()) / x.std()
    predicted = x[:, None] * np.asarray(slopes)
    return x, given(predicted, np.full(predicted.shape, noise_sd), ReadingNoise(noise_sd, **law))


@pytest.mark.parametrize("slope", [0.03, 0.3, 1.0, 3.0, 30.0])
def test_information_about_a_gaussian_is_the_closed_form(slope):
    """Shannon: log2(1 + signal / noise) / 2; from a thousandth of a bit up; groups cost up to 3 %."""
    _, predictive = linear([slope])
    assert predictive.information_bits[0] == pytest.approx(0.5 * math.log2(1 + slope**2), rel=0.03)


def by_adding_up(predicted, scale, noise, n_readings, seed):
    """Nested Monte Carlo: mean log ratio of likelihood and predictive density, over readings of drawn hypotheses."""
    rng = np.random.default_rng(seed)
    truth = rng.integers(len(predicted), size=n_readings)
    readings = noise.draw(predicted[truth], scale[truth], rng=rng)
    own = noise.log_density(readings, predicted[truth], scale[truth])
    density = noise.log_density(readings[:, None], predicted[None], scale[None])
    ratio = (own - logsumexp(density, axis=1) + math.log(len(predicted))) / math.log(2)
    return ratio.mean(), ratio.std() / math.sqrt(n_readings)


@pytest.mark.parametrize(
    "noise",
    [
        ReadingNoise(0.2),
        ReadingNoise(0.2, dof=3.0),
        ReadingNoise(0.2, outliers=0.2, between=(-3.0, 4.0)),
        ReadingNoise(lambda y: 0.1 + 0.2 * np.abs(y)),
    ],
    ids=["gaussian", "student", "outliers", "grows"],
)
def test_information_is_that_of_adding_up_all_hypotheses(noise):
    """A skew posterior of two lumps; within 3 sds of the Monte Carlo, or 2 % and a hundredth of a bit."""
    rng = np.random.default_rng(3)
    predicted = np.concatenate([rng.normal(0.0, 0.3, 700), 2.0 + rng.gamma(1.0, 0.5, 300)])[:, None]
    predicted = rng.permutation(predicted)
    scale = noise.scale(predicted, None)
    mean, error = by_adding_up(predicted[:, 0], scale[:, 0], noise, 4000, 4)
    assert given(predicted, scale, noise).information_bits[0] == pytest.approx(mean, abs=3 * error + 0.02 * mean + 0.01)


UNKNOWN = LogUniform(0.1, 10.0)


def unknown_noise(slope, *, dof=math.inf, n=1000):
    """Predictions slope * x of standard normal x, and sds from 0.1 to 10: (x, predicted, scale, noise)."""
    rng = np.random.default_rng(3)
    x, sd = rng.standard_normal(n), UNKNOWN.from_unit(rng.random(n))
    return x, slope * x[:, None], sd[:, None], ReadingNoise(UNKNOWN, dof=dof)


@pytest.mark.parametrize(("slope", "dof"), [(0.0, math.inf), (0.3, math.inf), (2.0, math.inf), (2.0, 4.0)])
def test_information_with_an_unknown_sd_of_the_noise_is_that_of_adding_up_all_hypotheses(slope, dof):
    """The information about the sd counts too; within 3 sds of the Monte Carlo and 5 %."""
    _, predicted, scale, noise = unknown_noise(slope, dof=dof)
    mean, error = by_adding_up(predicted[:, 0], scale[:, 0], noise, 4000, 4)
    found = given(predicted, scale, noise).information_bits[0]
    assert found == pytest.approx(mean, abs=3 * error + 0.05 * mean)
