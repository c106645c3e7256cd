"""The recording format, rule by rule; any bytes are a recording or a FileError."""

import contextlib
import json
import os
import sys
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probewise.errors import FileError, PipeWarning
from probewise.recordings import (
    Disc,
    HalfPlane,
    Polygon,
    Quadrant,
    Ramp,
    Stripes,
    Uniform,
    read_plan,
    read_prediction_columns,
    read_recording,
)
from probewise.recordings.columns import notes_on_codes

WHITE = {"white": {"kind": "uniform", "albedo": 1}}
TWO = {**WHITE, "edge": {"kind": "half_plane", "normal_deg": 90, "offset_mm": 2}}


def put(folder, csv, patterns=WHITE, **more):
    content = {"format": "recording/1", "reading": {"unit": "LEGO", "min": 0, "max": 100}, "patterns": patterns, **more}
    (folder / "rec.csv").write_bytes(csv if isinstance(csv, bytes) else csv.encode())
    (folder / "rec.json").write_text(json.dumps(content))
    return folder / "rec.csv"


def test_what_is_not_said_is_taken_by_default(tmp_path):
    recording = read_recording(put(tmp_path, "reading,x_mm,y_mm\n1,2,3\n4,5,6\n7,8,9\n"))
    plan = recording.plan
    np.testing.assert_array_equal(plan.orientation_rad, 0)
    np.testing.assert_array_equal(plan.scan, 0)
    np.testing.assert_array_equal(np.diff(plan.time_s), 1)
    assert plan.pattern_names == ("white",)
    assert recording.notes == ()
    assert plan.instrumentation.step is None
    assert plan.instrumentation.controls == ()


def test_byte_order_mark_crlf_quotes_blanks_and_empty_lines_are_accepted(tmp_path):
    csv = b'\xef\xbb\xbfx_mm, y_mm ,reading,scan\r\n1,2,3.5,"a, b"\r\n\r\n 4 ,5,+6e0,"a, b"\r\n'
    recording = read_recording(put(tmp_path, csv))
    np.testing.assert_array_equal(recording.readings, [3.5, 6])
    assert recording.plan.scan_names == ("a, b",)


def test_a_session_is_a_number_of_each_scan_and_one_session_is_none(tmp_path):
    csv = "x_mm,y_mm,reading,scan,session\n0,0,1,a,0\n1,0,1,a,0\n0,0,1,b,{0}\n1,0,1,c,{0}\n"
    assert read_plan(put(tmp_path, csv.format(3))).sessions == (0, 3, 3)
    assert read_plan(put(tmp_path, csv.format(0))).sessions == ()
    said = read_recording(put(tmp_path, "x_mm,y_mm,reading,session\n0,0,1,noon\n0,0,2,noon\n"))
    assert (said.plan.sessions, said.notes) == ((), ("column session is text, ignored",))


def test_missing_and_out_of_range_readings_are_counted_and_left_out(tmp_path):
    recording = read_recording(put(tmp_path, "x_mm,y_mm,reading\n0,0,\n0,0,NaN\n0,0,101\n0,0,50\n0,0,0\n0,0,1e200\n"))
    np.testing.assert_array_equal(recording.usable, [False, False, False, True, True, False])
    assert recording.notes == ("2 readings missing, left out", "2 readings outside 0 to 100, left out")
    assert recording.readings[2] == 101


def test_other_numbers_are_covariates_and_other_texts_are_noted(tmp_path):
    csv = "x_mm,y_mm,reading,battery_mv,who,height_mm,blank\n0,0,1,8300,Ann,14,\n0,0,2,nan,Bob,28,\n0,0,2,,,28,\n"
    recording = read_recording(put(tmp_path, csv))
    assert list(recording.plan.covariates) == ["battery_mv", "height_mm"]
    np.testing.assert_array_equal(recording.plan.covariates["battery_mv"], [8300, np.nan, np.nan])
    assert recording.notes == ("column who is text, ignored", "column blank is empty, ignored")


