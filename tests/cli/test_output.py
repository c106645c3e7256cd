"""Results are written whole or not at all, and nothing that was read is lost for them."""

import contextlib
import hashlib
import io
import itertools
import json
import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from probewise._writing import Drawings, Output, staged_output
from probewise.calibration import read_sensor, write_sensor
from probewise.cli import main
from probewise.cli._common import OutputError, print_result
from probewise.errors import FileError
from probewise.recordings import read_recording, write_recording


def write(out, files, main="", **options):
    with staged_output(out, main, **options) as stage:
        for name, text in files.items():
            stage.write(name, text)
    return stage


def test_what_an_earlier_run_wrote_goes_and_what_a_person_changed_or_put_there_stays(tmp_path):
    earlier = ("witness_time.svg", "witness_level.svg", "changed.svg", "frames/007.png", "taken.csv", "taken.json")
    write(tmp_path, dict.fromkeys(earlier, "old"))
    for name in ("notes.txt", "007.png", "changed.svg", "taken.csv"):
        (tmp_path / name).write_text("mine")
    assert write(tmp_path, {"witness_level.svg": "new"}).replaces
    (tmp_path / "frames").rmdir()
    mine = dict.fromkeys(("notes.txt", "007.png", "changed.svg", "taken.csv"), "mine")
    assert contents(tmp_path) == {"witness_level.svg": "new", "taken.json": "old", **mine}
    assert not write(tmp_path, {"more.svg": "new", "notes.txt": "mine"}, adds=True).replaces
    assert contents(tmp_path) == {"witness_level.svg": "new", "more.svg": "new", "taken.json": "old", **mine}
    assert write(tmp_path, {}).kept == {}
    assert contents(tmp_path).keys() == {"taken.json", *mine} - {"notes.txt"}  # which the run wrote as it was


def test_results_of_another_verb_stay_or_get_other_names(tmp_path):
    """As those of a calibration, where a search with its sensor.json writes too."""
    sensor = tmp_path / "sensor.json"
    write(tmp_path, {"sensor.json": "1", "ssf.png": "1", "report.html": "1"}, "sensor.json")
    for k in "23":
        write(tmp_path, {}, "result.json", inputs=(sensor,))
        write(
            tmp_path, {"sensor.json": k, "result.json": k, "report.html": k}, "result.json", inputs=(sensor,), adds=True
        )
    names = {"ssf.png": "1", "sensor_kept.json": "1", "sensor_kept_2.json": "2", "report_kept.html": "1"}
    assert contents(tmp_path) == {**names, **dict.fromkeys(("sensor.json", "result.json", "report.html"), "3")}


def test_a_persons_files_get_other_names_or_stay_in_a_folder_without_a_list(tmp_path):
    """As one that an earlier version wrote, which nobody can tell from a person's."""
    names = ("a.svg", "b.csv", "b.json", "witness_time.svg", "report.html", ".writing", ".complete", ".a.svg.part")
    for name in names:
        (tmp_path / name).write_text(f"mine {name}")
    results = {"b.csv": "new", "b.json": "mine b.json"}
    made = Output(
        lambda stage: [stage.write(*each) for each in results.items()], {"a.svg": lambda: b"new"}, lambda _: "new"
    )
    for _ in range(2):
        drawings = Drawings(tmp_path)
        drawings.write_results(made)
        found = contents(tmp_path)
        assert {found.pop(name) for name in ("a.svg", "b.csv", "report.html")} == {"new"}
        assert found.pop("b.json") == found["b_kept.json"]  # a table has its description with it
        assert sorted(found.values()) == sorted(f"mine {name}" for name in names)
    assert drawings.notes == ["note: the results of an earlier run there were replaced"]


LISTS = {
    "outside": {
        "../victim": "{digest}",
        "/victim": "{digest}",
        "{outside}": "{digest}",
        "sub/../../victim": "{digest}",
    },
    "behind a link": {"link": "{digest}", "linked/victim": "{digest}"},
    "no file": {"folder": "", "": "{digest}", ".": "", "..": "", "none": None, "a\0b": "{digest}"},
    "wrong types": {"mine.txt": 1, "a.txt": math.nan, "b.txt": ["{digest}"], "c.txt": {"{digest}": "{digest}"}},
    "no names": "{digest}",
    "a list": ["mine.txt"],
    "no UTF-8": {"\ud800": "{digest}", "x" * 5000: "{digest}"},
}


