"""`arm record --resume` continues a recording only with the plan and the description that it was begun with."""

import dataclasses
import math

import numpy as np
import pytest
from command import run

from probewise.arm import shipped_geometry_path
from probewise.recordings import HalfPlane, Image, Plan, Quadrant, Uniform, read_plan, read_recording, write_plan

EDGE = HalfPlane(0.0, 0.0)
OWN = """
def connect():
    return Arm()
class Arm:
    n = 0
    def measure(self, pose):
        self.n += 1
        {more}
"""
MISSING = """from probewise.arm import Reading
        if self.n == 3: raise OSError("unplugged")
        return Reading(float("nan"), pose, float(self.n))"""


def plan(**changes):
    options = {"x_mm": [-20, -10, 10, 20], "y_mm": 0, "patterns": {"edge": EDGE}, "unit": "V", "min": 0, "max": 5}
    return Plan.from_arrays(**{**options, **changes})


@pytest.fixture
def record(tmp_path, monkeypatch):
    """Record a plan with an instrument of one's own, whose `measure` ends with `more`; return the exit status."""
    monkeypatch.setattr("probewise.cli._bench.prompter_for_answer", lambda arm: lambda text: "")

    def of(plan, *words, more="return 2.5"):
        (tmp_path / "plans").mkdir(exist_ok=True)  # an image is kept beside the plan and beside the recording
        write_plan(plan, tmp_path / "plans" / "plan.csv")
        (tmp_path / "own.py").write_text(OWN.format(more=more))
        words = ("--arm", tmp_path / "own.py", "--quiet", *words)
        return run("arm", "record", tmp_path / "plans" / "plan.csv", "--out", tmp_path / "r.csv", *words)

    return of


CHANGES = {
    "the unit": ({}, ["--unit", "mV"], "unit is 'V' there, 'mV' here"),
    "the height": ({"height_mm": 20}, [], "height_mm is None there, 20.0 here"),
    "the orientation": ({"orientation_rad": [0, 0, 0.2, 0]}, [], "the orientation of reading 3 differs"),
    "a place": ({"x_mm": [-20, -10, 10, 26]}, [], "the x_mm of reading 4 differs"),
    "a place across": ({"y_mm": [0, 0, 6, 0]}, [], "the y_mm of reading 3 differs"),
    "a pattern": ({"patterns": {"edge": Quadrant((0.0, 0.0), (1, 1))}}, [], "pattern 'edge' is HalfPlane("),
    "its length": ({"x_mm": [-20, -10, 10]}, [], "it has 4 rows, this plan 3"),
}


@pytest.mark.parametrize(("changes", "words", "says"), CHANGES.values(), ids=CHANGES.keys())
def test_what_differs_from_the_session_that_began_it_is_named_and_nothing_is_written(
    changes, words, says, record, tmp_path, capsys
):
    assert record(plan()) == 0
    before = [(tmp_path / name).read_bytes() for name in ("r.csv", "r.json")]
    assert record(plan(**changes), *words, "--resume") == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert [(tmp_path / name).read_bytes() for name in ("r.csv", "r.json")] == before


def test_images_are_compared_by_their_pixels(record, tmp_path, capsys):
    def over(pixels):
        return plan(patterns={"eye": Image(pixels, 3.0, (-5.0, -6.0), "eye.png")})

    assert record(over(np.eye(4))) == 0
    assert record(over(np.eye(4)), "--resume") == 0
    capsys.readouterr()
    assert record(over(np.fliplr(np.eye(4))), "--resume") == 2
    assert "pattern 'eye' is Image(" in capsys.readouterr().err


def test_later_rows_and_the_description_may_change(record, tmp_path):
    assert record(plan()) == 0
    described = dataclasses.replace(plan().instrumentation, description="new words")
    longer = plan(
        x_mm=[-20, -10, 10, 20, 30],
        patterns={"edge": EDGE, "white": Uniform(1.0)},
        pattern=["edge"] * 4 + ["white"],
        orientation_rad=[0, 0, 0, 0, 1.0],
    )
    assert record(dataclasses.replace(longer, instrumentation=described), "--resume") == 0
    assert len(read_recording(tmp_path / "r.csv")) == 5


