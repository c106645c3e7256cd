"""Figures show the data that they are given, and leave nothing behind."""

import numpy as np
import pytest

from probewise.recordings import Recording, paper_plan, read_recording, shipped
from probewise.report import plots
from probewise.report.plots.readings import tracks_and_single_rows


@pytest.fixture(scope="module")
def recording():
    return read_recording(shipped("paper"))


def test_the_papers_plan_has_four_lines_and_four_readings_alone():
    found, alone = tracks_and_single_rows(paper_plan())
    assert [len(t.rows) for t in found] == [101] * 4
    assert [t.label for t in found] == ["0°", "90°", "180°", "270°"]
    assert len(alone) == 4
    for track in found:
        np.testing.assert_allclose(np.sort(track.along_mm), np.arange(-50.0, 51.0), atol=1e-9)


def test_predictions_get_a_panel_a_scan_and_one_for_the_readings_alone(recording):
    axes = plots.predicted_and_recorded_by_scan(recording, recording.readings, np.ones(len(recording)))
    assert sum(ax.get_visible() for ax in axes.flat) == 5
    plan = read_recording(shipped("concealed")).plan
    many = Recording(plan, np.full(len(plan), 30.0))
    axes = plots.predicted_and_recorded_by_scan(many, many.readings, np.ones(len(many)))
    assert sum(ax.get_visible() for ax in axes.flat) <= 8


def test_the_field_shows_readings_by_brightness_and_the_next_place():
    x, y = np.linspace(0, 1048, 131), np.linspace(0, 520, 65)
    utility = np.ones((65, 131))
    utility[:5] = np.nan
    ax = plots.playing_field(
        utility,
        x,
        y,
        outlines_mm=[np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [0.0, 0.0]])],
        places_mm=np.array([[100.0, 100.0], [200.0, 100.0]]),
        readings=np.array([10.0, 60.0]),
        levels=(10.0, 60.0),
        next_mm=(300.0, 100.0),
    )
    squares, green = ax.collections[1:]
    np.testing.assert_allclose(squares.get_facecolors()[:, :3], [[0, 0, 0], [1, 1, 1]])
    np.testing.assert_allclose(green.get_offsets(), [[300.0, 100.0]])
    assert "mm" in ax.get_xlabel()


def test_a_long_label_of_a_bar_is_broken_into_lines_that_leave_room_for_the_bar():
    long = "a cubic term of x in the rate of v, noise that grows with the signal and an offset of u_v"
    ax = plots.hypothesis_probabilities([f"{long} and {long}", "b", f"{long}, {long}"], [0.6, 0.3, 0.1])
    ax.figure.canvas.draw()
    assert ax.get_window_extent().width > 0.4 * ax.figure.bbox.width


@pytest.mark.slow
def test_probabilities_that_are_not_drawn_one_by_one_are_added_up():
    ax = plots.hypothesis_probabilities([str(k) for k in range(20)], np.full(20, 0.05), most=8)
    widths = [bar.get_width() for bar in ax.patches]
    assert len(widths) == 9
    assert sum(widths) == pytest.approx(1.0)


@pytest.mark.parametrize("repeats", [1, 2, 5])
def test_many_long_names_above_a_single_round_leave_room_for_its_bar(repeats):
    """Warnings are errors: matplotlib warns where a legend leaves its axes no width or no height."""
    long = " and ".join(["noise that grows with the signal and an effect with a long name"] * repeats)
    names = [f"{long}, number {k}" for k in range(9)]
    assert plots.png(plots.probabilities_by_round({"round 1: 30 readings": dict.fromkeys(names, 1 / 9)}), dpi=30)
