from __future__ import annotations

import functools
from collections.abc import Callable
from typing import cast

import numpy as np
import pytest

from probewise._arrays import FloatArray, IntArray
from probewise.calibration import SSFPrior, default_prior
from probewise.calibration.compensation import CompensatedShapeProposal
from probewise.calibration.faint_gaussian_reference import FaintGaussianReferenceDensity, has_uniform_prior_of_light
from probewise.calibration.label_symmetric_coordinates import LabelSymmetricCoordinates
from probewise.calibration.mixed_reference import MixedReferenceDensity
from probewise.calibration.order_problems import ProblemsByOrder
from probewise.calibration.peak_density import PeakDensity, StudentTDensity
from probewise.calibration.whole_coordinates import FAINT, count_bright_gaussians
from probewise.errors import ParameterError
from probewise.inference import SensorProblem
from probewise.nested.weights import n_effective
from probewise.priors import LogUniform, Uniform
from probewise.recordings import Recording

SortedDraws = Callable[[int, int, int, np.random.Generator], tuple[FloatArray, float]]


class _Silent:
    """A recording that says nothing: the posterior is the prior, the evidence one."""

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        return np.zeros(len(theta))


N_PRIOR_DRAWS = 400_000


@pytest.fixture(scope="module")
def sorted_draws(recording: Recording) -> SortedDraws:
    """Draws from the prior of an order, Gaussians sorted by mass, of which so many are bright; and their share."""

    @functools.cache
    def draws_of_prior(order: int) -> tuple[FloatArray, IntArray]:
        prior = default_prior(recording, order)
        space = prior.coordinates
        unit = np.random.default_rng(35 + order).random((N_PRIOR_DRAWS, len(prior.names)))
        theta = space.leave(space.enter(prior.from_unit_cube(unit)))[0]
        return theta, count_bright_gaussians(theta)

    def draw(order: int, n_bright: int, n: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
        theta, n_bright_of_draws = draws_of_prior(order)
        kept = theta[n_bright_of_draws == n_bright]
        return kept[rng.integers(len(kept), size=n)], len(kept) / len(theta)

    return draw


PARTS = [(2, 1), (3, 1), (3, 2)]


@pytest.fixture(scope="module")
def references(
    recording: Recording, make_compensation: Callable[..., CompensatedShapeProposal]
) -> dict[tuple[int, int], FaintGaussianReferenceDensity]:
    silent, rng = cast("SensorProblem", _Silent()), np.random.default_rng(30)
    return {
        (n, m): FaintGaussianReferenceDensity(default_prior(recording, n), silent, make_compensation(n, rng), m)
        for n, m in PARTS
    }


def _possible_rows(prior: SSFPrior, drawn: FloatArray, n_bright: int) -> IntArray:
    """Return the rows of draws that the prior allows, with this number of bright Gaussians."""
    alive = np.flatnonzero(np.isfinite(drawn).all(axis=1))
    return alive[np.isfinite(prior.log_prob(drawn[alive])) & (count_bright_gaussians(drawn[alive]) == n_bright)]


@pytest.mark.parametrize(("n", "m"), PARTS)
def test_weights_turn_draws_of_the_reference_into_those_of_the_prior(
    references: dict[tuple[int, int], FaintGaussianReferenceDensity], sorted_draws: SortedDraws, n: int, m: int
) -> None:
    """Mean weight the prior's share, and moments of its own draws; four standard errors: one false alarm in 16 000."""
    rng = np.random.default_rng(31)
    reference = references[n, m]
    rest, below = sorted_draws(n - 1, m, 20_000, rng)
    drawn = reference.draw(rest, rng=rng)
    weight = np.zeros(len(drawn))
    alive = _possible_rows(reference.prior, drawn, m)
    coordinates = reference.prior.coordinates
    drawn[alive] = coordinates.leave(coordinates.enter(drawn[alive]))[0]
    weight[alive] = below * np.exp(-reference.log_density_over_prior(drawn[alive]))
    assert 0.2 < len(alive) / len(drawn) < 1.0
    plain, share = sorted_draws(n, m, 20_000, rng)
    error_of_mean = np.hypot(weight.std() / np.sqrt(len(weight)), np.sqrt(share / N_PRIOR_DRAWS))
    assert abs(weight.mean() - share) < 4 * error_of_mean

    def asked(theta: FloatArray) -> FloatArray:
        """The first is narrower along x' than the last, the last sits left of it."""
        return ((theta[:, 3] > theta[:, -5]) & (theta[:, -7] < theta[:, 1])).astype(float)

    found = np.zeros(len(drawn))
    found[alive] = weight[alive] * asked(drawn[alive]) / share
    error = np.hypot(found.std(), asked(plain).std()) / np.sqrt(len(drawn))
    assert abs(found.mean() - asked(plain).mean()) < 4 * error


def test_weights_turn_draws_from_below_and_about_a_peak_into_those_of_the_prior(
    references: dict[tuple[int, int], FaintGaussianReferenceDensity], sorted_draws: SortedDraws
) -> None:
    """Where the recording says nothing: mean weight the share of the prior with one bright Gaussian, four errors."""
    rng, space = np.random.default_rng(36), LabelSymmetricCoordinates(references[2, 1].prior)
    y = space.enter(space.prior.from_unit_cube(rng.random((2000, 14))))
    peaks = tuple(
        PeakDensity(space, StudentTDensity(y.mean(axis=0), width * np.linalg.cholesky(np.cov(y, rowvar=False))))
        for width in (0.4, 0.9)
    )
    seeded = MixedReferenceDensity(references[2, 1], peaks, 0.0)
    drawn = seeded.draw(sorted_draws(1, 1, 10_000, rng)[0], rng=rng)
    weight = np.zeros(len(drawn))
    alive = _possible_rows(seeded.prior, drawn, 1)
    coordinates = seeded.prior.coordinates
    weight[alive] = np.exp(-seeded.log_density_over_prior(coordinates.leave(coordinates.enter(drawn[alive]))[0]))
    # The lighter of two uniform numbers is below a tenth of the other.
    assert abs(weight.mean() - FAINT) < 4 * weight.std() / np.sqrt(len(weight)) < 0.04
    there, log_drawn = seeded.propose_moves(drawn[alive], rng=rng)
    assert there.shape == (len(alive), 14)
    assert np.isfinite(log_drawn).mean() > 0.1
    assert seeded.propose_moves(drawn[:0], rng=rng)[0].shape == (0, 14)


@pytest.mark.parametrize(("n", "m"), PARTS)
def test_undoing_a_compensated_gaussian_gives_the_others_back(
    references: dict[tuple[int, int], FaintGaussianReferenceDensity], sorted_draws: SortedDraws, n: int, m: int
) -> None:
    rng = np.random.default_rng(33)
    reference = references[n, m]
    rest, _ = sorted_draws(n - 1, m, 200, rng)
    drawn = reference.with_compensated_gaussian(rest, rng=rng)
    possible = np.isfinite(drawn).all(axis=1)
    drawn, rest = drawn[possible], rest[possible]
    back, log_density = reference.without_compensated_gaussian(drawn)
    alive = np.isfinite(log_density)
    assert alive.sum() > 20
    assert not np.allclose(drawn[alive, 1], rest[alive, 1], rtol=1e-6)
    np.testing.assert_allclose(back[alive], rest[alive], rtol=1e-6, atol=1e-9)


def test_compensation_is_the_refit_of_least_squares(recording: Recording, truth: FloatArray, noise_sd: float) -> None:
    """Two routes: covariances over posterior samples, and the normal equations with a numerical derivative."""
    rng = np.random.default_rng(34)
    problems = ProblemsByOrder(recording, default_prior)
    problem, space = problems.problem(1), default_prior(recording, 1).coordinates
    truth = truth.copy()
    truth[0] = 0.5  # changes no reading; below the prior's bound

    def predicted(x: FloatArray) -> FloatArray:
        return problem.model.predict(space.leave(x)[0], recording.plan)

    told = [1, 2, 3, 4, 6, 7]  # edges at right angles say nothing of the correlation
    centre, step = space.enter(truth[None]), 1e-5 * np.eye(8)[told]
    slope = (predicted(centre + step) - predicted(centre - step)) / 2e-5
    covariance = noise_sd**2 * np.linalg.inv(slope @ slope.T)
    x = np.tile(centre, (4000, 1))
    x[:, told] += rng.standard_normal((4000, 6)) @ np.linalg.cholesky(covariance).T
    compensation = CompensatedShapeProposal.from_samples(problem, space, problem, space.leave(x)[0], rng=rng, n_pool=10)
    other = np.array([[1.0, 4.0, -3.0, 0.02, 0.05, 0.0]])
    lone = np.concatenate([other, truth[None, -2:]], axis=1)
    change = problem.model.predict(lone, recording.plan)[0] - predicted(centre)[0]
    refit = -np.linalg.solve(slope @ slope.T, slope @ change)
    shift = compensation.linear.shift_for_added_gaussian(other).shift[0]
    assert shift[0] == 0.0
    assert compensation.linear.shift_for_added_gaussian(other[:0]).shift.shape == (0, 8)
    sds = np.sqrt(np.diag(covariance))
    apart = np.linalg.norm((shift[told] - refit) / sds)
    assert apart < 0.15 * np.linalg.norm(refit / sds)


def test_the_pool_grows_until_enough_of_its_shapes_are_effective(
    make_compensation: Callable[..., CompensatedShapeProposal],
) -> None:
    compensation = make_compensation(2, np.random.default_rng(33), n_pool=60_000)
    log_asked = 0.8 * compensation.answers.log_bayes_factor(compensation.most)
    n = len(log_asked)
    assert len(compensation.pool) == n
    assert n == 60_000 or n_effective(log_asked) >= 4000
    assert n == 12_000 or n_effective(log_asked[:-12_000]) < 4000
    assert len(make_compensation(2, np.random.default_rng(33), n_pool=5000).pool) == 5000


@pytest.mark.parametrize(("n", "m"), PARTS)
def test_a_split_keeps_light_centre_and_covariance(
    references: dict[tuple[int, int], FaintGaussianReferenceDensity], sorted_draws: SortedDraws, n: int, m: int
) -> None:
    rng = np.random.default_rng(32)
    rest, _ = sorted_draws(n - 1, m, 200, rng)
    for label in range(m):
        split = references[n, m].split_gaussian_off_bright_one(rest, label, rng=rng)
        alive = np.isfinite(split).all(axis=1)
        assert alive.sum() > 50
        merged, log_density = references[n, m].merge_last_gaussian_into_bright_one(split[alive], label)
        np.testing.assert_allclose(merged, rest[alive], rtol=1e-6)
        assert np.isfinite(log_density).mean() > 0.5


def test_only_a_uniform_prior_of_light_has_a_reference(
    references: dict[tuple[int, int], FaintGaussianReferenceDensity], recording: Recording
) -> None:
    usual = default_prior(recording, 2)
    paper = SSFPrior(2, usual.offset_mm, LogUniform(0.001, 1.0), usual.i_min, Uniform(50.0, 60.0))
    assert has_uniform_prior_of_light(usual)
    assert not has_uniform_prior_of_light(paper)
    with pytest.raises(ParameterError, match="prior"):
        FaintGaussianReferenceDensity(paper, cast("SensorProblem", _Silent()), references[2, 1].compensation, 1)


@pytest.mark.parametrize(("n", "m"), PARTS)
def test_gaussians_that_are_redrawn_leave_the_prior_as_it_is(
    make_compensation: Callable[..., CompensatedShapeProposal],
    sorted_draws: SortedDraws,
    recording: Recording,
    n: int,
    m: int,
) -> None:
    """Where the recording says nothing: means and mean squares in the prior's cube, within five errors of uniform ones.

    The last Gaussian is drawn from a pool, which differs from the prior by the scatter of 4,000 shapes.
    """
    rng, prior = np.random.default_rng(35), default_prior(recording, n)
    reference = FaintGaussianReferenceDensity(
        prior, cast("SensorProblem", _Silent()), make_compensation(n, rng, spread=2e-3), m
    )
    here, _ = sorted_draws(n, m, 3000, rng)
    start = here
    for _ in range(12):
        there, log_drawn = reference.propose_moves(here, rng=rng)
        moved = np.isfinite(there).all(axis=1)
        moved[moved] = np.isfinite(prior.log_prob(there[moved])) & (count_bright_gaussians(there[moved]) == m)
        moved &= np.log(rng.random(len(here))) < log_drawn
        here = np.where(moved[:, None], there, here)
        here = prior.coordinates.leave(prior.coordinates.enter(here))[0]
    assert (np.abs(here - start) > 1e-9).any(axis=1).mean() > 0.1
    shapes = prior.to_unit_cube(here)[:, :-2].reshape(len(here), n, 6)[:, :, 1:].reshape(-1, 5)
    root = np.sqrt(len(here)) / np.hypot(1.0, np.sqrt(3000 / 4000))
    assert (np.abs(shapes.mean(axis=0) - 1 / 2) < 5 * np.sqrt(1 / 12) / root).all()
    assert (np.abs((shapes**2).mean(axis=0) - 1 / 3) < 5 * np.sqrt(4 / 45) / root).all()
