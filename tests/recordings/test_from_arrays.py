"""Recordings and plans made from arrays, lists, dicts of columns and data frames."""

import datetime

import numpy as np
import pytest

from probewise.errors import ParameterError, ShapeError, UnitWarning
from probewise.recordings import (
    Disc,
    HalfPlane,
    Instrumentation,
    Plan,
    Polygon,
    Quadrant,
    Recording,
    Stripes,
    Uniform,
    read_recording,
    shipped,
    write_recording,
)

EDGE = HalfPlane(0.0, 0.0)
THREE = {"x_mm": [-10, 0, 10], "y_mm": 0, "reading": [0.4, 1.6, 2.9]}
OPTIONS = ("patterns", "unit", "min", "max", "controls")


def made(**changes):
    options = {"patterns": {"edge": EDGE}, "unit": "V"} | {k: changes.pop(k) for k in OPTIONS if k in changes}
    return Recording.from_table(THREE | changes, **options)


ROW = {"x_mm": [1], "y_mm": [2], "reading": [3]}


def of_table(table):
    return Recording.from_table(table, patterns=EDGE, unit="V")


def columns_of(recording):
    """Take a recording apart into the columns of its file."""
    plan = recording.plan
    return {
        "reading": recording.readings,
        "x_mm": plan.x_mm,
        "y_mm": plan.y_mm,
        "orientation_deg": np.degrees(plan.orientation_rad),
        "scan": [plan.scan_names[k] for k in plan.scan],
        "pattern": [plan.pattern_names[k] for k in plan.pattern],
        "time_s": plan.time_s,
        **plan.covariates,
    }


def require_same(one, other):
    for name in ("x_mm", "y_mm", "time_s", "scan", "pattern"):
        assert np.array_equal(getattr(one.plan, name), getattr(other.plan, name))
    assert np.allclose(one.plan.orientation_rad, other.plan.orientation_rad, rtol=0, atol=1e-15)
    assert np.array_equal(one.readings, other.readings, equal_nan=True)
    assert (one.plan.scan_names, one.plan.pattern_names) == (other.plan.scan_names, other.plan.pattern_names)
    assert list(one.plan.covariates) == list(other.plan.covariates)


@pytest.mark.parametrize("frame", [dict, "pandas", np.rec.fromarrays], ids=["dict", "data frame", "records"])
def test_a_table_and_a_file_make_the_same_recording(frame):
    recording = read_recording(shipped("paper"))
    columns = columns_of(recording)
    if frame == "pandas":
        frame = pytest.importorskip("pandas").DataFrame
    table = frame(list(columns.values()), names=list(columns)) if frame is np.rec.fromarrays else frame(columns)
    inst = recording.plan.instrumentation
    other = Recording.from_table(
        table, patterns=recording.plan.patterns, unit=inst.unit, min=inst.min, max=inst.max, controls=inst.controls
    )
    require_same(other, recording)


def test_sessions_are_written_read_back_and_made_from_a_table(tmp_path):
    recording = made(scan=[*"aab"], session=[0, 0, 1])
    assert recording.plan.sessions == (0, 1)
    write_recording(recording, tmp_path / "made.csv")
    assert read_recording(tmp_path / "made.csv").plan.sessions == (0, 1)
    table = columns_of(recording) | {"session": [0, 0, 1]}
    assert Recording.from_table(table, patterns={"edge": EDGE}, unit="V").plan.sessions == (0, 1)
    assert made(scan=[*"aab"], session=[2, 2, 2]).plan.sessions == ()


def test_scans_that_are_named_by_numbers_get_a_note_that_1_10_is_1_1():
    (note,) = made(scan=[1.1, 1.1, 2.0]).notes
    assert note.startswith("column scan names scans by numbers, of which 1.10 is 1.1")
    assert not made(scan=["1.1", "1.10", "2"]).notes


