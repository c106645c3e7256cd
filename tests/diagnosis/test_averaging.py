"""Samples averaged over orders and hypotheses."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis.samples import HypothesisSamples, ModelSamples, mix
from probewise.diagnosis.search.hypotheses import HypothesisProbabilities
from probewise.diagnosis.sensors import default_sensor
from probewise.effects import RARE_EFFECTS, VOCABULARY, Extent
from probewise.recordings import two_way_plan
from probewise.sensor import ACCURATE_NODES

PLAN = two_way_plan()
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
