"""The light that a spot gathers, against closed forms and against itself refined."""

import math

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import multivariate_normal

from probewise.errors import ParameterError, ShapeError
from probewise.recordings import Disc, HalfPlane, Image, Polygon, Quadrant, Stripes
from probewise.world import Blob, Oval, Spot, albedo_at, gaussian_spot, ridge_spot, seen_white_fraction, tailed_spot

BLOB = Blob(1.0, (0.0, 1.5), (4.0, 2.5), 0.15)
SPOTS = {
    "gaussian": lambda pixel_mm: gaussian_spot([BLOB], pixel_mm=pixel_mm),
    "two gaussians": lambda pixel_mm: gaussian_spot([BLOB, Blob(0.5, (3, -2), (1.5, 2), -0.5)], pixel_mm=pixel_mm),
    "ridge": lambda pixel_mm: ridge_spot(
        9.0, center_mm=(0.0, 1.5), lobes=0.35, ridge_mm=-3.0, ridge_width_mm=1.2, shadow=0.6, pixel_mm=pixel_mm
    ),
    "tailed": lambda pixel_mm: tailed_spot((1.5, 1.0), center_mm=(0.0, 1.5), skew=0.4, pixel_mm=pixel_mm),
}
SURFACES = {
    "half plane": HalfPlane(0.0, 0.0),
    "slanted half plane": HalfPlane(0.7, 1.3),
    "quadrant": Quadrant((1.0, 2.0), (-1, 1)),
    "disc": Disc((3.0, -2.0), 11.3),
    "oval": Oval((0.0, 4.0), (14.0, 6.0), 0.4),
    "polygon": Polygon(((-9.0, -7.0), (12.0, -3.0), (2.0, 10.0))),
    "stripes": Stripes(0.2, 7.0, 0.4, 1.0),
}


def poses(n=40):
    rng = np.random.default_rng(3)
    # Whole millimetres and right angles are the hard case: edges run along pixel borders.
    x, y = rng.integers(-12, 13, n).astype(float), rng.integers(-12, 13, n).astype(float)
    turn = np.where(np.arange(n) % 2, rng.uniform(0, 6.28, n), rng.integers(0, 4, n) * np.pi / 2)
    return x, y, turn


@pytest.mark.parametrize(("spot", "surface"), list(zip([*SPOTS, *SPOTS], SURFACES, strict=False)))
def test_refining_pixels_and_rays_changes_less_than_a_thousandth(spot, surface):
    coarse = seen_white_fraction(SURFACES[surface], SPOTS[spot](0.25), *poses(6))
    fine = seen_white_fraction(SURFACES[surface], SPOTS[spot](0.125), *poses(6), n_rays=100)
    assert np.abs(coarse - fine).max() < 1e-3


def test_a_half_plane_is_the_normal_integral():
    """A Gaussian spot over a straight edge: the distribution function of its distance to the edge."""
    x, _, turn = poses(200)
    normal, offset = 0.7, 1.3
    direction = normal - turn  # the edge's normal in the sensor frame
    c, s = np.cos(direction), np.sin(direction)
    sd = np.sqrt(16 * c**2 + 6.25 * s**2 + 2 * 0.15 * 10 * c * s)
    expected = ndtr((x * math.cos(normal) + 1.5 * s - offset) / sd)
    got = seen_white_fraction(HalfPlane(normal, offset), gaussian_spot([BLOB]), x, np.zeros(200), turn)
    assert np.abs(got - expected).max() < 3e-4


@pytest.mark.parametrize(
    ("corner", "direction"), [((0, 0), (1, 1)), ((0, 0), (-1, 1)), ((4, 4), (1, 1)), ((-4, 4), (-1, 1))]
)
def test_a_quadrant_is_the_bivariate_normal_integral(corner, direction):
    (cx, cy), (dx, dy) = corner, direction
    cov = [[16, 1.5 * dx * dy], [1.5 * dx * dy, 6.25]]
    expected = multivariate_normal(mean=[0, 0], cov=cov).cdf([dx * (0 - cx), dy * (1.5 - cy)])
    got = seen_white_fraction(Quadrant(corner, direction), gaussian_spot([BLOB]), *np.zeros((3, 1)))[0]
    assert abs(got - expected) < 3e-4


def test_a_disc_under_a_round_spot_is_the_rayleigh_integral():
    spot = gaussian_spot([Blob(1.0, (0.0, 0.0), (3.0, 3.0))])
    got = seen_white_fraction(Disc((5.0, 5.0), 4.0), spot, np.array([5.0]), np.array([5.0]), np.array([1.0]))[0]
    assert abs(got - (1 - math.exp(-16 / 18))) < 3e-4


def test_an_image_shows_nothing_outside_and_has_its_first_row_on_top():
    photo = Image(np.array([[0.1, 0.2], [0.3, 0.4]]), 2.0, (10.0, 20.0), "photo.npy")
    x, y = np.array([11.0, 13.0, 11.0, 13.0, 9.9, 14.1]), np.array([23.0, 23.0, 21.0, 21.0, 21.0, 21.0])
    np.testing.assert_array_equal(albedo_at(photo, x, y), [0.1, 0.2, 0.3, 0.4, 0, 0])


@pytest.mark.parametrize(
    ("weights", "pixel_mm", "error"),
    [
        (np.zeros((2, 2)), 1.0, ParameterError),
        ([[1.0, -1.0]], 1.0, ParameterError),
        ([[1.0, np.nan]], 1.0, ParameterError),
        ([[1.0]], 0.0, ParameterError),
        ([1.0], 1.0, ShapeError),
    ],
)
def test_a_spot_without_light_is_refused(weights, pixel_mm, error):
    with pytest.raises(error):
        Spot(np.array(weights), pixel_mm, (0.0, 0.0))
