"""The posterior carried from reading to reading, and over kinds, against sums over a lattice of hypotheses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from probewise.arm.instrument import Pose, Reading
from probewise.errors import NotConvergedError
from probewise.experiment.evidence import sampled_about_points
from probewise.experiment.kinds import prior_posterior
from probewise.experiment.method import SequentialMonteCarlo
from probewise.inquiry.smc import (
    THOROUGH,
    LocalKernels,
    Particles,
    _EvaluatedSamples,
    _move_by_metropolis,
    prior_particles,
    update,
)
from probewise.nested import run
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


READINGS_OF_PARTICLES = [
    (120.0, 80.0, 10.3),
    (300.0, 200.0, 9.6),
    (250.0, 140.0, 59.2),
    (250.0, 203.0, 36.0),
    (190.0, 140.0, 41.5),
]


def never():
    raise AssertionError("no reading here is a surprise")


def noisy(small):
    return small.experiment(likelihood=small.gaussian(4.0), noise_sd=4.0)


def problem_of(small, n):
    """Noise of 4 units, so that a lattice of 2 mm can add up what is as sharp as 1.6 mm."""
    return noisy(small).problem([Reading(v, Pose(x, y), 0.0) for x, y, v in READINGS_OF_PARTICLES[:n]])


def particles(small, *, n_particles=3000, seed=0, steps=5, fall_back=never):
    random = rng(seed)
    found = prior_particles(problem_of(small, 0).prior, n_particles, rng=random)
    for n in range(1, steps + 1):
        found = update(found, problem_of(small, n), rng=random, fall_back=fall_back)
    return found


def carried(small, **options):
    return particles(small, **options).weighted


@pytest.fixture(scope="module")
def lattice():
    """Every hypothesis of the small prior at 2 mm: x, y, radius."""
    axes = np.meshgrid(np.arange(1, 400, 2.0), np.arange(1, 300, 2.0), np.arange(21, 150, 2.0), indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=1)


def by_lattice_of_particles(small, lattice, n):
    """log Z, mean and sd by adding up; see `problem_of`."""
    problem = problem_of(small, n)
    log_likelihood = np.concatenate([problem.log_likelihood(part) for part in np.array_split(lattice, 100)])
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()
    mean = weight @ lattice
    return float(logsumexp(log_likelihood)) - math.log(len(lattice)), mean, np.sqrt(weight @ (lattice - mean) ** 2)


@pytest.mark.parametrize("n", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 5))])
def test_evidence_and_moments_are_those_of_adding_up_all_hypotheses(small, lattice, n):
    """log Z within five of its stated errors (0.05 besides, for the lattice); means within 15 % of the sds."""
    posterior = carried(small, steps=n)
    log_z, mean, sd = by_lattice_of_particles(small, lattice, n)
    assert posterior.log_z == pytest.approx(log_z, abs=5 * posterior.log_z_error + 0.05)
    np.testing.assert_allclose(posterior.mean(), mean, atol=0.15 * sd.max())
    np.testing.assert_allclose(posterior.sd(), sd, rtol=0.12)


@pytest.mark.slow
def test_the_stated_error_of_the_evidence_is_its_scatter(small):
    """Twelve seeds: a chi-square of 11 degrees of freedom, 1e-4 on either side, and a factor for correlations."""
    runs = [carried(small, n_particles=600, seed=seed) for seed in range(12)]
    z = (np.array([r.log_z for r in runs]) - np.mean([r.log_z for r in runs])) / np.array([r.log_z_error for r in runs])
    assert 1.6 < (z**2).sum() < 4 * 36.0


def test_a_reading_that_keeps_the_samples_has_each_predict_once(small):
    problem, asked = problem_of(small, 1), []

    class Counted:
        names = problem.model.names

        def predict(self, theta, plan):
            asked.append(len(theta))
            return problem.model.predict(theta, plan)

    start = prior_particles(problem.prior, 300, rng=rng())
    kept = update(start, replace(problem, model=Counted()), rng=rng(), fall_back=never)
    np.testing.assert_array_equal(kept.weighted.theta, start.weighted.theta)
    assert asked == [300]
    assert kept.weighted.n_calls == 300


def test_a_reading_that_surprises_is_taken_in_from_scratch(small):
    """A posterior certain of the left half, then a reading on white in the right one."""
    problem = problem_of(small, 3)
    theta = problem.prior.from_unit_cube(rng().random((500, 3)))
    theta[:, 0] *= 0.2
    even = np.full(500, -math.log(500))
    start = prior_particles(problem.prior, 500, rng=rng()).weighted
    certain = type(start)(start.names, theta, np.zeros(500), even, 0.0, 0.0, 500.0, 0, -math.inf)
    before = Particles(certain, np.arange(500))
    assert update(before, problem, rng=rng(1)).strained
    found = update(before, problem, rng=rng(1), fall_back=lambda: run(problem, rng=rng(2), n_live=100)).weighted
    assert found.run is not None
    assert found.log_z == found.run.log_z
    assert found.mean()[0] == pytest.approx(250.0, abs=40.0)
    assert len(found.theta) == 500


def test_a_missing_reading_changes_nothing(small):
    before = particles(small, n_particles=300, steps=3)
    readings = [Reading(v, Pose(x, y), 0.0) for x, y, v in READINGS_OF_PARTICLES[:3]]
    problem = noisy(small).problem([*readings, Reading(math.nan, Pose(10.0, 10.0), 1.0)])
    after = update(before, problem, rng=rng(), fall_back=never)
    np.testing.assert_allclose(after.weighted.log_weight, before.weighted.log_weight)
    assert after.log_z == pytest.approx(before.log_z)


@pytest.mark.slow
def test_what_is_redrawn_has_its_shares_from_the_readings_not_from_where_it_began(small, lattice):
    """Nine in ten of the points are of the half of the posterior where the centre is to the left of its mean."""
    posterior, problem = carried(small, steps=4, fall_back=None), problem_of(small, 4)
    log_z, mean, sd = by_lattice_of_particles(small, lattice, 4)
    points = posterior.samples(2000, rng=rng(1))
    left = points[:, 0] < mean[0]
    uneven = np.concatenate([points[left], points[~left][: left.sum() // 9]])
    found = sampled_about_points(uneven, problem, 8000, rng(2))
    assert found.mean()[0] == pytest.approx(mean[0], abs=0.15 * sd[0])
    assert found.log_z == pytest.approx(log_z, abs=5 * found.log_z_error + 0.05)


def test_the_genealogy_tells_when_few_samples_at_the_start_are_ancestors_of_all(small):
    many = particles(small, n_particles=600, fall_back=None)
    few = replace(many, ancestor=many.ancestor % 4)
    assert many.log_z_error < 0.3
    assert few.log_z_error > 0.4


def test_kernels_have_the_density_of_the_gaussians_they_draw_from():
    """Two routes to the density: the product of features, and scipy's for each kernel."""
    points = rng().normal(size=(400, 3)) * [30.0, 1.0, 8.0] + [500.0, 200.0, 80.0]
    kernels = LocalKernels.fitted_to(points, rng=rng(1))
    at = kernels.draw(50, rng=rng(2))
    each = [
        multivariate_normal(kernels.origin + centre, root @ root.T).pdf(at)
        for centre, root in zip(kernels.centre, kernels.root, strict=True)
    ]
    np.testing.assert_allclose(kernels.log_density(at), np.log(np.mean(each, axis=0)), atol=1e-4)


