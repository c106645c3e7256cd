"""Gaussians that trade names: folded onto one order, with the density of all."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from probewise.diagnosis.evidence.folded import FoldedNormal, folded
from probewise.diagnosis.evidence.joint import JointProblem, StandardNormal
from probewise.diagnosis.evidence.laplace import weigh
from probewise.diagnosis.fitting.coordinates import default_sensor
from probewise.diagnosis.fitting.fit import Model, fit
from probewise.diagnosis.noise.law import white
from probewise.diagnosis.noise.models import NoiseModel
from probewise.effects import Extent
from probewise.recordings import Recording, paper_plan

PLAN = paper_plan().take(np.arange(0, 408, 8))
EXTENT = Extent.of(Recording(PLAN, np.linspace(10.0, 60.0, len(PLAN))))


def prior_of(n_gaussians: int) -> FoldedNormal:
    sensor = default_sensor(EXTENT, n_gaussians)
    near = 0.8 * np.random.default_rng(1).standard_normal(sensor.n_params + 2)  # two of an effect behind
    return FoldedNormal(StandardNormal(sensor.n_params + 2), sensor, near)


@pytest.mark.parametrize("n_gaussians", [2, 3])
def test_another_order_is_the_same_sensor(n_gaussians):
    sensor = default_sensor(EXTENT, n_gaussians)
    model, z = Model(sensor, (), PLAN), np.random.default_rng(2).standard_normal((5, sensor.n_params))
    for order in itertools.permutations(range(n_gaussians)):
        np.testing.assert_allclose(model.predict(sensor.renamed(z, order)), model.predict(z), rtol=1e-9)
    np.testing.assert_allclose(sensor.renamed(z, range(n_gaussians)), z, atol=1e-12)


@pytest.mark.parametrize("n_gaussians", [2, 3])
def test_all_orders_fold_to_one_where_the_density_is(n_gaussians):
    prior = prior_of(n_gaussians)
    n_own = prior.sensor.n_params
    z = np.random.default_rng(3).standard_normal((200, n_own + 2))
    once = prior.fold(z)
    assert np.isfinite(prior.log_prob(once)).all()
    np.testing.assert_array_equal(once[:, n_own:], z[:, n_own:])
    for order in itertools.permutations(range(n_gaussians)):
        other = np.concatenate([prior.sensor.renamed(z[:, :n_own], order), z[:, n_own:]], axis=1)
        np.testing.assert_allclose(prior.fold(other), once, atol=1e-9)


@pytest.mark.parametrize("n_gaussians", [2, 3])
def test_the_folded_density_sums_to_one(n_gaussians):
    """Weighed by draws of the plain prior: the mean of their ratio, N! or 0 for N = 2, within four standard errors."""
    prior = prior_of(n_gaussians)
    z = np.random.default_rng(4).standard_normal((40_000, prior.plain.n_params))
    ratio = np.exp(prior.log_prob(z) - prior.plain.log_prob(z))
    assert abs(ratio.mean() - 1.0) < 4 * ratio.std() / 200
    if n_gaussians == 2:
        assert set(np.round(np.unique(ratio), 9)) == {0.0, 2.0}


def test_where_no_names_can_be_traded_nothing_is_folded():
    recording = Recording(PLAN, np.random.default_rng(5).normal(30.0, 1.0, len(PLAN)))
    for n_gaussians, same in ((1, True), (2, False)):
        sensor = default_sensor(EXTENT, n_gaussians)
        found = fit(Model(sensor, (), PLAN), recording, np.zeros(sensor.n_params), white(len(PLAN)), sd_floor=0.1)
        evidence = weigh(found, NoiseModel((), recording), sd_floor=0.1)
        problem = JointProblem(found.model, recording, evidence, 0.1)
        once = folded(problem, found.z)
        assert (once is problem) == same
        z = found.z[None, :]
        np.testing.assert_array_equal(once.log_likelihood(z), problem.log_likelihood(z))
