"""The apparatus, the patterns and the two models of a recording, as drawn for somebody who has just arrived."""

import numpy as np
import pytest
from matplotlib.patches import Circle, Rectangle

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.recordings import read_recording, shipped
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
