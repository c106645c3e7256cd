"""The numbers that docs/explanation/errata.md states."""

import math

import numpy as np
import pytest

from probewise.inference import StudentT


def test_the_papers_exponents_give_data_to_the_minus_403():
    """Table 1: four sets of 101 readings and one of 4, each to the power (N_i - 1)/2 of a square."""
    sets = [101] * 4 + [4]
    assert sum(n - 1 for n in sets) == 403
    assert sum(sets) == 408


def test_a_proper_sigma_prior_counts_every_reading():
    """Scaling readings and sigma's bounds by s divides the evidence by s per reading: data^-408."""
    rng = np.random.default_rng(0)
    readings, groups = rng.normal(size=408), np.repeat(np.arange(5), [101, 101, 101, 101, 4])
    predicted = np.zeros((1, 408))
    one = StudentT(groups=groups, sd_floor=0.1, sd_ceiling=10.0).log_prob(readings, predicted)
    ten = StudentT(groups=groups, sd_floor=1.0, sd_ceiling=100.0).log_prob(10 * readings, predicted)
    assert one - ten == pytest.approx(408 * math.log(10), rel=1e-9)


def test_the_odds_of_the_table():
    """Table 1: N = 1, 2, 3 at -665.5, -674.9, -671.9."""
    assert math.exp(-665.5 + 674.9) == pytest.approx(12088, rel=1e-3)
    assert math.exp(9) == pytest.approx(8103, rel=1e-3)
    assert math.exp(-665.5 + 671.9) == pytest.approx(602, rel=1e-3)


def test_bits_to_know_a_circle_to_four_millimetres():
    """Differential entropies in bits: uniform prior, normal posterior of sd 4 mm."""
    prior = math.log2(1048 * 520 * 130)
    posterior = 3 * math.log2(4 * math.sqrt(2 * math.pi * math.e))
    assert (prior, posterior) == (pytest.approx(26.1, abs=0.05), pytest.approx(12.1, abs=0.05))
    assert prior - posterior == pytest.approx(13.9, abs=0.05)


def test_the_radius_range_that_25_bits_would_mean():
    """Counting cells of 1 mm and of 4 mm over the field."""
    assert pytest.approx(61.6, abs=0.1) == 2**25 / (1048 * 520)
    assert pytest.approx(3941, abs=1) == 4 * 2**25 / (1048 * 520 / 16)
