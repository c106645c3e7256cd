"""Whichever signal asks for it, or kill -9, a command stops, says what is kept, and goes on as if nothing had been."""

import contextlib
import json
import os
import random
import shlex
import signal
import subprocess
import sys
import threading
import time
import weakref

import numpy as np
import pytest
from command import content_of

from probewise._signals import (
    ENDING,
    SAME_S,
    Stopped,
    defer_signals,
    raise_if_stopped,
    reporting_what_is_kept,
    stoppable,
)
from probewise._writing import staged_output
from probewise.arm import LegoArm, Pose, read_geometry, shipped_geometry_path
from probewise.arm.nxt import Brick, BrickMachine, Link
from probewise.cli import main
from probewise.emulator import VirtualClock, VirtualLine, set_up_bench
from probewise.emulator import read_geometry as read_numbers
from probewise.errors import LinkError
from probewise.recordings import Uniform
from probewise.report import exploration
from probewise.world.shipped import true_world

GEOMETRY = read_geometry(shipped_geometry_path())


@pytest.mark.parametrize("number", ENDING, ids=lambda number: number.name)
def test_a_signal_raises_and_gives_the_status_that_shells_expect(number):
    before = [signal.getsignal(k) for k in ENDING]
    with pytest.raises(Stopped) as stop, stoppable():
        signal.raise_signal(number)
    assert stop.value.status == 128 + number
    assert [signal.getsignal(k) for k in ENDING] == before
    raise_if_stopped()  # answered: it does not interrupt what this process does next


def test_a_signal_in_a_callback_that_ignores_exceptions_stops_the_command_all_the_same(capsys):
    """Python prints what a callback of its garbage collection raises, and goes on."""

    class Kept:
        pass

    kept = [Kept()]
    follower = weakref.ref(kept[0], lambda _: signal.raise_signal(signal.SIGTERM))

    def work():
        kept.clear()
        for _ in range(500):
            time.sleep(0.01)

    with pytest.raises(Stopped), stoppable():
        work()
    assert follower() is None
    assert capsys.readouterr().err == ""


def test_a_signal_that_is_ignored_stays_ignored():
    """As under nohup."""
    before = signal.signal(ENDING[-1], signal.SIG_IGN)
    try:
        with stoppable():
            signal.raise_signal(ENDING[-1])
    finally:
        signal.signal(ENDING[-1], before)


def test_signals_within_a_second_are_one_request_and_a_later_one_forces(monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    with stoppable():
        with pytest.raises(Stopped):
            signal.raise_signal(signal.SIGTERM)
        now_s[0] += 0.9 * SAME_S
        signal.raise_signal(signal.SIGINT)
        now_s[0] += 0.2 * SAME_S
        with pytest.raises(Stopped):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("echo", [ValueError("Invalid affine transformation matrix"), OSError(5, "closed"), KeyError()])
def test_whatever_a_signal_is_turned_into_is_the_stop(echo):
    def turned():
        with stoppable(), reporting_what_is_kept(lambda: "ten are kept"):
            try:
                signal.raise_signal(signal.SIGTERM)
            except Stopped:
                raise echo from None

    with pytest.raises(Stopped, match="ten are kept") as stop:
        turned()
    assert stop.value.status == 128 + signal.SIGTERM


def test_an_error_without_a_signal_stays_what_it_is():
    with pytest.raises(ValueError, match="own"), stoppable(), reporting_what_is_kept(lambda: "kept"):
        raise ValueError("own")
    with pytest.raises(LinkError, match="dead; kept"), stoppable(), reporting_what_is_kept(lambda: "kept"):
        raise LinkError("dead")


@pytest.mark.parametrize("repeated", [False, True])
def test_deferred_lines_are_finished_first_unless_the_signal_is_repeated(repeated, monkeypatch):
    now_s, done = [0.0], []
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])

    def lines():
        with stoppable():
            with defer_signals(), defer_signals():
                signal.raise_signal(signal.SIGTERM)
                done.append("still here")
                if repeated:
                    now_s[0] += 2 * SAME_S
                    signal.raise_signal(signal.SIGTERM)
                done.append("finished")
            done.append("gone on")

    with pytest.raises(Stopped):
        lines()
    assert done == (["still here"] if repeated else ["still here", "finished"])