def test_samples_that_have_collapsed_on_a_point_still_have_kernels_about_it():
    """Samples that differ by rounding error alone, one coordinate not at all, had a covariance without a root."""
    exact = np.array([577.0, 357.0, 97.0, 0.0354365305, 0.0])
    points = exact + 1e-16 * exact * rng().integers(-20, 20, size=(500, 5))
    kernels = LocalKernels.fitted_to(points, rng=rng(1))
    drawn = kernels.draw(100, rng=rng(2))
    np.testing.assert_allclose(drawn, np.broadcast_to(exact, drawn.shape), rtol=1e-6, atol=1e-90)
    assert np.isfinite(kernels.log_density(drawn)).all()


def test_copies_of_one_sample_are_not_moved(small):
    """They are left where they are, and the posterior is marked as strained."""
    problem = small.experiment().problem([Reading(40.0, Pose(50.0, 30.0, 0.0), 1.0)])
    theta = np.repeat(problem.prior.from_unit_cube(np.full((1, len(problem.prior.names)), 0.5)), 60, axis=0)
    start = _EvaluatedSamples.of(theta, problem, 1.0)
    moved, accepted, _ = _move_by_metropolis(start, 1.0, problem, rng(1), [np.arange(len(theta))], THOROUGH)
    assert accepted == 0.0
    np.testing.assert_array_equal(moved.theta, theta)