def test_the_led_may_be_true_or_false(tmp_path):
    """As data frames write it."""
    recording = read_recording(put(tmp_path, "x_mm,y_mm,reading,led\n0,0,1,True\n1,0,2,false\n2,0,2,\n3,0,2,0.5\n"))
    np.testing.assert_array_equal(recording.plan.covariates["led"], [1.0, 0.0, np.nan, 0.5])
    assert recording.notes == ()


@pytest.mark.parametrize(
    ("name", "cells", "fragments"),
    [
        ("led", ("on", "off"), ["row 2, column led: 'on'", "0 or false (off), 1 or true (on)"]),
        ("height_mm", ("14 mm", "2 cm"), ["row 2, column height_mm: '14 mm'", "without its unit"]),
        ("speed", ("3", "fast"), ["row 3, column speed: 'fast'", "a number"]),
        ("session", ("mon", "tue"), ["row 2, column session: 'mon'", "a whole number from 0"]),
    ],
)
def test_what_was_commanded_is_not_left_out_because_it_is_text(tmp_path, name, cells, fragments):
    """Readings with the lamp off would count as readings with it on."""
    csv = f"x_mm,y_mm,reading,{name}\n0,0,1,{cells[0]}\n1,0,2,{cells[1]}\n2,0,2,{cells[1]}\n"
    with pytest.raises(FileError) as caught:
        read_recording(put(tmp_path, csv, controls=["speed", "orientation_deg"]))
    for fragment in fragments:
        assert fragment in str(caught.value)


def test_every_pattern_kind_is_read(tmp_path):
    level = {"inside": 0.25, "outside": 0.75}
    kinds = {
        "u": {"kind": "uniform", "albedo": 0.5},
        "h": {"kind": "half_plane", "normal_deg": 90, "offset_mm": 2, **level},
        "q": {"kind": "quadrant", "corner_mm": [1, 2], "direction": [1, -1]},
        "d": {"kind": "disc", "center_mm": [1, 2], "radius_mm": 3, **level},
        "p": {"kind": "polygon", "vertices_mm": [[0, 0], [1, 0], [0, 1]]},
        "s": {"kind": "stripes", "normal_deg": 0, "period_mm": 4, "duty": 0.5, "phase_mm": 1},
        "r": {"kind": "ramp", "normal_deg": 180, "per_mm": 0.01},
        "i": {"kind": "image", "file": "photo.npy", "pixel_mm": 2, "origin_mm": [-1, -2]},
    }
    np.save(tmp_path / "photo.npy", np.array([[0, 51], [102, 255]], dtype=np.uint8))
    plan = read_plan(put(tmp_path, "x_mm,y_mm,pattern\n" + "".join(f"0,0,{k}\n" for k in kinds), kinds))
    image = plan.patterns["i"]
    np.testing.assert_allclose(image.albedo, [[0, 0.2], [0.4, 1]])
    assert {name: p for name, p in plan.patterns.items() if name != "i"} == {
        "u": Uniform(0.5),
        "h": HalfPlane(np.pi / 2, 2, 0.25, 0.75),
        "q": Quadrant((1, 2), (1, -1)),
        "d": Disc((1, 2), 3, 0.25, 0.75),
        "p": Polygon(((0, 0), (1, 0), (0, 1))),
        "s": Stripes(0, 4, 0.5, 1),
        "r": Ramp(np.pi, 0.01),
    }


def test_an_orientation_beyond_a_full_turn_is_noted(tmp_path):
    path = put(tmp_path, "x_mm,y_mm,orientation_deg,reading\n0,0,90,1\n1,0,-9999,2\n")
    assert read_recording(path).notes == ("row 3: orientation_deg is -9999, beyond a full turn: mistyped?",)


def test_places_and_orientations_in_other_units_are_noted(tmp_path):
    path = put(tmp_path, "x_mm,y_mm,reading\n0,0,1\n0.12,0,1\n")
    assert read_recording(path).notes == ("all places lie within 0.12 mm: are x_mm and y_mm in metres?",)
    path = put(tmp_path, "x_mm,y_mm,orientation_deg,reading\n0,0,0,1\n1,0,1.571,2\n1,0,-.7854,2\n")
    assert read_recording(path).notes == ("orientation_deg holds 1.571, in radians 90 degrees",)


