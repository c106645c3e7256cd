"""The verb `arm` and `explore --arm`: tasks at the bench, on no bench."""

import pytest

from probewise.arm.nxt import Brick, Link
from probewise.cli import main

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
