"""Likelihoods and priors that misbehave: they are accepted where that is safe, and refused in words where it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from probewise.errors import NotConvergedError, ParameterError
from probewise.nested import RemainingEvidence, diversify, merge, refine, run, update
from probewise.nested.importance import repartitioned
from probewise.priors import Product, Uniform

SQUARE = Product({"a": Uniform(-3.0, 3.0), "b": Uniform(-3.0, 3.0)})
NORMAL = multivariate_normal([0.0, 0.0], 0.1)


@dataclass(frozen=True)
class Posed:
    """A problem of one function."""

    function: Callable[[np.ndarray], object]
    prior: object = SQUARE

    def log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        return self.function(theta)  # type: ignore[return-value]


@dataclass(frozen=True)
class OneWay:
    """A prior that maps the unit cube to parameters and can do nothing else."""

    names: tuple[str, ...] = ("a", "b")

    def from_unit_cube(self, u: np.ndarray) -> np.ndarray:
        return 6.0 * u - 3.0


def seeded() -> np.random.Generator:
    return np.random.default_rng(20261123)


def writes(theta: np.ndarray) -> np.ndarray:
    """Give the normal density, and leave a mess in the argument."""
    values = NORMAL.logpdf(theta)
    theta[:] = 1e6
    return np.atleast_1d(values)


def test_a_likelihood_that_writes_into_its_argument_changes_nothing() -> None:
    clean = run(Posed(lambda theta: np.atleast_1d(NORMAL.logpdf(theta))), rng=seeded(), n_live=60)
    messy = run(Posed(writes), rng=seeded(), n_live=60)
    assert np.array_equal(clean.theta, messy.theta)
    assert clean.log_z == messy.log_z


@pytest.mark.parametrize("constant", [-1e100, 1e100, -1e14, 7.0])
def test_a_constant_likelihood_is_its_own_evidence(constant: float) -> None:
    result = run(Posed(lambda theta: np.full(len(theta), constant)), rng=seeded(), n_live=30)
    assert result.log_z == pytest.approx(constant, rel=1e-12)
    assert result.weight.sum() == pytest.approx(1.0)
    assert result.information == pytest.approx(0.0, abs=1e-9)


def test_minus_1e100_may_stand_for_impossible_in_part_of_the_prior() -> None:
    def half(theta: np.ndarray) -> np.ndarray:
        return np.where(theta[:, 0] > 0, NORMAL.logpdf(theta), -1e100)

    result = run(Posed(half), rng=seeded(), n_live=100, stop=RemainingEvidence(0.01))
    assert abs(result.log_z + np.log(72.0)) < 3.9 * result.log_z_error


def test_a_masked_answer_is_refused_with_the_way_out() -> None:
    with pytest.raises(NotConvergedError, match=r"masked array with \d+ of 30 values masked.*filled\(-np\.inf\)"):
        run(Posed(lambda theta: np.ma.masked_less(theta[:, 0], 0.0)), rng=seeded(), n_live=30)


def test_a_prior_without_its_inverse_runs_and_is_refused_where_the_inverse_is_needed() -> None:
    n_asked = 0

    def counted(theta: np.ndarray) -> np.ndarray:
        nonlocal n_asked
        n_asked += len(theta)
        return np.asarray(NORMAL.logpdf(theta))

    problem = Posed(counted, OneWay())
    result = run(problem, rng=seeded(), n_live=30)
    n_asked = 0
    with pytest.raises(ParameterError, match="a prior with to_unit_cube"):
        refine(result, problem, rng=seeded())  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="a prior with to_unit_cube"):
        repartitioned(problem, result.theta)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="a prior with log_prob"):
        diversify(result.theta[:5], problem, rng=seeded())  # type: ignore[arg-type]
    assert n_asked == 0


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda result, problem: refine(result, problem, rng=None), "rng is None"),
        (lambda result, problem: merge([result, result], rng=5), "rng is 5"),
        (lambda result, problem: update(result, problem, rng=seeded(), fall_back=result), "fall_back is"),
        (lambda result, problem: diversify(result.theta[-5:], problem, rng=seeded(), n_steps=5.0), "n_steps is 5.0"),
    ],
)
def test_an_argument_of_the_wrong_kind_is_refused_in_words(call: Callable[..., object], said: str) -> None:
    problem = Posed(lambda theta: NORMAL.logpdf(theta))
    result = run(problem, rng=seeded(), n_live=20, max_cost=1.0)
    with pytest.raises(ParameterError, match=said):
        call(result, problem)
