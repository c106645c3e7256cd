"""Numbers with their errors, names without their units."""

import pytest

from probewise._words import unit_of_name
from probewise.report.words import (
    digits_of_range,
    range_text,
    value_and_interval_texts,
    value_with_error,
    words_without_unit,
)


@pytest.mark.parametrize(
    ("value", "error", "written"),
    [
        (-389.8199, 0.0234, "−389.820 ± 0.023"),
        (-394.28, 0.53, "−394.28 ± 0.53"),
        (1022.83, 1.53, "1022.8 ± 1.5"),
        (137.2, 11.4, "137 ± 11"),
        (0.0, 0.0996, "0.000 ± 0.100"),
        (12.5, 0.0, "12.5"),
        (float("nan"), 1.0, "–"),
        (3.0, float("nan"), "3"),
    ],
)
def test_a_value_is_written_to_the_second_figure_of_its_error(value, error, written):
    assert value_with_error(value, error) == written


def test_an_interval_is_written_to_the_third_figure_of_its_width():
    assert value_and_interval_texts(0.032489, 0.030724, 0.035694) == ("0.0325", "0.0307 to 0.0357")
    assert value_and_interval_texts(-3.0, -3.0, -3.0) == ("−3", "−3 to −3")


def test_ends_that_lie_close_together_are_written_with_the_digits_that_tell_them_apart():
    assert range_text(10.0213, 10.5641) == "10.02 to 10.56"
    assert range_text(36052.31, 36060.12) == "36052.3 to 36060.1"
    assert range_text(1764127000.0, 1764128500.0) == "1.764127e+09 to 1.7641285e+09"
    assert (range_text(50.0, 50.0 + 1e-14), range_text(0.0, 0.0)) == ("50", "0")
    assert digits_of_range(9.80664, 9.80666, 5) == 7


def test_a_parameters_unit_is_told_once():
    assert (words_without_unit("rectangle.width_mm"), unit_of_name("rectangle.width_mm")) == ("rectangle width", "mm")
    assert (words_without_unit("angle_rad"), unit_of_name("angle_rad")) == ("angle", "rad")
    assert (words_without_unit("A_1"), unit_of_name("A_1")) == ("A 1", "")
