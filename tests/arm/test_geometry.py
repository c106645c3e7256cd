"""The arm's geometry: kinematics by two routes, reach, orientation, the file."""

import dataclasses
import math
import re

import numpy as np
import pytest

from probewise.arm import Joint, read_geometry, shipped_geometry_path
from probewise.errors import FileError

SHIPPED = read_geometry(shipped_geometry_path())
RELATIVE = dataclasses.replace(
    SHIPPED, elbow_is_relative=True, elbow=dataclasses.replace(SHIPPED.elbow, low_rad=-3.1, high_rad=0.0)
)
GRID = np.stack(np.meshgrid(np.linspace(0, 1048, 50), np.linspace(0, 520, 30)), axis=-1).reshape(-1, 2)


def by_complex_numbers(geometry, base, shoulder, elbow):
    """Add up the arm as arrows in the plane of its links, one after another."""
    lower = shoulder + elbow if geometry.elbow_is_relative else elbow
    tip = complex(*geometry.shoulder_mm)
    tip += geometry.links_mm[0] * complex(math.cos(shoulder), math.sin(shoulder))
    tip += geometry.links_mm[1] * complex(math.cos(lower), math.sin(lower))
    tip += complex(geometry.sensor_mm[0], -geometry.sensor_mm[1])
    place = complex(*geometry.axis_mm) + tip.real * complex(math.cos(base), math.sin(base))
    return place.real, place.imag, tip.imag


@pytest.mark.parametrize("geometry", [SHIPPED, RELATIVE], ids=["absolute", "relative"])
def test_forward_kinematics_agree_with_arrows_in_the_plane(geometry):
    angles = np.random.default_rng(1).uniform(-3, 3, (200, 3))
    np.testing.assert_allclose(
        geometry.position_mm(angles), [by_complex_numbers(geometry, *row) for row in angles], atol=1e-9
    )


@pytest.mark.parametrize("geometry", [SHIPPED, RELATIVE], ids=["absolute", "relative"])
@pytest.mark.parametrize("height_mm", [14.0, 60.0])
def test_inverse_kinematics_lead_back_by_the_arrows(geometry, height_mm):
    angles = geometry.angles_rad(GRID, height_mm)
    solved = np.isfinite(angles).all(axis=-1)
    assert solved.mean() > 0.7
    back = np.array([by_complex_numbers(geometry, *row) for row in angles[solved]])
    np.testing.assert_allclose(back[:, :2], GRID[solved], atol=1e-9)
    np.testing.assert_allclose(back[:, 2], height_mm, atol=1e-9)


# What a person may get wrong in the file, the line to spoil it with, and what is said.
SPOILED = [
    ('format = "arm/1"', 'format = "arm/2"', 'format is "arm/2"; allowed: "arm/1"'),
    ("x_mm = 524", "", "base.x_mm is missing"),
    ("x_mm = 524", "x_mm = nan", "base.x_mm is NaN"),
    ("x_mm = 524", "x_mn = 524\nx_mm = 524", "base.x_mn is not known"),
    ("upper_mm = 350", "upper_mm = 0", "links_mm is 0.0; allowed: greater than 0"),
    ("port = 1\n", "port = 5\n", "sensor.port is 5; allowed: 1, 2, 3 or 4"),
    ("read_height_mm = 14", "read_height_mm = 70", "heights above 0, each above the one before"),
    ("whole_percent = true", "whole_percent = 1", "sensor.whole_percent is 1; allowed: true or false"),
    ('port = "A"', 'port = "D"', 'joints.base.port is "D"'),
    ('port = "A"', 'port = "B"', "a port of its own for each joint"),
    ("gear_ratio = 21", "gear_ratio = 0", "joints.base.gear_ratio is 0.0"),
    ("home_deg = -90", "home_deg = 90", "joints.base.home_deg is"),
    ("low_deg = -190", "low_deg = 190", "the low one below the high"),
    ("play_deg = 0.3", "play_deg = 0.3\nstop_deg = -100", "joints.base.stop_deg is -100.0"),
    ("home_deg = 90", "home_deg = 90\nstop_deg = -25", "not -178 mm"),
    ("[links]", "[lines]", "links is missing"),
    ("[field]", "[field", "not TOML"),
]


@pytest.mark.parametrize(("line", "instead", "says"), SPOILED, ids=[f"{k} {s[1]!r}" for k, s in enumerate(SPOILED)])
def test_a_file_that_cannot_be_used_is_refused_with_the_entry_named(tmp_path, line, instead, says):
    text = shipped_geometry_path().read_text()
    assert line in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(line, instead, 1))
    with pytest.raises(FileError, match=re.escape(says)) as caught:
        read_geometry(path)
    assert "mine.toml" in str(caught.value)


def test_a_file_that_is_not_there_or_not_text_is_refused(tmp_path):
    with pytest.raises(FileError, match="there is no such file"):
        read_geometry(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xff")
    with pytest.raises(FileError, match="UTF-8"):
        read_geometry(tmp_path / "bytes.toml")


def test_the_examples_hold_the_shipped_file():
    example = shipped_geometry_path().parents[3] / "examples" / "lego_arm.toml"
    if not example.exists():
        pytest.skip("no examples beside an installed package")
    assert example.read_text() == shipped_geometry_path().read_text()


@pytest.mark.parametrize(("stop_rad", "side", "counts"), [(1.1, 1, 447), (-1.0, -1, -407)])
def test_the_count_at_a_stop_has_the_play_on_its_side(stop_rad, side, counts):
    """7 turns of 180 / pi degrees for a radian: 401.07 counts, and half the play, 0.03 / 2, beyond the stop."""
    joint = Joint(0, 7.0, 0.0, -1.0, 1.0, 0.03, stop_rad)
    assert joint.stop_side == side
    assert joint.stop_counts == counts
