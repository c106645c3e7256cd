"""`--arm FILE.py`: a person's own instrument runs explore, arm scan and arm record, and its mistakes lose nothing."""

import dataclasses
import json

import numpy as np
import pytest
from command import run

from probewise.calibration import read_sensor, write_sensor
from probewise.experiment import read_journal
from probewise.recordings import Instrumentation, Plan, Quadrant, read_recording, write_plan

ARM = """
import math, os, signal
LOG = {log!r}
def connect():
    return Arm()
class Arm:
    n = 0
    def measure(self, pose):
        self.n += 1
        {more}
        inside = math.hypot(pose.x_mm - 600, pose.y_mm - 260) < 90
        return {{"value": 840 if inside else 140, "temperature_c": 20.0 + self.n}}
    def close(self):
        with open(LOG, "a") as log:
            log.write("closed\\n")
"""


@pytest.fixture
def arm_file(tmp_path):
    """Write the file of an instrument whose sensor gives ten bits; `more` is done at every measurement."""

    def write(more="pass", name="my_arm.py"):
        path = tmp_path / name
        path.write_text(ARM.format(log=str(tmp_path / "log"), more=more))
        return path

    return write


@pytest.fixture
def closed(tmp_path):
    """Count how often the instrument was closed."""
    return lambda: (tmp_path / "log").read_text().count("closed") if (tmp_path / "log").exists() else 0


@pytest.fixture
def ten_bits(sensor_file):
    """Scale the hand-made sensor to ten bits."""
    sensor = read_sensor(sensor_file)
    samples = sensor.samples.copy()
    samples[:, -2:] *= 14.0
    scale = Instrumentation(unit="counts", min=0.0, max=1023.0)  # without steps, which costs less
    path = sensor_file.with_name("ten_bits.json")
    write_sensor(dataclasses.replace(sensor, samples=samples, noise_sd=np.full(500, 20.0), instrumentation=scale), path)
    return path


@pytest.mark.slow
@pytest.mark.usefixtures("quick_frames")
def test_a_run_goes_on_where_the_instrument_failed_and_keeps_what_its_readings_brought(
    arm_file, ten_bits, tmp_path, capsys, closed
):
    out = tmp_path / "out"
    words = ("explore", "--sensor", ten_bits, "--out", out, "--max-readings", 2, "--quiet", "--arm")
    broken = arm_file("if self.n == 2: raise RuntimeError('the head is jammed')")
    assert run(*words, broken) == 1
    said = capsys.readouterr().err
    assert f"{broken}, line 10: measure raises RuntimeError: the head is jammed; " in said
    assert f"keeps 1 reading; go on with: probewise explore --sensor {ten_bits}" in said
    assert "Traceback" not in said
    assert closed() == 1
    assert len(read_journal(out / "journal.jsonl").entries) == 1

    assert run(*words, arm_file(name="mended.py"), "--resume") == 0
    assert closed() == 2
    journal = read_journal(out / "journal.jsonl")
    first, second = journal.readings
    assert {first.value, second.value} <= {140.0, 840.0}
    assert second.time_s >= first.time_s
    assert journal.recording().plan.covariates["temperature_c"].tolist() == [21.0, 21.0]
    assert json.loads((out / "result.json").read_text())["readings"] == 2
    assert journal.settings["options"]["reading_range"] == [0.0, 1023.0]


@pytest.mark.slow
@pytest.mark.usefixtures("quick_frames")
@pytest.mark.filterwarnings("always::probewise.errors.DoubtfulResultWarning")
def test_readings_at_another_height_than_the_calibrated_one_are_doubtful_and_the_result_says_so(
    arm_file, ten_bits, tmp_path, capsys
):
    sensor, out = read_sensor(ten_bits), tmp_path / "out"
    scale = dataclasses.replace(sensor.instrumentation, height_mm=14.0)
    write_sensor(dataclasses.replace(sensor, instrumentation=scale), ten_bits)
    arm = arm_file('return {"value": 140, "height_mm": 20}')
    assert run("explore", "--sensor", ten_bits, "--out", out, "--max-readings", 2, "--arm", arm) == 0
    said = capsys.readouterr()
    doubt = "the arm reads 20 mm above the surface, and the sensor was calibrated at 14 mm"
    assert said.err.count(f"warning: {doubt}") == 1
    assert said.out.count(f"doubtful: {doubt}") == 1
    (note,) = json.loads((out / "result.json").read_text())["notes"]
    assert note.startswith(doubt)
    assert doubt in (out / "report.html").read_text()


