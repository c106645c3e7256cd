"""`arm scan` and `arm record` with arms of arithmetic: patterns lie down and the sensor is turned by nobody."""

import numpy as np
import pytest
from command import run

from probewise.calibration import predict, read_sensor
from probewise.cli._bench import shifted_pattern, world_and_scale
from probewise.errors import ParameterError
from probewise.recordings import (
    Disc,
    HalfPlane,
    Image,
    Plan,
    Polygon,
    Quadrant,
    Ramp,
    Stripes,
    Uniform,
    paper_plan,
    read_recording,
    write_plan,
)

ORIGIN = (300.0, 200.0)
PATTERNS = [
    Uniform(0.5),
    HalfPlane(0.7, 3.0),
    Quadrant((1.0, 2.0), (-1, 1)),
    Disc((3.0, -2.0), 9.0),
    Polygon(((0.0, 0.0), (9.0, 1.0), (4.0, 8.0))),
    Stripes(0.7, 11.0, 0.4, 2.0),
    Image(np.eye(4), 3.0, (-5.0, -6.0), "eye.png"),
]


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda pattern: type(pattern).__name__)
def test_a_pattern_that_was_moved_reads_at_its_new_place_as_it_did_at_its_old(pattern):
    world, _ = world_and_scale(None)
    for x_mm, y_mm, turned_rad in ((0.0, 0.0, 0.0), (4.0, 1.0, 1.0), (-3.0, 6.0, 2.0)):
        here = world.read(pattern, x_mm, y_mm, turned_rad, time_s=0.0, rng=None)
        there = world.read(
            shifted_pattern(pattern, ORIGIN), x_mm + 300.0, y_mm + 200.0, turned_rad, time_s=0.0, rng=None
        )
        assert there == pytest.approx(here, abs=1e-6)


def test_a_ramp_stays_where_it_is():
    assert shifted_pattern(Ramp(0.0, 0.1), (0.0, 0.0)) == Ramp(0.0, 0.1)
    with pytest.raises(ParameterError, match="0,0 with a ramp"):
        shifted_pattern(Ramp(0.0, 0.1), ORIGIN)


def test_what_the_simulated_arm_records_is_what_its_sensor_predicts(sensor_file, tmp_path):
    """Over every pattern and orientation: chi-square per reading within 5 sd of 1, and rounding's twelfth."""
    sensor = read_sensor(sensor_file)
    plan = paper_plan()
    plan = plan.take(np.r_[0 : len(plan) - 4 : 5, len(plan) - 4 : len(plan)])
    write_plan(plan, tmp_path / "plan.csv")
    words = ("arm", "record", tmp_path / "plan.csv", "--arm", "simulated", "--sensor", sensor_file, "--quiet")
    assert run(*words, "--out", tmp_path / "r.csv", "--origin-mm", "524,260", "--seed", 3) == 0
    recording = read_recording(tmp_path / "r.csv")
    assert len(recording) == len(plan)
    assert "battery_mv" not in recording.plan.covariates  # the plan's is of another day
    found = predict(sensor, recording)
    chi_square = ((recording.readings - found.mean) ** 2 / (found.sd**2 + 1 / 12)).mean()
    assert chi_square == pytest.approx(1.0, abs=5 * np.sqrt(2 / len(plan)))


def test_the_emulated_arm_has_its_sensor_turned_and_patterns_laid(tmp_path):
    patterns = {"white": Uniform(1.0), "black": Uniform(0.0)}
    plan = Plan.from_arrays(
        x_mm=[0.0, 0.0],
        y_mm=0.0,
        patterns=patterns,
        pattern=["white", "black"],
        unit="LEGO",
        orientation_rad=[0.0, 1.6],
    )
    write_plan(plan, tmp_path / "plan.csv")
    words = ("arm", "record", tmp_path / "plan.csv", "--arm", "emulator", "--quiet", "--out", tmp_path / "r.csv")
    assert run(*words) == 0
    recording = read_recording(tmp_path / "r.csv")
    white, black = recording.readings
    assert white > 50 > 20 > black
    turned = np.diff(recording.plan.orientation_rad)[0]
    assert turned == pytest.approx(np.pi / 2, abs=0.01)


@pytest.mark.parametrize("arm", ["simulated", "emulator"])
def test_a_scan_goes_over_what_lies_there(arm, capsys):
    assert run("arm", "scan", "500,250", "600,250", "--readings", "2", "--arm", arm, "--scene", "600,250,60") == 0
    _, dark, bright = capsys.readouterr().out.splitlines()
    assert float(dark.split(",")[4]) < 20 < 50 < float(bright.split(",")[4])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--arm", "nxt:x", "--scene", "600,250,80"], "--scene is '600,250,80'; allowed: none with a real arm"),
        (
            ["--arm", "simulated", "--dry-run"],
            "--dry-run is True; allowed: none with simulated: it is for the LEGO arm",
        ),
        (["--arm", "emulator", "--scene", "blob"], "--scene is 'blob'; allowed: "),
    ],
)
def test_what_does_not_go_together_is_refused(words, message, capsys):
    assert run("arm", "scan", "500,250", "600,250", *words) == 2
    assert message in capsys.readouterr().err
