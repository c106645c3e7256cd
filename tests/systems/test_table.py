"""A person's table from memory: what its columns are."""

import numpy as np

from probewise.systems import RunTable


def test_numbers_among_which_some_are_none_are_a_column_of_numbers():
    table = RunTable({"y": [1.0, 2.0, 3.0], "room_c": [20.0, None, 21.0]})
    np.testing.assert_array_equal(table.covariates["room_c"], [20.0, np.nan, 21.0])


def test_missing_values_are_interpolated_within_each_run():
    table = RunTable({"run": np.repeat([1.0, 2.0, 3.0], 4), "y": np.zeros(12)}, run="run")
    values = np.array([np.nan, 1, np.nan, 3, 10, np.nan, np.nan, 40, *[np.nan] * 4])
    expected = [1, 1, 2, 3, 10, 20, 30, 40, *[6.5] * 4]
    np.testing.assert_allclose(table.interpolated_within_runs(values), expected)
