import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from quick_calibration import TrueSensor
from scipy.stats import ks_2samp

from probewise.calibration import calibrate, default_prior, estimate_ssf, paper_prior, problem_for
from probewise.errors import DoubtfulResultWarning, ParameterError
from probewise.nested import EvidenceChange
from probewise.recordings import fingerprint


def test_calibration_finds_the_parameters_that_made_the_readings(calibration, truth):
    """Within four posterior sds of each: a right fit fails once in 2 000."""
    sensor = calibration.sensor
    mean, sd = sensor.samples.mean(axis=0)[1:], sensor.samples.std(axis=0)[1:]
    assert (np.abs(mean - truth[1:]) < 4 * sd).all()
    assert (sd[:2] < 0.3).all()


def test_the_calibration_says_what_it_rests_on(calibration, recording):
    sensor = calibration.sensor
    assert sensor.fingerprint == fingerprint(recording)
    assert sensor.source == "edges.csv"
    assert [(o.n_gaussians, o.n_parameters) for o in calibration.orders] == [(1, 8)]
    assert calibration.orders[0].log_z == calibration.chosen.log_z
    assert calibration.orders[0].log_z_error == calibration.chosen.log_z_error > 0
    assert len(sensor.priors) == 6
    assert calibration.fields[1].values.sum() == pytest.approx(1.0)
    assert "most probable" in calibration.summary()
    json.loads(sensor.to_json())


def test_readings_left_out_change_nothing_but_are_counted(recording, truth):
    readings = recording.readings.copy()
    readings[[3, 70]] = np.nan
    problem = problem_for(replace(recording, readings=readings), default_prior(recording, 1))
    keep = np.isfinite(readings)
    other = problem_for(recording.take(keep), default_prior(recording, 1))
    ours, theirs = problem.log_likelihood(truth[None])[0], other.log_likelihood(truth[None])[0]
    assert ours == pytest.approx(theirs, abs=1e-9)


@pytest.mark.slow
def test_fewer_readings_than_parameters_are_warned_of_and_noted(recording):
    few = recording.take(np.array([0, 10, 15, 17, 20, 33]))
    rounds = []
    with pytest.warns(DoubtfulResultWarning, match="6 usable readings for 8 parameters"):
        found = calibrate(
            few,
            orders=(1,),
            n_live=40,
            rng=np.random.default_rng(17),
            progress=lambda order, state: rounds.append((order, state)),
        )
    assert any("6 usable readings" in note for note in found.sensor.notes)
    assert any("along 90 degrees" in note for note in found.sensor.notes)
    assert {order for order, _ in rounds} == {1}


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"executor": 2}, "executor is 2; allowed: an Executor"),
        ({"orders": ()}, "orders"),
        ({"orders": (0, 1)}, "orders"),
    ],
)
@pytest.mark.parametrize("quick", [True, False])
def test_what_the_sensor_cannot_have_is_refused_before_the_search(recording, asked, message, quick):
    def prior(recording, n_gaussians):
        raise AssertionError("a search began")

    with pytest.raises(ParameterError, match=message):
        calibrate(recording, prior=prior, quick=quick, rng=np.random.default_rng(1), **asked)


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    """20 recordings, 7 quantities: by the binomial 17 or more of 20 each, but for 1.6 %; 14 but for 3e-5."""
    held = []
    for rng in np.random.default_rng(19).spawn(20):
        truth = TrueSensor.drawn(rng)
        found = calibrate(truth.record(rng), orders=(1,), n_live=100, rng=rng)
        held.append(list(truth.held(found.sensor.samples).values()))
    assert np.sum(held, axis=0).min() >= 14
    assert np.sum(held) >= 122


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")
def test_orders_run_elsewhere_give_the_same_result(recording):
    """Every order has a stream of its own: here one after another, there on an executor. Thirty live points are few."""
    here, there = (
        calibrate(recording, orders=(1, 2), n_live=30, rng=np.random.default_rng(3), executor=executor)
        for executor in (None, ThreadPoolExecutor(2))
    )
    assert [o.log_z for o in here.orders] == [o.log_z for o in there.orders]
    np.testing.assert_array_equal(here.sensor.samples, there.sensor.samples)


def test_the_papers_prior_is_flat_over_the_matrices_that_rejection_leaves(recording):
    """Uniform A, B and C, drawn in a box, kept where abs(C) < 0.98 sqrt(A B): same volume, quantiles, density."""
    paper = paper_prior(recording, 1)
    rng = np.random.default_rng(1)
    low, high = paper.precision.low, paper.precision.high
    box = rng.uniform([low, low, -high], high, (400_000, 3))
    kept = box[np.abs(box[:, 2]) < 0.98 * np.sqrt(box[:, 0] * box[:, 1])]
    drawn = paper.from_unit_cube(rng.random((40_000, 8)))
    for column in (kept.T, (kept[:, 0] * kept[:, 1] - kept[:, 2] ** 2)[None]):
        theirs = drawn[:, 3:6].T if len(column) == 3 else (drawn[:, 3] * drawn[:, 4] - drawn[:, 5] ** 2)[None]
        assert all(ks_2samp(*pair).pvalue > 1e-4 for pair in zip(column, theirs, strict=True))
    density = paper.log_prob(drawn)
    np.testing.assert_allclose(density, density[0])
    others = np.ptp(paper.from_unit_cube(np.array([[0.0] * 8, [1.0] * 8]))[:, [0, 1, 2, 6, 7]], axis=0)
    volume = 2 * high * (high - low) ** 2 * len(kept) / len(box)
    assert density[0] == pytest.approx(-np.log(others).sum() - np.log(volume), abs=0.01)


@pytest.mark.slow
def test_the_papers_evidence_is_that_of_importance_sampling_under_the_same_prior(recording):
    """Two routes to one number: nested sampling to a change of 1e-8, and importance sampling from another run."""
    rng, other_rng = map(np.random.default_rng, (1, 2))
    ((_, nested, field),) = estimate_ssf(recording, orders=[1], n_live=100, rng=rng)
    other = calibrate(recording, rng=other_rng, n_live=300, orders=[1], prior=paper_prior)
    (refined,) = other.fits
    assert refined.found.refined.sound
    assert abs(nested.log_z - refined.log_z) < 4 * np.hypot(nested.log_z_error, refined.log_z_error)
    assert field.mean_mm == pytest.approx(refined.field.mean_mm, abs=0.2)


@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")  # of few live points
def test_calibration_by_the_papers_method_is_its_loop(recording):
    rng, same = np.random.default_rng(1), np.random.default_rng(1)
    ((_, nested, _),) = estimate_ssf(recording, orders=[1], n_live=20, rng=rng.spawn(1)[0])
    stop = EvidenceChange(1e-8)
    made = calibrate(recording, orders=[1], prior=paper_prior, n_live=20, stop=stop, refined=False, rng=same)
    assert made.chosen.log_z == nested.log_z
    assert any("nested sampling alone" in note for note in made.sensor.notes)