def test_an_instrument_that_knows_its_true_pose_goes_on(record, tmp_path):
    true = 'return {"value": 2.5, "x_mm": pose.x_mm + 0.5, "orientation_rad": 0.03}'
    assert record(plan(), more=true) == 0
    assert record(plan(), "--resume", more=true) == 0
    assert read_plan(tmp_path / "r.csv").orientation_rad == pytest.approx(0.03)


def test_a_lego_arm_whose_sensor_stands_up_to_45_degrees_off_goes_on_and_one_that_reads_higher_does_not(
    tmp_path, capsys
):
    write_plan(plan(x_mm=[-200, 0, 200], orientation_rad=[math.pi, 0, 0]), tmp_path / "plan.csv")
    words = ["arm", "record", tmp_path / "plan.csv", "--out", tmp_path / "r.csv", "--arm", "emulator", "--quiet"]
    assert run(*words) == 0
    assert np.ptp(np.abs(read_plan(tmp_path / "r.csv").orientation_rad)) > math.radians(100)
    assert run(*words, "--resume") == 0
    shipped = shipped_geometry_path().read_text()
    (tmp_path / "higher.toml").write_text(shipped.replace("read_height_mm = 14", "read_height_mm = 20"))
    capsys.readouterr()
    assert run(*words, "--resume", "--geometry", tmp_path / "higher.toml") == 2
    assert "height_mm is 14.0 there, 20.0 here" in capsys.readouterr().err
    write_plan(plan(x_mm=[-200, 0, 200], orientation_rad=[math.pi, math.pi / 2, 0]), tmp_path / "plan.csv")
    assert run(*words, "--resume") == 2
    assert "the orientation of reading 2 differs" in capsys.readouterr().err


def test_a_recording_whose_readings_are_all_missing_so_far_goes_on(record, tmp_path, capsys):
    assert record(plan(), more=MISSING) == 1
    assert "r.csv keeps 2 of 4 readings; go on with" in capsys.readouterr().err
    assert record(plan(), "--resume") == 0
    np.testing.assert_array_equal(read_recording(tmp_path / "r.csv").readings, [np.nan, np.nan, 2.5, 2.5])


def test_a_session_that_ended_before_its_first_reading_is_in_nobodys_way(record, tmp_path, capsys):
    assert record(plan()) == 0
    (tmp_path / "r.csv").unlink()
    assert record(plan(), "--resume") == 2
    assert "r.csv: no such file; allowed: a recording to resume; omit --resume" in capsys.readouterr().err
    assert record(plan()) == 0
    (tmp_path / "r.csv").unlink()
    (tmp_path / "r.json").write_text("of a person")
    assert record(plan()) == 2
    assert "r.json: the file exists already" in capsys.readouterr().err


def test_a_plan_where_the_recording_should_be_is_refused(record, tmp_path, capsys):
    write_plan(plan(), tmp_path / "r.csv")
    assert record(plan(), "--resume") == 2
    assert "no column of readings: this is a plan" in capsys.readouterr().err


def test_a_session_begun_while_another_records_is_refused_and_loses_no_reading(record, tmp_path, capsys):
    again = """from probewise.cli import main
        if self.n in (1, 3): main([{words}] + ["--resume"] * (self.n > 1))
        return float(self.n)"""
    words = "arm", "record", tmp_path / "plans" / "plan.csv", "--out", tmp_path / "r.csv", "--arm", tmp_path / "own.py"
    assert record(plan(), more=again.format(words=", ".join(repr(str(word)) for word in words))) == 0
    assert capsys.readouterr().err.count("r.csv: another process is writing to it; allowed: one process at a time") == 2
    np.testing.assert_array_equal(read_recording(tmp_path / "r.csv").readings, [1, 2, 3, 4])
