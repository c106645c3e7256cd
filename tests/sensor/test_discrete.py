"""The paper's sum over pixels against the closed forms: the second route to the response."""

import numpy as np
import pytest
from scipy.special import ndtr

from probewise.errors import ShapeError
from probewise.recordings import patterns as kinds
from probewise.scene import disc_region, region_of
from probewise.sensor import FixedMixture, Poses, mean_albedo_by_pixels, mean_ssf_field

MIXTURE = FixedMixture([1.0], [[0.7, 1.3]], [[[20.0, 6.0], [6.0, 30.0]]])


def poses_about(n_points, seed=2):
    rng = np.random.default_rng(seed)
    return Poses(
        rng.uniform(-15, 15, (1, n_points)), rng.uniform(-15, 15, (1, n_points)), rng.uniform(0, 6, (1, n_points))
    )


def pixels(pixel_mm, shift_mm=0.0):
    u = np.arange(-33, 33.01, pixel_mm) + shift_mm
    return mean_ssf_field(MIXTURE.footprint(np.zeros((1, 0))), u_mm=u, v_mm=u)


@pytest.mark.parametrize(("sd_mm", "pixel_mm", "error"), [(2.3, 1.0, 0.0038), (2.4, 1.0, 0.0034), (2.4, 0.5, 0.0009)])
def test_pixels_err_over_an_edge_as_the_page_says(sd_mm, pixel_mm, error):
    """docs/explanation/ssf.md: 0.242 / 12 times (pixel / sd)^2, the trapezoidal rule's error at the steepest slope."""
    narrow = FixedMixture([1.0], [[0.0, 0.0]], [[[sd_mm**2, 0.0], [0.0, 16.0]]])
    axis = np.arange(-30, 30.01, pixel_mm)
    field = mean_ssf_field(narrow.footprint(np.zeros((1, 0))), u_mm=axis, v_mm=axis)
    x_mm = np.linspace(-3, 3, 61)
    found = mean_albedo_by_pixels(region_of(kinds.HalfPlane(0.0, 0.0)), field, Poses(x_mm[None], *np.zeros((2, 1, 1))))
    worst = np.abs(found - ndtr(x_mm / sd_mm)).max()
    assert worst == pytest.approx(error, abs=1e-3 * pixel_mm)


def test_many_hypotheses_and_poses_equal_one_by_one():
    rng = np.random.default_rng(0)
    discs = disc_region(rng.normal(size=(3, 2)), np.array([5.0, 9.0, 14.0]))
    field = pixels(2.0)
    poses = Poses(rng.normal(size=(3, 4)) * 9, rng.normal(size=(1, 4)) * 9, np.zeros((1, 1)))
    together = mean_albedo_by_pixels(discs, field, poses)
    for i in range(3):
        one = disc_region(discs.center_mm[i : i + 1], discs.semi_axes_mm[i : i + 1, 0])
        alone = mean_albedo_by_pixels(one, field, Poses(poses.x_mm[i : i + 1], poses.y_mm, poses.orientation_rad))
        assert np.allclose(together[i], alone[0])
    shared = mean_albedo_by_pixels(discs, field, poses_about(4))
    assert shared.shape == (3, 4)
    with pytest.raises(ShapeError, match="poses of 3 hypotheses, 2 regions"):
        mean_albedo_by_pixels(disc_region(np.zeros((2, 2)), np.array([5.0, 9.0])), field, poses)