def test_ctrl_c_closes_the_instrument_and_keeps_the_journal(arm_file, ten_bits, tmp_path, capsys, closed):
    out = tmp_path / "out"
    struck = arm_file("os.kill(os.getpid(), signal.SIGINT)")
    assert run("explore", "--sensor", ten_bits, "--out", out, "--quiet", "--arm", struck) == 130
    assert "keeps 0 readings; go on with: probewise explore" in capsys.readouterr().err
    assert closed() == 1


def test_a_plan_is_recorded_in_the_instruments_own_unit_and_goes_on_when_it_was_cut(
    arm_file, tmp_path, capsys, monkeypatch, closed
):
    monkeypatch.setattr("probewise.cli._bench.prompter_for_answer", lambda arm: lambda text: "")
    plan = tmp_path / "plan.csv"
    write_plan(
        Plan.from_arrays(
            x_mm=[0, 20, 40], y_mm=0, patterns={"corner": Quadrant((0.0, 0.0), (1, 1))}, unit="LEGO", min=0, max=100
        ),
        plan,
    )
    out = tmp_path / "mine.csv"
    words = ["arm", "record", plan, "--out", out, "--quiet", "--origin-mm", "500,260"]
    words += ["--unit", "counts", "--range", "0,1023", "--step", "1", "--arm"]
    assert run(*words, arm_file("if self.n == 3: raise OSError('unplugged')")) == 1
    assert "line 10: measure raises OSError: unplugged; " in (said := capsys.readouterr().err)
    assert "keeps 2 of 3 readings" in said
    assert run(*words, arm_file(), "--resume") == 0
    recording = read_recording(out)
    assert recording.readings.tolist() == [140.0, 840.0, 840.0]
    assert recording.plan.instrumentation == Instrumentation(unit="counts", min=0.0, max=1023.0, step=1.0)
    assert recording.plan.covariates["temperature_c"].tolist() == [21.0, 22.0, 21.0]
    assert closed() == 2


@pytest.mark.slow
@pytest.mark.usefixtures("quick_frames")
def test_a_journal_finds_the_sensor_of_its_run_and_refuses_another_truth(sensor_file, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    words = ["explore", "--sensor", sensor_file, "--out", out, "--max-readings", 1, "--quiet"]
    assert run(*words, "--truth", "600,260,90") == 0
    assert run(*words, "--truth", "400,260,90", "--resume") == 2
    assert "hidden.x_mm 600.0 there, 400.0 here" in capsys.readouterr().err
    journal, seen = out / "journal.jsonl", []
    monkeypatch.setattr(
        "probewise.cli.diagnose.journal_recording_and_shape", lambda path, sensor: seen.append(sensor) or 1 / 0
    )
    with pytest.raises(ZeroDivisionError):
        run("diagnose", journal, "--out", tmp_path / "d")
    assert seen[0].names == read_sensor(sensor_file).names

    (out / "sensor.json").unlink()  # the run's own, which would be found in its place
    text = sensor_file.read_text()
    sensor_file.write_text(text.replace('"source"', '"source" ').replace("0.6", "0.7"))
    assert run("diagnose", journal, "--out", tmp_path / "d") == 2
    assert "is another by now; allowed: --sensor S.json" in capsys.readouterr().err
    sensor_file.unlink()
    assert run("diagnose", journal, "--out", tmp_path / "d") == 2
    assert "is not there any more; allowed: --sensor S.json" in capsys.readouterr().err
    (out / "sensor.json").write_text(text)  # a copy beside the journal does too
    with pytest.raises(ZeroDivisionError):
        run("diagnose", journal, "--out", tmp_path / "d")
