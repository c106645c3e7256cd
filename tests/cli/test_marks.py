"""The geometry fitted at the emulated bench, and sheets that are watched while a plan is carried out."""

import dataclasses
import math
import re

import numpy as np
import pytest

from probewise.arm import DryRun, LegoArm, read_geometry, shipped_geometry_path
from probewise.arm.fitting import write_marks
from probewise.arm.geometry import Accuracy
from probewise.cli import main
from probewise.cli._bench import warn_if_place_sd_large
from probewise.cli.arm import SheetCheck, bring_to_mark, place_after_moves
from probewise.recordings import hold_lock, paper_plan, write_plan

OFF = {"x_mm": 3, "y_mm": -3, "shoulder_forward_mm": 3, "shoulder_height_mm": -3, "upper_mm": 3, "lower_mm": -3}


@pytest.fixture
def true_toml(tmp_path):
    """The shipped arm, its lengths 3 mm and its home angles 2 degrees off."""
    text = shipped_geometry_path().read_text(encoding="utf-8")
    for name, by in OFF.items():
        text = re.sub(
            rf"^{name} = (\d+)", lambda found, by=by, name=name: f"{name} = {int(found[1]) + by}", text, flags=re.M
        )
    text = re.sub(r"^home_deg = (-?\d+)", lambda found: f"home_deg = {int(found[1]) - 2}", text, flags=re.M)
    path = tmp_path / "true.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def edge_plan(tmp_path):
    plan = paper_plan()
    write_plan(plan.take(np.r_[0:101:10]), tmp_path / "plan.csv")
    return tmp_path / "plan.csv"


@pytest.mark.slow
def test_an_arm_that_is_built_otherwise_is_fitted_and_records_without_touching_the_table(
    true_toml, edge_plan, tmp_path, capsys
):
    out, arm = tmp_path / "fitted.toml", f"emulator:{true_toml}"
    told = ["arm", "record", str(edge_plan), "--arm", arm, "--quiet", "--origin-mm", "524,60"]
    assert main([*told, "--out", str(tmp_path / "wrong.csv")]) == 0
    said = capsys.readouterr().err
    assert "the sensor may touch the table: it reads 14 mm above it" in said
    assert re.search(r"the emulated arm's sensor went \d+\.\d mm through the table", said)
    assert main(["arm", "fit-geometry", "--arm", arm, "--out", str(out)]) == 0
    fitted = read_geometry(out)
    assert fitted.links_mm == pytest.approx((353, 347), abs=6)
    assert math.degrees(fitted.base.home_rad) == pytest.approx(-92, abs=0.2)
    capsys.readouterr()
    assert main([*told, "--geometry", str(out), "--out", str(tmp_path / "right.csv")]) == 0
    assert capsys.readouterr().err == ""
    # The same marks fit again without an arm.
    again = [
        "arm",
        "fit-geometry",
        "--marks",
        str(tmp_path / "fitted.marks.csv"),
        "--out",
        str(tmp_path / "again.toml"),
    ]
    assert main(again) == 0
    assert (tmp_path / "again.toml").read_text() == out.read_text()


def test_marks_that_another_process_has_or_has_added_to_stay_as_they_are(tmp_path, monkeypatch, capsys):
    words = ["arm", "fit-geometry", "--arm", "emulator", "--out", str(tmp_path / "a.toml"), "--resume"]
    kept = tmp_path / "a.marks.csv"
    write_marks([[0.1, 0.2, 0.3, 500, 250, 32]], kept)
    before = kept.read_bytes()
    with hold_lock(kept):
        assert main(words) == 2
    assert "a.marks.csv: another process is writing to it" in capsys.readouterr().err
    monkeypatch.setattr("probewise.cli.arm.content_if_there", lambda path: b"an earlier one")
    assert main(words) == 2
    assert "a.marks.csv: another process has written to it; allowed: to resume it once" in capsys.readouterr().err
    assert kept.read_bytes() == before


def test_an_arm_that_is_known_less_well_than_a_shape_is_to_be_says_so_before_it_moves(capsys):
    shipped = read_geometry(shipped_geometry_path())
    for place_sd_mm, warned in ((4.5, True), (0.6, False)):
        rows = tuple((0.0,) * 9 for _ in range(9))
        warn_if_place_sd_large(dataclasses.replace(shipped, accuracy=Accuracy(8, place_sd_mm, 1.0, 0.01, rows)), 4.0)
        assert (
            "lengths will not be known to 4 mm: the arm knows its place to 4.5 mm" in capsys.readouterr().err
        ) == warned
    warn_if_place_sd_large(shipped, 4.0)
    assert capsys.readouterr().err == ""


def test_a_person_moves_the_sensor_in_words_and_is_told_what_cannot_be_done():
    geometry = read_geometry(shipped_geometry_path())
    arm = LegoArm(DryRun(geometry, lambda text: None), geometry)
    said, answers = [], iter(["", "x 4 y -2", "sideways", "down 55", "up 3", "ok"])
    with arm:
        met = bring_to_mark(arm, (520.0, 260.0), 32.0, lambda: next(answers), said.append)
    homes = np.array([joint.home_rad for joint in geometry.joints])
    x, y, height = geometry.position_mm((np.array(met[:3]) + homes)[None, :])[0]
    assert (x, y, height) == pytest.approx((524, 258, 60 - 5 + 3), abs=1.0)
    assert met[3:] == [520.0, 260.0, 32.0]
    assert any("'sideways' says nothing" in text for text in said)
    assert any("8 mm or more" in text for text in said)  # the guard refused 55 mm down


@pytest.mark.parametrize(
    ("answer", "moved"),
    [
        ("", (1, 2, 55)),
        ("down 2", (1, 2, 58)),
        ("x 1 y 1 up 1", (2, 3, 61)),
        ("x", None),
        ("x 1e9", None),
        ("z 1", None),
    ],
)
def test_an_answer_is_a_move_or_nothing(answer, moved):
    assert place_after_moves((1, 2, 60), answer) == moved


def edge(n=101):
    return paper_plan().take(np.arange(n))


def test_a_scan_that_starts_over_the_wrong_side_is_told_of_at_the_first_reading_that_shows_it():
    watch = SheetCheck(edge(), white_is_bright=True)
    said = [watch.complaint_about_reading(row, 58.0 if row < 40 else 14.0) for row in range(101)]
    first = next(k for k, text in enumerate(said) if text)
    assert first == 65  # the first that is all white, and dark
    assert "at (15, 0) mm it is white, and reads 14, where black read 58" in said[first]


def test_a_right_scan_is_not_told_of():
    plan = edge()
    noise = np.random.default_rng(3).normal(0.0, 1.5, len(plan))
    watch = SheetCheck(plan, white_is_bright=True)
    levels = 14 + 44 / (1 + np.exp(-plan.x_mm / 3))
    assert not any(watch.complaint_about_reading(row, float(value)) for row, value in enumerate(levels + noise))