def test_missing_readings_and_those_out_of_range_are_left_out_and_noted():
    recording = made(reading=[None, 9, 2.5], max=5)
    assert recording.usable.tolist() == [False, False, True]
    assert recording.notes == ("1 reading missing, left out", "1 reading outside the range up to 5, left out")
    masked = np.ma.masked_greater([0.4, 99.0, 2.9], 50)
    assert np.isnan(made(reading=masked).readings).tolist() == [False, True, False]
    for wrong in (np.ma.array(["a", "b", "c"]), np.ma.array([1j, 2.0, 3.0])):
        with pytest.raises(ParameterError, match="reading"):
            made(reading=wrong)


def test_a_table_may_say_n_a_where_a_number_is_missing_and_hold_dates():
    begun = datetime.datetime(2026, 11, 23, 18, 0, tzinfo=datetime.UTC)
    dates = [begun + datetime.timedelta(seconds=s) for s in (0, 2, 5)]
    table = {"x_mm": [0, 1, 2], "y_mm": [0, 0, 0], "reading": [1, "n/a", 3], "lux": ["7", "NA", ""], "time_s": dates}
    recording = of_table(table)
    assert np.isnan(recording.readings).tolist() == [False, True, False]
    assert np.isnan(recording.plan.covariates["lux"]).tolist() == [False, True, True]
    assert recording.plan.time_s.tolist() == [0.0, 2.0, 5.0]
    stamps = np.array(["2026-11-23T18:00:00", "2026-11-23T18:00:00.5"], dtype="datetime64[ms]")
    assert made(x_mm=[0, 1], reading=[1, 2], time_s=stamps).plan.time_s.tolist() == [0.0, 0.5]


@pytest.mark.parametrize("text", ["infinity", "1_000"])
def test_a_text_that_is_no_number_in_a_file_is_none_in_a_table(text):
    table = {"x_mm": [0, 1], "y_mm": [0, 0], "reading": [1, 2], "lux": ["3", text]}
    recording = of_table(table)
    assert recording.notes == ("column lux holds no numbers, ignored",)
    with pytest.raises(ParameterError, match="reading is"):
        made(x_mm=[0, 1], reading=["3", text])


