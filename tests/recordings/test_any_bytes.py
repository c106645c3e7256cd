"""Whatever bytes stand in the files, the answer is a recording or a FileError."""

import contextlib
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probewise.errors import FileError
from probewise.recordings import read_recording

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