@pytest.mark.parametrize("listed", [*LISTS.values(), "damaged", "deep", "link", "pipe"], ids=[*LISTS, *"1234"])
def test_a_hostile_list_removes_nothing_and_stops_nothing(listed, tmp_path):
    out, file = tmp_path / "out", tmp_path / "out" / ".probewise-written"
    (out / "folder").mkdir(parents=True)
    for name in ("victim", "out/mine.txt"):
        (tmp_path / name).write_text("mine")
    (out / "link").symlink_to(tmp_path / "victim")
    (out / "linked").symlink_to(tmp_path)
    digest = hashlib.sha256(b"mine").hexdigest()
    match listed:
        case "damaged":
            file.write_bytes(b'{"mine.txt": "\xff')
        case "deep":
            file.write_text("[" * 100_000)
        case "link":
            (tmp_path / "list").write_text(json.dumps({"mine.txt": digest}))
            file.symlink_to(tmp_path / "list")
        case "pipe":
            os.mkfifo(file)
        case _:
            text = json.dumps(listed).replace("{digest}", digest)
            file.write_text(text.replace("{outside}", str(tmp_path / "victim")))
    write(out, {"mine.txt": "new", "link": "new"})
    assert (tmp_path / "victim").read_text() == (out / "mine_kept.txt").read_text() == "mine"
    assert (out / "link_kept").readlink() == tmp_path / "victim"
    assert {path.name for path in out.iterdir() if path.name[0] != "."} == {
        *("folder", "link", "link_kept", "linked", "mine.txt", "mine_kept.txt")
    }
    write(out, {})
    assert not (out / "mine.txt").exists()
    assert (out / "mine_kept.txt").exists()


def test_an_input_that_would_be_replaced_is_set_aside_with_its_description(tmp_path):
    csv, json = tmp_path / "plan.csv", tmp_path / "plan.json"
    for round_ in ("first", "second"):
        csv.write_text(round_)
        json.write_text(round_)
        write(tmp_path, {"plan.csv": "new", "plan.json": "new"}, inputs=(csv, json))
        assert csv.read_text() == json.read_text() == "new"
    kept = {p.name: p.read_text() for p in tmp_path.glob("plan_kept*")}
    assert kept == {
        "plan_kept.csv": "first",
        "plan_kept.json": "first",
        "plan_kept_2.csv": "second",
        "plan_kept_2.json": "second",
    }


def test_a_search_does_not_replace_the_sensor_that_it_was_given(sensor_file, tmp_path, quick_frames, capsys):
    sensor_file.write_text(sensor_file.read_text() + "\n")  # which the search would not write
    before = sensor_file.read_bytes()
    words = ("--sensor", sensor_file, "--truth", "500,250,90", "--trust", 1, "--max-readings", 1, "--out", tmp_path)
    assert main([str(word) for word in ("explore", *words)]) == 0
    assert (tmp_path / "sensor_kept.json").read_bytes() == before
    assert "sensor_kept.json" in capsys.readouterr().out


@pytest.mark.slow
def test_readings_filled_in_where_the_plan_stood_are_not_lost(recording_file, tmp_path, capsys):
    """Whoever fills in next_plan.csv in place and diagnoses again, with it or without it, still has it."""
    out = tmp_path / "out"
    assert main(["diagnose", str(recording_file), "--out", str(out), "--quiet"]) == 0
    recording = read_recording(recording_file)
    few = type(recording)(recording.plan.take(np.arange(30)), recording.readings[:30] + 0.01)
    write_recording(few, out / "next_plan.csv")
    taken = (out / "next_plan.csv").read_bytes()
    assert main(["diagnose", str(recording_file), "--out", str(out)]) == 0
    kept = out / "next_plan_kept.csv"
    assert (kept if kept.exists() else out / "next_plan.csv").read_bytes() == taken
    sensor = read_sensor(out / "sensor.json")
    write_sensor(sensor, out / "sensor.json")
    before = (out / "sensor.json").read_bytes()
    assert main(["diagnose", str(recording_file), "--sensor", str(out / "sensor.json"), "--out", str(out)]) == 0
    assert (out / "sensor_kept.json").read_bytes() == before
    assert "sensor_kept.json" in capsys.readouterr().out


