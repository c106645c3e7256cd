"""Every effect of the vocabulary keeps the contract of an effect, and does what the vocabulary says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from probewise.effects import (
    VOCABULARY,
    AmbientGradient,
    Backlash,
    CorrelatedNoise,
    Extent,
    GainDrift,
    HeavyTailed,
    LogHeavyTailed,
    Nonlinearity,
    Saturation,
)
from probewise.errors import ParameterError
from probewise.recordings import HalfPlane, Plan, Recording
from probewise.sensor import NoiseLevel, Poses, Stage

EXTENT = Extent(10.0, 60.0, 100.0, 600.0)


def there_and_back() -> Plan:
    x = np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0])
    return Plan(
        x_mm=x,
        y_mm=np.zeros(6),
        orientation_rad=np.zeros(6),
        time_s=np.arange(6) * 10.0,
        scan=[0, 0, 0, 1, 1, 1],
        scan_names=("out", "back"),
        pattern=np.zeros(6),
        pattern_names=("edge",),
        patterns={"edge": HalfPlane(0.0, 0.0)},
    )


@pytest.mark.parametrize("name", VOCABULARY)
def test_every_effect_keeps_the_contract(name):
    effect = VOCABULARY[name].for_extent(EXTENT)
    names = effect.prior.names
    assert effect.name == name
    assert isinstance(effect.stage, Stage)
    assert len(effect.units) == len(names)
    assert effect.covariates
    bank = effect.bank()
    assert bank.ndim == 3
    assert bank.shape[2] == len(names)
    assert np.isfinite(effect.prior.log_prob(bank.reshape(-1, len(names)))).all()
    said = effect.sentence(bank[0, 0], np.abs(bank[0, 0]) / 10 + 1e-6)
    assert said[0].islower()
    assert any(c.isdigit() for c in said)
    VOCABULARY[name]()  # a sensor file needs its function only, whatever the prior's scale


@pytest.mark.parametrize("name", VOCABULARY)
def test_a_prior_maps_the_unit_cube_to_its_own_density(name):
    """Route one: draws through the cube; route two: the density integrated over their inner 90 %."""
    prior = VOCABULARY[name].for_extent(EXTENT).prior
    u = np.random.default_rng(1).random((4000, len(prior.names)))
    theta = prior.from_unit_cube(u)
    assert np.isfinite(prior.log_prob(theta)).all()
    for k, marginal in enumerate(prior.marginals.values()):
        low, high = marginal.from_unit(np.array([0.3, 0.8]))
        mass, _ = quad(lambda x, m=marginal: float(np.exp(m.log_prob(np.array(x)))), low, high, limit=400)
        assert mass == pytest.approx(0.5, abs=2e-4)
        assert np.mean((theta[:, k] > low) & (theta[:, k] < high)) == pytest.approx(0.5, abs=0.04)


def test_a_heavy_tail_is_exact_at_both_ends():
    prior = HeavyTailed(0.5)
    u = np.array([1e-9, 1e-3, 0.2, 0.5, 0.8, 0.999, 1 - 1e-9])
    x = prior.from_unit(u)
    np.testing.assert_allclose(x, -x[::-1], rtol=1e-6, atol=1e-12)
    positive = HeavyTailed(0.5, positive=True)
    np.testing.assert_allclose(positive.from_unit(np.array([0.6])), prior.from_unit(np.array([0.8])), rtol=1e-9)
    assert positive.log_prob(np.array([-1.0]))[0] == -np.inf
    # Twenty-five typical sizes are no surprise: the density there is far above a normal's.
    assert prior.log_prob(np.array([12.5]))[0] > -8
    assert LogHeavyTailed(0.1).from_unit(np.array([0.5]))[0] == pytest.approx(1.0)


def test_a_heavy_tail_refuses_a_size_of_zero():
    with pytest.raises(ParameterError, match="greater than 0"):
        HeavyTailed(0.0)


def test_backlash_leaves_the_sensor_behind_whichever_way_it_came():
    plan = there_and_back()
    poses = Poses(plan.x_mm[None], plan.y_mm[None], plan.orientation_rad[None])
    moved = Backlash().apply(poses, np.array([[0.4]]), plan)
    np.testing.assert_allclose(moved.x_mm[0] - plan.x_mm, [-0.2, -0.2, -0.2, 0.2, 0.2, 0.2])
    np.testing.assert_allclose(moved.y_mm[0], 0.0)


def test_gain_drift_scales_the_signal_and_fades():
    plan = there_and_back()
    out = GainDrift().apply(np.full((1, 6), 50.0), np.array([[0.1, 20.0]]), plan)
    np.testing.assert_allclose(out[0], 50 * (1 + 0.1 * np.exp(-plan.time_s / 20)))


def test_stray_light_adds_a_plane_over_the_table():
    plan = there_and_back()
    out = AmbientGradient().apply(np.full((1, 6), 20.0), np.array([[0.5, 3.0]]), plan)
    np.testing.assert_allclose(out[0], 20 + 0.5 * plan.x_mm)


def test_saturation_is_a_hard_limit_as_its_softness_goes_to_zero():
    values = np.array([[10.0, 49.0, 50.0, 51.0, 80.0]])
    hard = Saturation().apply(values, np.array([[50.0, 1e-6]]), there_and_back())
    np.testing.assert_allclose(hard, np.minimum(values, 50.0), atol=1e-5)
    soft = Saturation().apply(values, np.array([[50.0, 4.0]]), there_and_back())
    assert (soft < np.minimum(values, 50.0)).all()
    assert soft[0, 0] == pytest.approx(10.0, abs=1e-3)


def test_nonlinearity_keeps_black_and_white():
    out = Nonlinearity().apply(np.array([[-1e-17, 0.0, 0.25, 1.0, 1 + 1e-15]]), np.array([[0.5]]), there_and_back())
    np.testing.assert_allclose(out, [[0.0, 0.0, 0.5, 1.0, 1.0]])


def test_correlated_noise_sets_the_memory_and_not_the_sd():
    level = NoiseLevel(sd=np.full((1, 1), 0.6), rho=np.zeros((1, 1)))
    out = CorrelatedNoise().apply(level, np.array([[0.3]]), there_and_back())
    assert out.rho[0, 0] == 0.3
    assert out.sd[0, 0] == 0.6


def test_the_extent_of_a_recording_is_its_range_length_and_duration():
    plan = there_and_back()
    extent = Extent.of(Recording(plan, [1.0, 2.0, 5.0, np.nan, 3.0, 2.0]))
    assert (extent.low, extent.high, extent.length_mm, extent.duration_s) == (1.0, 5.0, 2.0, 50.0)
    with pytest.raises(ParameterError, match="usable readings"):
        Extent.of(Recording(plan, np.full(6, np.nan)))
