"""What the suites of other samplers hold theirs to, written anew: known evidences, posteriors and calibration.

Each test names the suite and the fact. Differences are measured in the run's own errors, and the thresholds are
quantiles: with another seed (`PROBEWISE_FACTS_SEED`) a right sampler fails one of these tests about once in 10 000.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from nested_sampling.problems import box
from scipy.stats import binom, chi2, kstest, norm

from probewise.nested import NestedResult, run
from probewise.priors import LogUniform, Normal, Prior, Product, Uniform

SEED = int(os.environ.get("PROBEWISE_FACTS_SEED", "20261124"))
# Two-sided: a right sampler is further off in less than one run of 10 000.
N_ERRORS = 3.9
CHANCE = 1e-4


@dataclass(frozen=True)
class Posed:
    """A log likelihood of a batch, with its prior; it counts what it is asked."""

    prior: Prior
    function: Callable[[np.ndarray], np.ndarray]
    periodic: tuple[str, ...] = ()
    seen: list[np.ndarray] = field(default_factory=list)

    def log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        self.seen.append(theta.copy())
        return np.asarray(self.function(theta), dtype=np.float64)


def seeded(*more: int) -> np.random.Generator:
    return np.random.default_rng([SEED, *more])


def distance(result: NestedResult, log_z: float) -> float:
    """Difference from the true log evidence in the run's own errors."""
    return (result.log_z - log_z) / result.log_z_error


def thinned(result: NestedResult, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw fewer equally weighted samples than are effective, so that few share a lineage."""
    assert n < result.n_eff
    return result.samples(n, rng=rng)


def assert_distributed(values: np.ndarray, cdf: Callable[[np.ndarray], np.ndarray], n_tests: int = 1) -> None:
    assert kstest(values, cdf).pvalue > CHANCE / n_tests


def test_a_likelihood_that_says_nothing_gives_back_the_prior() -> None:
    """bilby: with a constant likelihood every parameter's samples pass a Kolmogorov-Smirnov test against its prior."""
    prior = Product({"level": Uniform(-2.0, 5.0), "scale": LogUniform(1e-3, 10.0), "offset": Normal(3.0, 0.5)})
    result = run(Posed(prior, lambda theta: np.zeros(len(theta))), rng=seeded(9), n_live=400, max_cost=1)
    assert result.log_z == pytest.approx(0.0, abs=1e-12)
    cube = prior.to_unit_cube(thinned(result, 350, seeded(9, 1)))
    for column in cube.T:
        assert_distributed(column, lambda u: u, 3)
    # Independent in pairs too: a correlation of n pairs has sd 1 / sqrt(n).
    off = np.abs(np.corrcoef(cube, rowvar=False) - np.eye(3)).max()
    assert off < norm.isf(CHANCE / 6) / math.sqrt(len(cube))


def test_every_evaluation_is_counted_and_none_is_made_twice() -> None:
    """UltraNest: the number of calls reported is that of the distinct points asked for; two overlapping peaks."""

    def function(theta: np.ndarray) -> np.ndarray:
        steps = 0.1 * np.arange(2)
        left, right = (-2.0 * ((theta - c) ** 2).sum(axis=1) for c in (0.83456 - steps, 0.43456 + steps))
        return np.logaddexp(left, right)

    problem = Posed(box(2, -5, 5), function)
    result = run(problem, rng=seeded(11), n_live=200, max_cost=1)
    seen = np.concatenate(problem.seen)
    assert result.n_calls == len(seen) == len(np.unique(seen, axis=0))
    # Each peak has the integral pi / 2 and lies well within the box.
    assert abs(distance(result, math.log(math.pi / 100))) < N_ERRORS


def line(rng: np.random.Generator) -> tuple[Posed, np.ndarray, float]:
    """Draw a truth from the prior and ten readings of its line; also the closed log evidence."""
    truth, x = rng.standard_normal(2), np.linspace(-1, 1, 10)
    design = np.stack([x, np.ones(10)], axis=1)
    readings = design @ truth + 0.5 * rng.standard_normal(10)

    def function(theta: np.ndarray) -> np.ndarray:
        return norm.logpdf(readings, theta @ design.T, 0.5).sum(axis=1)

    covariance = design @ design.T + 0.25 * np.eye(10)
    fit = readings @ np.linalg.solve(covariance, readings) + np.linalg.slogdet(2 * np.pi * covariance)[1]
    return Posed(Product({"slope": Normal(0, 1), "offset": Normal(0, 1)}), function), truth, -0.5 * float(fit)


@pytest.mark.slow
def test_truths_lie_evenly_in_their_posteriors_and_evidences_scatter_as_claimed() -> None:
    """bilby's p-p test and simulation-based calibration (Talts et al. 2018), with the evidence's errors besides.

    Over 200 truths drawn from the prior the truth's posterior quantile is uniform, for both parameters, and the sum of
    squares of the evidences' z is chi-square's; each fails by chance once in 10 000.
    """
    n, quantile, z = 200, [], []
    for k in range(n):
        problem, truth, log_z = line(seeded(13, k))
        result = run(problem, rng=seeded(14, k), n_live=100, max_cost=1)
        quantile.append(result.weight @ (result.theta < truth))
        z.append(distance(result, log_z))
    for column in np.transpose(quantile):
        assert_distributed(column, lambda u: u, 2)
    low, high = chi2.ppf([CHANCE / 2, 1 - CHANCE / 2], n)
    assert low < np.square(z).sum() < high
    # One in twenty beyond two errors, no more of them than the binomial allows.
    assert (np.abs(z) > 1.96).sum() < binom.isf(CHANCE, n, 0.05)
