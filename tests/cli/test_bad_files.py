"""Files made to break a reader: exit status 2, one short line, nothing written, and soon."""

import numpy as np
import pytest
from command import refused

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


def after(first):
    """Some texts as a file of lines holds them, by themselves and after its first line."""
    return {f"{name}{' after a line' * bool(a)}": a + TEXTS[name] + b"\n" for a in (b"", first) for name in SOME_TEXTS}


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


JOURNAL, CAMPAIGN = b'{"format": "journal/1"}\n', b'{"format": "campaign/1", "settings": {}}\n'
SHIPPED = shipped_geometry_path().read_text().encode()
X_MM = SHIPPED.index(b"= ", SHIPPED.index(b"\nx_mm")) + 2
NUMBERS = {"a huge number": b"9" * 400, "deep lists": b"[" * 100_000, "a huge text": b'"' + b"a" * 100_000 + b'"'}
GEOMETRIES = {name: SHIPPED[:X_MM] + n + SHIPPED[SHIPPED.index(b"\n", X_MM) :] for name, n in NUMBERS.items()}
READERS = {  # by command its file, and what that may hold
    "predict bad.json small.csv --out p.csv": ("bad.json", TEXTS),
    "diagnose bad.jsonl --sensor sensor.json --out out": ("bad.jsonl", after(JOURNAL)),
    "challenge --out .": ("cases.jsonl", after(CAMPAIGN)),
    "study --out .": ("trials.jsonl", after(CAMPAIGN)),
    "arm check --geometry bad.toml": ("bad.toml", TEXTS | GEOMETRIES),
    "emulate-nxt --geometry bad.toml": ("bad.toml", TEXTS | GEOMETRIES),
    "diagnose small.csv --out out --quiet": ("small.csv", TABLES),
}


@pytest.mark.parametrize(("command", "what"), [(words, what) for words, (_, own) in READERS.items() for what in own])
def test_what_cannot_be_read_is_refused(command, what, recording_file, sensor_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    name, contents = READERS[command]
    (tmp_path / name).write_bytes(contents[what])
    assert name in refused(capsys, tmp_path, *command.split())


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
