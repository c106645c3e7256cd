"""What a command says while it works: a bar on a terminal, a line now and then elsewhere, nothing where it is quiet."""

import io
import time
from types import SimpleNamespace

import numpy as np
import pytest

import probewise
from probewise import _progress
from probewise._progress import progress_shown
from probewise.cli._bench import prompter_for_answer
from probewise.progress import silent


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def hurried(monkeypatch):
    """Let two seconds pass in a hundredth of one."""
    for name in ("_PATIENCE_S", "_BETWEEN_LINES_S", "_BEAT_S"):
        monkeypatch.setattr(_progress, name, 0.01)


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on when it is told to, and lines on standard error."""
    now_s = [100.0]
    monkeypatch.setattr(_progress.time, "monotonic", lambda: now_s[0])
    return now_s


def test_a_question_is_not_overwritten_by_the_bar(hurried, monkeypatch):
    """Nothing follows it on its line until it is answered."""
    terminal, slow = Terminal(), Terminal("\n")
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr(slow, "readline", lambda: (time.sleep(0.2), "\n")[1])
    monkeypatch.setattr("sys.stdin", slow)
    arm = SimpleNamespace(keep_awake=lambda: None)
    with progress_shown(quiet=False) as progress:
        progress("exploring")
        time.sleep(0.1)
        prompter_for_answer(arm)("Is it there? ")
        before, after = terminal.getvalue().split("Is it there? ")
        assert "exploring" in before
        assert "exploring" not in after.split("\r")[0]
        assert after.count("exploring") <= 1


def test_lines_begin_after_two_seconds_and_come_every_five(clock, capsys):
    lines = _progress._TextProgress()
    for _ in range(13):
        lines("refitting effects", int(clock[0]) - 100, 20)
        clock[0] += 1.0
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "refitting effects, 2 of 20 (2 s)",
        "refitting effects, 7 of 20 (7 s)",
        "refitting effects, 12 of 20 (12 s)",
    ]


def test_a_terminal_shows_the_stage_its_share_and_the_clock(hurried, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(_progress.sys, "stderr", terminal)
    with progress_shown(quiet=False) as progress:
        progress("refitting effects", 3, 12)
        time.sleep(0.1)
        progress("drawing the figures", note="slowly")
        time.sleep(0.1)
    shown = terminal.getvalue()
    assert "refitting effects:  25%|" in shown
    assert "3 of 12 [00:00, 00:00 left]" in shown
    assert "refitting effects: 100%" in shown
    assert "drawing the figures [00:00], slowly" in shown


def test_a_program_without_a_console_shows_nothing(monkeypatch):
    monkeypatch.setattr("sys.stderr", None)
    with progress_shown(quiet=False) as progress:
        assert progress is silent


def test_a_run_that_is_resumed_tells_how_far_it_is_through_its_journal(sensor_file, tmp_path):
    sensor, journal, told = probewise.read_sensor(sensor_file), tmp_path / "journal.jsonl", []

    def tell(stage, done=0, total=0, note=""):
        told.append((stage, done, total))

    for n in (1, 2):
        rng = np.random.default_rng(5)
        probewise.explore(sensor, max_readings=n, rng=rng, journal=journal, progress=tell)
    assert told[:2] == [("taking the first readings", 0, 0), ("reading 1 of at most 1", 0, 0)]
    through = "going through the journal"
    assert told[2:] == [(through, 0, 1), (through, 1, 1), ("reading 2 of at most 2", 0, 0)]
