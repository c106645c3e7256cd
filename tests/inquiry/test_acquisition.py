"""What a reading promises, against closed forms and against sums over every sample."""

import math

import numpy as np
import pytest
from scipy.special import logsumexp

from probewise.inquiry import ReadingNoise
from probewise.inquiry.predictive import expected_nats_above_goal, gaussian_nats_above_goal, readings_given_noise
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


@pytest.mark.parametrize("slope", [0.3, 2.0])
def test_the_expected_nats_above_the_goal_with_an_unknown_sd_are_those_of_adding_up(slope):
    """The mean of ln sd of the reweighted samples, over 2,000 readings of drawn hypotheses; within 0.03 nats."""
    x, predicted, scale, noise = unknown_noise(slope)
    rng = np.random.default_rng(5)
    truth = rng.integers(len(x), size=2000)
    readings = noise.draw(predicted[truth, 0], scale[truth, 0], rng=rng)
    weight = np.exp(noise.log_density(readings[:, None], predicted[None, :, 0], scale[None, :, 0]))
    weight /= weight.sum(axis=1, keepdims=True)
    variance = weight @ x**2 - (weight @ x) ** 2
    found = expected_nats_above_goal(given(predicted, scale, noise), x[:, None], np.array([1e-3]))[0]
    assert found == pytest.approx(0.5 * np.log(variance).mean() - math.log(1e-3), abs=0.03)


def test_the_expected_fall_of_a_gaussians_sd_is_the_closed_form():
    """The sd after a reading is 1 / sqrt(1 + slope^2), whatever is read."""
    slopes = np.array([0.1, 1.0, 3.0])
    x, predictive = linear(slopes)
    goal = np.array([0.01])
    expected = -0.5 * np.log(1 + slopes**2) - math.log(0.01)
    np.testing.assert_allclose(expected_nats_above_goal(predictive, x[:, None], goal), expected, atol=0.02)
    scale = np.ones((len(x), len(slopes)))
    np.testing.assert_allclose(gaussian_nats_above_goal(x[:, None] * slopes, scale, x[:, None], goal), expected)


def test_what_is_within_its_goal_counts_no_more():
    x, predictive = linear([3.0])
    assert expected_nats_above_goal(predictive, x[:, None], np.array([2.0]))[0] == 0.0
    both = expected_nats_above_goal(predictive, np.stack([x, x], axis=1), np.array([2.0, 0.01]))
    assert both[0] == pytest.approx(expected_nats_above_goal(predictive, x[:, None], np.array([0.01]))[0])
