"""Chains that remember: the error of log Z must know it."""

import math
from dataclasses import dataclass

import numpy as np
from nested_sampling.problems import Known, box
from runs import quiet
from scipy.stats import chi2

from probewise.nested import Tally

_STEEP = 2000.0
LOG_Z = 2 * (math.log(-math.expm1(-_STEEP)) - math.log(_STEEP))


@dataclass(frozen=True)
class Forgetful:
    """Draw exactly from the triangle x + y < t, but leave a share `kept` of the chains at their y."""

    kept: float

    def draw(self, start, bound, live, evaluate, rng):
        n, t = len(start), -bound.log_likelihood / _STEEP
        fresh = t * (1.0 - np.sqrt(rng.random(n)))  # density of y falls linearly to 0 at t
        y = np.where(rng.random(n) < self.kept, start.u[:, 1], fresh)
        x = rng.random(n) * (t - y)
        return evaluate(np.column_stack([x, y]), rng), Tally(n, n)

    def adapted(self, tally):
        return self


def runs(kept, n, **options):
    """Run n times at a corner of the unit square, where the levels are triangles."""
    corner = Known(box(2, 0, 1), lambda theta: -_STEEP * theta.sum(axis=1), LOG_Z)
    return [quiet(corner, seed=seed, n_live=100, move=Forgetful(kept), **options) for seed in range(n)]


def test_chains_that_remember_have_an_error_that_knows_it():
    """Right errors leave these limits once in a thousand; without the memory they would be far outside."""
    n = 40
    found = runs(0.8, n)
    z = np.array([(r.log_z - LOG_Z) / r.log_z_error for r in found])
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], n - 1) / (n - 1))
    assert low < np.std(z, ddof=1) < high < np.std(z * np.sqrt([r.memory for r in found]), ddof=1)
