"""Few evaluations for slow likelihoods: known evidences, honest errors, and what happens where no density fits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from nested_sampling import hard, problems
from nested_sampling.sampler import Counted

from probewise.errors import ParameterError
from probewise.nested import run_in_few_calls
from probewise.nested.mixture import fit_mixture, single_student_t

N_ERRORS = 3.9


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng([20261124, seed])


def two_spots(theta: np.ndarray) -> np.ndarray:
    """Two spots, three to one: log Z is that of the unit square's share."""
    near, far = ((theta - 0.25) ** 2).sum(axis=1), ((theta - 0.75) ** 2).sum(axis=1)
    return np.logaddexp(math.log(0.75) - 0.5 * near / 0.01**2, math.log(0.25) - 0.5 * far / 0.01**2)


def test_a_gaussian_is_right_to_the_error_asked_for() -> None:
    known = problems.gaussian(2, 0.5)
    counted, told = Counted(known), list[int]()
    found = run_in_few_calls(counted, rng=rng(), error=0.02, progress=told.append)
    assert found.sound
    assert found.run is None
    assert abs(found.log_z - known.log_z) < N_ERRORS * found.log_z_error < N_ERRORS * 0.026
    assert found.n_calls == counted.n_evaluations == told[-1]
    assert told == sorted(told)


@pytest.mark.slow
def test_a_plain_function_of_one_point_gives_the_same_as_one_of_a_batch() -> None:
    prior = problems.box(2, 0, 1)
    one = run_in_few_calls(lambda theta: float(two_spots(theta[None])[0]), prior, rng=rng(2), error=0.2)
    many = run_in_few_calls(two_spots, prior, vectorized=True, rng=rng(2), error=0.2)
    assert one.log_z == pytest.approx(many.log_z, abs=1e-9)
    assert abs(many.log_z - math.log(2 * math.pi * 0.01**2)) < N_ERRORS * many.log_z_error
    assert many.weight @ (many.theta[:, 0] < 0.5) == pytest.approx(0.75, abs=0.12)


def test_an_error_much_finer_than_what_was_asked_for_is_not_claimed() -> None:
    assert run_in_few_calls(problems.gaussian(2), rng=rng(3), error=0.5).log_z_error >= 0.5


def test_where_draws_do_not_reach_the_posterior_an_ordinary_run_follows() -> None:
    known = problems.gaussian(8, 0.9)
    found = run_in_few_calls(known, rng=rng(4), max_calls=5000)
    assert found.run is not None
    assert found.n_calls <= 5000
    assert any("max_calls" in doubt for doubt in found.doubts)
    assert not found.sound


@pytest.mark.slow
def test_a_prior_of_which_little_is_possible_is_drawn_from_until_enough_is() -> None:
    def corner(theta: np.ndarray) -> np.ndarray:
        return np.where((theta < 0.1).all(axis=1), 0.0, -np.inf)

    found = run_in_few_calls(corner, problems.box(2, 0, 1), vectorized=True, rng=rng(5))
    assert abs(found.log_z - math.log(0.01)) < N_ERRORS * found.log_z_error


@pytest.mark.slow
def test_in_six_dimensions_a_narrow_part_may_be_lost_and_the_result_says_so() -> None:
    """Of two seeds one loses the needle, and with it 4.5 nats."""
    known = hard.needle_beside_hill()
    found = [run_in_few_calls(known, rng=np.random.default_rng([seed, 28])) for seed in range(2)]
    assert all("narrow part of the posterior" in one.doubts[-1] for one in found)
    assert not any(one.sound for one in found)


def test_options_out_of_range_are_refused() -> None:
    known = problems.gaussian(2)
    for options, message in (
        ({"error": 0.0}, "error is 0.0; allowed: greater than 0"),
        ({"error": math.nan}, "error is nan"),
        ({"max_calls": 100}, "max_calls is 100"),
        ({"prior": known.prior}, "given beside a problem that has its own"),
    ):
        with pytest.raises(ParameterError, match=message):
            run_in_few_calls(known, rng=rng(), **options)


def test_a_mixture_is_a_density_and_finds_the_parts() -> None:
    draw = rng(6)
    x = np.concatenate([draw.normal((-2, 0), 0.3, (300, 2)), draw.normal((2, 1), 0.6, (100, 2))])
    fitted = fit_mixture(x, rng=draw)
    side = np.linspace(-12, 12, 481)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    # Student t: a hundredth of the density lies outside of the grid.
    assert np.exp(fitted.log_density(grid)).sum() * (side[1] - side[0]) ** 2 == pytest.approx(1.0, abs=0.01)
    left = fitted.clusters.mean[:, 0] < 0
    assert fitted.share[left].sum() == pytest.approx(0.75, abs=0.02)
    weighted = fit_mixture(x, np.repeat([1.0, 3.0], [300, 100]), rng=draw)
    assert weighted.share[weighted.clusters.mean[:, 0] < 0].sum() == pytest.approx(0.5, abs=0.03)


def test_a_single_component_has_the_moments_given() -> None:
    covariance = np.array([[2.0, 0.5], [0.5, 1.0]])
    drawn = single_student_t(np.array([3.0, -1.0]), covariance).draw(40_000, rng=rng(7))
    assert np.abs(drawn.mean(axis=0) - (3, -1)).max() < 0.05
    # Of a Student t with 8 degrees of freedom the covariance is 8 / 6 of its kernel's.
    assert np.cov(drawn, rowvar=False) == pytest.approx(covariance * 8 / 6, abs=0.12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Rosenbrock 2-D", "Gaussian 4-D", "shells 2-D"])
def test_errors_are_honest_over_many_seeds(name: str) -> None:
    """Of 12 standard normals the mean square exceeds 3.26 once in 10,000 times (chi-square)."""
    known = problems.problem(name)
    z = []
    for seed in range(12):
        found = run_in_few_calls(known, rng=rng(100 + seed), error=0.05)
        z.append((found.log_z - known.log_z) / math.hypot(found.log_z_error, known.log_z_error))
    assert np.mean(np.square(z)) < 3.26


def test_a_limit_that_the_first_draws_would_exceed_is_refused_at_once() -> None:
    counted = Counted(problems.gaussian(40, 0.5))
    with pytest.raises(ParameterError, match="max_calls is 5000; allowed: 5500 or more for 40 parameters"):
        run_in_few_calls(counted, rng=rng(), max_calls=5000)
    assert counted.n_evaluations == 0
