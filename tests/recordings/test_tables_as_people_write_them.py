"""Tables as loggers, spreadsheets and people write them: read in the one way that is possible, or refused."""

import numpy as np
import pytest

from probewise.errors import FileError
from probewise.systems import read_run_table

TIMES = [0, 3, 6, 9]
READINGS = ["20.00", "24.50", "27.63", "1030.99"]
HEAD = "t_s,temp_c\n"


def table(row="{t},{y}", head=HEAD, times=TIMES, readings=READINGS):
    """Write the same rows in another way; `c` is the reading with a decimal comma."""
    given = zip(times, readings, strict=True)
    return head + "".join(row.format(t=t, y=y, c=y.replace(".", ",")) + "\n" for t, y in given)


def rows(text, other):
    """Replace the first numbers of the table's rows."""
    return text.replace("\n3", f"\n{other}", 1)


PLAIN = table()
READ = {
    "plain": (PLAIN, ""),
    "UTF-16 of a spreadsheet": (table("{t}\t{y}", "t_s\ttemp_c\n").encode("utf-16"), "tabs"),
    "semicolons and decimal commas": (table("{t},0;{c}", "t_s;temp_c\n"), "semicolons; decimal commas in t_s, temp_c"),
    "quoted decimal commas": (table('"{t},0","{c}"'), "decimal commas in t_s, temp_c"),
    "exponents": (table("{t};{c}e0", "t_s;temp_c\n"), "decimal commas in temp_c"),
    "a decimal comma that another column shows": (table("{t},000;{c}", "t_s;temp_c\n"), "decimal commas in t_s"),
    "the separator named": ("sep=,\n" + PLAIN, "separated by commas"),
    "aligned by blanks": (table("{t:>5}  {y:>9}", "  t_s     temp_c\n"), "separated by blanks"),
    "a header that is a comment": (table("{t}e0 {y}", "# t_s temp_c\n"), "separated by blanks"),
    "markdown": (table("| {t} | {y} |", "| t_s | temp_c |\n|---|---|\n"), "separated by '|'"),
    "comments above": ("; exported; 2026\n;device M2K\n" + PLAIN, "header in row 3"),
    "rows above of the same width": ("Device,M2K\nDate,2026-01-02\n" + PLAIN, "header in row 3"),
    "a row of units": (PLAIN.replace("\n", "\ns,degC\n", 1), "row 's', 'degC' below the header left out"),
    "units in the cells": (table("{t} s,{y} °C"), "t_s in s, as its cells say; temp_c in °C, as its cells say"),
    "trailing delimiters": (PLAIN.replace("\n", ",,\n"), "empty cells"),
    "trailing delimiters below the header": (table("{t},{y},"), "empty cells"),
    "a column of comments that rows lack": (table("{t}\t{y}", "t_s\ttemp_c\tComment\n"), "tabs"),
    "row numbers without a name": (table("{t},{t},{y}", "," + HEAD), "a column without a name, ignored"),
    "row numbers without a header": (
        "t_s temp_c\n" + "".join(f'"{k + 1}" {t} {y}\n' for k, (t, y) in enumerate(zip(TIMES, READINGS, strict=True))),
        "a column without a name, ignored",
    ),
    "a name on two lines": (table("{t},{y},5", '"t_s","temp_c","room\n(°C)"\n'), ""),
    "a summary below names": (
        table("ann,{t},{y}", "who,t_s,temp_c\n") + "Average,4.5,275.8\nTotal,18,1103.1\n",
        "2 rows without readings left out (first: row 6)",
    ),
    "a column of numbers but for a word": (
        table("{t},{y},{t}", "t_s,temp_c,room\n").replace(",6\n", ",OL\n"),
        "column room is taken as text: row 4 holds 'OL'",
    ),
    "a summary below": (PLAIN + "mean,275.8\n\nend of file\n", "2 rows without readings left out (first: row 6)"),
    "empty rows below": (PLAIN + ",\n,\n", ""),
    "a comment between rows": (rows(PLAIN, "# door opened, and shut, twice\n3"), "1 row without readings"),
    "dates": (table("2026-01-20 22:09:{t:02},{y}"), "counted in s from 2026-01-20 22:09:00"),
    "dates of a zone": (table("2026-01-20T22:09:{t:02}.250+01:00,{y}"), "counted in s from 2026-01-20T22:09:00.250"),
    "dates with a decimal comma": (table("2026-01-20 22:09:{t:02},5;{y}", "t_s;temp_c\n"), "column 't_s' counted"),
    "months first": (table("01/20/2026 22:09:{t:02},{y}"), "month first"),
    "days first": (table("20.01.2026 22:09:{t:02},{y}"), "day first"),
    "either first, which is the same": (table("01/02/2026 10:00:{t:02},{y}"), "counted in s"),
    "a clock of half days": (table("12:00:{t:02} am,{y}"), "counted in s from 12:00:00 am"),
    "a name of a month": (table("28-Nov-2026 10:00:{t:02},{y}"), "counted in s"),
    "LabVIEW": (
        "LabVIEW Measurement\t\nDate\t2026/01/02\n***End_of_Header***\t\n\t\nX_Dimension\tTime\t\n"
        "***End_of_Header***\t\t\n" + table("{t},000000\t{c}", "X_Value\ttemp_c\tComment\n"),
        "X_Value, in s, is t_s",
    ),
    "a logger's four rows of header": (
        '"TOA5","CR1000"\n"t_s","temp_c"\n"s","degC"\n"","Avg"\n' + table(head=""),
        "header in row 2",
    ),
}  # fmt: skip


