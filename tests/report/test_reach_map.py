"""The drawing of an arm's reach: its colours are those of the angles that there are."""

import numpy as np
import pytest

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.report.plots import reach_map

X, Y = np.linspace(0.0, 1048.0, 27), np.linspace(0.0, 520.0, 14)


@pytest.mark.parametrize("mounted_deg", [180.0, 0.0, 77.0])
def test_the_colours_span_the_angles_that_there_are_also_across_180_degrees(mounted_deg):
    """The sensor turns by less than half a turn over the field, however it is mounted."""
    geometry = read_geometry(shipped_geometry_path())
    places = np.stack(np.meshgrid(X, Y), axis=-1).reshape(-1, 2)
    standing = geometry.orientation_rad(places) + np.radians(mounted_deg - 180.0)
    held = np.where(geometry.contains(places), (standing + np.pi) % (2 * np.pi) - np.pi, np.nan).reshape(Y.size, X.size)
    ax = reach_map(held, X, Y, axis_mm=geometry.axis_mm)
    low, high = ax.images[0].get_clim()
    assert 150 < high - low < 180
    drawn = np.ma.filled(ax.images[0].get_array(), np.nan)
    np.testing.assert_allclose(np.exp(1j * np.radians(drawn)), np.exp(1j * held), atol=1e-9)
    ax.figure.canvas.draw()
    ticks = [label.get_text() for label in ax.child_axes[-1].get_yticklabels()]
    assert len(ticks) >= 10
    assert all(-180 <= float(tick.replace("−", "-")) <= 180 for tick in ticks)


def test_an_arm_that_reaches_nothing_can_be_drawn():
    assert reach_map(np.full((14, 27), np.nan), X, Y, axis_mm=(524.0, 580.0)).get_title(loc="left").startswith("0 %")