def test_dates_with_and_without_a_time_zone_are_refused_together():
    begun = datetime.datetime(2026, 11, 23, 18, 0, tzinfo=datetime.UTC)
    with pytest.raises(ParameterError, match=r"time_s is .* dates that all have a time zone, or none of them"):
        made(x_mm=[0, 1], reading=[1, 2], time_s=[begun, begun.replace(tzinfo=None)])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pattern": "edgy"}, r"'edgy' is named but not described: pass patterns=\{'edgy': ...\}"),
        ({"patterns": {"a": EDGE, "b": EDGE}}, "pattern is None; allowed: the name of each reading's pattern"),
        ({"patterns": {}}, "patterns is {}; allowed: what lay under the sensor, by name"),
        ({"patterns": {"edge": {"kind": "half_plane"}}}, r"patterns\['edge'\] is .*; allowed: a pattern such as"),
        ({"unit": None}, "unit is None; allowed: a text"),
        ({"x_mm": ["a", "b", "c"]}, "x_mm is .*; allowed: numbers, in an array or a list"),
        ({"x_mm": [0, 1, 10**400]}, "x_mm is .*; allowed: numbers, in an array or a list"),
        ({"x_mm": [[0], [1, 2], 3]}, "x_mm is .*; allowed: numbers, in an array or a list"),
        ({"reading": [0, 1e300, 1]}, r"reading\[1\] is 1e\+300; allowed: magnitudes up to 1e\+15"),
        ({"y_mm": [0, 1, -1e10]}, r"y_mm\[2\] is -10000000000.0; allowed: magnitudes up to 1e\+09"),
        ({"temperature": [0, 1e16, 1]}, r"temperature\[1\] is 1e\+16; allowed: magnitudes up to 1e\+15"),
        ({"reading": [0, 1, 1j]}, "reading is .*; allowed: numbers, in an array or a list"),
        ({"x_mm": [0, 1], "y_mm": [0, 1, 2]}, r"x_mm has shape \(2,\); allowed: \(3,\), one per reading"),
        ({"pattern": ["edge", None, "edge"]}, r"pattern\[1\] is None; allowed: a name in every row"),
        ({"scan": ["a", "b", None]}, r"scan\[2\] is None; allowed: a name in every row"),
        ({"x_mm": [0, None, 1]}, r"x_mm\[1\] is nan; allowed: finite numbers"),
        ({"y_mm": [[0, 1, 2]]}, r"y_mm has shape \(1, 3\); allowed: \(3,\), one per reading"),
        ({"reading": [np.nan] * 3}, "allowed: at least one number within the declared range"),
        ({"scan": ["a"]}, "scan has 1 names; allowed: 3"),
        ({"session": [0, 0, 1]}, r"session\[2\] is 1.0; allowed: a whole number from 0, the same throughout a scan"),
        ({"min": 5, "max": 0}, "max is 0.0; allowed: greater than min, 5"),
        ({"controls": "led"}, "controls is 'led'; allowed: a tuple of texts"),
    ],
)
def test_what_cannot_be_a_recording_is_refused_in_words(changes, message):
    with pytest.raises((ParameterError, ShapeError), match=message):
        made(**changes)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: of_table([1, 2, 3]), "table is .*; allowed: columns by name: a dict of arrays, or a data frame"),
        (lambda: of_table({"x": [1], "y_mm": [2], "reading": [3]}), "x_mm among them; rename the table's columns"),
        (lambda: of_table(ROW | {"orientation_deg": [0], "orientation_rad": [0]}), "one of orientation_deg and orient"),
        (lambda: of_table(ROW | {" x_mm": [5]}), "columns is 'x_mm'; allowed: each name once"),
        (lambda: HalfPlane("0", 0), "normal_rad is '0'; allowed: a finite number"),
        (lambda: Disc(0.0, 40.0), r"center_mm is 0.0; allowed: two finite numbers \(x, y\)"),
        (lambda: Disc((0.0, 0.0), -1.0), "radius_mm is -1.0; allowed: a number greater than 0"),
        (lambda: Polygon([(0, 0), (1, 1)]), "allowed: three corners"),
        (lambda: Quadrant((0, 0), (0, 1)), r"direction is .*; allowed: \(1, 1\)"),
        (lambda: Stripes(0.0, 8.0, 50, 0.0), "duty is 50.0; allowed: a number from 0 to 1"),
        (lambda: Uniform([1.0]), r"albedo is \[1.0\]; allowed: a finite number"),
        (lambda: Instrumentation(height_mm="14"), "height_mm is '14'; allowed: a number or None"),
        (lambda: Plan.from_arrays(x_mm=0, y_mm=0, patterns=EDGE, unit="V", orientation_rad="90"), "orientation_rad is"),
    ],
)
def test_what_is_of_the_wrong_kind_is_refused_in_words(make, message):
    with pytest.raises(ParameterError, match=message):
        make()


def test_a_scan_with_a_name_that_no_file_can_hold_is_refused_where_it_is_made():
    """Else a calibration of hours ends in an error, when its recording's fingerprint is taken."""
    with pytest.raises(ParameterError, match=r"scan\[2\] is 'b.*printable"):
        made(scan=["a", "a", "b\n\0c"])
    assert made(scan=[" a", "a", "b\n"]).plan.scan_names == ("a", "b")


def test_rows_are_taken_by_number_by_truth_and_by_slice():
    whole = read_recording(shipped("paper"))
    for rows in ([0, 1, 2], slice(3), np.arange(len(whole)) < 3):
        assert whole.take(rows).readings.tolist() == whole.readings[:3].tolist()
        assert whole.plan.take(rows).x_mm.tolist() == whole.plan.x_mm[:3].tolist()
    assert len(whole.take([])) == 0
    assert whole.take([-1]).readings[0] == whole.readings[-1]


def test_degrees_given_where_radians_are_meant_are_warned_of():
    with pytest.warns(UnitWarning, match="orientation_rad reaches 90 rad, .* convert degrees"):
        made(orientation_rad=[0, 45, -90])
    made(orientation_rad=[0, np.pi, -2 * np.pi])
