"""`probewise investigate` on the simulated arm: the rounds it keeps, the files it leaves, what it refuses."""

import json

import pytest
from command import run

from probewise.recordings import paper_plan, read_recording, write_plan


@pytest.fixture
def few(tmp_path):
    """Two scans across the edge: a diagnosis of them is quick."""
    plan = paper_plan()
    path = tmp_path / "few.csv"
    write_plan(plan.take(plan.scan < 2), path)
    return path


@pytest.mark.slow
def test_one_round_leaves_a_diagnosis_and_all_it_was_made_of(few, tmp_path, capsys):
    out = tmp_path / "out"
    options = ("--plan", few, "--truth", "nothing", "--rounds", 1, "--seed", 1)
    assert run("investigate", *options, "--out", out) == 0
    names = {path.name for path in out.iterdir()}
    assert {
        "diagnosis.json",
        "sensor.json",
        "calibrated.json",
        "recording.csv",
        "report.html",
        "rounds",
        "by_round.png",
    } <= names
    assert len(read_recording(out / "recording.csv")) == len(read_recording(out / "rounds" / "1.csv"))
    assert json.loads((out / "diagnosis.json").read_text())["verdict"]
    said = capsys.readouterr().out
    assert "round 1:" in said
    assert "concealed    nothing" in said
    page = (out / "report.html").read_text()
    assert "How it came to that" in page
    assert "http://" not in page


@pytest.mark.slow
def test_an_aliased_effect_is_settled_by_the_readings_that_are_asked_for(tmp_path):
    out = tmp_path / "out"
    options = ("--plan", "paper", "--truth", "backlash:0.5", "--seed", 4, "--quiet")
    assert run("investigate", *options, "--out", out) == 0
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["hypotheses"][0]["effects"] == ["backlash"]
    assert found["hypotheses"][0]["probability"] > 0.95
    assert (out / "rounds" / "2.csv").exists()
    assert set(read_recording(out / "recording.csv").plan.sessions) >= {0, 1}


OWN = """
import math

def connect():
    return Edge()

class Edge:
    turns = True

    def measure(self, pose):
        across = pose.x_mm * math.cos(0.0) / 6.0
        return round(10.0 + 25.0 * (1.0 + math.tanh(across)) + 0.4 * math.sin(37.0 * pose.x_mm + 11.0 * pose.y_mm), 3)

    def close(self):
        with open(CLOSED, "w") as file:
            file.write("closed")
"""


@pytest.mark.slow
def test_an_instrument_of_ones_own_is_investigated_and_closed(few, tmp_path):
    file, closed, out = tmp_path / "edge.py", tmp_path / "closed.txt", tmp_path / "out"
    file.write_text(OWN.replace("CLOSED", repr(str(closed))))
    one = tmp_path / "one.csv"
    plan = paper_plan()
    write_plan(plan.take(plan.scan < 1), one)
    options = ("--arm", file, "--plan", one, "--rounds", 1, "--no-hands", "--quiet")
    assert run("investigate", *options, "--out", out) == 0
    assert closed.read_text() == "closed"
    assert len(read_recording(out / "recording.csv")) == len(read_recording(out / "rounds" / "1.csv"))
    assert "the world concealed" not in (out / "report.html").read_text()
