"""A brick whose gears play more than its geometry file says: what that does to readings, and what a run says of it.

The driver ends every move of the base in the same direction. As long as its approach takes up the play, the arm is
turned by half of the play that is not known, wherever it came from: to the arm that is another circle.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from probewise.arm import Pose, read_geometry, shipped_geometry_path
from probewise.cli._bench import open_emulated_arm_and_bench
from probewise.recordings import Disc
from probewise.world.shipped import true_world

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
