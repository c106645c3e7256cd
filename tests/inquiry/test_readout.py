"""What a reading can tell: noise, rounding and ends of the scale; the capacity of a sensor; bits learned."""

import itertools
import math
from math import e, log2, pi

import numpy as np
import pytest
from scipy.stats import norm

from probewise.errors import ParameterError
from probewise.inquiry import Readout, bits_gained, prior_entropy
from probewise.inquiry.predictive import WeightsGivenReading
from probewise.inquiry.readout import capacity_bits, entropy_bits
from probewise.nested import run
from probewise.priors import Normal, Product, Uniform


def test_the_cells_of_a_rounding_sensor_are_its_readings():
    levels = np.array([30.2, 47.0])
    readout = Readout(0.8, 1.0, 1.0, 100.0)
    chance = readout.cell_probability(levels)
    edges = readout.cell_edges(levels)
    np.testing.assert_allclose(edges, np.arange(edges[0], edges[-1] + 0.5))
    np.testing.assert_allclose(chance.sum(axis=1), 1.0)
    reading = np.concatenate([[edges[0] - 0.5], edges + 0.5])
    np.testing.assert_allclose(chance @ reading, levels, atol=1e-5)
    assert chance[0, reading == 30.0] == pytest.approx(norm.cdf(0.3 / 0.8) - norm.cdf(-0.7 / 0.8))


def test_the_ends_of_the_scale_take_all_beyond():
    readout = Readout(2.0, 1.0, 1.0, 100.0)
    chance = readout.cell_probability(np.array([0.0, 99.5]))
    assert chance[0, 0] == pytest.approx(norm.cdf(1.5 / 2.0))
    assert chance[1, -1] == pytest.approx(norm.sf(0.0))


@pytest.mark.parametrize("sd", [0.1, 0.29, 0.4])
@pytest.mark.parametrize("black", [10.0, 10.5])
def test_the_information_of_a_reading_counts_the_noise_at_each_level(sd, black):
    """Rounded, a level between two steps is noisier than one on a step; by the cells of every hypothesis apart."""
    rng = np.random.default_rng(0)
    weight = np.full(800, 1 / 800)
    grey, few_white = rng.uniform(30.0, 33.0, 800), rng.choice([black, 59.5], 800, p=[0.95, 0.05])
    answers = np.stack([np.full(800, black), few_white, grey, np.full(800, 59.5)], axis=1)
    readout = Readout(sd, 1.0, 1.0, 100.0)
    found = WeightsGivenReading.of(answers, weight, readout).information_bits
    for column, bits in zip(answers.T, found, strict=True):
        chance = readout.cell_probability(column)
        exact = entropy_bits(weight @ chance) - weight @ entropy_bits(chance)
        assert bits == pytest.approx(exact, abs=0.02)


@pytest.mark.parametrize(("noise_sd", "repeats"), [(0.1, 4), (0.29, 3), (0.7, 4)])
def test_repeats_of_rounded_readings_are_those_of_all_outcomes(noise_sd, repeats):
    """Each reading is rounded by itself, and clipped at 13: every sum of readings, by adding up all outcomes."""
    levels, readings = np.array([10.0, 10.5, 11.3, 13.2]), np.arange(4, 14)
    readout = Readout(noise_sd, 1.0, 4.0, 13.0)
    upper = np.append(readings[:-1] + 0.5, np.inf)
    one = np.diff(norm.cdf(upper, levels[:, None], noise_sd), axis=1, prepend=0.0)
    expected = np.zeros((4, repeats * 13 + 1))
    for outcome in itertools.product(range(10), repeat=repeats):
        expected[:, readings[list(outcome)].sum()] += one[:, outcome].prod(axis=1)
    found = readout.cell_probability(levels, repeats=repeats)
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    np.testing.assert_allclose(found, expected[:, -found.shape[1] :], atol=1e-5)
    merged = readout.cell_probability(levels, repeats=repeats, most=5)
    assert merged.shape[1] <= 5
    np.testing.assert_allclose(merged.sum(axis=1), 1.0)


def test_a_reading_that_the_sensor_cannot_return_is_refused():
    readout = Readout(1.0, 1.0, 1.0, 100.0)
    readout.require_in_range(100.0)
    readout.require_in_range(math.nan)
    with pytest.raises(ParameterError, match=r"reading is 130.0; allowed: 1 to 100, the range of the sensor"):
        readout.require_in_range(130.0)


@pytest.mark.parametrize("change", [{"noise_sd": 0.0}, {"step": -1.0}, {"low": 5.0, "high": 5.0}])
def test_a_readout_out_of_range_is_refused(change):
    with pytest.raises(ParameterError):
        Readout(**{"noise_sd": 1.0, **change})


def test_cells_taken_together_hold_what_they_held_apart():
    levels = np.linspace(1000.0, 60000.0, 50)
    readout = Readout(100.0, 1.0, 0.0, 65535.0)
    edges = readout.cell_edges(levels, most=300)
    assert len(edges) <= 301
    assert (edges % 1.0 == 0.5).all()  # no reading lies on one
    together = readout.cell_probability(levels, most=300)
    expected = norm.cdf(edges[:, None], levels, 100.0).T
    np.testing.assert_allclose(np.cumsum(together, axis=1)[:, :-1], expected, atol=1e-12)
    np.testing.assert_allclose(together.sum(axis=1), 1.0)


def test_two_levels_far_apart_carry_at_least_a_bit_and_noise_free_steps_their_log():
    """A rounding sensor of little noise tells apart as many levels as it has steps."""
    assert capacity_bits(10.0, 17.0, Readout(0.05, 1.0)) == pytest.approx(3.0, abs=0.01)


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
    """Prior minus posterior differential entropy, by the information and exactly."""
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
    assert bits == pytest.approx(exact, abs=tolerance)
