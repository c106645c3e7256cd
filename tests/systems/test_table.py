"""Tables as users have them, and several joined to one."""

import dataclasses
import datetime
from collections.abc import Iterator
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from heater import runs

from probewise.errors import ParameterError
from probewise.systems import RunTable, concatenate_tables


def test_numbers_among_which_some_are_none_are_a_column_of_numbers():
    table = RunTable({"y": [1.0, 2.0, 3.0], "room_c": [20.0, None, 21.0]})
    np.testing.assert_array_equal(table.covariates["room_c"], [20.0, np.nan, 21.0])


def test_missing_values_are_interpolated_within_each_run():
    table = RunTable({"run": np.repeat([1.0, 2.0, 3.0], 4), "y": np.zeros(12)}, run="run")
    values = np.array([np.nan, 1, np.nan, 3, 10, np.nan, np.nan, 40, *[np.nan] * 4])
    expected = [1, 1, 2, 3, 10, 20, 30, 40, *[6.5] * 4]
    np.testing.assert_allclose(table.interpolated_within_runs(values), expected)


def test_two_columns_of_one_name_are_refused():
    class Frame(dict[str, list[float]]):
        def items(self) -> Iterator[tuple[str, list[float]]]:  # type: ignore[override]  # as of a data frame
            return iter([("x", [1.0]), ("x", [2.0])])

    with pytest.raises(ParameterError, match=r"columns is 'x twice'; allowed: each column once"):
        RunTable(Frame())


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (["1.1", "1.2", "1.10"], ("1.1", "1.2", "1.10")),
        (["0E8", "0E9", "0"], ("0E8", "0E9", "0")),
        (["01", "1"], ("01", "1")),
        ([2, 1, 2], ("2", "1")),
        (np.array([9007199254740992, 9007199254740993]), ("9007199254740992", "9007199254740993")),
        ([1.0, 1.5, 1e22], ("1", "1.5", "1e+22")),
        (np.array([1, "a", 1.0, np.int64(1)], dtype=object), ("1", "a")),
        ([True, False], ("True", "False")),
        (np.ma.masked_equal([1, 2], 2), ("1", "")),
    ],
)
def test_names_of_runs_are_texts(given, names):
    table = RunTable({"run": given, "x": np.zeros(len(given))}, run="run")
    assert table.scan_names == names
    assert table.columns["run"].tolist() == [names[k] for k in table.scan]


def test_rows_without_a_run_and_dates_without_marks_are_noted_once():
    """A spreadsheet leaves a repeated name out; 20260131 is followed by 20260201, 70 later."""
    for times, n_notes in (([20260131, 20260201], 2), ([20260131235958.0, 20260131235959.5], 2), ([0, 1], 1)):
        table = RunTable({"run": ["a", ""], "t": times}, run="run", time="t").take(np.arange(2))
        assert len(table.notes) == n_notes
        assert "fill it in" in table.notes[0]
    assert not RunTable({"run": ["", ""], "t": [20261301, 20261302]}, run="run", time="t").notes


def test_a_simulator_gets_names_of_runs_as_numbers_only_if_they_are_different_numbers():
    for given, expected in ((["1", "02"], [1.0, 2.0]), (["1.1", "1.10"], ["1.1", "1.10"]), (["1", "b"], ["1", "b"])):
        table = RunTable({"run": given, "x": [0.0, 1.0]}, run="run")
        assert table.columns_as_given["run"].tolist() == expected


_FIRST = datetime.datetime(2026, 11, 23, 18, 0)
_END_OF_SUMMER = datetime.datetime(2026, 10, 25, 0, 59, 59, tzinfo=datetime.UTC)  # clocks go back a second later
_LATER = [datetime.timedelta(seconds=s) for s in (0, 2, 90)]


@pytest.mark.parametrize(
    "times",
    [
        [_FIRST + later for later in _LATER],
        [(_FIRST + later).replace(tzinfo=datetime.UTC) for later in _LATER],
        [(_END_OF_SUMMER + later).astimezone(ZoneInfo("Europe/Berlin")) for later in _LATER],
        np.array([_FIRST + later for later in _LATER], dtype="datetime64[ns]"),
        np.array(_LATER, dtype="timedelta64[ms]"),
        _LATER,
        ["2026-11-23 18:00:00", "2026-11-23 18:00:02", "2026-11-23 18:01:30"],
        [(_FIRST + later).time() for later in _LATER],
    ],
)
def test_dates_clocks_and_time_differences_count_from_the_first_row(times):
    table = RunTable({"t": times, "y": np.zeros(3)}, "t")
    assert table.time_s.tolist() == [0.0, 2.0, 90.0]
    assert table.notes[0].startswith("column 't' counted in s from ")
    np.testing.assert_allclose(RunTable({"t": times}, "t", time_unit="min").time_s, [0, 2 / 60, 1.5])


