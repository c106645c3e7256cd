"""The experiment of a fitted sensor; a run's pace; how few readings could do; angles within the symmetry of a shape."""

import math
from dataclasses import dataclass, replace
from math import e, log2, pi

import numpy as np
import pytest
from exploring import ChainArm, run
from hand_made import NAMES, sensor_of

from probewise.arm import Pose, Reading
from probewise.effects import Origin
from probewise.experiment import Experiment, experiment_for, least_readings
from probewise.experiment.from_sensor import AdjustedMixture, sensor_change_prior
from probewise.experiment.judgement import (
    probability_of_length_off,
    shape_moments_and_probabilities,
    with_aligned_angles,
)
from probewise.experiment.kinds import prior_posterior
from probewise.experiment.rivals import PACED_S_PER_READING, Pace, gain_loss, rivals_of
from probewise.inference import GaussianKnown
from probewise.inquiry import Readout
from probewise.inquiry.readout import capacity_bits
from probewise.nested import Weighted
from probewise.proof.study import REFERENCE, experiment_of
from probewise.scene import AnyOf, Circle, Field, HypothesisScene, Rectangle
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


def readings(s_per_reading, start_s=0.0):
    return [Reading(20.0, Pose(100.0 * k, 50.0 * (k % 3), 0.0), start_s + s_per_reading * k) for k in range(8)]


def rivals(name):
    plain = experiment_of(REFERENCE)
    return [r.effect for r in rivals_of(plain.model, plain.likelihood, (1048.0, 520.0)) if r.name == name]


@pytest.mark.parametrize("name", ["ambient_step", "offset_drift", "gain_drift", "lag"])
def test_a_fast_instrument_drifts_over_as_many_readings_as_a_slow_one(name):
    """The clock may even be that of the world, in seconds since 1970."""
    experiment = replace(experiment_of(REFERENCE), trust=0.9)
    slow, fast = (experiment.problem(readings(*clock)).recording.plan for clock in ((8.0,), (0.02, 1.7e9)))
    for effect in rivals(name):
        theta = effect.prior.from_unit_cube(np.random.default_rng(1).random((20, len(effect.prior.names))))
        value = np.tile(np.linspace(10.0, 60.0, 8), (20, 1))
        np.testing.assert_allclose(effect.apply(value, theta, fast), effect.apply(value, theta, slow), rtol=1e-4)


def test_parameters_are_told_by_the_clock():
    (step,) = rivals("ambient_step")
    pace = Pace.from_readings(readings(2.0))
    assert pace.s_per_reading == pytest.approx(2.0)
    np.testing.assert_allclose(pace.in_seconds(step, np.array([5.0, 4 * PACED_S_PER_READING])), [5.0, 8.0])
    (drift,) = rivals("offset_drift")
    np.testing.assert_allclose(pace.in_seconds(drift, np.array([1.0])), [4.0])


def test_a_lamp_that_begins_as_calibrated_may_fade():
    plan = experiment_of(REFERENCE).problem(readings(8.0)).recording.plan
    faded = gain_loss().apply(np.full((1, 8), 50.0), np.array([[-0.5, 800.0]]), plan)[0]
    assert faded[0] == 50.0
    assert (np.diff(faded) < 0).all()
    np.testing.assert_allclose(faded[-1], 50.0 * (1 - 0.5 * (1 - np.exp(-56.0 / 800.0))))


@pytest.mark.parametrize(("tau_s", "told"), [(10.0, "falls by 10 % in the end, 10 % in the"), (6000.0, "0.1 % in the")])
def test_a_lamp_never_fades_by_more_in_a_minute_than_in_the_end(tau_s, told):
    assert told in gain_loss().sentence(np.array([-0.1, tau_s]), np.zeros(2))


def test_samples_keep_their_seconds_where_the_pace_changes():
    """A step of the light between two readings stays there, and is as probable as by the other pace's prior."""
    experiment = replace(experiment_of(REFERENCE), trust=0.9)
    kind = next(kind for kind in experiment.kinds if kind.left_out == "ambient_step")
    rng = np.random.default_rng(2)
    slow = prior_posterior([kind], 4000, rng=rng).particles[0]
    fast = kind.at_pace(slow, 8.0, 4.0)
    np.testing.assert_allclose(fast.weighted.theta[:, -1], 2.0 * slow.weighted.theta[:, -1])
    np.testing.assert_array_equal(fast.weighted.theta[:, :-1], slow.weighted.theta[:, :-1])
    lost = slow.weighted.theta[:, -1] > 400.0  # later than a run by the new pace may be; log-uniform within
    np.testing.assert_allclose(fast.weighted.weight, np.where(lost, 0.0, 1.0 / (~lost).sum()))
    assert fast.log_z == pytest.approx(np.log((~lost).mean()))
    assert kind.at_pace(fast, 4.0, 8.0).log_z == pytest.approx(fast.log_z)
    plain = next(kind for kind in experiment.kinds if not kind.left_out)
    own = prior_posterior([plain], 300, rng=rng).particles[0]
    assert plain.at_pace(own, 8.0, 4.0) is own