class Struck(Exception):
    """A signal's exception."""


def strike(number, frame):
    raise Struck


def struck_session(n):
    """Measure once, struck at the n-th telegram; return the emulated brick, and how many telegrams came."""
    clock = VirtualClock()
    bench = set_up_bench(read_numbers(shipped_geometry_path()), true_world("paper"), Uniform(0.5), clock, seed=1)
    send, sent = bench.radio.send, []

    def struck(data):
        send(data)
        sent.append(data)
        if len(sent) == n:
            signal.raise_signal(signal.SIGTERM)

    bench.radio.send = struck
    x_mm, y_mm = GEOMETRY.field_mm[0] / 2, GEOMETRY.field_mm[1] / 2
    standing = float(GEOMETRY.orientation_rad(np.array([[x_mm, y_mm]]))[0])
    brick = Brick(Link(VirtualLine(bench.radio, clock), clock=clock), clock=clock)
    with contextlib.suppress(Struck), LegoArm(BrickMachine(brick, GEOMETRY), GEOMETRY, clock=clock) as arm:
        arm.measure(Pose(x_mm, y_mm, standing))
    bench.radio.brick.advance()
    return bench.radio.brick, len(sent)


@pytest.mark.slow
@pytest.mark.parametrize("step", [31, 4])
def test_wherever_a_signal_strikes_a_measurement_motors_and_led_are_off(step):
    """At every so manyth telegram of a session and the last ten, which end it; the emulator says how it is left."""
    before = signal.signal(signal.SIGTERM, strike)
    try:
        _, total = struck_session(0)
        for n in {*range(1, total, step), *range(total - 10, total + 1)}:
            brick, _ = struck_session(n)
            assert all(output.is_at_rest for output in brick.outputs.ports), n
            assert brick.answer(bytes((0, 7, GEOMETRY.sensor_port)))[6] == 0, n  # its type: none, without LED
    finally:
        signal.signal(signal.SIGTERM, before)
    assert total > 50


def command(sensor_file, out, *more):
    where = ("--sensor", sensor_file, "--truth", "500,250,90", "--out", out, "--seed", 3, "--quiet")
    return [str(word) for word in ("explore", *where, "--max-readings", 1, *more)]


@pytest.mark.slow
def test_ctrl_c_while_the_report_is_written_says_how_to_go_on_and_that_goes_on(
    sensor_file, tmp_path, quick_frames, monkeypatch, capsys
):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(exploration, "page_html", lambda *_, **__: signal.raise_signal(signal.SIGINT))
        assert main(command(sensor_file, out)) == 130
    said = capsys.readouterr().err
    again = command(sensor_file, out, "--resume")
    assert said == (
        f"probewise explore: stopped; {out / 'journal.jsonl'} keeps 1 reading; "
        f"go on with: {shlex.join(['probewise', *again])}\n"
    )
    kept = (out / "journal.jsonl").read_bytes()
    assert not (out / "report.html").exists()
    assert main(again) == 0
    assert (out / "journal.jsonl").read_bytes() == kept
    assert (out / "report.html").exists()


def test_a_drawing_that_swallows_a_signal_stops_the_run_all_the_same(
    sensor_file, tmp_path, quick_frames, monkeypatch, capsys
):
    drawn = exploration.robot_view_png

    def swallowing(*_, **__):
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            return drawn()

    monkeypatch.setattr(exploration, "robot_view_png", swallowing)
    out = tmp_path / "out"
    assert main(command(sensor_file, out)) == 128 + signal.SIGTERM
    assert "keeps 1 reading; go on with" in capsys.readouterr().err
    assert [p.name for p in out.iterdir() if p.name[0] != "."] == ["journal.jsonl"]


@pytest.mark.slow
def test_pictures_of_a_run_whose_journal_is_gone_do_not_mix_with_those_of_the_next(sensor_file, tmp_path, quick_frames):
    out = tmp_path / "out"
    assert main(command(sensor_file, out, "--max-readings", 2)) == 0
    (out / "journal.jsonl").unlink()
    (out / "notes.txt").write_text("mine")
    assert main(command(sensor_file, out)) == 0
    names = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file() and p.name[0] != "."}
    results = {"report.html", "run.gif", "result.json", "samples.csv", "sensor.json"}
    assert names == {"journal.jsonl", "frames/001.png", "notes.txt"} | results


