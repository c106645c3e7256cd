"""Centre, widths and angle of an SSF, against a covariance turned by hand."""

import numpy as np
import pytest

from probewise.calibration import ssf_quantities


def parameters(sd_long, sd_short, angle_deg, centre=(0.3, 1.5), mass=1.0):
    """The paper's a, u, v, A, B, C of a Gaussian with these widths, turned anticlockwise: half the inverse."""
    turn = np.radians(angle_deg)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    matrix = 0.5 * np.linalg.inv(axes @ np.diag([sd_long**2, sd_short**2]) @ axes.T)
    amplitude = mass * np.sqrt(np.linalg.det(matrix))
    return [amplitude, *centre, matrix[0, 0], matrix[1, 1], matrix[0, 1]]


def by_name(samples, n_gaussians=1):
    return {q.name: q for q in ssf_quantities(np.array(samples), n_gaussians)}


@pytest.mark.parametrize("angle_deg", [-60.0, 0.0, 10.0, 80.0])
def test_widths_and_angle_are_those_that_the_covariance_was_made_of(angle_deg):
    found = by_name([parameters(4.0, 2.4, angle_deg)] * 5)
    assert list(found) == ["centre_u_mm", "centre_v_mm", "sd_long_mm", "sd_short_mm", "angle_deg"]
    medians = [q.median for q in found.values()]
    assert medians == pytest.approx([0.3, 1.5, 4.0, 2.4, angle_deg], abs=1e-9)


def test_an_axis_has_no_direction():
    """Angles on either side of 90 degrees are neighbours: their interval is narrow."""
    found = by_name([parameters(4.0, 2.4, angle) for angle in np.linspace(84.0, 98.0, 50)])["angle_deg"]
    low, high = found.interval95
    assert high - low == pytest.approx(14.0, abs=0.8)
    assert found.median % 180.0 == pytest.approx(91.0, abs=0.2)


def test_two_gaussians_are_summed_up_as_a_whole_and_one_by_one():
    """Two alike, 6 mm apart along u: the variances between and within add up."""
    rows = [[*parameters(2.0, 1.0, 0.0, (-3.0, 0.0), 3.0), *parameters(2.0, 1.0, 0.0, (3.0, 0.0), 1.0)]] * 3
    found = by_name(rows, 2)
    assert found["centre_u_mm"].median == pytest.approx(-1.5)
    assert found["sd_long_mm"].median == pytest.approx(np.sqrt(4.0 + 0.75 * 0.25 * 36.0))
    assert found["gaussian_1.share"].median == pytest.approx(0.75)
    assert found["gaussian_2.centre_u_mm"].median == pytest.approx(3.0)
    assert found["gaussian_2.sd_short_mm"].median == pytest.approx(1.0)
