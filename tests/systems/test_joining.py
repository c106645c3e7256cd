"""Several tables of one system: the first one's columns, runs apart."""

import dataclasses

import numpy as np
import pytest
from heater import runs

from probewise.errors import ParameterError
from probewise.systems import RunTable, concatenate_tables


def test_runs_of_one_name_in_two_tables_are_two_runs():
    joined, notes = concatenate_tables([runs((20.0, 21.0)), runs((25.0,))], ["a.csv", "b.csv"])
    assert joined.scan_names == ("1", "2", "1 (2)")
    assert notes == ("runs of b.csv renamed, as another table has them too: 1 is 1 (2)",)


def test_a_column_that_the_second_lacks_is_missing_there_and_noted():
    second = runs((25.0,), names="7")
    bare = dataclasses.replace(second, columns={k: v for k, v in second.columns.items() if k != "room_c"})
    joined, notes = concatenate_tables([runs(), bare], ["a.csv", "b.csv"])
    assert np.isnan(joined.columns["room_c"][len(runs()) :]).all()
    assert notes == ("b.csv has no column room_c: missing there",)


def test_a_column_that_the_first_lacks_is_left_out_and_noted():
    first = runs()
    bare = dataclasses.replace(first, columns={k: v for k, v in first.columns.items() if k != "room_c"})
    joined, notes = concatenate_tables([bare, runs((25.0,), names="7")], ["a.csv", "b.csv"])
    assert "room_c" not in joined.columns
    assert notes == ("column room_c of b.csv left out: a.csv has none",)


def test_the_same_table_twice_is_refused():
    with pytest.raises(ParameterError, match=r"a.csv and a.csv"):
        concatenate_tables([runs(), runs()], ["a.csv", "a.csv"])


def test_texts_where_the_first_has_numbers_are_refused():
    first, second = runs(), runs((25.0,), names="7")
    cells = second.columns["room_c"].astype(str)
    cells[2] = "warm"
    texts = second.with_columns({"room_c": cells})
    with pytest.raises(ParameterError, match=r"column 'room_c' of b.csv in row 4 is 'warm'"):
        concatenate_tables([first, texts], ["a.csv", "b.csv"])


def test_tables_without_runs_are_a_run_each():
    first, second = RunTable({"x": [1.0, 2.0]}), RunTable({"x": [3.0]})
    joined, _ = concatenate_tables([first, second], ["a.csv", "b.csv"])
    assert joined.scan_names == ("a.csv", "b.csv")


def test_a_renamed_run_is_not_merged_with_another_run_of_its_table():
    joined, _ = concatenate_tables([runs((20.0,)), runs((25.0, 26.0), names=("1", "1 (2)"))], ["a.csv", "b.csv"])
    assert joined.scan_names == ("1", "1 (3)", "1 (2)")
    assert len(set(joined.scan.tolist())) == 3


def test_runs_named_by_numbers_are_joined_with_runs_named_by_texts():
    first = RunTable({"day": [1.0, 1.0, 2.0], "x": [1.0, 2.0, 3.0]}, run="day")
    advised = RunTable({"day": ["1 again", "1 again"], "x": [1.0, 2.0]}, run="day")
    joined, _ = concatenate_tables([first, advised], ["a.csv", "next.csv"])
    assert joined.scan_names == ("1", "2", "1 again")
    assert list(joined.columns) == ["day", "x"]
    assert concatenate_tables([advised, first], ["next.csv", "a.csv"])[0].scan_names == ("1 again", "1", "2")


def test_a_column_of_remarks_may_be_empty_in_one_table():
    empty, written = RunTable({"x": [1.0], "note": [np.nan]}), RunTable({"x": [2.0], "note": ["rain"]})
    for tables, expected in (([empty, written], ["", "rain"]), ([written, empty], ["rain", ""])):
        assert concatenate_tables(tables, ["a.csv", "b.csv"])[0].columns["note"].tolist() == expected


def test_a_text_that_is_a_number_in_the_second_table_is_the_same_text():
    first, second = RunTable({"batch": ["2", "2b"]}), RunTable({"batch": [2.0, 3.0]})
    joined, _ = concatenate_tables([first, second], ["a.csv", "b.csv"])
    assert joined.columns["batch"].tolist() == ["2", "2b", "2", "3"]