def test_the_bound_is_that_of_the_prior_the_disc_and_the_sensor_by_hand():
    """A sensor so narrow that a place is met as often as the disc covers it: mean of pi r^2 over the field."""
    field = Field(1000.0, 500.0)
    shape = Circle(field, (50.0, 150.0))
    mixture = FixedMixture([1.0], [[0.0, 0.0]], [[[0.5, 0.0], [0.0, 0.5]]])
    model = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(shape), n_nodes=FAST_NODES)
    bound = least_readings(Experiment(shape, model, GaussianKnown(1.0), 1.0), rng=np.random.default_rng(0))
    covered = np.pi * (150.0**3 - 50.0**3) / (3 * 100.0) / (1000.0 * 500.0)
    prior_bits = log2(1000.0 * 500.0 * 100.0)
    assert bound.search_bits == pytest.approx(-log2(covered), abs=0.25)  # of 20,000 draws the best of all places
    target_bits = 1.5 * log2(2 * pi * e * 4.0**2)
    assert bound.refinement_bits == pytest.approx(prior_bits + log2(covered) - target_bits, abs=0.25)
    assert bound.capacity_bits == pytest.approx(capacity_bits(10.0, 60.0, Readout(1.0)))
    assert bound.search_capacity_bits == pytest.approx(
        -covered * log2(covered) - (1 - covered) * log2(1 - covered), abs=0.05
    )
    readings = bound.search_bits / bound.search_capacity_bits + bound.refinement_bits / bound.capacity_bits
    assert 5.0 < readings < 20.0


FIELD = Field(400.0, 300.0)
UPRIGHT = np.array([[200.0, 150.0, 80.0, 120.0, 0.02], [200.0, 150.0, 120.0, 80.0, math.pi / 2 - 0.02]])


@dataclass(frozen=True)
class Anything:
    """A sensor with these parameters that reads 0 everywhere."""

    names: tuple[str, ...]

    def predict(self, theta, plan):
        return np.zeros((len(theta), len(plan)))


def of_samples(small, shape, theta):
    """An experiment for the shape, and its posterior of equally weighted samples."""
    names = shape.prior.names
    experiment = small.experiment(shape=shape, model=Anything(names))
    even = np.full(len(theta), -math.log(len(theta)))
    return experiment, Weighted(names, theta, np.zeros(len(theta)), even, 0.0, 0.0, float(len(theta)), 0, -math.inf)


def test_an_upright_rectangle_has_two_sides_whatever_end_of_the_range_its_angles_lie_at(small):
    experiment, posterior = of_samples(small, Rectangle(FIELD), np.repeat(UPRIGHT, 50, axis=0))
    raw_sd = shape_moments_and_probabilities(experiment, posterior)[1]
    assert raw_sd[2] == pytest.approx(20.0)
    aligned = with_aligned_angles(experiment, posterior)
    mean, sd, _ = shape_moments_and_probabilities(experiment, aligned)
    assert sorted(mean[2:4]) == pytest.approx([80.0, 120.0])
    assert sd == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.02], abs=1e-9)
    assert probability_of_length_off(experiment, posterior, 12.0) == pytest.approx(1.0)
    assert probability_of_length_off(experiment, aligned, 12.0) == 0.0


def test_of_a_set_of_shapes_each_is_aligned_by_its_own_samples(small):
    shape = AnyOf({"circle": Circle(FIELD), "rectangle": Rectangle(FIELD)})
    circles = np.column_stack([np.full(10, 0.5), np.tile([200.0, 150.0, 50.0, 70.0, 70.0, 1.5], (10, 1))])
    rectangles = np.column_stack([np.full(20, 1.5), np.repeat(UPRIGHT, 10, axis=0)[:, :2], np.full(20, 50.0)])
    rectangles = np.column_stack([rectangles, np.repeat(UPRIGHT, 10, axis=0)[:, 2:]])
    experiment, posterior = of_samples(small, shape, np.concatenate([circles, rectangles]))
    _, sd, shapes = shape_moments_and_probabilities(experiment, with_aligned_angles(experiment, posterior))
    assert shapes["rectangle"] == pytest.approx(2 / 3)
    assert sd[[4, 5]] == pytest.approx([0.0, 0.0], abs=1e-9)