def put(folder, content):
    path = folder / "data.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("what", READ)
def test_what_can_be_read_in_one_way_is_read_with_one_line_that_says_how(tmp_path, what):
    content, said = READ[what]
    read = read_run_table(put(tmp_path, content), time="t_s", run=None, reading="temp_c")
    np.testing.assert_allclose(read.columns["t_s"], TIMES)
    np.testing.assert_array_equal(read.columns["temp_c"], [float(y) for y in READINGS])
    assert len(read.notes) == bool(said)
    assert all(note.startswith("data.csv: ") and said in note for note in read.notes)


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["1,020.5", "2,000.0"], [1020.5, 2000]),
        (["1.020,5", "2.000,0"], [1020.5, 2000]),
        (["1\u00a0020,5", "3\u202f000"], [1020.5, 3000]),
        (["1'020.5", "2’000"], [1020.5, 2000]),
        (["\u22121.5", "2"], [-1.5, 2]),
        (["#N/A", "2"], [np.nan, 2]),
        (["---", "2"], [np.nan, 2]),
        (["5 %", "7 %"], [5, 7]),
    ],
)
def test_numbers_are_read_as_people_write_them(tmp_path, cells, expected):
    path = put(tmp_path, "x;y\n" + "".join(f"{k};{cell}\n" for k, cell in enumerate(cells)))
    np.testing.assert_array_equal(read_run_table(path, time=None, run=None).columns["y"], expected)


@pytest.mark.parametrize(
    "cells", [["1 V", "5 mV"], ["2.0D+01", "3.0D+01"], ["OL", "2"], ["0x1F", "2"], ["1.5", "2,5"], ["1_000", "2"]]
)
def test_cells_that_are_no_numbers_of_one_kind_stay_texts(tmp_path, cells):
    path = put(tmp_path, "x;y\n" + "".join(f"{k};{cell}\n" for k, cell in enumerate(cells)))
    assert read_run_table(path, time=None, run=None).columns["y"].tolist() == cells


def test_a_clock_that_passes_midnight_goes_on(tmp_path):
    path = put(tmp_path, "t,y\n23:59:57,1\n00:00:00,2\n00:00:03.5,3\n")
    read = read_run_table(path, time="t", run=None, time_unit="min")
    np.testing.assert_allclose(read.time_s, [0, 0.05, 6.5 / 60])
    assert "column 't' counted in min from 23:59:57, past midnight" in read.notes[0]


@pytest.mark.parametrize(("last", "noted"), [("2026-11-30", True), ("2026-11-28", False)])
def test_a_clock_beside_dates_of_other_days_is_noted(tmp_path, last, noted):
    path = put(tmp_path, f"day,t,y\n2026-11-27,23:59:57,1\n2026-11-28,00:00:00,2\n{last},00:00:03.5,3\n")
    read = read_run_table(path, time="t", run=None)
    assert ("day has other days than t" in read.notes[0]) == noted


