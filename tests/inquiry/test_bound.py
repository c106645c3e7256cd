"""The bound: capacity of the sensor, bits needed, search and refinement apart."""

from math import e, log2, pi

import pytest

from probewise.errors import ParameterError
from probewise.inquiry import Readout, capacity_bits, fewest_readings, target_entropy


def test_two_levels_far_apart_carry_at_least_a_bit_and_noise_free_steps_their_log():
    """A rounding sensor of little noise tells apart as many levels as it has steps."""
    assert capacity_bits(10.0, 17.0, Readout(0.05, 1.0)) == pytest.approx(3.0, abs=0.01)


@pytest.mark.slow
def test_a_wide_range_carries_its_log_over_the_noise():
    """High-power limit of a Gaussian channel of limited amplitude: log2(range / (sd sqrt(2 pi e))) from above."""
    capacity = capacity_bits(10.0, 60.0, Readout(0.25))
    limit = log2(50.0 / (0.25 * (2 * pi * e) ** 0.5))
    assert limit < capacity < limit + 0.15


def test_little_range_carries_what_the_sign_of_it_does():
    """Low-power limit: half an amplitude A of noise sd 1 carries A^2 / (2 ln 2) bits, two levels being best."""
    amplitude = 0.2
    exact = amplitude**2 / (2 * 0.6931)
    assert capacity_bits(-amplitude, amplitude, Readout(1.0)) == pytest.approx(exact, rel=0.06)


def test_more_noise_carries_less():
    values = [capacity_bits(10.0, 60.0, Readout(sd)) for sd in (0.5, 1.0, 2.0)]
    assert values[0] > values[1] > values[2]


def test_the_target_is_the_gaussian_of_that_sd():
    assert target_entropy(3, 4.0) == pytest.approx(3 * 0.5 * log2(2 * pi * e * 16.0))


def test_search_and_refinement_are_divided_by_what_each_can_carry():
    bound = fewest_readings(25.0, 21.0, 12.0, most_covered=0.11, capacity=3.0)
    yes = -0.11 * log2(0.11) - 0.89 * log2(0.89)
    assert bound.readings_of_search == pytest.approx(4.0 / yes)
    assert bound.readings_of_refinement == pytest.approx(3.0)
    assert bound.readings == pytest.approx(4.0 / yes + 3.0)


def test_a_search_that_covers_half_carries_one_bit_at_most():
    assert fewest_readings(25.0, 21.0, 12.0, most_covered=0.8, capacity=3.0).readings_of_search == pytest.approx(4.0)


@pytest.mark.parametrize(
    "change", [{"most_covered": 0.0}, {"met_bits": 30.0}, {"target_bits": 24.0}], ids=["covered", "met", "target"]
)
def test_a_bound_of_what_cannot_be_is_refused(change):
    asked = {"prior_bits": 25.0, "met_bits": 21.0, "target_bits": 12.0, "most_covered": 0.1, "capacity": 3.0, **change}
    with pytest.raises(ParameterError):
        fewest_readings(**asked)


def test_a_sensor_without_contrast_is_refused():
    with pytest.raises(ParameterError, match="low < high"):
        capacity_bits(10.0, 10.0, Readout(1.0))