def test_numbers_that_stand_for_missing_ones_and_names_that_look_alike_are_noted(tmp_path):
    rows = [f"{x},0,{x},{8300 + x},20,{'aA'[x > 2]}" for x in range(5)]
    rows += ["999,0,6,-9999,20,A", "5,0,6,8301,-273.15,A"]
    says = "column {} holds {}: if that says that a value is missing, empty the cell"
    codes = [says.format(*each) for each in (("x_mm", 999), ("battery_mv", -9999), ("temp_c", -273.15))]
    path = put(tmp_path, "\n".join(["x_mm,y_mm,reading,battery_mv,temp_c,scan", *rows, ""]))
    assert read_recording(path).notes == (*codes, "column scan: 'A' and 'a' are different scans")
    assert not notes_on_codes({"whole": np.arange(1000.0), "none": np.full(3, np.nan), "all": np.full(3, 999.0)})


def test_time_that_runs_backwards_is_noted(tmp_path):
    recording = read_recording(put(tmp_path, "x_mm,y_mm,reading,time_s\n0,0,1,5\n0,0,1,4\n"))
    assert recording.notes == ("time_s runs backwards at row 3",)


HEAD = "x_mm,y_mm,reading\n"
BAD_TABLES = {
    "missing column": ("x_mm,reading\n0,1\n", ["row 1", "column y_mm", "'x_mm', 'reading'"]),
    "a plan": ("x_mm,y_mm\n0,1\n", ["row 1", "column reading", "plan"]),
    "text in a number": (HEAD + "0,0,1\n0,abc,2\n", ["row 3", "column y_mm", "'abc'", "finite number"]),
    "text in a reading": (HEAD + "0,0,dark\n", ["row 2", "column reading", "'dark'", "empty, nan or n/a"]),
    "comma as decimal point": (HEAD + "0,0,1,5\n", ["row 2", "4 cells", "1.5"]),
    "infinite reading": (HEAD + "0,0,1\n0,0,inf\n", ["row 3", "column reading", "'inf'"]),
    "huge coordinate": (HEAD + "1e300,0,1\n", ["row 2", "column x_mm", "'1e300'", "1e+09"]),
    "radians": ("orientation_rad," + HEAD + "0,0,0,1\n", ["row 1", "orientation_rad", "orientation_deg"]),
    "text in a covariate": ("t_c," + HEAD + "1,0,0,1\n2,0,0,1\nx,0,0,1\n", ["row 4", "column t_c", "'x'"]),
    "no scan": ("scan," + HEAD + "a,0,0,1\n,0,0,1\nb,0,0,1\n", ["row 3, column scan: the cell is empty", "in none"]),
    "unprintable scan": ("scan," + HEAD + "a,0,0,1\nb\1,0,0,1\n", ["row 3", "column scan", "b\\x01", "printable"]),
    "duplicate header": ("x_mm,y_mm,reading,x_mm\n0,0,1,2\n", ["row 1", "column x_mm", "twice"]),
    "short row": (HEAD + "0,0,1\n\n0,0\n", ["row 4", "2 cells", "3 cells"]),
    "no reading": (HEAD + "0,0,\n0,0,nan\n", ["column reading", "no reading at all"]),
    "nothing in range": (HEAD + "0,0,200\n", ["column reading", "0 to 100"]),
    "empty": ("", ["the file is empty"]),
    "open quote": (HEAD + '0,0,"1\n', ["row", "CSV"]),
    "not UTF-8": (HEAD.encode() + b"0,0,1\n0,0,\xff\n", ["row 3", "0xff", "UTF-8"]),
    "a workbook": (b"PK\x03\x04\x14\x00", ["workbook", "CSV UTF-8"]),
    "UTF-16 without its mark": ((HEAD + "0,0,1\n").encode("utf-16-le"), ["row 1", "NUL", "UTF-16", "UTF-8"]),
    "half of UTF-16": (HEAD.encode("utf-16")[:-1], ["row", "is not UTF-16", "UTF-8"]),
    "two sessions": ("session," + HEAD + "0,0,0,1\n1,0,0,1\n", ["row 3", "column session", "throughout a scan"]),
    "unknown pattern": ("pattern," + HEAD + "white,0,0,1\nred,0,0,1\n", ["row 3", "column pattern", "'red'", "white"]),
}  # fmt: skip


