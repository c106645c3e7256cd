"""A second run from a prior near the posterior: the evidence is what quadrature has, and sharper."""

import math

import numpy as np
import pytest
from nested_sampling.problems import Known

from probewise.nested.importance import repartitioned
from probewise.priors import Normal, Product

WIDE = Product({"x": Normal(0.0, 10.0), "y": Normal(0.0, 10.0)})


def _two(theta):
    """Two spots, three to one."""
    x, y = theta.T
    return np.logaddexp(math.log(0.75) - 50 * ((x - 2) ** 2 + y**2), math.log(0.25) - 50 * ((x + 2) ** 2 + y**2))


def test_a_peak_has_a_part_of_the_prior():
    rng = np.random.default_rng(12)
    right = rng.random(2000) < 0.75
    theta = rng.normal(0.0, 0.1, (2000, 2)) + np.stack([np.where(right, 2.0, -2.0), np.zeros(2000)], axis=1)
    near = repartitioned(Known(WIDE, _two, 0.0), theta[right], peaks=(theta[~right],)).prior
    drawn, _ = near.leave(e := near.draw(4000, rng=rng))
    np.testing.assert_allclose(near.enter(drawn), e, atol=1e-9)
    # Student t with five degrees of freedom and the scale 0.14: 1.3 % lie beyond a distance of 0.5 in one of two.
    distance = np.minimum(*(np.hypot(drawn[:, 0] - x, drawn[:, 1]) for x in (2.0, -2.0)))
    assert (distance < 0.7).mean() > 0.95
    # The share of 2,000 samples scatters by 0.01, that of 4,000 draws by 0.007: six sds.
    assert (drawn[:, 0] > 0).mean() == pytest.approx(0.75, abs=0.072)
    # The density that the parts claim is that of their draws: its mean reciprocal over a region is the region's area.
    inside = (np.abs(drawn[:, 0] - 2.0) < 0.2) & (np.abs(drawn[:, 1]) < 0.2)
    area = np.where(inside, np.exp(near.log_prior_ratio(drawn) - WIDE.log_prob(drawn)), 0.0)
    assert area.mean() == pytest.approx(0.16, abs=6 * area.std() / math.sqrt(4000))