REFUSED = {
    "decimal commas between commas": (
        table("{t},{c}"),
        ["row 2: the row has 3 cells", "row 1 is taken for the header: 't_s', 'temp_c'", "decimal comma"],
    ),
    "a comma that is a thousand or a decimal": (
        table("{t};1,{t}00", "t_s;temp_c\n", times=[1, 2, 3, 4]),
        ["row 2, column temp_c: '1,100'", "without thousands"],
    ),
    "two columns of one name": (table("{t},{y},{t}", "t_s,temp_c,t_s\n"), ["row 1, column t_s", "rename or delete"]),
    "row numbers twice": (table("{t},{t},{t},{y}", ",t_s,,temp_c\n"), ["row 1: two columns without a name"]),
    "another unit of time": (table("{t} min,{y}"), ["row 2, column t_s: '0 min'", 'times in s, or time_unit = "min"']),
    "a row of another unit of time": (PLAIN.replace("\n", "\n[h],K\n", 1), ["row 2, column t_s: 'h'", "times in s"]),
    "no header": (table(head=""), ["row 1, column t_s: no such column; the header has '0', '20.00'"]),
    "no such column below a preamble": (
        "; a\n; b\n" + PLAIN.replace("t_s", "t"),
        ["row 3, column t_s", "the header has 't', 'temp_c'"],
    ),
    "a row cut off": (PLAIN + "12\n", ["row 6: the row has 1 cells", "2 cells as in the header"]),
    "years of two digits": (table("0{t}/11/26,{y}", times=[1, 2, 3, 4]), ["row 2", "a year of four digits"]),
    "days or months": (table("0{t}/11/2026,{y}", times=[1, 2, 3, 4]), ["row 3, column t_s", "year first"]),
    "hours or minutes": (table("10:0{t},{y}"), ["row 2, column t_s: '10:00'", "hours, minutes and seconds"]),
    "zones in some rows": (rows(table("2026-01-20T00:00:0{t}Z,{y}"), "").replace("03Z", "03"), ["time zone"]),
    "no such day": (table("2026-02-{t},{y}", times=[27, 28, 29, 30]), ["row 4, column t_s: '2026-02-29'", "exists"]),
    "one word among the times": (rows(table("10:00:0{t},{y}"), "").replace("10:00:06", "noon"), ["row 4", "'noon'"]),
    "an empty cell among the times": (table("10:00:0{t},{y}").replace("10:00:06", ""), ["row 4", "is empty"]),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_could_be_read_in_two_ways_is_refused_with_line_and_cure(tmp_path, what):
    content, fragments = REFUSED[what]
    with pytest.raises(FileError) as caught:
        read_run_table(put(tmp_path, content), time="t_s", run=None, reading="temp_c")
    for fragment in fragments:
        assert fragment in str(caught.value)


@pytest.mark.parametrize(
    "names", [["1.1", "1.2", "1.10"], ["0E8", "0E9"], ["01", "1"], ["1,5", "1,50"], ["5 V", "6 V"]]
)
def test_names_of_runs_are_texts(tmp_path, names):
    path = put(tmp_path, "run;y\n" + "".join(f"{name};1,5\n" for name in names))
    read = read_run_table(path, time=None, run="run")
    assert read.scan_names == tuple(names)
    assert read.columns["y"].tolist() == [1.5] * len(names)


@pytest.mark.parametrize("end", ["\n", "\r", "\r\n"])
def test_a_long_table_is_read_to_its_end(tmp_path, end):
    wide = ",".join(f"column_{k:04}" for k in range(12_000))
    assert len(read_run_table(put(tmp_path, f"{wide}{end}{','.join(['1'] * 12_000)}{end}"), time=None, run=None)) == 1
    long = put(tmp_path, end.join(["x,y", *(f"{k},{k}.5" for k in range(20_000)), "mean,7", ""]))
    assert read_run_table(long, time=None, run=None).columns["y"][-1] == 19_999.5


def test_a_first_row_that_lacks_its_numbers_is_no_row_of_units(tmp_path):
    path = put(tmp_path, "run,x,y\na,#N/A,NULL\nb,1,2\nb,3,4\n")
    assert read_run_table(path, time=None, run="run").scan_names == ("a", "b")


@pytest.mark.parametrize(
    ("times", "unit", "said"),
    [
        ([1795824000000 + 3000 * k for k in range(4)], "s", "milliseconds since 1970: divide by 1000"),
        ([1795824000000 + 3000 * k for k in range(4)], "ms", ""),
        (
            [46354.52083 + k * 1e-5 for k in range(4)],
            "s",
            "days since 1900, of a spreadsheet: write 2026-11-28 12:30:00",
        ),
        ([46354.52083 + k * 1e-5 for k in range(4)], "d", ""),
        ([46354.5 + 0.01 * k for k in range(4)], "s", ""),
        ([46354 + k for k in range(4)], "s", ""),
        (["2026-11-28"] * 4, "s", "from 2026-11-28, the time of all rows"),
    ],
)
def test_times_that_look_like_others_are_noted(tmp_path, times, unit, said):
    read = read_run_table(put(tmp_path, table(times=times)), time="t_s", run=None, reading="temp_c", time_unit=unit)
    assert [said in note for note in read.notes] == [True] * bool(said)


def test_dates_need_a_unit_of_time_with_a_length(tmp_path):
    path = put(tmp_path, table("2026-01-20 22:09:{t:02},{y}"))
    with pytest.raises(FileError, match='in place of "month"'):
        read_run_table(path, time="t_s", run=None, time_unit="month")
