"""Sheets at true scale, measured in the PDF's own drawing."""

import dataclasses
import re
import zlib

import numpy as np
import pytest

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.cli import main
from probewise.errors import ParameterError
from probewise.recordings import paper_plan
from probewise.recordings.patterns import Image, Stripes, Uniform
from probewise.report.plots.sheets import sheets_pdf
from probewise.report.sheets import (
    BOTTOM_MM,
    LEFT_MM,
    OVERLAP_MM,
    Sheet,
    arm_home_jig_sheet,
    field_sheet,
    marks_sheet,
    pattern_sheets,
    target_sheet,
    tiles_of,
)

POINT_MM = 25.4 / 72  # a point of PDF is 1/72 inch
CIRCLE = np.array([600.0, 250.0]) + 80 * np.stack(
    [np.cos(np.linspace(0, 2 * np.pi, 121)), np.sin(np.linspace(0, 2 * np.pi, 121))], axis=-1
)


def pages_of(pdf):
    """Size (mm) of each page with its paths: vertices (mm) and how each is painted, read without matplotlib."""
    boxes = [tuple(map(float, box.split())) for box in re.findall(rb"/MediaBox \[ ?([^\]]*?) ?\]", pdf)]
    streams = [zlib.decompress(s) for s in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.S) if s[:1] == b"x"]
    drawn = [s for s in streams if b" m\n" in s and b"BT" in s]
    assert len(boxes) == len(drawn)
    return [(np.array(box[2:]) * POINT_MM, paths_of(content)) for box, content in zip(boxes, drawn, strict=True)]


def paths_of(content):
    paths, path, stack, to_page, numbers = [], [], [], np.eye(3), []
    for word in re.sub(rb"\((?:\\.|[^\\)])*\)", b"", content, flags=re.S).decode("latin-1").split():
        if re.fullmatch(r"-?\d*\.?\d+", word):
            numbers.append(float(word))
            continue
        if word == "cm":
            a, b, c, d, e, f = numbers
            to_page = np.array([[a, b, 0], [c, d, 0], [e, f, 1]]) @ to_page
        elif word == "q":
            stack.append(to_page)
        elif word == "Q":
            to_page = stack.pop()
        elif word in ("m", "l"):
            path.append((np.array([*numbers, 1.0]) @ to_page)[:2] * POINT_MM)
        elif path and word in ("f", "S", "n", "B", "s"):
            paths.append((word, np.array(path)))
            path = []
        numbers = []
    return paths


def filled(page):
    return [points for how, points in page[1] if how == "f" and (points > 1).all()]  # without the page's own ground


@pytest.mark.parametrize(("paper", "size"), [("a4", (210, 297)), ("letter", (215.9, 279.4))])
def test_the_edge_is_where_it_should_be_and_the_ruler_is_100_mm_long(paper, size):
    plan = paper_plan()
    pages = pages_of(sheets_pdf(pattern_sheets(plan.patterns, plan), paper=paper, title="t"))
    assert len(pages) == 6  # one that explains, five sheets
    page = pages[1]
    assert sorted(page[0]) == pytest.approx(size, abs=0.01)
    black, white = filled(page)[:2]
    assert np.ptp(black, axis=0) == pytest.approx([180, 80], abs=0.01)
    assert white[:, 0].min() - black[:, 0].min() == pytest.approx(90, abs=0.01)
    assert white[:, 0].max() == pytest.approx(black[:, 0].max(), abs=0.01)
    ruler = [points for _, points in page[1] if len(points) == 2 and np.ptp(points[:, 0]) > 95]
    assert any(np.ptp(points[:, 0]) == pytest.approx(100, abs=0.01) for points in ruler)


def test_each_quadrant_has_its_corner_and_its_side():
    plan = paper_plan()
    pages = pages_of(sheets_pdf(pattern_sheets(plan.patterns, plan), paper="a4", title="t"))
    for page, (corner, direction) in zip(
        pages[2:], [((0, 0), (1, 1)), ((0, 0), (-1, 1)), ((4, 4), (1, 1)), ((-4, 4), (-1, 1))], strict=True
    ):
        black, white = filled(page)[:2]
        origin = black.min(axis=0) + 40
        inner = [white[:, k].min() if direction[k] > 0 else white[:, k].max() for k in (0, 1)]
        assert inner - origin == pytest.approx(corner, abs=0.01)


@pytest.mark.slow
def test_the_fields_pages_join_without_gap_or_step():
    sheet = field_sheet((700.0, 340.0), CIRCLE)
    tiles = tiles_of(sheet, "a4")
    assert len(tiles) == 6
    pages = pages_of(sheets_pdf([sheet], paper="a4", title="t"))[1:]
    inked = 0.0
    for tile, page in zip(tiles, pages, strict=True):
        black, white = filled(page)[:2]
        shift = np.array(tile.low_mm) - [LEFT_MM, BOTTOM_MM]
        # The same circle on every page, once each page is laid where its cut says.
        assert white.min(axis=0) + shift == pytest.approx([520, 170], abs=0.02)
        assert white.max(axis=0) + shift == pytest.approx([680, 330], abs=0.02)
        # Black reaches over the cut, where a neighbour lies on it, and ends within the page.
        assert black.min(axis=0) + shift == pytest.approx(tile.low_mm, abs=0.02)
        assert black.max(axis=0) + shift == pytest.approx(np.add(tile.high_mm, tile.beyond_mm), abs=0.02)
        assert (black.max(axis=0) < page[0] - 4).all()
        inked += np.prod(np.subtract(tile.high_mm, tile.low_mm))
    assert inked == pytest.approx(700 * 340)
    assert {tile.beyond_mm[0] for tile in tiles} == {0.0, OVERLAP_MM}


