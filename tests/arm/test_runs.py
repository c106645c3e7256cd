"""Tasks at the bench on a brick made of paper: what they say, what is kept when the line dies, and how they go on."""

import io
import json
import re
import signal

import numpy as np
import pytest
from hand_made import TRUTH, sensor_of

from probewise.arm import LegoArm, Pose, read_geometry, shipped_geometry_path
from probewise.arm.nxt import Brick, BrickMachine, Link
from probewise.calibration import write_sensor
from probewise.cli import _bench, main
from probewise.errors import LinkError
from probewise.recordings import paper_plan, read_recording, write_plan, write_recording

DARK_COUNTS = 826  # 10 %


@pytest.fixture
def bricks(monkeypatch, make_paper_brick):
    """Open a new paper brick each time; the n-th dies as it is to be read the m-th time, bricks[n] = m."""
    deaths, opened = {}, []

    def open_nxt_arm(port, geometry, *, start_s=0.0):
        paper = make_paper_brick()
        paper.raw_counts = DARK_COUNTS
        carry_out, asked = paper.carry_out, []
        death = deaths.get(len(opened))
        opened.append(paper)

        def mortal(opcode, body):
            if opcode == 0x07 and paper.clock.now_s >= paper.input[2]:  # a valid reading
                asked.append(opcode)
                if len(asked) == death:
                    paper.is_cut = True
                    raise LinkError("the line is cut")
            return carry_out(opcode, body)

        paper.carry_out = mortal
        clock = paper.clock
        machine = BrickMachine(Brick(Link(paper, clock=clock), clock=clock), geometry)
        return LegoArm(machine, geometry, clock=clock, start_s=start_s)

    monkeypatch.setattr("probewise.cli._bench.open_nxt_arm", open_nxt_arm)
    monkeypatch.setattr("sys.stdin", io.StringIO("\n" * 100))
    deaths["opened"] = opened
    return deaths


@pytest.fixture
def plan_file(tmp_path):
    plan = paper_plan()
    write_plan(plan.take(np.r_[0:404:50, 404:408]), tmp_path / "plan.csv")
    return tmp_path / "plan.csv"


@pytest.fixture
def sensor_file(tmp_path):
    samples = TRUTH + 1e-4 * np.random.default_rng(0).standard_normal((500, 8))
    write_sensor(sensor_of(samples), tmp_path / "sensor.json")
    return tmp_path / "sensor.json"


def run(capsys, *arguments):
    status = main([str(a) for a in arguments])
    return status, capsys.readouterr().err


def test_a_plan_is_recorded(bricks, plan_file, tmp_path, capsys):
    out = tmp_path / "rec.csv"
    status, asked = run(capsys, "arm", "record", plan_file, "--out", out, "--arm", "nxt:x", "--quiet")
    assert status == 0
    assert asked.count("then press Enter") == 10
    # An earlier process may have left it turned, so the person is asked at the start too.
    assert re.findall(r"sensor on its mount to (\d+) degrees", asked) == ["0", "90", "180", "270", "0"]
    recording = read_recording(out)
    assert len(recording) == 13
    np.testing.assert_array_equal(recording.readings, 10)
    assert (np.diff(recording.plan.time_s) > 1).all()
    assert set(recording.plan.covariates) == {"battery_mv", "height_mm"}
    assert recording.plan.instrumentation.step == 1
    assert all(paper.at_rest and not paper.is_open for paper in bricks["opened"])


def test_a_recording_that_a_dead_line_ended_goes_on(bricks, plan_file, tmp_path, capsys):
    bricks.update({0: 1, 1: 5, 2: 3})
    out = tmp_path / "rec.csv"
    arguments = ["arm", "record", plan_file, "--out", out, "--arm", "nxt:x", "--quiet"]
    status, said = run(capsys, *arguments)
    assert status == 1
    assert said.endswith("cut; nothing was written\n")
    status, said = run(capsys, *arguments)
    assert status == 1
    assert "rec.csv keeps 4 of 13 readings; go on with: probewise arm record" in said
    status, said = run(capsys, *arguments, "--resume")
    assert "rec.csv keeps 6 of 13 readings" in said
    status, said = run(capsys, *arguments, "--resume")
    assert status == 0
    recording = read_recording(out)
    assert len(recording) == 13
    assert (np.diff(recording.plan.time_s) > 1).all()


def then(first, after):
    def both(*arguments):
        first(*arguments)
        after()

    return both


class Terminal(io.StringIO):
    """A terminal at which somebody has typed."""

    def isatty(self):
        return True