def test_a_pattern_must_be_named_where_there_are_several(tmp_path):
    with pytest.raises(FileError, match=r"row 1, column pattern: .*2 patterns"):
        read_recording(put(tmp_path, HEAD + "0,0,1\n", TWO))


def described(**patterns):
    return json.dumps({"format": "recording/1", "patterns": patterns})


def with_white(**more):
    return json.dumps({"format": "recording/1", "patterns": WHITE, **more})


BAD_DESCRIPTIONS = {
    "does not parse": ('{"format": \n "recording/1",,}', ["line 2", "JSON"]),
    "not a number of JSON": ('{"format": "recording/1", "reading": {"min": NaN}}', ["NaN"]),
    "a list": ("[]", ["an object"]),
    "a name twice": ('{"format": 1, "format": 2}', ["'format' comes twice"]),
    "too deep": ("[" * 100_000, ["JSON"]),
    "another format": ('{"format": "recording/9", "patterns": {}}', ["format is", '"recording/1"']),
    "no patterns": ('{"format": "recording/1"}', ["patterns is missing"]),
    "unknown kind": (described(a={"kind": "blob"}), ['patterns.a.kind is "blob"', "half_plane", "image"]),
    "unprintable pattern": (described(**{"a\n": {"kind": "uniform"}}), ["a\\n", "printable"]),
    "field missing": (described(a={"kind": "uniform"}), ["patterns.a.albedo is missing"]),
    "text in a field": (described(a={"kind": "uniform", "albedo": "1"}), ['patterns.a.albedo is "1"', "finite number"]),
    "huge field": ('{"format": "recording/1", "patterns": {"a": {"albedo": 1e999}}}', ["'1e999' is beyond"]),
    "negative radius": (
        described(a={"kind": "disc", "center_mm": [0, 0], "radius_mm": -3}),
        ["radius_mm is -3", "greater than 0"],
    ),
    "duty": (
        described(a={"kind": "stripes", "normal_deg": 0, "period_mm": 1, "duty": 2, "phase_mm": 0}),
        ["duty is 2", "0 to 1"],
    ),
    "image elsewhere": (
        described(a={"kind": "image", "file": "../x.png", "pixel_mm": 1, "origin_mm": [0, 0]}),
        ["without a path"],
    ),
    "image missing": (
        described(a={"kind": "image", "file": "x.png", "pixel_mm": 1, "origin_mm": [0, 0]}),
        ["patterns.a.file", "x.png", "same folder"],
    ),
    "range": (with_white(reading={"min": 5, "max": 5}), ["reading.max is 5", "greater than min"]),
    "controls": (with_white(controls="led"), ["controls", "list of texts"]),
}  # fmt: skip


@pytest.mark.parametrize("what", [*BAD_TABLES, *BAD_DESCRIPTIONS])
def test_a_bad_file_is_answered_with_its_name_its_row_and_column_or_its_field(tmp_path, what):
    content, fragments = (BAD_TABLES | BAD_DESCRIPTIONS)[what]
    path = put(tmp_path, content if what in BAD_TABLES else HEAD + "0,0,1\n")
    if what in BAD_DESCRIPTIONS:
        (tmp_path / "rec.json").write_text(content)
    with pytest.raises(FileError) as caught:
        read_recording(path)
    message = str(caught.value)
    assert message.startswith(str(path if what in BAD_TABLES else tmp_path))
    assert "\n" not in message
    for fragment in ("allowed: ", *fragments):
        assert fragment in message


def test_an_unused_field_of_a_pattern_is_noted(tmp_path):
    patterns = {"a": {"kind": "uniform", "albedo": 1, "colour": "white"}}
    notes = read_recording(put(tmp_path, HEAD + "0,0,1\n", patterns)).notes
    assert notes == ("pattern a: colour not used, no field of kind uniform",)


