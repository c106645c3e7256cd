"""Tables of the unit Gaussian over a corner and over a bent edge, against integrals done in another way."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ndtr
from scipy.stats import multivariate_normal, norm

from probewise.inquiry.scanlines import to_int32, to_single_precision
from probewise.inquiry.unit_gaussian import N_OPENINGS, REACH, mass_within_corner, mass_within_curved_edge

HALF_STEP = 1 / 64  # sd, and the steepest slope of a distribution function is 0.4 per sd
TO_NEAREST = 0.4 * HALF_STEP


@pytest.mark.parametrize("correlation", [-0.95, -0.5, 0.0, 0.3, 0.9])
def test_a_corner_shows_what_the_bivariate_normal_holds(correlation):
    rng = np.random.default_rng(2)
    h, k = rng.uniform(-3, 3, (2, 60))
    opening = int((np.arcsin(correlation) / np.pi + 0.5) * N_OPENINGS)
    found = mass_within_corner(to_single_precision(h), to_single_precision(k), to_int32(np.full(60, opening)))
    expected = multivariate_normal.cdf(np.stack([h, k], axis=-1), cov=[[1, correlation], [correlation, 1]])
    assert found == pytest.approx(expected, abs=2 * TO_NEAREST + 0.5 / (2 * N_OPENINGS))


def test_a_corner_far_off_leaves_one_edge():
    h = np.linspace(-3, 3, 41)
    for opening in (0, N_OPENINGS // 2, N_OPENINGS - 1):
        found = mass_within_corner(
            to_single_precision(h), to_single_precision(np.full(41, 50.0)), to_int32(np.full(41, opening))
        )
        assert found == pytest.approx(ndtr(h), abs=TO_NEAREST + ndtr(-REACH))


def test_the_sharpest_bend_is_the_last_of_the_table():
    """In single precision 1e9 / (1 + 1e9) is one, which would be a row behind the last."""
    sharp = mass_within_curved_edge(to_single_precision(np.zeros(2)), to_single_precision(np.array([1e3, 1e9])))
    assert sharp[0] == sharp[1] < 0.15


@pytest.mark.parametrize("bend", [0.0, 0.1, 0.7, 3.0])
def test_a_bent_edge_shows_what_lies_within_a_parabola(bend):
    distance = np.linspace(-2.5, 3.5, 13)
    found = mass_within_curved_edge(to_single_precision(distance), to_single_precision(np.full(13, bend)))
    expected = [quad(lambda t, d=d: norm.pdf(t) * ndtr(d - bend * t * t / 2), -8, 8)[0] for d in distance]
    assert found == pytest.approx(np.array(expected), abs=TO_NEAREST + 0.5 * (1 + bend) ** 2 / 64 * 0.2)
