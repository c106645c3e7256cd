"""`explore` killed at any moment: with --resume it ends with what one never killed would have."""

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest
from command import content_of

from probewise.cli import main


def command(sensor_file, out, *more):
    where = ("--sensor", sensor_file, "--truth", "500,250,90", "--out", out, "--seed", 3, "--quiet")
    return [str(word) for word in ("explore", *where, "--max-readings", 4, *more)]


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
        assert content_of(out) == content_of(tmp_path / "whole") or cut == cuts[-1]  # which notes the torn line


@pytest.mark.slow
def test_a_second_run_on_the_same_journal_is_refused_and_the_first_goes_on(
    sensor_file, tmp_path, quick_frames, monkeypatch, capsys
):
    from probewise.report import exploration

    out, drawn, second = tmp_path / "out", exploration.robot_view_png, []

    def begin_another(*_, **__):
        if not second:
            second.append(None)
            second[:] = [main(command(sensor_file, out, "--resume")), capsys.readouterr().err]
        return drawn()

    monkeypatch.setattr(exploration, "robot_view_png", begin_another)
    assert main(command(sensor_file, out, "--max-readings", 1)) == 0
    status, said = second
    assert status == 2
    assert said.count("\n") == 1
    assert "journal.jsonl: another process is writing to it" in said
    assert [json.loads(line).get("index", 0) for line in (out / "journal.jsonl").read_text().splitlines()] == [0, 1]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
def test_kill_9_at_random_moments_changes_nothing_of_the_outcome(sensor_file, tmp_path):
    """As processes, with all pictures; killed twice in all, and no run more often than that."""
    began_s = time.monotonic()
    run = [sys.executable, "-m", "probewise"]
    subprocess.run([*run, *command(sensor_file, tmp_path / "whole")], check=True)
    whole_s, whole = time.monotonic() - began_s, content_of(tmp_path / "whole")
    chance = random.Random(int(os.environ.get("PROBEWISE_KILL_SEED", "1")))
    n_killed = 0
    for k in range(9):  # a machine that has become faster ends more runs before they are killed
        out = tmp_path / str(k)
        status = None
        while status != 0:
            more = ["--resume"] if (out / "journal.jsonl").exists() else []
            process = subprocess.Popen([*run, *command(sensor_file, out, *more)])
            killer = threading.Timer(chance.uniform(0.1, 0.9) * whole_s, process.kill)
            if n_killed < 2:
                killer.start()
            status = process.wait()
            killer.cancel()
            assert status in (0, -signal.SIGKILL)
            n_killed += status != 0
        found = content_of(out)
        notes = {"report.html"} if b"torn" in found["report.html"] else set()
        assert {n: c for n, c in found.items() if n not in notes} == {n: c for n, c in whole.items() if n not in notes}
        if n_killed == 2:
            break
    assert n_killed == 2