def test_patterns_alone_make_sheets_and_what_no_outline_draws_is_a_picture():
    picture = Image(np.linspace(0, 1, 20).reshape(4, 5), 10.0, (0.0, 0.0), "x.npy")
    sheets = pattern_sheets({"a": Stripes(0.3, 8.0, 0.5, 1.0), "b": picture, "c": Uniform(0.5)})
    assert b"/Subtype /Image" in sheets_pdf(sheets, paper="a4", title="t")


def crosses_in(pdf, sheet):
    """Centres of the crosses of a sheet's pages, in the sheet's frame: lines of 30 mm that cross at their middles."""
    found = []
    for tile, page in zip(tiles_of(sheet, "a4"), pages_of(pdf)[1:], strict=True):
        shift = np.array(tile.low_mm) - [LEFT_MM, BOTTOM_MM]
        lines = [points for how, points in page[1] if how == "S" and len(points) == 2]
        for across in (points for points in lines if np.ptp(points, axis=0) == pytest.approx([30, 0], abs=0.01)):
            found.append(tuple(np.round(across.mean(axis=0) + shift, 2).tolist()))
    return found


@pytest.mark.slow
def test_marks_and_targets_are_at_their_places_of_the_field():
    geometry = read_geometry(shipped_geometry_path())
    sheet = marks_sheet(geometry)
    assert len(sheet.crosses_mm) == 8
    assert geometry.contains(sheet.crosses_mm).all()
    pdf = sheets_pdf([sheet], paper="a4", title="t")
    for tile, page in zip(tiles_of(sheet, "a4"), pages_of(pdf)[1:], strict=True):
        labels = [box for box in filled(page) if np.ptp(box, axis=0).max() < 40]
        assert len(labels) == (tile.column < 5) + (tile.row < 1)
    assert {tuple(mark) for mark in sheet.crosses_mm.tolist()} <= set(crosses_in(pdf, sheet))
    cut = pages_of(sheets_pdf([target_sheet("circle", CIRCLE)], paper="a4", title="t"))[1:]
    assert any(np.ptp(points, axis=0) == pytest.approx([160, 160], abs=0.02) for _, points in cut[0][1])


@pytest.mark.parametrize("elbow_is_relative", [False, True])
def test_the_jig_holds_the_joints_where_the_kinematics_put_them_at_home(elbow_is_relative):
    shipped = read_geometry(shipped_geometry_path())
    elbow = dataclasses.replace(shipped.elbow, home_rad=np.radians(-120.0 if elbow_is_relative else -30.0))
    arm = dataclasses.replace(
        shipped, elbow=elbow, elbow_is_relative=elbow_is_relative, links_mm=(150.0, 120.0), shoulder_mm=(40.0, 60.0)
    )
    side = arm_home_jig_sheet(arm)
    pdf = sheets_pdf([side], paper="a4", title="t")
    wrist = 40 + 120 * np.cos(np.radians(30)), 60 + 150 - 120 * np.sin(np.radians(30))
    face = np.add(wrist, [arm.sensor_mm[0], -arm.sensor_mm[1]])
    expected = [(40, 60), (40, 210), wrist, face]
    assert set(crosses_in(pdf, side)) == {tuple(np.round(place, 2)) for place in expected}
    # The same place and height of the sensor by the arm's own forward kinematics.
    x_mm, y_mm, height_mm = arm.position_mm(np.array([[joint.home_rad for joint in arm.joints]]))[0]
    assert face == pytest.approx([np.hypot(x_mm - arm.axis_mm[0], y_mm - arm.axis_mm[1]), height_mm])
    assert "-90 degrees" in side.lines[-1]
    assert side.low_mm[1] == 0.0  # the cut stands on the table


def test_the_command_writes_the_pages_and_refuses_what_it_cannot_draw(tmp_path, capsys):
    out = tmp_path / "s.pdf"
    assert (
        main(["sheets", "target", "--target", "hexagon:600,250,120,0.3", "--out", str(out), "--paper", "letter"]) == 0
    )
    assert out.read_bytes().startswith(b"%PDF")
    said = capsys.readouterr().out
    assert "cut it out" in said
    assert "replaced" not in said
    assert main(["sheets", "target", "--target", "600,250,80", "--out", str(out)]) == 0
    assert f"note: an earlier {out} was replaced" in capsys.readouterr().out
    for words, told in (
        (["paper", "--paper", "a3"], "--paper is 'a3'; allowed: a4 or letter"),
        (["target"], "--target is missing: give a shape"),
        (["target", "--target", "blob:1,2"], "--target is 'blob:1,2'; allowed: a shape of"),
        (["target", "--target", "600,250,999"], "as the circle's prior has it\n"),
        (["target", "--target", "1040,250,80"], "a shape that lies on the field, 1048 x 520 mm"),
        (["paper", "--target", "600,250,80"], "none with paper"),
        (["nothing.csv"], "nothing.csv"),
    ):
        assert main(["sheets", *words, "--out", str(tmp_path / "no.pdf")]) == 2
        assert told in capsys.readouterr().err
        assert not (tmp_path / "no.pdf").exists()


def test_a_sheet_of_thousands_of_pages_or_of_stripes_that_no_printer_draws_is_refused():
    """A page had 200,000 stripes of a micrometre."""
    with pytest.raises(ParameterError, match=r"period_mm of fine is 0.001; allowed: 0.1 or more"):
        tiles_of(Sheet("fine", Stripes(0.0, 0.001, 0.5, 0.0), (0.0, 0.0), (100.0, 100.0)), "a4")
    with pytest.raises(ParameterError, match="a sheet of 400 pages at most"):
        tiles_of(Sheet("huge", Uniform(0.0), (0.0, 0.0), (1e5, 1e5)), "a4")
