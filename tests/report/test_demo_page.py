"""The demo's page: every figure is there, and the diagnosis is that of the command."""

import io
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made import hand_made_sensor
from PIL import Image
from small_search import arm_and_experiment

import probewise
from probewise.arm import Pose
from probewise.cli import main
from probewise.cli.demo import diagnose_shipped_recording
from probewise.errors import ParameterError
from probewise.experiment import HiddenShape, run_from_place
from probewise.recordings import read_recording, shipped
from probewise.report.demo import doubt_section, doubt_sentence, draw_views, largest_error_mm
from probewise.report.plots import PAGE_IN, png

FIRST = Pose(590.0, 250.0)


def searched(max_readings):
    arm, experiment = arm_and_experiment((600.0, 260.0, 90.0), np.random.default_rng(3))
    run = run_from_place(FIRST, arm, experiment, rng=np.random.default_rng(5), max_readings=max_readings)
    return replace(run, hidden=HiddenShape("circle", experiment.shape, (600.0, 260.0, 90.0)))


@pytest.fixture(scope="module")
def found():
    return searched(2)


def test_the_demo_the_command_and_the_function_diagnose_by_the_same_randomness(monkeypatch, tmp_path):
    """So that one recording has one exponent, in the README, on the page and in the terminal."""
    states = []

    def diagnose(*recordings, rng, **options):
        states.append(rng.bit_generator.state)
        raise ParameterError("readings", 0, "none: this is a rehearsal")

    monkeypatch.setattr("probewise.diagnosis.diagnose", diagnose)
    recording = shipped("concealed")
    with pytest.raises(ParameterError, match="rehearsal"):
        diagnose_shipped_recording(2013)
    with pytest.raises(ParameterError, match="rehearsal"):
        probewise.diagnose(read_recording(recording), rng=np.random.default_rng(2013), progress=False)
    assert main(["diagnose", str(recording), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert len(states) == 3
    assert states[0] == states[1] == states[2]


def test_the_robot_that_doubts_is_shown_beside_the_one_that_trusts(found):
    """Their pictures, how both ended, and what the second one reports of its sensor."""
    searches = {name: found for name in ("trusting", "doubting")}
    drawn = {"doubt.png": png(draw_views(searches, 2)), "belief.png": b"<svg></svg>"}
    widest = 110 * (PAGE_IN + 0.3)  # wider ones are shrunk on a page
    assert Image.open(io.BytesIO(drawn["doubt.png"])).width <= widest
    said = "".join(doubt_section(searches, drawn, white=60.0).elements)
    for row in ("trusting", "doubting"):
        assert f">{row}<" in said
    assert f"2 readings, off by {largest_error_mm(found):.1f} mm" in doubt_sentence(searches)
    assert found.stop_reason in said


@pytest.mark.slow
def test_the_page_shows_every_figure_that_is_drawn(found):
    """Of a diagnosis of few readings, which is quick; the calibration is a sensor made by hand."""
    from probewise.arm import read_geometry, shipped_geometry_path
    from probewise.calibration import predict
    from probewise.diagnosis import diagnose
    from probewise.report import demo as report

    recording = read_recording(shipped("paper"))
    sensor = hand_made_sensor()
    calibration = SimpleNamespace(sensor=sensor, orders=sensor.orders, fields={1: sensor.field})
    searches = {name: found for name in ("naive", "SSF")}
    found = report.DemoRun(
        calibration,
        recording,
        predict(sensor, recording.plan, recording.readings),
        searches,
        searches,
        diagnose(recording.take(np.arange(0, 408, 8)), rng=np.random.default_rng(1)),
        read_geometry(shipped_geometry_path()),
        "lag",
        1,
    )
    drawn = {name: draw() for name, draw in report.figure_drawers(found).items()}
    page = report.page_html(found, drawn, seconds=2.0)
    assert page.count("<img") == len(drawn) - 1  # one figure is a file alone, ssf.png
    assert "could not be drawn" not in page
    assert "The simulated world that made this recording concealed: lag." in page
