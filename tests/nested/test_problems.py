"""The benchmark's problems against second routes to their evidence, and its bookkeeping."""

from __future__ import annotations

import math

import numpy as np
import pytest
from nested_sampling import problems, ssf
from scipy.special import logsumexp


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


@pytest.mark.parametrize("n_gaussians", [1, 2, 4])
def test_the_ssf_likelihood_is_the_one_written_down_from_the_formulas(
    n_gaussians: int, rng: np.random.Generator
) -> None:
    """Closed forms and incomplete gammas of the package against quadratures, every constant included."""
    known = problems.ssf(n_gaussians)
    u = rng.random((200, known.n_params))
    theta = known.prior.from_unit_cube(u)
    direct = ssf.Direct(ssf.recording())
    assert known.log_likelihood(theta) == pytest.approx(direct.log_likelihood(theta, np), abs=1e-4)
    assert ssf.from_unit(n_gaussians, u, np) == pytest.approx(theta)


@pytest.mark.parametrize("name", ["shells 2-D", "eggbox", "LogGamma 2-D", "plateau", "Rosenbrock 2-D", "Gaussian 2-D"])
def test_evidence_and_moments_agree_with_a_fine_grid(name: str) -> None:
    """Midpoint rule on 1500 x 1500 cells of the unit square."""
    known = problems.problem(name)
    side = (np.arange(1500) + 0.5) / 1500
    u = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    theta = known.prior.from_unit_cube(u)
    height = known.log_likelihood(theta)
    log_z = float(logsumexp(height)) - math.log(len(u))
    assert log_z == pytest.approx(known.log_z, abs=1e-3)
    weight = np.exp(height - logsumexp(height))
    for check in known.checks:
        values = check.function(theta)
        mean = float(weight @ values)
        sd = math.sqrt(float(weight @ (values - mean) ** 2))
        assert mean == pytest.approx(check.mean, abs=2e-3 * sd), check.name


@pytest.mark.parametrize("name", ["slab and spike 5-D", "two far peaks 5-D", "LogGamma 10-D"])
def test_evidence_and_moments_agree_with_importance_sampling(name: str, rng: np.random.Generator) -> None:
    """Draws from the mixture that each likelihood is made of, cut at the box; within five standard errors."""
    n = 40_000
    if name.startswith("slab"):
        known = problems.slab_and_spike()
        sd = np.where(rng.random(n) < 0.5, 0.1, 0.01)[:, None]
        theta = 0.5 + sd * rng.standard_normal((n, 5))
        square = ((theta - 0.5) ** 2).sum(axis=1)
        parts = [-0.5 * square / s**2 - 5 * math.log(s) for s in (0.1, 0.01)]
        proposal = np.logaddexp(*parts) - math.log(2) - 2.5 * problems.LOG_2PI
    elif name.startswith("two"):
        known = problems.problem(name)
        centre = np.where(rng.random(n) < 0.5, 0.3, 0.7)[:, None]
        theta = centre + 0.02 * rng.standard_normal((n, 5))
        parts = [-0.5 * (((theta - c) / 0.02) ** 2).sum(axis=1) for c in (0.3, 0.7)]
        proposal = np.logaddexp(*parts) - math.log(2) - 5 * (0.5 * problems.LOG_2PI + math.log(0.02))
    else:
        known = problems.problem(name)
        # Student-like tails on either side of the modes: a mixture of uniform and logistic draws.
        centre = np.full((n, 10), 2 / 3)
        centre[:, :2] = rng.choice([1 / 3, 2 / 3], (n, 2))
        theta = centre + rng.logistic(0, 0.03, (n, 10))

        def logistic(z: np.ndarray) -> np.ndarray:
            return -np.abs(z) - 2 * np.log1p(np.exp(-np.abs(z))) - math.log(0.03)

        high, low = logistic((theta - 2 / 3) / 0.03), logistic((theta - 1 / 3) / 0.03)
        proposal = high[:, 2:].sum(axis=1) + np.logaddexp(high[:, :2], low[:, :2]).sum(axis=1) - 2 * math.log(2)
    inside = ((theta > 0) & (theta < 1)).all(axis=1)
    log_weight = np.where(inside, known.log_likelihood(np.where(inside[:, None], theta, 0.5)) - proposal, -np.inf)
    log_z = float(logsumexp(log_weight)) - math.log(n)
    weight = np.exp(log_weight - logsumexp(log_weight))
    assert log_z == pytest.approx(known.log_z, abs=5 * math.sqrt(float(weight @ weight)))
    for check in known.checks:
        values = check.function(theta)
        mean = float(weight @ values)
        error = math.sqrt(float(weight**2 @ (values - mean) ** 2))
        assert mean == pytest.approx(check.mean, abs=5 * error + 1e-6), check.name
