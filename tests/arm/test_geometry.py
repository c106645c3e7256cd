"""The arm's geometry: kinematics by two routes, reach, the file; and fitted to marks."""

import dataclasses
import math
import re

import numpy as np
import pytest

from probewise.arm import Joint, read_geometry, shipped_geometry_path
from probewise.arm.fitting import (
    MarksDisagreeError,
    fit_geometry,
    read_turns_and_places,
    spread_mark_places,
    write_marks,
)
from probewise.arm.geometry_file import text_with_fitted_values
from probewise.errors import FileError, ParameterError

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


BLOCK_MM = 32.0


def built(base=2.0, shoulder=-2.0, elbow=-2.0, off_mm=3.0, geometry=SHIPPED):
    """The arm as it really is: home angles and lengths differ from those of the file."""
    joints = {
        name: dataclasses.replace(getattr(geometry, name), home_rad=getattr(geometry, name).home_rad + math.radians(by))
        for name, by in (("base", base), ("shoulder", shoulder), ("elbow", elbow))
    }
    (x, y), (forward, up), (upper, lower) = geometry.axis_mm, geometry.shoulder_mm, geometry.links_mm
    return dataclasses.replace(
        geometry,
        axis_mm=(x + off_mm, y - off_mm),
        shoulder_mm=(forward + off_mm, up - off_mm),
        links_mm=(upper + off_mm, lower - off_mm),
        **joints,
    )


def homes(geometry):
    return np.array([joint.home_rad for joint in geometry.joints])


def touched(true, *, noise_mm=0.0, rng=None, marks=None):
    marks = spread_mark_places(SHIPPED) if marks is None else marks
    turned = true.angles_rad(marks, BLOCK_MM) - homes(true)
    places = np.column_stack([marks, np.full(len(marks), BLOCK_MM)])
    if noise_mm:
        places = places + rng.normal(0.0, noise_mm, places.shape)
    return turned, places


def errors_mm(fitted, true):
    """Where the sensor really is, less where it is sent, all over the field: (n, 3)."""
    places = SHIPPED.reachable_grid_mm
    places = places[fitted.contains(places)]
    angles = fitted.angles_rad(places, SHIPPED.read_height_mm) - homes(fitted) + homes(true)
    return true.position_mm(angles) - np.column_stack([places, np.full(len(places), SHIPPED.read_height_mm)])


