"""Values with one scale in common: coordinates and density belong together, and one value tells of the others."""

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from probewise.effects import HeavyTailedPrior
from probewise.priors import SharedScalePrior


def _prior(n):
    return SharedScalePrior(tuple("abcdefghijklmnopqrstuvwx"[:n]), HeavyTailedPrior(2.0))


@pytest.mark.parametrize("n", [2, 5, 12, 24])
def test_coordinates_and_density_belong_together(n):
    prior, z = _prior(n), np.random.default_rng(n).standard_normal((6, n))
    values = prior.from_unit_cube(ndtr(z))
    np.testing.assert_allclose(ndtri(prior.to_unit_cube(values)), z, atol=1e-6)
    step = 1e-5 * np.eye(n)
    for at, found in zip(z, prior.log_prob(values), strict=True):
        slopes = (prior.from_unit_cube(ndtr(at + step)) - prior.from_unit_cube(ndtr(at - step))) / 2e-5
        of_normal = -0.5 * float(at @ at) - 0.5 * n * np.log(2 * np.pi)
        assert found == pytest.approx(of_normal - np.linalg.slogdet(slopes)[1], abs=1e-4)


def test_values_beside_large_ones_are_expected_to_be_large():
    prior, own = _prior(12), HeavyTailedPrior(2.0)
    large = np.full((1, 12), 8.0)
    mixed = np.where(np.arange(12) < 1, large, 0.0)
    assert prior.log_prob(large)[0] > own.log_prob(large).sum() + 10
    assert prior.log_prob(mixed)[0] < own.log_prob(mixed).sum()
