"""The apparatus, the patterns and the two models of a recording, as drawn for somebody who has just arrived."""

import numpy as np
import pytest
from matplotlib.patches import Circle, Rectangle

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.errors import ParameterError
from probewise.recordings import Recording, read_recording, shipped, two_way_plan
from probewise.report import plots
from probewise.report.plots.apparatus import draw_sensor_face


@pytest.fixture(scope="module")
def recording():
    return read_recording(shipped("paper"))


@pytest.fixture(scope="module")
def geometry():
    return read_geometry(shipped_geometry_path())


def test_the_arm_is_drawn_with_its_sensor_at_the_height_at_which_it_reads(geometry):
    side, above, _ = plots.arm_and_sensor(geometry, (380.0, 170.0))[0]
    lowest = min(p.get_y() for p in side.patches if isinstance(p, Rectangle) and p.get_x() > 100)
    assert lowest == pytest.approx(geometry.read_height_mm)
    ends = np.array([line.get_xydata()[-1] for line in above.lines])
    assert (ends == [380.0, 170.0]).all(axis=1).any()


@pytest.mark.parametrize(("turned_deg", "photodiode"), [(0, (0, 1)), (90, (-1, 0)), (180, (0, -1)), (270, (1, 0))])
def test_the_photodiode_turns_with_the_sensor_as_the_readings_do(turned_deg, photodiode):
    """At 90 degrees the patch that the sensor sees lies to the left, so that the edge is met later: as in the data."""
    ax = plots.grid_of_axes(1, 1, size_in=(2, 2))[0, 0]
    ax.set(xlim=(-1, 1), ylim=(-1, 1))
    draw_sensor_face(ax, size=1.0, turned_rad=np.radians(turned_deg))
    (white,) = (p for p in ax.patches if isinstance(p, Circle) and p.get_facecolor()[:3] == (1, 1, 1))
    center = ax.transData.inverted().transform(white.get_transform().transform(white.get_center()))
    np.testing.assert_allclose(center / np.hypot(*center), photodiode, atol=1e-9)


def test_each_orientation_of_the_boundary_scans_is_drawn_with_its_symbol(recording):
    ax = plots.sensor_orientations(recording)
    drawn = {(line.get_marker(), line.get_color()) for line in ax.lines}
    data = {(line.get_marker(), line.get_color()) for line in plots.readings_by_orientation(recording).lines}
    assert drawn == data
    assert {"0°", "90°", "180°", "270°"} <= {text.get_text() for text in ax.texts}


def test_each_quadrant_holds_its_reading_and_its_corner(recording):
    axes = plots.quadrant_patterns(recording)
    texts = [text.get_text() for ax in axes.flat for text in ax.texts]
    assert [t for t in texts if t.startswith("(")] == ["(0, 0) mm", "(0, 0) mm", "(4, 4) mm", "(−4, 4) mm"]
    assert [float(t) for t in texts if not t.startswith("(")] == pytest.approx(recording.readings[-4:], abs=0.05)


def test_patterns_that_a_recording_does_not_have_are_refused(recording):
    edges = recording.take(np.arange(404))
    with pytest.raises(ParameterError, match="quadrant"):
        plots.quadrant_patterns(edges)
    with pytest.raises(ParameterError, match="half_plane"):
        plots.sensor_orientations(recording.take(np.arange(404, 408)))


def two_models():
    """Readings of a plan by one model, and another that is 2 units off within 6 mm of every edge."""
    plan = two_way_plan()
    after = np.full(len(plan), 30.0)
    before = np.where((np.abs(plan.x_mm) < 6) & (plan.pattern == 0), 32.0, 30.0)
    return Recording(plan, after), before, after


def test_scans_that_the_repair_changes_are_drawn_on_the_same_axes():
    recording, before, after = two_models()
    axes = plots.residuals_by_scan(recording, before, after, most=8)
    shown = [ax for ax in axes.flat if ax.get_visible()]
    assert [ax.get_title(loc="left")[:4] for ax in shown] == ["edge"] * 8
    assert len({ax.get_ylim() for ax in shown}) == 1


@pytest.mark.parametrize("lego_scale", [False, True])
def test_lego_units_stand_over_the_field_only_where_they_are_asked_for(lego_scale):
    ax = plots.playing_field(np.ones((3, 4)), np.arange(4.0), np.arange(3.0), lego_scale=lego_scale)
    assert [axis.get_xlabel() for axis in ax.child_axes if axis.get_xlabel()] == [
        "LEGO distance units (8 mm)"
    ] * lego_scale
