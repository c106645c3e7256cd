import numpy as np
import pytest

from probewise.calibration import choose_pixel_mm, mixture_moments, posterior_mean_ssf_field
from probewise.errors import ParameterError, ShapeError

ONE = np.array([[1.0, 0.5, 1.5, 0.03, 0.08, -0.01]])
TWO = np.array([[0.2, 2.0, 0.0, 0.5, 0.5, 0.0, 0.9, -1.0, 1.0, 0.02, 0.03, 0.005]])


def test_a_footprint_too_wide_for_the_grid_gets_wider_pixels():
    wide = ONE * [1, 1, 1, 1e-4, 1e-4, 1e-4]
    field = posterior_mean_ssf_field(wide, 1, pixel_mm=0.1)
    assert field.pixel_mm > 0.1
    assert max(field.values.shape) <= 302


def test_the_pixel_is_a_millimetre_and_finer_for_fine_scans_and_narrow_footprints():
    wide = ONE * [1, 1, 1, 0.3, 0.1, 0.1]
    assert choose_pixel_mm(wide, 1, step_mm=1.0) == 1.0
    assert choose_pixel_mm(wide, 1, step_mm=5.0) == 1.0
    assert choose_pixel_mm(wide, 1, step_mm=0.05) == 0.05
    assert choose_pixel_mm(np.array([[1.0, 0, 0, 0.5, 0.5, 0.0]]), 1, step_mm=1.0) == 0.2


def test_moments_of_a_mixture_are_those_of_its_field():
    found = mixture_moments(TWO, 2)
    field = posterior_mean_ssf_field(TWO, 2, pixel_mm=0.2)
    np.testing.assert_allclose([found["centre x'"][0], found["centre y'"][0]], field.mean_mm, atol=2e-3)
    np.testing.assert_allclose(np.exp(found["log width along x'"][0]) ** 2, field.cov_mm2[0, 0], rtol=5e-3)
    np.testing.assert_allclose(np.exp(found["log width along y'"][0]) ** 2, field.cov_mm2[1, 1], rtol=5e-3)


def test_weights_that_do_not_match_and_pixels_of_no_size_are_refused():
    with pytest.raises(ShapeError, match="one per sample"):
        posterior_mean_ssf_field(ONE, 1, weight=np.ones(3))
    with pytest.raises(ParameterError, match="pixel_mm"):
        posterior_mean_ssf_field(ONE, 1, pixel_mm=0.0)
