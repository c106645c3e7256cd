"""Kinds of hypotheses weighed against each other at every reading, against sums over a lattice of all hypotheses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

from probewise.arm.instrument import Pose, Reading
from probewise.errors import NotConvergedError
from probewise.experiment.kinds import prior_posterior
from probewise.experiment.method import SequentialMonteCarlo
from probewise.scene import AnyOf

# The lead changes four times.
READINGS = [
    (120.0, 80.0, 10.3),
    (250.0, 140.0, 59.2),
    (262.0, 196.0, 12.0),
    (205.0, 140.0, 22.0),
    (300.0, 100.0, 57.0),
    (210.0, 60.0, 36.0),
]


def rng(seed=0):
    return np.random.default_rng(seed)


class Either:
    """The sensor over a small circle or a large one; theta as `AnyOf` has it."""

    def __init__(self, sensor):
        self.sensor = sensor
        self.names = ("shape", *(f"{size}.{name}" for size in ("small", "large") for name in sensor.names))

    def predict(self, theta, plan):
        large = theta[:, :1] >= 1
        return self.sensor.predict(np.where(large, theta[:, 4:], theta[:, 1:4]), plan)


def either(small, **changes):
    shapes = {"small": small.circle((20.0, 60.0)), "large": small.circle((60.0, 150.0))}
    return small.experiment(
        shape=AnyOf(shapes, (0.75, 0.25)),
        model=Either(small.sensor()),
        likelihood=changes.pop("likelihood", small.gaussian(4.0)),
        noise_sd=4.0,
        n_particles=changes.pop("n_particles", 1500),
        **changes,
    )


def readings(n):
    return [Reading(v, Pose(x, y), 0.0) for x, y, v in READINGS[:n]]


def followed(experiment, n, *, seed=0):
    random = rng(seed)
    now = prior_posterior(experiment.kinds, experiment.n_particles, rng=random)
    for k in range(1, n + 1):
        now = SequentialMonteCarlo(experiment.n_particles, experiment.n_live).updated(
            now, experiment.problem(readings(k)).recording, rng=random
        )
        yield now


def by_lattice(small, experiment, n):
    """Probability of the small circles, and ln Z."""
    odds = []
    for radii, share in ((np.arange(21, 60, 2.0), 0.75), (np.arange(61, 150, 2.0), 0.25)):
        axes = np.meshgrid(np.arange(1, 400, 2.0), np.arange(1, 300, 2.0), radii, indexing="ij")
        theta = np.stack([axis.ravel() for axis in axes], axis=1)
        plan = experiment.problem(readings(n)).recording.plan
        values = np.array([v for _, _, v in READINGS[:n]])
        log_likelihood = [
            experiment.likelihood.log_prob(values, small.sensor().predict(part, plan))
            for part in np.array_split(theta, 60)
        ]
        odds.append(math.log(share / len(theta)) + float(logsumexp(np.concatenate(log_likelihood))))
    return math.exp(odds[0] - logsumexp(odds)), float(logsumexp(odds))


@pytest.mark.slow
def test_probabilities_of_kinds_are_those_of_adding_up_all_hypotheses_at_every_reading(small):
    """Within .05 at every reading, though the lead changes; ln Z of the mixture within 0.15."""
    experiment = either(small)
    leads = set()
    for n, now in enumerate(followed(experiment, len(READINGS)), start=1):
        share, log_z = by_lattice(small, experiment, n)
        assert now.probability[0] == pytest.approx(share, abs=0.05)
        assert now.log_z == pytest.approx(log_z, abs=0.15)
        leads.add(share > 0.5)
    assert leads == {True, False}  # else the readings would not test it


def test_samples_of_all_kinds_are_one_posterior_of_the_whole(small):
    experiment = either(small, n_particles=300)
    *_, now = followed(experiment, 3)
    joined = now.joined(rng=rng())
    assert joined.names == experiment.names
    assert joined.weight.sum() == pytest.approx(1.0)
    which = experiment.shape.shape_index(joined.theta)
    np.testing.assert_allclose(np.bincount(which, weights=joined.weight), now.probability)
    assert np.isfinite(experiment.prior.log_prob(joined.theta)).all()
    np.testing.assert_allclose(
        experiment.problem(readings(3)).log_likelihood(joined.theta), joined.log_likelihood, atol=1e-9
    )


class Window:
    """Allows readings within 12 units, and no others."""

    def log_prob(self, values, predicted):
        return np.where((np.abs(values - predicted) < 12.0).all(axis=1), 0.0, -np.inf)


def test_a_kind_that_cannot_be_is_impossible_and_the_others_go_on(small):
    """White at places 100 mm apart, black between circles: no circle of at most 60 mm does it."""
    experiment = either(small, likelihood=Window())
    taken = [Reading(60.0, Pose(150.0, 140.0), 0.0), Reading(60.0, Pose(290.0, 140.0), 0.0)]
    random = rng()
    now = prior_posterior(experiment.kinds, 1500, rng=random)
    for k in (1, 2):
        now = SequentialMonteCarlo(1500, experiment.n_live).updated(
            now, experiment.problem(taken[:k]).recording, rng=random
        )
    np.testing.assert_array_equal(now.probability, [0.0, 1.0])


def test_readings_that_no_kind_allows_are_refused(small):
    experiment = either(small, likelihood=Window())
    random = rng()
    now = prior_posterior(experiment.kinds, 300, rng=random)
    with pytest.raises(NotConvergedError):
        SequentialMonteCarlo(300, experiment.n_live).updated(
            now, experiment.problem([Reading(200.0, Pose(150.0, 140.0), 0.0)]).recording, rng=random
        )


def last_of(small, n=4):
    """The posterior of one kind, large circles, given some readings; and these."""
    experiment = small.experiment(
        shape=small.circle((20.0, 150.0)),
        model=small.sensor(),
        likelihood=small.gaussian(4.0),
        noise_sd=4.0,
        n_particles=1000,
    )
    *_, now = followed(experiment, n)
    return now, experiment.problem(readings(n)).recording


def checked(now, recording):
    return SequentialMonteCarlo(3000, n_live=200).reconsidered(now, recording, rng=rng(2))


@pytest.mark.parametrize("share", [0.02, 0.7])
def test_a_part_of_the_posterior_that_the_samples_lost_is_found_before_a_run_ends(small, share):
    """The samples are confined to a share of the posterior, the largest radii: ln Z is too small by its log."""
    now, recording = last_of(small)
    (whole,) = now.particles
    theta, weight = whole.weighted.theta, whole.weighted.weight
    kept = theta[:, 2] >= np.quantile(theta[:, 2], 1 - share)
    log_weight = np.where(kept, np.log(np.maximum(weight, 1e-300)) - math.log(weight[kept].sum()), -np.inf)
    few = replace(whole.weighted, log_weight=log_weight, log_z=whole.log_z + math.log(share))
    found = checked(replace(now, particles=(replace(whole, weighted=few),)), recording).particles[0]
    assert found.log_z == pytest.approx(whole.log_z, abs=0.5)
    away = np.abs(found.weighted.mean() - whole.weighted.mean()) / whole.weighted.sd()
    assert (away < 0.4).all()


def test_samples_that_lost_nothing_stay_as_they_are(small):
    now, recording = last_of(small)
    again = checked(now, recording)
    assert again.particles[0].weighted is now.particles[0].weighted
    assert checked(again, recording).particles[0] is again.particles[0]  # it was checked just now
