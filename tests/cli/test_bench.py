"""`arm scan` and `arm record` with arms of arithmetic, whose sensor nobody turns; gears of unknown play."""

import math
from pathlib import Path

import numpy as np
import pytest
from command import run

from probewise.arm import Pose, read_geometry, shipped_geometry_path
from probewise.calibration import predict, read_sensor
from probewise.cli._bench import open_emulated_arm_and_bench
from probewise.recordings import Disc, Plan, Ramp, Uniform, paper_plan, read_recording, write_plan
from probewise.world.shipped import true_world


def test_a_ramp_is_laid_where_its_origin_is_to_lie(tmp_path):
    """A ramp of 1 in 100 mm, from 20 mm left of its origin: .3, .5, .7 of the way from black to white."""
    ramp = Ramp(0.0, 0.01)
    plan = Plan.from_arrays(x_mm=[30.0, 50.0, 70.0], y_mm=0.0, patterns=ramp, unit="LEGO")
    write_plan(plan, tmp_path / "plan.csv")
    words = ("arm", "record", tmp_path / "plan.csv", "--arm", "simulated", "--quiet", "--out", tmp_path / "r.csv")
    assert run(*words, "--origin-mm", "524,260") == 0
    low, middle, high = read_recording(tmp_path / "r.csv").readings
    assert high - low == pytest.approx(0.4 * 47, abs=5)
    assert middle == pytest.approx((low + high) / 2, abs=4)


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


SHIPPED = read_geometry(shipped_geometry_path())
KNOWN_DEG = 0.3
BASE_MM = (524.0, 580.0)


def built_with(play_deg, path):
    text = Path(shipped_geometry_path()).read_text(encoding="utf-8")
    known = f"play_deg = {KNOWN_DEG}"
    assert text.count(known) == 1
    path.write_text(text.replace(known, f"play_deg = {play_deg}"), encoding="utf-8")
    return path


def turned_deg(play_deg, path):
    """How far the base stands from where the driver believes it, at places that it comes to from both sides."""
    arm, bench = open_emulated_arm_and_bench(
        SHIPPED, built_with(play_deg, path), true_world("paper"), Disc((500.0, 250.0), 90.0), seed=1, start_s=0.0
    )
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi, 8)
    places = np.stack([BASE_MM[0] + 200 * np.cos(angle), 200 + 120 * np.sin(angle)], axis=1)
    off, from_below, before = [], [], -90.0
    with arm:
        for x_mm, y_mm in places:
            (orientation_rad,) = arm.orientation_rad(np.array([[x_mm, y_mm]]))
            at = arm.measure(Pose(float(x_mm), float(y_mm), float(orientation_rad))).pose
            stand = bench.arm.sensor_pose()
            believed, true = (
                math.degrees(math.atan2(here.y_mm - BASE_MM[1], here.x_mm - BASE_MM[0])) for here in (at, stand)
            )
            off.append(true - believed)
            from_below.append(believed > before)
            before = believed
    return np.array(off), np.array(from_below)


@pytest.mark.parametrize("play_deg", [KNOWN_DEG, 1.5, 2.5])
def test_play_that_the_approach_takes_up_turns_the_arm_by_half_of_what_is_not_known(play_deg, tmp_path):
    """To within two counts of the motor, 0.1 degrees of the base."""
    off, from_below = turned_deg(play_deg, tmp_path / "true.toml")
    assert from_below.any()
    assert not from_below.all()
    np.testing.assert_allclose(off, -(play_deg - KNOWN_DEG) / 2, atol=0.1)
