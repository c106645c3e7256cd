"""Bits learned: information of nested sampling, a Gaussian's entropy, distances to neighbours."""

from math import e, log, log2, pi

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from probewise.errors import ParameterError
from probewise.inquiry import bits_gained, neighbour_entropy, prior_entropy
from probewise.nested import run
from probewise.priors import Normal, Product, Uniform


def gaussian_entropy(theta):
    """Entropy in bits of a Gaussian with the samples' covariance."""
    return multivariate_normal(cov=np.cov(theta, rowvar=False)).entropy() / log(2)


def correlated(n, seed=0):
    covariance = np.array([[4.0, 1.2, 0.0], [1.2, 1.0, 0.3], [0.0, 0.3, 9.0]])
    theta = np.random.default_rng(seed).multivariate_normal([1.0, 2.0, 3.0], covariance, size=n)
    return theta, 0.5 * (3 * log2(2 * pi * e) + log2(np.linalg.det(covariance)))


def test_a_gaussian_sample_has_its_closed_form_by_both_routes():
    """Standard errors at 4000 samples are below 0.05 bits."""
    theta, exact = correlated(4000)
    assert gaussian_entropy(theta) == pytest.approx(exact, abs=0.1)
    assert neighbour_entropy(theta) == pytest.approx(exact, abs=0.15)


def test_an_even_box_is_measured_by_neighbours_and_overrated_by_a_gaussian():
    """Of all densities of one covariance the Gaussian has the greatest entropy: 0.25 bits an axis above the box."""
    theta = np.random.default_rng(1).uniform([0, 0], [8, 2], (4000, 2))
    assert neighbour_entropy(theta) == pytest.approx(4.0, abs=0.15)
    assert gaussian_entropy(theta) == pytest.approx(4.0 + log2(2 * pi * e / 12), abs=0.1)


def test_the_entropy_of_a_prior_is_its_closed_form():
    prior = Product({"a": Uniform(0.0, 8.0), "b": Normal(0.0, 3.0)})
    exact = 3.0 + 0.5 * log2(2 * pi * e * 9.0)
    assert prior_entropy(prior, rng=np.random.default_rng(2)) == pytest.approx(exact, abs=0.05)


class GaussianProblem:
    """A Gaussian likelihood of sd s on three parameters."""

    def __init__(self, prior, sd):
        self.prior, self.sd = prior, np.asarray(sd)

    def log_likelihood(self, theta):
        return -0.5 * (((theta - 0.5) / self.sd) ** 2).sum(axis=1)


@pytest.mark.parametrize("marginal", [Uniform(-50.0, 50.0), Normal(0.0, 30.0)], ids=["even", "normal"])
def test_bits_agree_between_information_and_the_posteriors_entropy(marginal):
    """Three routes to prior minus posterior differential entropy, and the exact figure."""
    prior = Product({name: marginal for name in "abc"})
    problem = GaussianProblem(prior, [1.0, 2.0, 3.0])
    result = run(problem, rng=np.random.default_rng(3), n_live=400)
    before = prior_entropy(prior, rng=np.random.default_rng(4))
    bits = bits_gained(result.information, prior.log_prob(result.theta), result.weight, before)
    sd = np.array([1.0, 2.0, 3.0])
    if isinstance(marginal, Uniform):
        exact = float(sum(log2(100 / (s * np.sqrt(2 * pi * e))) for s in sd))
    else:
        exact = float(sum(0.5 * log2(1 + (30 / s) ** 2) for s in sd))
    # The information's error is that of log Z, about sqrt(H / n_live) nats.
    tolerance = 4 * result.log_z_error / np.log(2)
    samples = result.samples(1000, rng=np.random.default_rng(5))
    assert bits == pytest.approx(exact, abs=tolerance)
    assert before - gaussian_entropy(samples) == pytest.approx(exact, abs=0.4)
    assert before - neighbour_entropy(np.unique(samples, axis=0)) == pytest.approx(bits, abs=tolerance + 0.5)


def test_samples_that_cannot_tell_an_entropy_are_refused():
    with pytest.raises(ParameterError, match="repeated"):
        neighbour_entropy(np.repeat(np.arange(4.0)[:, None], 10, axis=0))
    with pytest.raises(ParameterError, match="constant"):
        neighbour_entropy(np.ones((20, 1)))
