"""Files made to break a reader: exit status 2, one short line, nothing written, and soon."""

from functools import partial

import command
import numpy as np
import pytest

from probewise.arm import shipped_geometry_path
from probewise.cli import main
from probewise.recordings import paper_plan, write_plan

TEXTS = {
    "an integer of 5000 digits": b'{"format": ' + b"9" * 5000 + b"}",
    "a number beyond floats": b'{"format": 1e999}',
    "lists a million deep": b"[" * 1_000_000,
    "NaN": b'{"format": NaN}',
    "a long name twice": b'{"' + b"k" * 100_000 + b'": 1, "' + b"k" * 100_000 + b'": 2}',
    "an escape sequence": b'{"format": "\x1b[31m"}',
    "random bytes": np.random.default_rng(0).bytes(4000),
    "a list": b"[1]",
    "nothing": b"",
}
SOME_TEXTS = ("an integer of 5000 digits", "lists a million deep", "NaN", "random bytes", "a list", "nothing")
TABLES = {
    "200,000 cells in one line": b",".join([b"a"] * 200_000),
    "ten thousand columns": b",".join(b"c%d" % k for k in range(10_000)) + b"\n" + b",".join([b"1"] * 10_000),
    "a name to obey twice": b"\x1b[31m,\x1b[31m,x_mm,y_mm,reading\n",
    "nothing": b"",
    "CR line ends, a bad cell": b"x_mm,y_mm,reading\r1,2,abc\r",
    "a quote that never closes": b'x_mm,y_mm,reading\n1,2,"3\n' + b"1,2,3\n" * 30_000,
    "a cell of NUL": b"x_mm,y_mm,reading\n1,2,\0\n",
    "a number of 100,000 digits": b"x_mm,y_mm,reading\n1,2," + b"9" * 100_000 + b"\n",
    "random bytes": np.random.default_rng(1).bytes(4000),
}


@pytest.fixture
def refused(tmp_path, capsys):
    return partial(command.refused, capsys, tmp_path)


@pytest.mark.parametrize("what", TEXTS)
def test_a_sensor_that_is_no_sensor_is_refused(what, refused, recording_file, tmp_path):
    (tmp_path / "bad.json").write_bytes(TEXTS[what])
    said = refused("predict", tmp_path / "bad.json", recording_file, "--out", tmp_path / "p.csv")
    assert "bad.json" in said


@pytest.mark.parametrize("what", SOME_TEXTS)
@pytest.mark.parametrize("first", [b"", b'{"format": "journal/1"}\n'])
def test_a_journal_that_is_none_is_refused(what, first, refused, sensor_file, tmp_path):
    (tmp_path / "bad.jsonl").write_bytes(first + TEXTS[what] + b"\n")
    said = refused("diagnose", tmp_path / "bad.jsonl", "--sensor", sensor_file, "--out", tmp_path / "out")
    assert "bad.jsonl" in said


@pytest.mark.parametrize("what", SOME_TEXTS)
@pytest.mark.parametrize("first", [b"", b'{"format": "campaign/1", "settings": {}}\n'])
@pytest.mark.parametrize(("verb", "name"), [("challenge", "cases.jsonl"), ("study", "trials.jsonl")])
def test_a_campaign_that_is_none_is_refused(verb, name, first, what, refused, tmp_path):
    (tmp_path / name).write_bytes(first + TEXTS[what] + b"\n")
    assert name in refused(verb, "--out", tmp_path)


@pytest.mark.parametrize("what", [*TEXTS, "a huge number", "deep lists", "a huge text"])
def test_a_geometry_that_is_none_is_refused(what, refused, tmp_path):
    shipped = shipped_geometry_path().read_text().encode()
    instead = {"a huge number": b"9" * 400, "deep lists": b"[" * 100_000, "a huge text": b'"' + b"a" * 100_000 + b'"'}
    at = shipped.index(b"= ", shipped.index(b"\nx_mm")) + 2
    harmed = shipped[:at] + instead[what] + shipped[shipped.index(b"\n", at) :] if what in instead else TEXTS[what]
    (tmp_path / "bad.toml").write_bytes(harmed)
    assert "bad.toml" in refused("arm", "check", "--geometry", tmp_path / "bad.toml")
    assert "bad.toml" in refused("emulate-nxt", "--geometry", tmp_path / "bad.toml")


@pytest.mark.parametrize("what", TABLES)
def test_a_table_that_is_none_is_refused(what, refused, recording_file, tmp_path):
    recording_file.write_bytes(TABLES[what])
    assert "small.csv" in refused("diagnose", recording_file, "--out", tmp_path / "out", "--quiet")


def test_a_byte_order_mark_is_taken_wherever_text_is_read(sensor_file, tmp_path, capsys):
    plan = paper_plan()
    write_plan(plan.take(np.arange(4)), tmp_path / "plan.csv")
    geometry = tmp_path / "arm.toml"
    geometry.write_bytes(shipped_geometry_path().read_bytes())
    for path in (sensor_file, tmp_path / "plan.csv", tmp_path / "plan.json", geometry):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert main(["predict", str(sensor_file), str(tmp_path / "plan.csv"), "--out", str(tmp_path / "p.csv")]) == 0
    assert main(["arm", "jog", "base", "1", "--dry-run", "--geometry", str(geometry)]) == 0
    assert capsys.readouterr().err == ""
