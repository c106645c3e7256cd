"""What the suites of other samplers hold theirs to: truths lie evenly in their posteriors.

With another seed (`PROBEWISE_FACTS_SEED`) a right sampler fails about once in 10 000.
"""

import os

import numpy as np
import pytest
from nested_sampling.problems import Known
from scipy.stats import binom, chi2, kstest, norm

from probewise.nested import run
from probewise.priors import Normal, Product

SEED = int(os.environ.get("PROBEWISE_FACTS_SEED", "20261124"))
CHANCE = 1e-4


def line(rng):
    """Draw a truth from the prior and ten readings of its line; the problem has the closed log evidence."""
    truth, x = rng.standard_normal(2), np.linspace(-1, 1, 10)
    design = np.stack([x, np.ones(10)], axis=1)
    readings = design @ truth + 0.5 * rng.standard_normal(10)
    covariance = design @ design.T + 0.25 * np.eye(10)
    fit = readings @ np.linalg.solve(covariance, readings) + np.linalg.slogdet(2 * np.pi * covariance)[1]
    prior = Product({"slope": Normal(0, 1), "offset": Normal(0, 1)})
    return Known(prior, lambda theta: norm.logpdf(readings, theta @ design.T, 0.5).sum(axis=1), -0.5 * fit), truth


@pytest.mark.slow
def test_truths_lie_evenly_in_their_posteriors_and_evidences_scatter_as_claimed():
    """bilby's p-p test and simulation-based calibration (Talts et al. 2018), with the evidence's errors besides.

    Over 200 truths drawn from the prior the truth's posterior quantile is uniform, for both parameters, and the sum of
    squares of the evidences' z is chi-square's; each fails by chance once in 10 000.
    """
    n, quantile, z = 200, [], []
    for k in range(n):
        problem, truth = line(np.random.default_rng([SEED, 13, k]))
        result = run(problem, rng=np.random.default_rng([SEED, 14, k]), n_live=100, max_cost=1)
        quantile.append(result.weight @ (result.theta < truth))
        z.append((result.log_z - problem.log_z) / result.log_z_error)
    for column in np.transpose(quantile):
        assert kstest(column, lambda u: u).pvalue > CHANCE / 2
    low, high = chi2.ppf([CHANCE / 2, 1 - CHANCE / 2], n)
    assert low < np.square(z).sum() < high
    # One in twenty beyond two errors, no more of them than the binomial allows.
    assert (np.abs(z) > 1.96).sum() < binom.isf(CHANCE, n, 0.05)
