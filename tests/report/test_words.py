"""Numbers with their errors, names without their units."""

import pytest

from probewise.report.words import value_and_interval_texts, value_with_error


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
