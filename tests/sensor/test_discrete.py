"""The paper's sum over pixels against the closed forms: the second route to the response."""

import numpy as np
import pytest

from probewise.errors import ShapeError
from probewise.scene import disc_region
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
