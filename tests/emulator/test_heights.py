"""`arm heights` on the emulator: the light against where the emulated sensor truly hangs."""

import re

import numpy as np
import pytest

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.cli import main
from probewise.cli._bench import open_emulated_arm_and_bench
from probewise.recordings import Uniform
from probewise.world.shipped import true_world

PLACES = ["524,260", "120,80", "520,390"]
HANGS = re.compile(r"it hangs ([\d.]+) ± ([\d.]+) mm (higher|lower)")


def built(tmp_path, home_deg):
    """Write the file of an arm whose elbow stands otherwise at home."""
    file = tmp_path / "true.toml"
    head, mark, rest = shipped_geometry_path().read_text(encoding="utf-8").partition("[joints.elbow]")
    file.write_text(head + mark + rest.replace("home_deg = -20", f"home_deg = {home_deg}", 1), encoding="utf-8")
    return file


def true_off_mm(file):
    """Look where the sensor of that arm hangs, relative to the first place."""
    geometry = read_geometry(shipped_geometry_path())
    lego, bench = open_emulated_arm_and_bench(geometry, file, true_world("paper"), Uniform(1.0), seed=1)
    off = []
    with lego as arm:
        for text in PLACES:
            arm.go_down(*map(float, text.split(",")))
            off.append(bench.arm.sensor_pose().height_mm - arm.position_mm[2])
    return np.array(off[1:]) - off[0]


def test_a_home_angle_that_is_off_shows_in_the_light_by_its_millimetres(tmp_path, capsys):
    file = built(tmp_path, -21)
    assert main(["arm", "heights", *PLACES, "--arm", f"emulator:{file}"]) == 0
    said = capsys.readouterr()
    assert "the light contradicts the heights" in said.err
    found = [(float(mm) * (1 if side == "higher" else -1), float(sd)) for mm, sd, side in HANGS.findall(said.out)]
    off, sd = np.array(found).T
    true = true_off_mm(file)
    assert np.abs(true).max() > 1.0
    np.testing.assert_array_less(np.abs(off - true), 3 * sd + 0.1 * np.abs(true))


def test_an_arm_that_is_as_its_file_says_is_not_contradicted(capsys):
    assert main(["arm", "heights", *PLACES, "--arm", "emulator"]) == 0
    said = capsys.readouterr()
    assert "agree with the counters" in said.out
    assert said.err == ""
    # The LED's half goes with h exp(-h / 8 mm), the room's half with nothing.
    fall = (1 / 8 - 1 / 14) / 2
    assert float(re.search(r"light_per_mm = ([\d.]+)", said.out)[1]) == pytest.approx(fall, rel=0.2)