def test_months_count_in_days():
    table = RunTable({"t": np.array(["2026-01", "2026-03"], dtype="datetime64[M]")}, "t", time_unit="d")
    assert table.time_s.tolist() == [0.0, 59.0]


def test_a_missing_date_is_refused():
    for times in (np.array(["2026-01-01", "NaT"], dtype="datetime64[s]"), ["2026-01-01 10:00:00", ""]):
        with pytest.raises(ParameterError, match=r"t in row 1 \(the first is 0\)"):
            RunTable({"t": times}, "t")


def test_runs_of_one_name_in_two_tables_are_two_runs():
    joined, notes = concatenate_tables([runs((20.0, 21.0)), runs((25.0,))], ["a.csv", "b.csv"])
    assert joined.scan_names == ("1", "2", "1 (2)")
    assert notes == ("runs of b.csv renamed, as another table has them too: 1 is 1 (2)",)


def test_a_column_of_one_table_is_missing_or_left_out_in_both_and_noted():
    first, second = runs(), runs((25.0,), names="7")
    bare, without = (
        dataclasses.replace(table, columns={k: v for k, v in table.columns.items() if k != "room_c"})
        for table in (second, first)
    )
    joined, notes = concatenate_tables([first, bare], ["a.csv", "b.csv"])
    assert np.isnan(joined.columns["room_c"][len(first) :]).all()
    assert notes == ("b.csv has no column room_c: missing there",)
    joined, notes = concatenate_tables([without, second], ["a.csv", "b.csv"])
    assert "room_c" not in joined.columns
    assert notes == ("column room_c of b.csv left out: a.csv has none",)


def test_the_same_table_twice_or_texts_where_the_first_has_numbers_are_refused():
    with pytest.raises(ParameterError, match=r"a.csv and a.csv"):
        concatenate_tables([runs(), runs()], ["a.csv", "a.csv"])
    second = runs((25.0,), names="7")
    cells = second.columns["room_c"].astype(str)
    cells[2] = "warm"
    with pytest.raises(ParameterError, match=r"column 'room_c' of b.csv in row 2 is 'warm'"):
        concatenate_tables([runs(), second.with_columns({"room_c": cells})], ["a.csv", "b.csv"])


def test_runs_named_by_numbers_are_joined_with_runs_named_by_texts():
    first = RunTable({"day": [1.0, 1.0, 2.0], "x": [1.0, 2.0, 3.0]}, run="day")
    advised = RunTable({"day": ["1 again", "1 again"], "x": [1.0, 2.0]}, run="day")
    joined, _ = concatenate_tables([first, advised], ["a.csv", "next.csv"])
    assert joined.scan_names == ("1", "2", "1 again")
    assert list(joined.columns) == ["day", "x"]
    assert concatenate_tables([advised, first], ["next.csv", "a.csv"])[0].scan_names == ("1 again", "1", "2")


def test_rows_of_a_data_frame_are_called_as_its_index_shows_them():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"t_s": [0.0, 1.0, 0.5]}, index=["mon", "tue", "wed"])
    with pytest.raises(ParameterError, match=r"order of column 'y' is .*: make them one data frame"):
        RunTable({"t_s": frame["t_s"], "y": frame["t_s"].iloc[::-1]})
    missing = RunTable({"y": pandas.Series([pandas.NA, 2.0], dtype=object)}).columns["y"]
    np.testing.assert_array_equal(missing, [np.nan, 2.0])
    with pytest.raises(ParameterError, match=r"in row wed is 0.5"):
        RunTable(frame, "t_s").require_rising_time()
    with pytest.raises(ParameterError, match=r"t in row 8 is 'noon'"):
        RunTable(pandas.DataFrame({"t": ["10:00:00", "noon"]}, index=[7, 8]), "t")