@pytest.mark.skipif(sys.platform == "win32", reason="devices have other names there")
def test_a_device_is_no_file():
    """It may have no end."""
    with pytest.raises(FileError, match="/dev/zero: this is a device; allowed: a CSV file"):
        read_recording("/dev/zero")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileError, match=r"rec\.csv: there is no such file"):
        read_recording(tmp_path / "rec.csv")
    (tmp_path / "rec.csv").write_text(HEAD + "0,0,1\n")
    with pytest.raises(FileError, match=r"rec\.json: there is no such file; .*beside the CSV"):
        read_recording(tmp_path / "rec.csv")
    with pytest.raises(FileError, match="name of the CSV"):
        read_recording(tmp_path / "rec.json")
    with pytest.raises(FileError, match="cannot be read"):
        read_recording(tmp_path)


def test_a_prediction_with_a_spread_of_nothing_is_refused(tmp_path):
    (tmp_path / "p.csv").write_text("mean,sd,log_density\n1,1,\n1,0,2\n")
    with pytest.raises(FileError, match="row 3, column sd"):
        read_prediction_columns(tmp_path / "p.csv")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes with names")
def test_who_waits_for_a_pipe_is_told(tmp_path):
    put(tmp_path, "x_mm,y_mm,reading,pattern\n0,0,1,white\n")
    content = (tmp_path / "rec.csv").read_bytes()
    (tmp_path / "rec.csv").unlink()
    os.mkfifo(tmp_path / "rec.csv")
    writer = threading.Thread(target=lambda: (tmp_path / "rec.csv").write_bytes(content))
    writer.start()
    with pytest.warns(PipeWarning, match="rec.csv is a pipe"):
        assert len(read_recording(tmp_path / "rec.csv")) == 1
    writer.join()


CSV = b"x_mm,y_mm,reading,scan,pattern,time_s\n0,0,1,a,white,3\n1,0,2,a,edge,4\n"
JSON = json.dumps(
    {
        "format": "recording/1",
        "reading": {"unit": "LEGO", "min": 0, "max": 100, "step": 1},
        "patterns": {
            "white": {"kind": "uniform", "albedo": 1},
            "edge": {"kind": "quadrant", "corner_mm": [0, 0], "direction": [1, -1]},
        },
    }
).encode()
cells = st.sampled_from(["", "nan", "inf", "-1e308", "1e999", "0x1", "a", '"', "1", "\x00", "é", "white", ","])
values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers(-(10**400), 10**400) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=4,
)


def answered(folder, csv, description):
    (folder / "rec.csv").write_bytes(csv)
    (folder / "rec.json").write_bytes(description)
    with contextlib.suppress(FileError):
        read_recording(folder / "rec.csv")


def replaced(content, at, new):
    at %= len(content)
    return content[:at] + new + content[at + 1 :]


@settings(max_examples=60, deadline=None)
@given(at=st.integers(0, 500), new=st.binary(max_size=3), which=st.booleans())
def test_a_changed_byte_anywhere_is_survived(at, new, which, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    answered(folder, replaced(CSV, at, new) if which else CSV, JSON if which else replaced(JSON, at, new))


@settings(max_examples=40, deadline=None)
@given(rows=st.lists(st.lists(cells, min_size=6, max_size=6), max_size=3))
def test_any_cells_are_survived(rows, tmp_path_factory):
    answered(tmp_path_factory.getbasetemp(), CSV + "\n".join(",".join(r) for r in rows).encode(), JSON)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(value=values, where=st.integers(0, 8))
def test_any_value_in_any_field_is_survived(value, where, tmp_path_factory):
    content = json.loads(JSON)
    holders = (
        [content] * 3 + [content["reading"]] * 3 + [content["patterns"]["white"]] + [content["patterns"]["edge"]] * 2
    )
    keys = ["format", "reading", "patterns", "unit", "min", "step", "albedo", "corner_mm", "direction"]
    holders[where][keys[where]] = value
    answered(tmp_path_factory.getbasetemp(), CSV, json.dumps(content).encode())