LOWERING = [
    ("\n", ["arm", "heights", "524,260", "300,200"]),
    ("", ["arm", "scan", "300,200", "310,200"]),
    ("\n\n", ["arm", "record", "PLAN", "--out", "OUT"]),
    ("", ["explore", "--sensor", "SENSOR", "--out", "OUT", "--model", "naive"]),
    ("\n\n", ["investigate", "--plan", "PLAN", "--out", "OUT"]),
]


@pytest.mark.parametrize(("typed", "words"), LOWERING, ids=["heights", "scan", "record", "explore", "investigate"])
def test_a_person_confirms_the_first_lowering_of_an_arm_that_nobody_fitted(
    typed, words, bricks, plan_file, sensor_file, tmp_path, monkeypatch, capsys
):
    """As long as nobody presses Enter, the sensor stays at travel height."""
    monkeypatch.setattr("sys.stdin", Terminal(typed))
    files = {"PLAN": plan_file, "SENSOR": sensor_file, "OUT": tmp_path / "out"}
    status, said = run(capsys, *(files.get(word, word) for word in words), "--arm", "nxt:x")
    assert status == 2
    assert "the sensor may touch the table" in said
    assert "Check that the sensor is 60 mm above the table, and free to be lowered further, then press Enter" in said
    assert "nobody is there to press Enter" in said
    geometry = read_geometry(shipped_geometry_path())
    counts = [bricks["opened"][0].motors[joint.port].position for joint in geometry.joints]
    angles = [joint.angle_at(count, 0) for joint, count in zip(geometry.joints, counts, strict=True)]
    assert geometry.position_mm(np.array([angles]))[0, 2] > geometry.travel_height_mm - 10


@pytest.mark.slow
@pytest.mark.parametrize("model", ["naive", pytest.param("ssf", marks=pytest.mark.slow)])
def test_exploring_with_a_brick_goes_on_after_its_line_died(model, bricks, sensor_file, tmp_path, capsys):
    """Each line of the journal is a reading, once, with the orientation that the base gave it."""
    bricks.update({0: 1, 1: 3})
    out = tmp_path / "found"
    arguments = ["explore", "--sensor", sensor_file, "--out", out, "--arm", "nxt:x", "--max-readings", 3]
    arguments += ["--model", model, "--quiet"]
    status, said = run(capsys, *arguments)
    assert status == 1
    assert said.count("\n") == 2  # one of a geometry that nobody fitted
    status, said = run(capsys, *arguments, "--resume")
    assert status == 1
    assert "journal.jsonl keeps 2 readings; go on with: probewise explore" in said
    status, said = run(capsys, *arguments, "--resume")
    assert (status, said.count("\n")) == (0, 1)
    lines = [json.loads(line) for line in (out / "journal.jsonl").read_text().splitlines()[1:]]
    assert [line["index"] for line in lines] == [1, 2, 3]
    assert [line["reading"] for line in lines] == [10] * 3
    assert (np.diff([line["time_s"] for line in lines]) > 1).all()
    for line in lines:
        base = np.arctan2(line["pose"]["y_mm"] - 580, line["pose"]["x_mm"] - 524)
        assert np.cos(line["pose"]["orientation_rad"] - (base + np.pi / 2)) == pytest.approx(1, abs=1e-5)
    assert (out / "report.html").exists()


@pytest.fixture
def stop_as_it_rises(bricks, monkeypatch):
    """Stop the command as the sensor begins to rise for the n-th time: behind the telegram that turns the motor."""
    raise_sensor = LegoArm.raise_sensor

    def at(n):
        rises = []

        def struck(arm):
            rises.extend([None] if arm._is_down else [])
            if len(rises) == n:
                rises.append(None)  # once
                paper = bricks["opened"][-1]
                write = paper.write

                def stopping(data):
                    write(data)
                    if data[3] == 0x04 and not paper.at_rest:
                        paper.write = write
                        signal.raise_signal(signal.SIGINT)

                paper.write = stopping
            raise_sensor(arm)

        monkeypatch.setattr(LegoArm, "raise_sensor", struck)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield at
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("n_read", [1, 3], ids=["in a scan", "before the sensor is to be turned"])
def test_a_stop_while_the_sensor_rises_keeps_the_reading_and_asks_for_nothing(
    n_read, stop_as_it_rises, bricks, plan_file, tmp_path, capsys, monkeypatch
):
    """The motors are released before the reading is written."""
    at_rest = []
    spy = then(write_recording, lambda: at_rest.append(bricks["opened"][-1].at_rest))
    monkeypatch.setattr("probewise.cli.arm.write_recording", spy)
    stop_as_it_rises(n_read)
    out = tmp_path / "rec.csv"
    arguments = ["arm", "record", plan_file, "--out", out, "--arm", "nxt:x", "--quiet"]
    status, said = run(capsys, *arguments)
    assert status == 130
    assert f"stopped; {out} keeps {n_read} of 13 readings; go on with" in said
    assert said.count("then press Enter") == 2
    assert len(at_rest) == n_read
    assert at_rest[-1]
    assert bricks["opened"][0].at_rest
    assert run(capsys, *arguments, "--resume")[0] == 0
    assert len(read_recording(out)) == 13


