"""Samples of several SSF orders, and of several hypotheses, in one model."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from heater import ABOUT

from probewise.diagnosis.averaging import can_share_one_model, mix_over_hypotheses, mix_over_orders
from probewise.diagnosis.samples import ModelSamples
from probewise.diagnosis.sensors import default_sensor
from probewise.effects import RARE_EFFECTS, VOCABULARY, Extent
from probewise.recordings import two_way_plan
from probewise.sensor import ACCURATE_NODES
from probewise.systems.forms import bind_forms

PLAN = two_way_plan()
EXTENT = Extent(10.0, 60.0, PLAN)
BUILT = {name: kind.for_extent(EXTENT) for name, kind in {**VOCABULARY, **RARE_EFFECTS}.items()}


def samples_of(n_gaussians: int, n: int = 500) -> ModelSamples:
    sensor = default_sensor(Extent(10.0, 60.0, PLAN), n_gaussians)
    z = 0.3 * np.random.default_rng(n_gaussians).standard_normal((n, sensor.n_params))
    chain = sensor.chain(PLAN, (), n_nodes=ACCURATE_NODES)
    return ModelSamples(chain, sensor.theta(z), np.full(n, float(n_gaussians)), (), n_gaussians)


def test_a_gaussian_in_halves_predicts_the_same():
    one, three = samples_of(1), samples_of(3)
    mixed = mix_over_orders([one, three], np.array([1.0, 0.0]), rng=np.random.default_rng(0))
    assert mixed.n_gaussians == 3
    assert mixed.theta.shape == three.theta.shape
    expected = np.sort(one.chain.predict(one.theta, PLAN)[:, 150])
    np.testing.assert_allclose(np.sort(mixed.chain.predict(mixed.theta, PLAN)[:, 150]), expected, rtol=1e-10)


def test_orders_are_mixed_by_their_probability():
    mixed = mix_over_orders([samples_of(1), samples_of(2)], np.array([0.3, 0.7]), rng=np.random.default_rng(3))
    of_one = int(np.sum(mixed.noise_sd == 1.0))
    # Four sd of a binomial of 500: fails by chance once in 16,000 seeds.
    assert of_one == pytest.approx(150, abs=4 * np.sqrt(500 * 0.3 * 0.7))
    assert dataclasses.replace(mixed).theta.shape == (500, 14)


def test_one_order_alone_stays_as_it_is():
    one = samples_of(2)
    alone = mix_over_orders([one], np.ones(1), rng=np.random.default_rng(0))
    np.testing.assert_array_equal(np.sort(alone.theta, axis=0), np.sort(one.theta, axis=0))


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


def test_no_lag_is_none_where_the_clock_stands_still():
    """Two readings at one time: nothing has waited, and still nothing is held back."""
    plan = dataclasses.replace(PLAN, time_s=2.0 * (np.arange(len(PLAN)) // 2))
    samples = samples_of(1, 5)
    chain = default_sensor(EXTENT, 1).chain(plan, (BUILT["lag"],), n_nodes=ACCURATE_NODES)
    theta = np.concatenate([samples.theta, np.zeros((5, 1))], axis=1)
    np.testing.assert_allclose(chain.predict(theta, plan), samples.chain.predict(samples.theta, plan), atol=1e-9)


def with_effect(name: str, n_gaussians: int, mark: float) -> ModelSamples:
    effect = BUILT[name].variants()[0]
    plain = samples_of(n_gaussians)
    own = effect.prior.from_unit_cube(np.random.default_rng(3).random((500, len(effect.prior.names))))
    chain = default_sensor(EXTENT, n_gaussians).chain(PLAN, (effect,), n_nodes=ACCURATE_NODES)
    theta = np.concatenate([plain.theta, own], axis=1)
    return ModelSamples(chain, theta, np.full(500, mark), (name,), n_gaussians)


def test_hypotheses_are_mixed_by_their_probability_and_predict_what_each_does():
    parts = [with_effect("lag", 2, 1.0), with_effect("backlash", 1, 2.0), dataclasses.replace(samples_of(1))]
    parts[2] = dataclasses.replace(parts[2], noise_sd=np.full(500, 3.0))
    shares = np.array([0.5, 0.3, 0.2])
    null = default_sensor(EXTENT, 2)
    mixed = mix_over_hypotheses(parts, shares, null, PLAN, rng=np.random.default_rng(4))
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


def test_what_does_not_fit_into_one_model():
    first, second = BUILT["scan_misplacement"].variants()[:2]
    assert not can_share_one_model([first], [second])
    assert can_share_one_model([first], [BUILT["lag"]])
    assert can_share_one_model([BUILT["lag"]], [dataclasses.replace(BUILT["lag"])])
    assert not can_share_one_model([SimpleNamespace(name="own", nothing=None)], [BUILT["lag"]])


def test_variants_of_a_form_share_one_model_unless_they_act_otherwise():
    """A step in one interval and in another are one action with other priors; a factor and a slope are two."""
    step = bind_forms(ABOUT)["offset_step"]
    first, second = step.variants()[:2]
    assert can_share_one_model([first], [second])
    assert step.variants()[0] is first
    assert can_share_one_model([first], [step.with_fewer_variants().variants()[0]])
    assert not can_share_one_model([first], [dataclasses.replace(first, act=lambda value, theta, rows: value)])