NEW = {"a.txt": "new", "plan.csv": "new", "plan.json": "new", "sub/c.txt": "new", "same.txt": "same"}
OLD = {"same.txt": "same", "a.txt": "old", "plan.csv": "read", "plan.json": "old", "witness_1.svg": "old"}
DONE = {**NEW, "plan_kept.csv": "read", "plan_kept.json": "old"}


def contents(folder):
    """Return what files hold, by name, but for the lock file and the list of results."""
    files = [
        p for p in folder.rglob("*") if p.is_file() and not p.name.startswith((".results.lock", ".probewise-written"))
    ]
    return {p.relative_to(folder).as_posix(): p.read_text() for p in files}


def write_new(out):
    write(out, NEW, inputs=(out / "plan.csv",))


def write_abc(out):
    write(out, dict.fromkeys("abc", "new"))


def killed_at(n, write, out):
    """Run in a process that is killed before it moves, removes or makes its n-th file; tell whether it was."""
    pid = os.fork()
    if pid == 0:
        calls = itertools.count()

        def dying(do):
            return lambda *a, **k: os.kill(os.getpid(), signal.SIGKILL) if next(calls) == n else do(*a, **k)

        for name in ("replace", "rename", "unlink", "mkdir", "rmdir"):
            setattr(os, name, dying(getattr(os, name)))
        write(out)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) != 0


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")
def test_wherever_a_command_is_killed_the_next_one_finds_all_of_its_files_or_none(tmp_path):
    """Killed before each step on the disk; then a command that fails begins, which settles what it finds."""
    settled = []
    for n in itertools.count():
        out = tmp_path / str(n)
        write(out, OLD)
        if not killed_at(n, write_new, out):
            break
        with pytest.raises(ZeroDivisionError), staged_output(out):
            raise ZeroDivisionError
        assert contents(out) in (OLD, DONE), n
        settled.append(contents(out) == DONE)
    assert contents(out) == DONE
    assert settled == sorted(settled)  # none before the list is complete, all from then on
    assert 5 <= sum(settled) < len(settled)


def test_a_file_that_cannot_be_replaced_is_put_in_place_by_the_next_command(tmp_path, monkeypatch):
    real = os.replace

    def held(source, target):
        if Path(target) == tmp_path / "b":
            raise PermissionError(13, "Permission denied", str(source), None, str(target))
        real(source, target)

    monkeypatch.setattr(os, "replace", held)
    with pytest.raises(FileError, match=r"b: cannot be replaced \(Permission denied\).*next results"):
        write_abc(tmp_path)
    assert (tmp_path / "a").exists()
    monkeypatch.undo()
    write(tmp_path, {}, adds=True)
    assert contents(tmp_path) == dict.fromkeys("abc", "new")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device")
def test_a_full_standard_output_is_told_with_what_it_was_to_print(
    sensor_file, recording_file, tmp_path, monkeypatch, capsys
):
    with open("/dev/full", "w") as full, contextlib.suppress(OSError):
        monkeypatch.setattr("sys.stdout", full)
        out = tmp_path / "p.csv"
        assert main(["predict", str(sensor_file), str(recording_file), "--out", str(out)]) == 2
        said = capsys.readouterr().err
        assert "standard output takes no more (No space left on device); it was to print '" in said
        assert said.endswith(f"what was written is kept: {out}\n")


def test_a_standard_output_that_a_file_closed_is_told(monkeypatch):
    closed = io.StringIO()
    closed.close()
    for stream in (closed, None):
        monkeypatch.setattr("sys.stdout", stream)
        with pytest.raises(OutputError, match=r"takes no more \(it is closed\); it was to print 'kept'"):
            print_result("kept")


def test_a_signal_while_files_are_put_in_place_is_heard_when_all_are(tmp_path, monkeypatch):
    real = os.replace

    def signalled(source, target):
        real(source, target)
        if Path(target) == tmp_path / "a":
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(os, "replace", signalled)
    before = signal.signal(signal.SIGINT, stop)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_abc(tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert contents(tmp_path) == dict.fromkeys("abc", "new")


def stop(number, frame):
    raise KeyboardInterrupt
