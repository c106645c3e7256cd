"""`probewise diagnose --each`: a folder and a row for each recording, whatever one of them holds."""

import csv
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from probewise.cli import main
from probewise.cli._executor import worker_pool
from probewise.errors import NotConvergedError
from probewise.report import each

LINE = (
    "reading, unit = 'y', 'V'\nparameters = {'slope': (-5, 5), 'offset': (-5, 5)}\nvectorized = True\n"
    "def simulate(p, data):\n    return p['slope'] * data['x'] + p['offset']\n"
)


@pytest.fixture
def words(tmp_path):
    """What `diagnose` is given beside its recordings: a straight line, and a folder for each."""
    (tmp_path / "line.py").write_text(LINE)
    return "--simulator", str(tmp_path / "line.py"), "--each", "--out", str(tmp_path / "out"), "--quiet"


def write_line(path, *, jump=0.0):
    x = np.linspace(0.0, 1.0, 40)
    y = 2 * x + 1 + 0.1 * np.random.default_rng(1).standard_normal(40) + jump * (x > 0.55)
    np.savetxt(path, np.c_[x, y], delimiter=",", header="x,y", comments="", fmt="%.4f")
    return str(path)


def test_each_recording_has_a_row_and_a_folder_and_is_diagnosed_once(words, tmp_path, monkeypatch):
    out = tmp_path / "out"
    (tmp_path / "1.10.csv").write_text("x,z\n1,2\n")
    files = [write_line(tmp_path / "a.csv"), write_line(tmp_path / "b.csv", jump=0.8), str(tmp_path / "1.10.csv")]
    given = ["diagnose", *files, *words]
    assert main(given) == 0
    with (out / "table.csv").open() as file:
        rows = {row["device"]: row for row in csv.DictReader(file)}
    assert {name: row["verdict"] for name, row in rows.items()} == {"b": "cannot_tell", "a": "clean", "1.10": "refused"}
    assert "y" in rows["1.10"]["says"]
    assert (out / "b" / "repaired.json").exists()
    assert not (out / "1.10").exists()
    page = (out / "report.html").read_text()
    assert page.index("b/report.html") < page.index("a/report.html")
    monkeypatch.setattr("probewise.cli.diagnose._diagnosed", lambda words: pytest.fail("diagnosed again"))
    again = [*given[:3], *given[4:]]  # without the one that was refused
    assert main(again) == 0
    monkeypatch.setattr("probewise.cli.diagnose._diagnosed", lambda words: ("again", {}))
    for damaged in ("{", "[]", "{}"):
        (out / "a" / "diagnosis.json").write_text(damaged)
        assert main(again) == 0
        assert "a,refused,,,,,again" in (out / "table.csv").read_text().splitlines()


def test_a_folder_that_cannot_be_written_to_is_told_with_what_is_kept(words, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("probewise.cli.diagnose._diagnosed", lambda words: ("", {"diagnosis.json": b"{}"}))
    files = [write_line(tmp_path / "a.csv"), write_line(tmp_path / "b.csv")]
    (tmp_path / "out" / "b" / "diagnosis.json").mkdir(parents=True)
    assert main(["diagnose", *files, *words]) == 2
    assert "in the way; allowed: another folder, or none there; " in (said := capsys.readouterr().err)
    assert "go on with: probewise diagnose" in said


def test_rows_are_sorted_by_what_ails_most_devices():
    rows = [
        each.DeviceRow("clean one", "clean"),
        each.DeviceRow("lagging", "named", "lag", 9.0, 0.9, 0.001, "it lags"),
        each.DeviceRow("worse", "named", "drag:v", 20.0),
        each.DeviceRow("bad", "named", "drag:v", 12.0),
    ]
    assert [row.device for row in each.in_order(rows)] == ["worse", "bad", "lagging", "clean one"]
    assert each.columns_of(rows)["probability"] == ["", "", "0.9", ""]


def test_names_that_cannot_name_a_folder_and_one_with_other_results_are_refused(words, tmp_path, capsys):
    out = tmp_path / "out"
    (out / "b").mkdir(parents=True)
    (out / "b" / "fit.json").touch()
    for name, said in (("...csv", "another name"), ("..csv", "another name"), ("b.csv", "holds a fit")):
        assert main(["diagnose", write_line(tmp_path / name), *words]) == 2
        assert said in capsys.readouterr().err
    (tmp_path / "elsewhere").mkdir()
    (out / "c").symlink_to(tmp_path / "elsewhere")
    assert main(["diagnose", write_line(tmp_path / "c.csv"), *words]) == 2
    assert "c: is a symbolic link, which may lead out of the folder" in capsys.readouterr().err
    assert not any((tmp_path / "elsewhere").iterdir())
    here = {path.name for path in tmp_path.iterdir()}
    assert here == {"out", "elsewhere", "line.py", "b.csv", "c.csv", "..csv", "...csv"}


def test_a_process_that_dies_is_said_in_words():
    """As one that the system ends for want of memory."""
    with pytest.raises(NotConvergedError, match="a worker process has died"), worker_pool(1) as pool:
        pool.submit(os._exit, 1).result()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_the_processes_of_a_killed_command_end_with_it_and_leave_no_file(number, tmp_path):
    """They hold its standard output, which would stay open."""
    use = "import os, tempfile\nfrom probewise.cli._executor import worker_pool\nwith worker_pool(2) as pool:\n"
    killed = f"{use}    pool.submit(tempfile.mkdtemp).result()\n    os.kill(os.getpid(), {number:d})"
    ended = subprocess.run(
        [sys.executable, "-c", killed], env={**os.environ, "TMPDIR": str(tmp_path)}, capture_output=True, timeout=60
    )
    assert ended.returncode == -number
    assert not any(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes with names")
def test_a_recording_that_is_a_pipe_is_waited_for_with_a_word(words, tmp_path, capsys):
    os.mkfifo(tmp_path / "a.csv")
    threading.Thread(target=lambda: (tmp_path / "a.csv").write_text("no table"), daemon=True).start()
    assert main(["diagnose", str(tmp_path / "a.csv"), *words]) == 0
    assert "a.csv is a pipe: reading it waits" in capsys.readouterr().err


def test_a_package_that_is_missing_is_named_and_not_the_address(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["study", "--out", str(tmp_path / "out"), "--scheduler", "localhost:8786", "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "--scheduler needs the package distributed, which is not installed" in said
    assert "pip install distributed" in said
    assert said.count("\n") == 1
