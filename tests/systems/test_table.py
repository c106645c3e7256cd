"""A person's table from memory: what its columns are."""

from collections.abc import Iterator
from decimal import Decimal

import numpy as np
import pytest

from probewise.errors import ParameterError
from probewise.systems import RunTable, read_run_table


def test_numbers_among_which_some_are_none_are_a_column_of_numbers():
    table = RunTable({"y": [1.0, 2.0, 3.0], "room_c": [20.0, None, 21.0]})
    np.testing.assert_array_equal(table.covariates["room_c"], [20.0, np.nan, 21.0])


def test_missing_values_are_interpolated_within_each_run():
    table = RunTable({"run": np.repeat([1.0, 2.0, 3.0], 4), "y": np.zeros(12)}, run="run")
    values = np.array([np.nan, 1, np.nan, 3, 10, np.nan, np.nan, 40, *[np.nan] * 4])
    expected = [1, 1, 2, 3, 10, 20, 30, 40, *[6.5] * 4]
    np.testing.assert_allclose(table.interpolated_within_runs(values), expected)


def test_masked_values_are_missing():
    x = np.ma.masked_equal([1, 2, -999], -999)
    texts = np.ma.masked_array(["a", "bad"], mask=[False, True])
    np.testing.assert_array_equal(RunTable({"x": x}).columns["x"], [1.0, 2.0, np.nan])
    assert RunTable({"who": texts}).columns["who"].tolist() == ["a", ""]


def test_decimal_numbers_are_numbers():
    table = RunTable({"x": [Decimal("1.5"), None, Decimal(2)]})
    np.testing.assert_array_equal(table.covariates["x"], [1.5, np.nan, 2.0])


def test_two_columns_of_one_name_are_refused():
    class Frame(dict[str, list[float]]):
        def items(self) -> Iterator[tuple[str, list[float]]]:  # type: ignore[override]  # as of a data frame
            return iter([("x", [1.0]), ("x", [2.0])])

    with pytest.raises(ParameterError, match=r"columns is 'x twice'; allowed: each column once"):
        RunTable(Frame())


def test_large_numbers_in_a_file_are_numbers(tmp_path):
    path = tmp_path / "diode.csv"
    rows = "9007199254740992,1e22,0.1\n9007199254740993,3e23,\n"
    path.write_text(f"run,doping_per_m3,u_v\n{rows}", encoding="utf-8")
    table = read_run_table(path, time=None, run="run")
    assert table.scan_names == ("9007199254740992", "9007199254740993")
    np.testing.assert_array_equal(table.covariates["doping_per_m3"], [1e22, 3e23])
