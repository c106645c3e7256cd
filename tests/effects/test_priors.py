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


def test_one_value_alone_is_distributed_about_as_by_its_own_prior():
    prior = _prior(5)
    values = prior.from_unit_cube(np.random.default_rng(0).random((20_000, 5)))[:, 0]
    np.testing.assert_allclose(
        prior.each.to_unit(np.quantile(values, [0.1, 0.25, 0.5, 0.75, 0.9])), [0.1, 0.25, 0.5, 0.75, 0.9], atol=0.03
    )


def test_values_beside_large_ones_are_expected_to_be_large():
    prior, own = _prior(12), HeavyTailedPrior(2.0)
    large = np.full((1, 12), 8.0)
    mixed = np.where(np.arange(12) < 1, large, 0.0)
    assert prior.log_prob(large)[0] > own.log_prob(large).sum() + 10
    assert prior.log_prob(mixed)[0] < own.log_prob(mixed).sum()


def test_nothing_maps_to_nothing_and_a_value_alone_reaches_far():
    prior = _prior(24)
    np.testing.assert_allclose(prior.from_unit_cube(np.full((1, 24), 0.5)), 0.0, atol=1e-12)
    alone = np.where(np.arange(24) == 3, ndtr(6.0), 0.5)[None, :]
    assert prior.from_unit_cube(alone)[0, 3] > 50 * prior.each.typical
