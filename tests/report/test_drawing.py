"""Line drawings: axes at round values, marks where they belong, nothing outside the sheet."""

import re
import subprocess
import sys
from xml.etree import ElementTree

import numpy as np
import pytest

from probewise.report.drawing import Band, Bars, Boxes, Dots, Line, Panel, Rule, Span, drawing
from probewise.report.drawing.frame import Frame, ticks

X = np.linspace(0.0, 10.0, 11)
EVERY_MARK = (
    Span(2.0, 3.0, "span"),
    Band(X, -np.ones(11), np.ones(11), "band"),
    Boxes(X, -np.ones(11), np.ones(11)),
    Dots(X, X / 10, "dots"),
    Line(X, X / 10, "line", knots=True),
    Rule(0.0),
    Rule(5.0, upright=True),
)


def pieces(svg, kind):
    return [element for element in ElementTree.fromstring(svg).iter() if element.tag.endswith(kind)]


def test_every_mark_is_drawn_within_the_sheet():
    svg = drawing([[Panel(EVERY_MARK, x="X (mm)", y="reading", title="all of them")]])
    root = ElementTree.fromstring(svg)
    width, height = float(root.get("width")), float(root.get("height"))
    for element in pieces(svg, "text"):
        assert 0 <= float(element.get("x")) <= width
        assert 0 <= float(element.get("y")) <= height
    for element in pieces(svg, "path"):
        for x, y in re.findall(r"[M ](-?[0-9.]+),(-?[0-9.]+)", element.get("d")):
            assert 0 <= float(x) <= width
            assert 0 <= float(y) <= height
    said = [element.text for element in pieces(svg, "text")]
    assert {"span", "band", "dots", "line", "X (mm)", "reading", "all of them"} <= set(said)


def test_values_are_mapped_linearly_and_up_is_up():
    frame = Frame(100.0, 10.0, 200.0, 50.0, (0.0, 4.0), (-1.0, 1.0))
    np.testing.assert_allclose(frame.px_of_x(np.array([0.0, 1.0, 4.0])), [100.0, 150.0, 300.0])
    np.testing.assert_allclose(frame.px_of_y(np.array([1.0, 0.0, -1.0])), [10.0, 35.0, 60.0])


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (0.0, 1.25, ["0", "0.5", "1.0"]),
        (-52.0, 51.0, ["−50", "0", "50"]),
        (0.0, 2600.0, ["0", "1,000", "2,000"]),
        (0.0123, 0.0131, ["0.0124", "0.0126", "0.0128", "0.0130"]),
        (-1.7, 1.7, ["−1", "0", "1"]),
    ],
)
def test_ticks_stand_at_round_values(low, high, labels):
    assert [label for _, label in ticks(low, high, 4)] == labels


def test_a_bar_ends_at_its_value_and_says_it():
    svg = drawing([[Panel((Bars(np.array([0.5, 1.0]), ["#111", "#222"], ["half", "one"]),), x_ends=(0.0, 2.0))]])
    short, long = (e for e in pieces(svg, "rect") if e.get("fill") in ("#111", "#222"))
    assert float(long.get("width")) == pytest.approx(2 * float(short.get("width")), abs=0.2)
    assert {"half", "one"} <= {element.text for element in pieces(svg, "text")}


def test_nothing_to_draw_is_drawn_as_empty_axes():
    nothing = np.empty(0)
    svg = drawing([[Panel((Line(nothing, nothing), Dots(nothing, nothing), Dots(X, np.full(11, np.nan))))]])
    assert b"nan" not in svg


def test_a_hundred_thousand_dots_stay_a_small_file():
    rng = np.random.default_rng(0)
    svg = drawing([[Panel((Dots(rng.random(100_000), rng.standard_normal(100_000)),))]])
    assert len(svg) < 1_000_000


def test_names_are_escaped():
    assert b"a &lt; b" in drawing([[Panel((Line(X, X, "a < b"),))]])


def test_a_diagnosis_and_its_page_need_no_plotting_library():
    """A second of its start alone is a fifth of what a whole diagnosis may take."""
    asked = "import sys, probewise.cli.diagnose, probewise.diagnosis, probewise.report.diagnosis; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout.split()
    assert not {"matplotlib", "scipy.stats", "scipy.spatial", "scipy.optimize"} & set(loaded)
