"""Posterior samples of a diagnosed model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from probewise.calibration import FittedSensor
from probewise.diagnosis.coordinates import default_sensor
from probewise.diagnosis.free_form import FreeForm
from probewise.diagnosis.repaired import ModelSamples, doubted, over_orders
from probewise.effects import ArmKnock, Extent
from probewise.recordings import Recording, two_way_plan
from probewise.sensor import total_variation

PLAN = two_way_plan()


def samples_of(n_gaussians: int, n: int = 500) -> ModelSamples:
    sensor = default_sensor(Extent(10.0, 60.0, PLAN), n_gaussians)
    z = 0.3 * np.random.default_rng(n_gaussians).standard_normal((n, sensor.n_params))
    chain = sensor.chain(PLAN, (), n_nodes=16)
    return ModelSamples(chain, sensor.theta(z), np.full(n, float(n_gaussians)), (), n_gaussians)


def test_a_gaussian_in_halves_predicts_the_same():
    one, three = samples_of(1), samples_of(3)
    mixed = over_orders([one, three], np.array([1.0, 0.0]), rng=np.random.default_rng(0))
    assert mixed.n_gaussians == 3
    assert mixed.theta.shape == three.theta.shape
    expected = np.sort(one.chain.predict(one.theta, PLAN)[:, 150])
    np.testing.assert_allclose(np.sort(mixed.chain.predict(mixed.theta, PLAN)[:, 150]), expected, rtol=1e-10)


def test_orders_are_mixed_by_their_probability():
    mixed = over_orders([samples_of(1), samples_of(2)], np.array([0.3, 0.7]), rng=np.random.default_rng(3))
    of_one = int(np.sum(mixed.noise_sd == 1.0))
    # Four sd of a binomial of 500: fails by chance once in 16,000 seeds.
    assert of_one == pytest.approx(150, abs=4 * np.sqrt(500 * 0.3 * 0.7))
    assert dataclasses.replace(mixed).theta.shape == (500, 14)


def test_a_sensor_of_free_form_is_written_read_and_driven_by():
    free = FreeForm.about(default_sensor(Extent(10.0, 60.0, PLAN), 1))
    rng = np.random.default_rng(5)
    z = 0.3 * rng.standard_normal(free.n_params) + 0.02 * rng.standard_normal((500, free.n_params))
    chain = free.chain(PLAN, (), n_nodes=16)
    samples = ModelSamples(chain, free.theta(z), np.full(500, 0.5), (), free.n_gaussians, exchangeable=False)
    readings = chain.predict(samples.theta[:1], PLAN)[0]
    sensor = samples.fitted_sensor(Recording(PLAN, readings + 0.5 * rng.standard_normal(len(PLAN))), rng=rng)
    assert sensor.free_form
    assert "an SSF of free form" in sensor.summary()
    assert "a_2" not in sensor.summary()
    again = FittedSensor.from_json(sensor.to_json())
    np.testing.assert_allclose(again.samples, samples.theta, rtol=1e-12)
    # Four Gaussians of positive mass stand for it: mean and covariance to a pixel, no response off by a tenth.
    mixture = sensor.mixture()
    np.testing.assert_allclose(mixture.mean_mm, sensor.field.mean_mm, atol=sensor.field.pixel_mm)
    assert total_variation(mixture, sensor.field) < 0.1


def test_one_order_alone_stays_as_it_is():
    one = samples_of(2)
    alone = over_orders([one], np.ones(1), rng=np.random.default_rng(0))
    np.testing.assert_array_equal(np.sort(alone.theta, axis=0), np.sort(one.theta, axis=0))


def test_a_share_of_the_samples_is_without_the_effect():
    knock = ArmKnock.for_extent(Extent(10.0, 60.0, PLAN))
    sensor, plain = default_sensor(Extent(10.0, 60.0, PLAN), 2), samples_of(1)
    z = 0.3 * np.random.default_rng(7).standard_normal((500, sensor.n_params))
    own = np.tile([0.8, -0.4, 3.0, float(np.median(PLAN.time_s))], (500, 1))
    chain = sensor.chain(PLAN, (knock,), n_nodes=16)
    repaired = ModelSamples(chain, np.concatenate([sensor.theta(z), own], axis=1), np.full(500, 2.0), ("arm_knock",), 2)
    mixed = doubted(repaired, plain, [knock], 0.3, rng=np.random.default_rng(0))
    without = mixed.noise_sd == 1.0
    # Four sd of a binomial of 500: fails by chance once in 16,000 seeds.
    assert without.sum() == pytest.approx(150, abs=4 * np.sqrt(500 * 0.3 * 0.7))
    rows = np.flatnonzero(without)
    expected = plain.chain.predict(plain.theta[rows], PLAN)
    # Two quadratures: where a sample turns the sensor, straight edges are not taken together.
    np.testing.assert_allclose(chain.predict(mixed.theta[rows], PLAN), expected, rtol=1e-8)
    np.testing.assert_array_equal(mixed.theta[~without], repaired.theta[~without])