@pytest.mark.parametrize("signs", [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_two_degrees_and_three_mm_are_found(signs):
    true = built(*(2.0 * sign for sign in signs))
    assert np.abs(errors_mm(SHIPPED, true)).max() > 15  # as the file stands
    fitted = fit_geometry(SHIPPED, *touched(true)).geometry
    off = errors_mm(fitted, true)
    assert np.abs(off[:, :2]).max() < 1.0
    assert np.abs(off[:, 2]).max() < 1.0


@pytest.mark.slow
def test_claimed_sds_hold_over_many_arms():
    """Place and height, in units of the claimed variance: 1 on average; 100 arms, each marked anew."""
    rng = np.random.default_rng(20)
    place, height = [], []
    for _ in range(100):
        true = built(*rng.normal(0.0, 2.0, 3), off_mm=float(rng.normal(0.0, 3.0)))
        found = fit_geometry(SHIPPED, *touched(true, noise_mm=1.0, rng=rng)).geometry
        off = errors_mm(found, true)
        place.append((off[:, :2] ** 2).mean() / found.accuracy.place_sd_mm**2)
        height.append((off[:, 2] ** 2).max() / found.accuracy.height_sd_mm**2)
    assert 0.7 < np.mean(place) < 1.3
    assert 0.5 < np.mean(height) < 1.6


def test_a_mark_that_was_only_seen_gives_its_place():
    turned, places = touched(built())
    places[::3, 2] = np.nan
    found = fit_geometry(SHIPPED, turned, places)
    assert np.isnan(found.residuals_mm[0, 2])
    assert found.geometry.links_mm[0] == pytest.approx(353, abs=2.5)


def test_the_mark_that_disagrees_is_named():
    turned, places = touched(built())
    places[3, 0] += 12
    with pytest.raises(MarksDisagreeError, match=r"all but mark 4 agree, and it is 1\d mm off: bring the sensor there"):
        fit_geometry(SHIPPED, turned, places)


def test_marks_that_no_arm_explains_are_refused():
    turned, places = touched(built())
    places[:, 0] = places[::-1, 0]
    with pytest.raises(MarksDisagreeError, match="gears that do not slip"):
        fit_geometry(SHIPPED, turned, places)


def test_marks_that_do_not_determine_the_geometry_are_refused():
    near = np.array([[500.0 + 10 * k, 300.0] for k in range(6)])
    turned, places = touched(built(), marks=near)
    with pytest.raises(ParameterError, match=r"6 that leave the height open.*near and far from the base"):
        fit_geometry(SHIPPED, turned, places)
    seen, places = touched(built())
    places[:, 2] = np.nan
    with pytest.raises(ParameterError, match=r"8 that leave the height open to \d\d.\d mm and the place to 1.\d mm"):
        fit_geometry(SHIPPED, seen, places)
    with pytest.raises(ParameterError, match="marks is 4; allowed: 5 or more"):
        fit_geometry(SHIPPED, turned[:4], places[:4])


def test_the_file_keeps_its_comments_and_reads_back_as_fitted(tmp_path):
    text = shipped_geometry_path().read_text(encoding="utf-8")
    fitted = fit_geometry(SHIPPED, *touched(built())).geometry
    (tmp_path / "arm.toml").write_text(text_with_fitted_values(text, fitted), encoding="utf-8")
    back = read_geometry(tmp_path / "arm.toml")
    assert "# shoulder to elbow" in (tmp_path / "arm.toml").read_text(encoding="utf-8")
    assert back.accuracy.marks == len(spread_mark_places(SHIPPED))
    np.testing.assert_allclose(homes(back), homes(fitted), atol=1e-6)
    np.testing.assert_allclose(
        [*back.links_mm, *back.axis_mm, *back.shoulder_mm],
        [*fitted.links_mm, *fitted.axis_mm, *fitted.shoulder_mm],
        atol=1e-4,
    )
    # What a motor may turn is as it was: limits are counted from home.
    for was, is_ in zip(SHIPPED.joints, back.joints, strict=True):
        assert is_.high_rad - is_.home_rad == pytest.approx(was.high_rad - was.home_rad, abs=1e-5)
    again = text_with_fitted_values((tmp_path / "arm.toml").read_text(encoding="utf-8"), fitted)
    assert again.count("[accuracy]") == 1


@pytest.mark.parametrize(
    ("line", "instead", "name"),
    [
        ("upper_mm = 350", '"upper_mm" = 350', "links.upper_mm"),
        ('[joints.base]\nport = "A"\n', '[joints]\nbase = { port = "A", home_deg = -90 }\n', "joints.base.home_deg"),
    ],
)
def test_a_number_that_cannot_be_replaced_in_its_file_is_refused(line, instead, name):
    """It would stay, beside the accuracy of the fitted one."""
    text = shipped_geometry_path().read_text(encoding="utf-8")
    assert line in text
    with pytest.raises(ParameterError, match=rf"{name} is 'written in another way'; allowed: .* on a line of its own"):
        text_with_fitted_values(text.replace(line, instead, 1), SHIPPED)


def test_marks_come_back_from_their_file(tmp_path):
    marks = [[0.1, -0.2, 0.3, 100.0, 60.0, 32.0], [0.4, 0.5, -0.6, 520.0, 60.0, math.nan]]
    write_marks(marks, tmp_path / "m.csv")
    turned, places = read_turns_and_places(tmp_path / "m.csv")
    np.testing.assert_allclose(turned, [mark[:3] for mark in marks], atol=1e-6)
    np.testing.assert_array_equal(places, [mark[3:] for mark in marks])
    (tmp_path / "m.csv").write_text("x_mm,y_mm\n1,2\n")
    with pytest.raises(FileError, match="base_turned_deg"):
        read_turns_and_places(tmp_path / "m.csv")


def test_what_a_wrong_home_costs_is_told_from_the_geometry():
    """Both links two degrees off, worked out by moving them; a fitted geometry knows better."""
    places = SHIPPED.reachable_grid_mm
    angles = SHIPPED.angles_rad(places, 14.0)
    lower = angles - np.radians([0.0, 2.0, 2.0])
    sinks = 14.0 - SHIPPED.position_mm(lower)[:, 2]
    assert SHIPPED.max_height_error_mm == pytest.approx(sinks.max(), rel=0.05)
    fitted = fit_geometry(SHIPPED, *touched(built())).geometry
    assert fitted.max_height_error_mm == 2 * fitted.accuracy.height_sd_mm < 6
