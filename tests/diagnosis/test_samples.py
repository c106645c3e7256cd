"""Posterior samples of a model, and the probabilities of variants beside other effects."""

from dataclasses import replace

import numpy as np
import pytest
from mixtures import total_variation

from probewise.calibration import FittedSensor, predict
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import laplace_evidence
from probewise.diagnosis.fit import FARTHEST, Model, fit
from probewise.diagnosis.noise import NoiseModel, white_noise
from probewise.diagnosis.samples import ModelSamples, sample_model, weights_beside_other_effects
from probewise.diagnosis.search import search
from probewise.diagnosis.sensors import CalibratedSensor, default_sensor, with_free_form
from probewise.effects import EFFECTS, Extent
from probewise.recordings import Recording, Uniform, two_way_plan
from probewise.systems import RunTable, Simulator

PLAN = two_way_plan()


@pytest.mark.slow
def test_a_sensor_of_free_form_is_written_read_and_driven_by():
    free = with_free_form(default_sensor(Extent(10.0, 60.0, PLAN), 1))
    rng = np.random.default_rng(5)
    z = 0.3 * rng.standard_normal(free.n_params) + 0.02 * rng.standard_normal((500, free.n_params))
    chain = free.chain(PLAN, (), n_nodes=16)
    samples = ModelSamples(chain, free.theta(z), np.full(500, 0.5), free.n_gaussians, has_exchangeable_gaussians=False)
    readings = chain.predict(samples.theta[:1], PLAN)[0]
    sensor = samples.fitted_sensor(Recording(PLAN, readings + 0.5 * rng.standard_normal(len(PLAN))), rng=rng)
    assert sensor.is_free_form
    assert "an SSF of free form" in sensor.summary()
    assert "a_2" not in sensor.summary()
    again = FittedSensor.from_json(sensor.to_json())
    np.testing.assert_allclose(again.samples, samples.theta, rtol=1e-12)
    # Four Gaussians of positive mass stand for it: mean and covariance to a pixel, no response off by a tenth.
    mixture = sensor.mean_mixture()
    np.testing.assert_allclose(mixture.mean_mm, sensor.field.mean_mm, atol=sensor.field.pixel_mm)
    assert total_variation(mixture, sensor.field) < 0.1


def test_a_sensors_effects_count_from_where_those_that_were_fitted_do():
    """Only part of a recording far from 0 was fitted: another first time, and another middle of its places."""
    far = replace(
        PLAN, x_mm=PLAN.x_mm + 5e3, time_s=PLAN.time_s + 1.7e9, patterns=dict.fromkeys(PLAN.pattern_names, Uniform(1.0))
    )
    fitted = far.take(np.arange(40, 90))
    effects = [EFFECTS[name].for_extent(Extent(10.0, 60.0, fitted)) for name in ("ambient_gradient", "gain_drift")]
    sensor, rng = default_sensor(Extent(10.0, 60.0, fitted), 1), np.random.default_rng(0)
    chain = sensor.chain(far, effects, n_nodes=16)
    own = {"ambient_gradient.per_mm_x": 0.01, "gain_drift.frac": 0.2, "gain_drift.tau_s": 30.0}
    theta = np.concatenate([sensor.theta(np.zeros((1, 7)))[0], [own.get(name, 0.0) for name in chain.names[8:]]])
    samples = ModelSamples(chain, np.tile(theta, (500, 1)), np.full(500, 0.5), 1)
    predicted = chain.predict(theta[None, :], far)[0]
    found = samples.fitted_sensor(Recording(far, predicted + 0.5 * rng.standard_normal(len(far))), rng=rng)
    assert found.origins["gain_drift"].time_s == far.time_s[40]
    np.testing.assert_allclose(predict(found, far).mean, predicted, rtol=1e-9)


@pytest.mark.slow
def test_a_posterior_against_the_bound_of_its_prior_is_drawn_from():
    """An earlier sensor whose white level is twenty of its sds off: the fit rests at six of them."""
    rng = np.random.default_rng(0)
    center = default_sensor(Extent(10.0, 60.0, PLAN), 1).center
    tight = CalibratedSensor(
        1, center, np.diag([0.05, 0.05, 0.01, 0.01, 0.02, 0.05, 0.05]), has_exchangeable_gaussians=False
    )
    truth = tight.theta(np.zeros((1, 7)))
    truth[:, -1] += 20 * 0.05
    readings = tight.chain(PLAN, (), n_nodes=16).predict(truth, PLAN)[0] + 0.3 * rng.standard_normal(len(PLAN))
    recording = Recording(PLAN, readings)
    found = fit(Model(tight, (), PLAN), recording, np.zeros(7), white_noise(len(PLAN), least=1e-3))
    noise = laplace_evidence(found, NoiseModel((), recording, least_sd=1e-3))
    samples = sample_model(found, noise, recording, weights={}, rng=rng)
    z = tight.z(samples.theta)
    assert z[:, -1].max() < FARTHEST
    assert z[:, -1].min() > FARTHEST - 1.5
    assert len(np.unique(z[:, -1])) > 250


_N, _AT, _SD = 150, 90, 0.08


@pytest.fixture(scope="module")
def prepared():
    """A straight line that leaves out a step, and the humidity, which hides the place of the step by half as much."""
    rng = np.random.default_rng(6)
    t, force = np.arange(float(_N)), 10 * rng.random(_N)
    humidity = 50 + 10 * rng.normal(size=_N)
    y = 2 + 0.5 * force + 0.3 * (t >= _AT) + 0.013 * (humidity - 50) + _SD * rng.normal(size=_N)
    table = RunTable({"t_s": t, "force": force, "humidity": humidity, "y": y}, time="t_s", run=None)
    simulator = Simulator(
        "y", "V", {"zero": (-10, 10), "slope": (0, 2)}, simulate=lambda p, u: p["zero"] + p["slope"] * u["force"],
        time="t_s",
    )  # fmt: skip
    return prepare_system(simulator, table), (t, force, humidity, y)


@pytest.fixture(scope="module")
def searched(prepared):
    return search(prepared[0])


def _best_of(searched, names):
    return max((fit for (_, own), fit in searched.evidences.fits.items() if own == names), key=lambda fit: fit.log_z)


def _exact_weights(columns):
    """Return the probability of each interval of the step by least squares with everything else: route two."""
    t, force, humidity, y = columns
    log_like = []
    for k in range(_N - 1):
        design = np.column_stack([np.ones(_N), force, humidity - humidity.mean(), t > k + 0.5])
        left = y - design @ np.linalg.lstsq(design, y)[0]
        log_like.append(-0.5 * (_N - 4) * np.log(np.sum(left**2)))
    log_like = np.array(log_like)
    return np.exp(log_like - log_like.max()) / np.exp(log_like - log_like.max()).sum()


def test_the_interval_of_a_step_is_as_probable_as_least_squares_with_all_effects_says(prepared, searched):
    ready, columns = prepared
    fit = _best_of(searched, ("offset_step", "sensitivity:humidity"))
    found = weights_beside_other_effects(fit.found, fit.law, ready.usable_rows, fit.weights)["offset_step"]
    exact = _exact_weights(columns)
    assert 0.5 * np.abs(found - exact).sum() < 0.1
    assert 0.5 * np.abs(fit.weights["offset_step"] - exact).sum() > 0.3  # as it was added, alone
