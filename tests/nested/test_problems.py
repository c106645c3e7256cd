"""The benchmark's problems against second routes to their evidence, and its bookkeeping."""

import math

import numpy as np
import pytest
from nested_sampling import hard, problems, ssf
from scipy.special import logsumexp


@pytest.fixture
def rng():
    return np.random.default_rng(20240229)


@pytest.mark.parametrize("n_gaussians", [1, 2, 4])
def test_the_ssf_likelihood_is_the_one_written_down_from_the_formulas(n_gaussians, rng):
    """Closed forms and incomplete gammas of the package against quadratures, every constant included."""
    known = problems.ssf(n_gaussians)
    u = rng.random((200, known.n_params))
    theta = known.prior.from_unit_cube(u)
    direct = ssf.Direct(ssf.recording())
    assert known.log_likelihood(theta) == pytest.approx(direct.log_likelihood(theta), abs=1e-4)


IN_TWO = ("shells 2-D", "eggbox", "LogGamma 2-D", "plateau", "Rosenbrock 2-D", "Gaussian 2-D")


@pytest.mark.parametrize(
    ("name", "n", "error"),
    [
        *((name, 1500, 1e-3) for name in IN_TWO),
        # A slab across the square's corner leaves a kink: in eight dimensions the density is smooth.
        *(
            pytest.param(name, 700, 0.012, marks=[] if k % 3 == 0 else pytest.mark.slow)
            for k, name in enumerate(hard.IN_TWO)
        ),
    ],
)
def test_evidence_and_moments_agree_with_a_fine_grid(name, n, error):
    """Midpoint rule on n x n cells of the unit square."""
    known = hard.IN_TWO[name]() if name in hard.IN_TWO else problems.problem(name)
    side = (np.arange(n) + 0.5) / n
    u = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    theta = known.prior.from_unit_cube(u)
    height = known.log_likelihood(theta)
    log_z = float(logsumexp(height)) - math.log(len(u))
    assert log_z == pytest.approx(known.log_z, abs=error)
    weight = np.exp(height - logsumexp(height))
    for check in known.checks if name in IN_TWO else ():
        values = check.function(theta)
        mean = float(weight @ values)
        sd = math.sqrt(float(weight @ (values - mean) ** 2))
        assert mean == pytest.approx(check.mean, abs=2e-3 * sd), check.name
