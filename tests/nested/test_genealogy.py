"""Chains that remember: the error of log Z must know it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from nested_sampling.problems import Known, box
from scipy.stats import chi2

from probewise.nested import Bound, Evaluator, NestedResult, Points, Tally, run

_STEEP = 2000.0


@dataclass(frozen=True)
class Forgetful:
    """Draw exactly from the triangle x + y < t, but leave a share `kept` of the chains at their y."""

    kept: float

    def draw(
        self, start: Points, bound: Bound, live: np.ndarray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        n, t = len(start), -bound.log_likelihood / _STEEP
        fresh = t * (1.0 - np.sqrt(rng.random(n)))  # density of y falls linearly to 0 at t
        y = np.where(rng.random(n) < self.kept, start.u[:, 1], fresh)
        x = rng.random(n) * (t - y)
        return evaluate(np.column_stack([x, y]), rng), Tally(n, n)

    def adapted(self, tally: Tally) -> Forgetful:
        return self


def corner() -> Known:
    """A corner of the unit square; the levels are triangles."""
    log_z = 2 * (math.log(-math.expm1(-_STEEP)) - math.log(_STEEP))
    return Known(box(2, 0, 1), lambda theta: -_STEEP * theta.sum(axis=1), log_z)


def runs(kept: float, n: int, **options: int) -> list[NestedResult]:
    return [
        run(corner(), rng=np.random.default_rng(seed), n_live=100, move=Forgetful(kept), max_cost=1.0, **options)
        for seed in range(n)
    ]


def z_sd(found: list[NestedResult], *, with_memory: bool) -> float:
    truth = corner().log_z
    return float(
        np.std([(r.log_z - truth) / r.log_z_error * (1 if with_memory else math.sqrt(r.memory)) for r in found], ddof=1)
    )


@pytest.mark.slow
def test_chains_that_remember_have_an_error_that_knows_it() -> None:
    """Right errors leave these limits once in a thousand; without the memory the error would be far outside."""
    n = 40
    found = runs(0.8, n)
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], n - 1) / (n - 1))
    assert low < z_sd(found, with_memory=True) < high
    assert z_sd(found, with_memory=False) > high


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"n_replaced": 7}])
def test_independent_points_have_no_memory(options: dict[str, int]) -> None:
    assert np.mean([r.memory for r in runs(0.0, 8, **options)]) < 1.1