@pytest.mark.parametrize("n_poses", [1, 2], ids=["the end of with", "the next measurement"])
def test_a_stop_while_the_sensor_rises_is_raised_by_what_comes_next(n_poses, stop_as_it_rises, bricks):
    geometry, place = read_geometry(shipped_geometry_path()), (300.0, 200.0)
    pose = Pose(*place, float(geometry.orientation_rad(np.array([place]))[0]))
    readings = []

    def measure():
        with _bench.open_nxt_arm("x", geometry) as arm:
            readings.extend(arm.measure(pose) for _ in range(n_poses))

    stop_as_it_rises(1)
    with pytest.raises(KeyboardInterrupt):
        measure()
    assert len(readings) == 1
    assert bricks["opened"][0].at_rest
    assert not bricks["opened"][0].is_open


TASKS = [["jog", "300,200"], ["home"], ["read"], ["heights"], ["scan", "300,200", "310,200"], ["record", "paper"]]


def said(capsys, *arguments, status=0):
    assert main([str(a) for a in arguments]) == status
    return capsys.readouterr()


def test_check_says_and_draws_how_far_the_arm_reaches(tmp_path, capsys):
    out = said(capsys, "arm", "check", "--out", tmp_path / "reach.png").out
    assert "126 to 755 mm from the arm's axis" in out
    assert "% of it within reach" in out
    assert (tmp_path / "reach.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture
def at_port(paper_brick, clock, monkeypatch):
    monkeypatch.setattr(
        "probewise.cli._bench.open_brick", lambda port: Brick(Link(paper_brick, clock=clock), clock=clock)
    )
    return paper_brick


@pytest.mark.filterwarnings("default::probewise.errors.LowBatteryWarning")
def test_check_warns_of_an_empty_battery(at_port, capsys):
    at_port.millivolt = 5900
    told = said(capsys, "arm", "check", "--arm", "nxt:x")
    assert "battery 5.90 V" in told.out
    assert told.err.count("warning: the NXT's battery is at 5.90 V, below 6 V") == 1


def test_check_tells_of_a_program_that_runs(at_port, capsys):
    at_port.statuses = {}
    assert "the program dance.rxe runs on the brick" in said(capsys, "arm", "check", "--arm", "nxt:x", status=1).err


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task[0])
def test_a_dry_run_prints_the_moves_and_writes_nothing(task, tmp_path, capsys):
    out = ["--out", tmp_path / "r.csv"] if task[0] == "record" else []
    text = said(capsys, "arm", *task, "--dry-run", *out).out
    assert "release all motors" in text
    if task[0] not in ("read", "home"):
        assert "base     to" in text
    if task[0] == "record":
        assert text.count("ask: ") == 9
    assert not list(tmp_path.iterdir())


def test_a_joint_can_be_jogged(capsys):
    assert "base     to" in said(capsys, "arm", "jog", "base", "-5", "--dry-run").out
    assert "allowed: -190 to 10 degrees" in said(capsys, "arm", "jog", "base", "-500", "--dry-run", status=2).err


def test_jog_down_asks_a_person_to_look(capsys):
    assert "ask: check" in said(capsys, "arm", "jog", "300,200", "--down", "--dry-run").out


def test_home_here_sets_the_counters_where_a_person_brought_the_arm(capsys):
    out = said(capsys, "arm", "home", "--here", "--dry-run").out
    assert "base -90, shoulder 90, elbow -20 degrees" in out
    assert "set to 0 the counters of base, shoulder, elbow" in out


@pytest.mark.parametrize("dry", [["--dry-run"], ["--arm", "nxt:x"]], ids=["rehearsed", "on a brick"])
def test_a_scan_that_leaves_the_reach_moves_nothing_and_prints_nothing(dry, monkeypatch, capsys):
    """The whole scan is checked first: the line to a brick is not even opened."""
    monkeypatch.setattr("probewise.cli._bench.open_brick", lambda port: pytest.fail("the line was opened"))
    told = said(capsys, "arm", "scan", "300,200", "5,5", "--readings", "6", *dry, status=2)
    assert told.out == ""
    assert "the place of reading 6 of the scan (mm) is (5.0, 5.0); allowed: a place on the field" in told.err
    assert "126 to 755 mm from the arm's axis" in told.err
    assert "of these 6 places 5 are in reach" in told.err
    assert "Pose(" not in told.err