@pytest.mark.parametrize("is_input", [False, True])
def test_results_of_an_earlier_run_do_not_stand_beside_a_new_journal_when_it_is_stopped(
    is_input, sensor_file, tmp_path, quick_frames, monkeypatch
):
    """Its sensor.json stays if it is the input of this run."""
    drawn = exploration.robot_view_png

    def stopped_at_the_second(*_, **__):
        return signal.raise_signal(signal.SIGTERM) if (out / "frames" / "001.png").exists() else drawn()

    monkeypatch.setattr(exploration, "robot_view_png", stopped_at_the_second)
    out = tmp_path / "out"
    with staged_output(out, "result.json") as stage:
        for name in ("result.json", "samples.csv", "report.html", "sensor.json"):
            stage.write(name, sensor_file.read_text())
    (out / "notes.txt").write_text("mine")
    words = command(out / "sensor.json" if is_input else sensor_file, out, "--max-readings", 2)
    assert main(words) == 128 + signal.SIGTERM
    left = {p.name for p in out.iterdir() if p.name[0] != "."}
    assert left == {"journal.jsonl", "frames", "notes.txt"} | ({"sensor.json"} if is_input else set())


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows cannot bound the size of a file")
def test_a_full_disk_names_the_picture_and_the_journal(sensor_file, tmp_path, quick_frames, monkeypatch, capsys):
    import resource

    monkeypatch.setattr("probewise.report.exploration.animated_gif", lambda _: bytes(5_000_000))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000_000, limits[1]))
    out = tmp_path / "out"
    try:
        assert main(command(sensor_file, out)) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    said = capsys.readouterr().err
    assert f"{out / 'run.gif'}: cannot be written (File too large)" in said
    assert f"the results are in {out}, without figures and report" in said
    assert (out / "result.json").exists()
    assert not (out / "report.html").exists()
    assert len([json.loads(line) for line in (out / "journal.jsonl").read_text().splitlines()]) == 2


def four_readings(sensor_file, out, *more):
    return command(sensor_file, out, "--max-readings", 4, *more)


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 3])
def test_a_resumed_run_is_byte_for_byte_the_one_that_was_never_interrupted(
    batch, sensor_file, tmp_path, quick_frames, monkeypatch
):
    """Stopped before each reading, and between a reading and what was inferred from it; all in one sitting."""
    more = ("--batch", batch)
    assert main(four_readings(sensor_file, tmp_path / "whole", *more)) == 0
    whole = (tmp_path / "whole" / "journal.jsonl").read_bytes()
    lines = whole.splitlines(keepends=True)
    n_kept = [1, 2, 4] if batch == 1 else [2]
    cuts = [sum(map(len, lines[:k])) for k in n_kept] + [whole.index(b', "belief"', sum(map(len, lines[:2])))]
    for cut in cuts:
        out = tmp_path / f"cut at {cut}"
        out.mkdir()
        (out / "journal.jsonl").write_bytes(whole[:cut])
        assert main(four_readings(sensor_file, out, *more, "--resume")) == 0
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
            second[:] = [main(four_readings(sensor_file, out, "--resume")), capsys.readouterr().err]
        return drawn()

    monkeypatch.setattr(exploration, "robot_view_png", begin_another)
    assert main(four_readings(sensor_file, out, "--max-readings", 1)) == 0
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
    subprocess.run([*run, *four_readings(sensor_file, tmp_path / "whole")], check=True)
    whole_s, whole = time.monotonic() - began_s, content_of(tmp_path / "whole")
    chance = random.Random(int(os.environ.get("PROBEWISE_KILL_SEED", "1")))
    n_killed = 0
    for k in range(9):  # a machine that has become faster ends more runs before they are killed
        out = tmp_path / str(k)
        status = None
        while status != 0:
            more = ["--resume"] if (out / "journal.jsonl").exists() else []
            process = subprocess.Popen([*run, *four_readings(sensor_file, out, *more)])
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
