"""Posterior samples of a model, and the probabilities of variants beside other effects."""

import dataclasses
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mixtures import total_variation

from probewise.calibration import FittedSensor, predict
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import laplace_evidence
from probewise.diagnosis.fit import FARTHEST, Model, fit
from probewise.diagnosis.noise import NoiseModel, white_noise
from probewise.diagnosis.samples import HypothesisSamples, ModelSamples, mix, sample_model, weights_beside_other_effects
from probewise.diagnosis.search import search
from probewise.diagnosis.search.hypotheses import HypothesisProbabilities
from probewise.diagnosis.sensors import CalibratedSensor, default_sensor, with_free_form
from probewise.effects import EFFECTS, RARE_EFFECTS, VOCABULARY, Extent
from probewise.recordings import Recording, Uniform, two_way_plan
from probewise.sensor import ACCURATE_NODES
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


EXTENT = Extent(10.0, 60.0, PLAN)
BUILT = {name: kind.for_extent(EXTENT) for name, kind in {**VOCABULARY, **RARE_EFFECTS}.items()}


def samples_of(n_gaussians: int, n: int = 500) -> ModelSamples:
    sensor = default_sensor(Extent(10.0, 60.0, PLAN), n_gaussians)
    z = 0.3 * np.random.default_rng(n_gaussians).standard_normal((n, sensor.n_params))
    chain = sensor.chain(PLAN, (), n_nodes=ACCURATE_NODES)
    return ModelSamples(chain, sensor.theta(z), np.full(n, float(n_gaussians)), n_gaussians)


@pytest.mark.parametrize("name", [n for n, e in BUILT.items() if e is not None and e.nothing])
def test_an_effect_at_nothing_does_nothing(name):
    """In a prediction, and in the noise of one."""
    effect = BUILT[name].variants()[0]
    sensor, samples = default_sensor(EXTENT, 1), samples_of(1, 5)
    own = effect.prior.from_unit_cube(np.random.default_rng(2).random((5, len(effect.prior.names))))
    for k, value in effect.nothing.items():
        own[:, k] = value
    chain = sensor.chain(PLAN, (effect,), n_nodes=ACCURATE_NODES)
    theta = np.concatenate([samples.theta, own], axis=1)
    # Two quadratures where a pose changes, and a central difference where a scene does.
    np.testing.assert_allclose(chain.predict(theta, PLAN), samples.chain.predict(samples.theta, PLAN), atol=2e-4)
    level, plain = (
        c.noise_parameters(t, PLAN, np.ones((5, 1))) for c, t in ((chain, theta), (samples.chain, samples.theta))
    )
    for share in ("sd", "rho", "wide_share", "lost_share", "step"):
        here, there = np.broadcast_arrays(getattr(level, share), getattr(plain, share))
        np.testing.assert_allclose(here, there, err_msg=share)


def with_effect(name: str, n_gaussians: int, mark: float) -> ModelSamples:
    effect = BUILT[name].variants()[0]
    plain = samples_of(n_gaussians)
    own = effect.prior.from_unit_cube(np.random.default_rng(3).random((500, len(effect.prior.names))))
    chain = default_sensor(EXTENT, n_gaussians).chain(PLAN, (effect,), n_nodes=ACCURATE_NODES)
    theta = np.concatenate([plain.theta, own], axis=1)
    return ModelSamples(chain, theta, np.full(500, mark), n_gaussians)


def test_hypotheses_are_mixed_by_their_probability_and_predict_what_each_does():
    parts = [with_effect("lag", 2, 1.0), with_effect("backlash", 1, 2.0), dataclasses.replace(samples_of(1))]
    parts[2] = dataclasses.replace(parts[2], noise_sd=np.full(500, 3.0))
    shares = np.array([0.5, 0.3, 0.2])
    null = default_sensor(EXTENT, 2)
    mixed = mix(parts, shares, null, PLAN, rng=np.random.default_rng(4))
    assert mixed.effects == ("backlash", "lag")
    assert mixed.n_gaussians == 2
    predicted = mixed.chain.predict(mixed.theta, PLAN)
    low = list(mixed.chain.names).index("I_min")
    for part, share, mark in zip(parts, shares, (1.0, 2.0, 3.0), strict=True):
        rows = np.flatnonzero(mixed.noise_sd == mark)
        # Four sd of a binomial of 500: fails by chance once in 16,000 seeds.
        assert len(rows) == pytest.approx(500 * share, abs=4 * np.sqrt(500 * share * (1 - share)))
        of_part = {value: k for k, value in enumerate(part.theta[:, list(part.chain.names).index("I_min")])}
        own = [of_part[value] for value in mixed.theta[rows, low]]
        assert len(set(own)) == len(rows)
        expected = part.chain.predict(part.theta[own], PLAN)
        # Two quadratures: where a sample moves the sensor, straight edges are not taken together.
        np.testing.assert_allclose(predicted[rows], expected, atol=1e-6)


def candidate(names, log_z):
    sensor = SimpleNamespace(has_exchangeable_gaussians=True)
    found = SimpleNamespace(model=SimpleNamespace(sensor=sensor))
    return SimpleNamespace(names=names, found=found, evidence={(): SimpleNamespace(log_z=log_z)})


def samples(probabilities, own=frozenset()):
    """Hypotheses whose evidence under white noise alone says the opposite of the verdict, which weighs all noises."""
    fits = {(0, names): candidate(names, log_z) for names, log_z in [((), 0.0), (("lag",), 1.0), (("drift",), 9.0)]}
    searched = SimpleNamespace(
        evidences=SimpleNamespace(fits=fits),
        posterior=HypothesisProbabilities(probabilities),
        prior=SimpleNamespace(log_prior_on_mean=lambda names: 0.0),
        prepared=SimpleNamespace(effects={}, apparatus=SimpleNamespace(user_effect_names=lambda effects: own)),
    )
    return HypothesisSamples(searched, (), np.random.default_rng(0)), fits


def test_the_repaired_model_is_mixed_by_the_probabilities_of_the_verdict():
    said = {
        (("lag",), ()): 0.1,
        (("lag",), ("outliers",)): 0.5,
        (("drift",), ()): 0.15,
        ((), ("outliers",)): 0.05,
        (("unknown",), ()): 0.1,
        (("seen by screening alone",), ()): 0.1,
    }
    cached, fits = samples(said)
    by_mean = cached.compatible_probabilities(fits[0, ("lag",)])
    assert by_mean == pytest.approx({("lag",): 0.75, ("drift",): 0.1875, (): 0.0625})
