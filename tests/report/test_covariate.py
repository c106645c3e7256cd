"""Names and units of covariates on the axes of a report."""

import pytest

from probewise.report.covariate import covariate_in_words, covariate_unit


@pytest.mark.parametrize("name", ["k", "c", "v", "s", "mm", "deg", "percent", "_k"])
def test_a_letter_that_is_the_whole_name_of_a_column_is_no_unit(name):
    assert covariate_unit(name, "counts") == ""


def test_the_last_part_of_a_columns_name_is_its_unit_and_the_rest_its_name():
    assert (covariate_in_words("room_c"), covariate_unit("room_c", "counts")) == ("room", "°C")
    assert (covariate_in_words("battery_mv"), covariate_unit("battery_mv", "counts")) == ("battery", "mV")
    assert (covariate_in_words("k"), covariate_in_words("_k")) == ("k", " k")
    assert covariate_unit("time", "counts") == "s"
