"""The experiment of a fitted sensor: its effects, and the sensor as an unknown beside the shape."""

import numpy as np
import pytest
from exploring import ChainArm, run
from hand_made import NAMES, sensor_of

from probewise.effects import Origin
from probewise.experiment import experiment_for
from probewise.experiment.from_sensor import AdjustedMixture, sensor_change_prior
from probewise.inference import GaussianKnown
from probewise.scene import Circle, Field, HypothesisScene
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture, FreeLevels

TRUE = FixedMixture([0.6, 0.4], [[0.5, 1.5], [0.0, -1.0]], [[[16.0, 2.0], [2.0, 9.0]], [[30.0, 0.0], [0.0, 12.0]]])
SENSOR = sensor_change_prior((10.0, 60.0))


def rng(seed=0):
    return np.random.default_rng(seed)


def test_an_adjustment_stretches_about_the_mean_and_shifts():
    """By samples of the mixture: stretched along each axis about their mean, then shifted."""
    theta = np.array([[0.2, -0.4, 1.0, -2.0]])
    which = rng().random(200_000) < 0.6
    draws = np.where(
        which[:, None],
        rng(1).multivariate_normal(TRUE.means_mm[0], TRUE.covs_mm2[0], 200_000),
        rng(2).multivariate_normal(TRUE.means_mm[1], TRUE.covs_mm2[1], 200_000),
    )
    moved = TRUE.mean_mm + (draws - TRUE.mean_mm) * np.exp(theta[0, :2]) + theta[0, 2:]
    foot = AdjustedMixture(TRUE).footprint(theta)
    weight, u, v = foot.weight[0, 0], foot.u_mm[0, 0], foot.v_mm[0, 0]
    np.testing.assert_allclose([weight @ u, weight @ v], moved.mean(axis=0), atol=0.05)
    var_u = weight @ (foot.var_u[0, 0] + u**2) - (weight @ u) ** 2
    cov = weight @ (foot.cov_uv[0, 0] + u * v) - (weight @ u) * (weight @ v)
    np.testing.assert_allclose([var_u, cov], [np.var(moved[:, 0]), np.cov(moved.T)[0, 1]], rtol=0.1, atol=0.1)


@pytest.mark.slow
def test_a_footprint_taken_for_a_half_too_wide_is_put_right(small):
    """Within five sds; the wrong SSF taken for true is off by more than it states."""
    circle = Circle(Field(400.0, 300.0), (40.0, 100.0), True)
    wide = FixedMixture(TRUE.weights, TRUE.means_mm, TRUE.covs_mm2 * 1.5**2)
    truth = (220.0, 150.0, 70.0)
    options = {"shape": circle, "likelihood": GaussianKnown(1.0), "n_particles": 1500, "stop_sd_mm": 1.0}
    scene = HypothesisScene(circle)
    learning = small.experiment(
        model=Chain(AdjustedMixture(wide), FreeLevels(), scene, n_nodes=FAST_NODES), sensor_prior=SENSOR, **options
    )
    arm = ChainArm(Chain(TRUE, FixedLevels(10.0, 60.0), scene), truth)
    found = run(arm, learning, rng=rng(), max_readings=25)
    assert (np.abs(found.last.mean - truth) < 5 * found.last.sd).all()
    assert found.last.names == ("x_mm", "y_mm", "radius_mm")
    assert found.last.samples.shape[1] == 3
    size, error = found.last.sensor["log_size_u"]
    assert abs(size - np.log(1 / 1.5)) < 5 * error
    assert "log_size_u" in found.summary()


def test_effects_of_a_sensor_from_far_away_count_from_0_in_a_run():
    sensor = sensor_of(
        np.tile([1.0, 0.5, 1.5, 0.03, 0.08, -0.005, 11.0, 58.0, 0.2, 30.0], (500, 1)),
        names=(*NAMES, "gain_drift.frac", "gain_drift.tau_s"),
        effects=("gain_drift",),
        origins={"gain_drift": Origin(time_s=1.7e9)},
    )
    (kept,) = sensor.effects_on_new_scans
    (of_run,) = experiment_for(sensor, Circle(), Field(), trust=1.0).model.effects
    assert (kept.binding.where.origin, of_run.effect.binding.where.origin) == (Origin(time_s=1.7e9), Origin())
