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
from scipy.integrate import quad
from scipy.special import gammaln, logsumexp
from scipy.stats import binom, chi2, kstest, norm

from probewise.nested import NestedResult, merge, run
from probewise.nested.repartition import repartitioned
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


def test_a_strongly_correlated_gaussian_has_its_evidence_mean_and_covariance() -> None:
    """dynesty: three parameters, correlation 0.95, means -1, 0 and 1, uniform priors from -10 to 10; ln Z = -3 ln 20.

    A covariance's relative error over n draws is sqrt(2 / n); five of them, with a third of n_eff for n.
    """
    mean, covariance = np.array([-1.0, 0.0, 1.0]), np.full((3, 3), 0.95) + 0.05 * np.eye(3)
    inverse, log_norm = np.linalg.inv(covariance), 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]

    def function(theta: np.ndarray) -> np.ndarray:
        off = theta - mean
        return -0.5 * np.einsum("ni,ij,nj->n", off, inverse, off) - log_norm

    result = run(Posed(box(3, -10, 10), function), rng=seeded(1), n_live=200, max_cost=1)
    assert abs(distance(result, -3 * math.log(20))) < N_ERRORS
    n = result.n_eff / 3
    assert np.abs(result.mean() - mean).max() < 5 / math.sqrt(n)
    assert np.abs(result.covariance() - covariance).max() < 5 * math.sqrt(2 / n)


def test_a_wedding_cake_of_plateaus_has_its_evidence_merged_too() -> None:
    """Fowlie, Handley & Su 2020, and dynesty: five dimensions, every level set a plateau, 0.7 of the last one."""
    n_params, ratio, width = 5, 0.7, 0.2

    def function(theta: np.ndarray) -> np.ndarray:
        reach = 2 * np.abs(theta - 0.5).max(axis=1)
        step = np.floor(n_params * np.log(np.maximum(reach, 1e-300)) / math.log(ratio))
        return -(ratio ** (2 * step / n_params)) / (8 * width**2)

    steps = np.arange(400)
    log_volume = steps * math.log(ratio) + math.log(1 - ratio)
    log_z = float(logsumexp(-(ratio ** (2 * steps / n_params)) / (8 * width**2) + log_volume))
    runs = [run(Posed(box(5, 0, 1), function), rng=seeded(3, k), n_live=100, max_cost=1) for k in range(2)]
    merged = merge(runs, rng=seeded(3, 9))
    assert max(abs(distance(one, log_z)) for one in runs) < N_ERRORS
    assert abs(distance(merged, log_z)) < N_ERRORS
    assert merged.log_z_error < 0.85 * min(one.log_z_error for one in runs)


@pytest.mark.parametrize(
    ("n_params", "published"),
    [(2, -1.75), (5, -5.67), pytest.param(10, -14.59, marks=pytest.mark.slow)],
)
def test_gaussian_shells_have_the_published_evidence(n_params: int, published: float) -> None:
    """MultiNest (Feroz, Hobson & Bridges 2009) and dynesty: two shells of radius 2 and width 0.1 in [-6, 6]^n.

    The published figures are rounded to a hundredth; a radial quadrature gives the rest.
    """

    def function(theta: np.ndarray) -> np.ndarray:
        rest = (theta[:, 1:] ** 2).sum(axis=1)
        radius = [np.sqrt((theta[:, 0] - centre) ** 2 + rest) for centre in (-3.5, 3.5)]
        return np.logaddexp(*(norm.logpdf(r, 2.0, 0.1) for r in radius))

    radial = quad(lambda r: r ** (n_params - 1) * norm.pdf(r, 2.0, 0.1), 1, 3, points=[2.0])[0]
    area = math.log(2) + 0.5 * n_params * math.log(math.pi) - gammaln(n_params / 2)
    log_z = math.log(2 * radial) + area - n_params * math.log(12)
    assert log_z == pytest.approx(published, abs=0.006)
    result = run(Posed(box(n_params, -6, 6), function), rng=seeded(5, n_params), n_live=100, max_cost=1)
    assert abs(distance(result, log_z)) < N_ERRORS


def test_a_funnel_cut_by_the_cube_has_its_evidence_by_two_routes() -> None:
    """nautilus: the width of y is exp(20 (x - 1/2)) / 100, from 1/5000 to 5 over six sd of x; by quadrature."""

    def function(theta: np.ndarray) -> np.ndarray:
        x, y = theta.T
        return norm.logpdf(x, 0.5, 0.1) + norm.logpdf(y, 0.5, np.exp(20 * (x - 0.5)) / 100)

    def inside(x: float) -> float:
        width = math.exp(20 * (x - 0.5)) / 100
        return float(norm.pdf(x, 0.5, 0.1) * (norm.cdf(0.5 / width) - norm.cdf(-0.5 / width)))

    log_z = math.log(quad(inside, 0, 1, epsrel=1e-10)[0])
    problem = Posed(box(2, 0, 1), function)
    result = run(problem, rng=seeded(6), n_live=100, max_cost=1)
    assert abs(distance(result, log_z)) < N_ERRORS
    near = repartitioned(problem, result.samples(1000, rng=seeded(6, 1)))
    assert abs(distance(run(near, rng=seeded(6, 2), n_live=100, max_cost=1), log_z)) < N_ERRORS


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
