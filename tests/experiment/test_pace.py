"""A run's own time: what drifts does so over so many readings, whatever the clock says of them."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.arm import Pose, Reading
from probewise.experiment.kinds import prior_posterior
from probewise.experiment.rivals import PACED_S_PER_READING, Pace, gain_loss, rivals_of
from probewise.proof.study import REFERENCE, experiment_of


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
