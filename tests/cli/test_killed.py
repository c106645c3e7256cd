"""`explore` killed at any moment: what the same command with --resume ends with is what one never killed would have."""

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest

from probewise.cli import main


def command(sensor_file, out, *more):
    where = (
        "--sensor",
        sensor_file,
        "--truth",
        "500,250,90",
        "--out",
        out,
        "--seed",
        3,
        "--quiet",
        "--max-readings",
        4,
    )
    return [str(word) for word in ("explore", *where, *more)]


def contents(out):
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in out.rglob("*") if p.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 3])
def test_a_resumed_run_is_byte_for_byte_the_one_that_was_never_interrupted(
    batch, sensor_file, tmp_path, quick_frames, monkeypatch
):
    """Stopped before each reading, and between a reading and what was inferred from it; all in one sitting."""
    more = ("--batch", batch)
    assert main(command(sensor_file, tmp_path / "whole", *more)) == 0
    whole = (tmp_path / "whole" / "journal.jsonl").read_bytes()
    lines = whole.splitlines(keepends=True)
    n_kept = [1, 2, 4] if batch == 1 else [2]
    cuts = [sum(map(len, lines[:k])) for k in n_kept] + [whole.index(b', "belief"', sum(map(len, lines[:2])))]
    for cut in cuts:
        out = tmp_path / f"cut at {cut}"
        out.mkdir()
        (out / "journal.jsonl").write_bytes(whole[:cut])
        assert main(command(sensor_file, out, *more, "--resume")) == 0
        assert (out / "journal.jsonl").read_bytes() == whole, cut
        assert contents(out) == contents(tmp_path / "whole") or cut == cuts[-1]  # which notes the torn line


@pytest.mark.slow
def test_a_second_run_on_the_same_journal_is_refused_and_the_first_goes_on(
    sensor_file, tmp_path, quick_frames, monkeypatch, capsys
):
    from probewise.report import exploration

    out, drawn, second = tmp_path / "out", exploration.frame, []

    def begin_another(*_, **__):
        if not second:
            second.append(None)
            second[:] = [main(command(sensor_file, out, "--resume")), capsys.readouterr().err]
        return drawn()

    monkeypatch.setattr(exploration, "frame", begin_another)
    assert main(command(sensor_file, out, "--max-readings", 1)) == 0
    status, said = second
    assert status == 2
    assert said.count("\n") == 1
    assert f"journal.jsonl: process {os.getpid()} is writing to it" in said
    assert [json.loads(line).get("index", 0) for line in (out / "journal.jsonl").read_text().splitlines()] == [0, 1]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
def test_kill_9_at_random_moments_changes_nothing_of_the_outcome(sensor_file, tmp_path):
    """As processes, with all pictures; each is killed up to four times before it may end."""
    began_s = time.monotonic()
    run = [sys.executable, "-m", "probewise"]
    subprocess.run([*run, *command(sensor_file, tmp_path / "whole")], check=True)
    whole_s, whole = time.monotonic() - began_s, contents(tmp_path / "whole")
    chance = random.Random(int(os.environ.get("PROBEWISE_KILL_SEED", "1")))
    n_killed = 0
    for k in range(9):
        if k >= 3 and n_killed >= 3:  # a machine that has become faster ends more runs before they are killed
            break
        out = tmp_path / str(k)
        for session in range(5):
            more = ["--resume"] if (out / "journal.jsonl").exists() else []
            process = subprocess.Popen([*run, *command(sensor_file, out, *more)])
            if session < 4:
                killer = threading.Timer(chance.uniform(0.2, 1.1) * whole_s, process.kill)
                killer.start()
            status = process.wait()
            killer.cancel()
            if status == 0:
                break
            assert status == -signal.SIGKILL
            n_killed += 1
        assert status == 0
        found = contents(out)
        notes = {"report.html"} if b"torn" in found["report.html"] else set()
        assert {n: c for n, c in found.items() if n not in notes} == {n: c for n, c in whole.items() if n not in notes}
    assert n_killed >= 3
