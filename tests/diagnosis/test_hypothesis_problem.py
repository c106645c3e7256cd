"""Folded priors of exchangeable Gaussians."""

import itertools

import numpy as np
import pytest

from probewise.diagnosis.posterior import FoldedNormal, StandardNormal
from probewise.diagnosis.sensors import default_sensor
from probewise.effects import Extent
from probewise.recordings import Recording, paper_plan

PLAN = paper_plan().take(np.arange(0, 408, 8))
EXTENT = Extent.of(Recording(PLAN, np.linspace(10.0, 60.0, len(PLAN))))


def prior_of(n_gaussians: int) -> FoldedNormal:
    sensor = default_sensor(EXTENT, n_gaussians)
    near = 0.8 * np.random.default_rng(1).standard_normal(sensor.n_params + 2)  # two of an effect behind
    return FoldedNormal(sensor.n_params + 2, sensor, near)


@pytest.mark.parametrize("n_gaussians", [2, 3])
def test_all_orders_fold_to_one_where_the_density_is(n_gaussians):
    prior = prior_of(n_gaussians)
    n_own = prior.sensor.n_params
    z = np.random.default_rng(3).standard_normal((200, n_own + 2))
    once = prior.fold(z)
    assert np.isfinite(prior.log_prob(once)).all()
    np.testing.assert_array_equal(once[:, n_own:], z[:, n_own:])
    for order in itertools.permutations(range(n_gaussians)):
        other = np.concatenate([prior.sensor.permuted(z[:, :n_own], order), z[:, n_own:]], axis=1)
        np.testing.assert_allclose(prior.fold(other), once, atol=1e-9)


def test_the_folded_density_sums_to_one():
    """Twice the plain one on half of it: a share of 40,000 draws, beyond 4.4 standard errors once in 100,000 times."""
    prior = prior_of(2)
    z = np.random.default_rng(4).standard_normal((40_000, prior.n_params))
    ratio = np.exp(prior.log_prob(z) - StandardNormal(prior.n_params).log_prob(z))
    assert set(np.round(np.unique(ratio), 9)) == {0.0, 2.0}
    assert abs(ratio.mean() - 1.0) < 4.4 * 1.0 / 200


@pytest.mark.slow
def test_where_orders_differ_in_density_what_is_drawn_has_the_folded_one():
    """Three Gaussians: shares of folded draws in two halves of the domain, against the folded density by importance."""
    prior = prior_of(3)
    rng = np.random.default_rng(5)
    drawn = prior.from_unit_cube(rng.random((40_000, prior.n_params)))
    z = rng.standard_normal((40_000, prior.n_params))
    ratio = np.exp(prior.log_prob(z) - StandardNormal(prior.n_params).log_prob(z))
    for column in (0, 1, 4):
        middle = np.median(drawn[:, column])
        upper = ratio * (z[:, column] > middle)
        assert abs(upper.mean() - 0.5) < 4.4 * np.hypot(upper.std(), 0.5) / 200
