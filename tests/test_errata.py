"""The numbers that docs/explanation/errata.md states."""

import math

import numpy as np
import pytest

from probewise.inference import StudentT


def test_a_proper_sigma_prior_counts_every_reading():
    """Scaling readings and sigma's bounds by s divides the evidence by s per reading: data^-408."""
    rng = np.random.default_rng(0)
    readings, groups = rng.normal(size=408), np.repeat(np.arange(5), [101, 101, 101, 101, 4])
    predicted = np.zeros((1, 408))
    one = StudentT(groups=groups, sd_floor=0.1, sd_ceiling=10.0).log_prob(readings, predicted)
    ten = StudentT(groups=groups, sd_floor=1.0, sd_ceiling=100.0).log_prob(10 * readings, predicted)
    assert one - ten == pytest.approx(408 * math.log(10), rel=1e-9)


def test_the_arithmetic_of_the_page():
    """Exponents and odds of Table 1; bits to know a circle to 4 mm, by entropies and by cells of 1 mm and of 4 mm."""
    assert (sum(n - 1 for n in (101, 101, 101, 101, 4)), sum((101, 101, 101, 101, 4))) == (403, 408)
    odds = [math.exp(-665.5 + 674.9), math.exp(9), math.exp(-665.5 + 671.9)]
    assert odds == pytest.approx([12088, 8103, 602], rel=1e-3)
    prior, posterior = math.log2(1048 * 520 * 130), 3 * math.log2(4 * math.sqrt(2 * math.pi * math.e))
    assert [prior, posterior, prior - posterior] == pytest.approx([26.1, 12.1, 13.9], abs=0.05)
    assert pytest.approx(61.6, abs=0.1) == 2**25 / (1048 * 520)
    assert pytest.approx(3941, abs=1) == 4 * 2**25 / (1048 * 520 / 16)
