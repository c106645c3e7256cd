"""Folded priors of exchangeable Gaussians."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from probewise import nested
from probewise.diagnosis.fit import Model
from probewise.diagnosis.posterior import FoldedNormal, StandardNormal
from probewise.diagnosis.sensors import default_sensor
from probewise.effects import Extent
from probewise.nested.repartition import repartitioned
from probewise.recordings import Recording, paper_plan

PLAN = paper_plan().take(np.arange(0, 408, 8))
EXTENT = Extent.of(Recording(PLAN, np.linspace(10.0, 60.0, len(PLAN))))


def prior_of(n_gaussians: int) -> FoldedNormal:
    sensor = default_sensor(EXTENT, n_gaussians)
    near = 0.8 * np.random.default_rng(1).standard_normal(sensor.n_params + 2)  # two of an effect behind
    return FoldedNormal(sensor.n_params + 2, sensor, near)


@pytest.mark.parametrize("n_gaussians", [2, 3])
def test_another_order_is_the_same_sensor(n_gaussians):
    sensor = default_sensor(EXTENT, n_gaussians)
    model, z = Model(sensor, (), PLAN), np.random.default_rng(2).standard_normal((5, sensor.n_params))
    for order in itertools.permutations(range(n_gaussians)):
        np.testing.assert_allclose(model.predict(sensor.permuted(z, order)), model.predict(z), rtol=1e-9)
    np.testing.assert_allclose(sensor.permuted(z, range(n_gaussians)), z, atol=1e-12)


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


@pytest.mark.slow
def test_the_evidence_of_two_gaussians_is_the_same_folded():
    """A likelihood that does not ask for names: prior draws, a folded run, one from a prior near what that found."""
    prior = prior_of(2)
    m = prior.sensor.n_params

    def of(z):
        levels = z[:, m - 2 : m]
        spots = prior.sensor.theta(z[:, :m])[:, [1, 7]]  # u_1, u_2
        return -0.5 * ((spots - 3.0) ** 2).sum(axis=1) - 0.5 * (levels**2).sum(axis=1) / 0.5**2

    rng = np.random.default_rng(6)
    likelihood = np.exp(of(rng.standard_normal((200_000, prior.n_params))))
    truth, error = np.log(likelihood.mean()), likelihood.std() / likelihood.mean() / np.sqrt(len(likelihood))
    problem = SimpleNamespace(prior=prior, log_likelihood=of)
    first = nested.run(problem, rng=rng, n_live=200)
    second = nested.run(repartitioned(problem, first.samples(2000, rng=rng)), rng=rng, n_live=200)
    for found in (first, second):
        assert abs(found.log_z - truth) < 4 * np.hypot(found.log_z_error, error)
