"""From the last live points of a run draws climb to the top of their peak, also along the arm of a heavy tail."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from nested_sampling import hard, problems

from probewise.nested import NestedResult
from probewise.nested.missed import climb_to_top, find_missed_hills, gaussian_of_last_live_points
from probewise.nested.problem import Evaluator
from probewise.nested.sampler import run_once


@dataclasses.dataclass(frozen=True)
class Cross:
    """The Student cross in 8-D, of which only what lies further out than `fence` along the first arm is likely."""

    fence: float

    @property
    def known(self) -> problems.Known:
        return hard.student()

    @property
    def prior(self) -> problems.Product:
        return self.known.prior

    def log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        along = (theta @ hard.rotation(8))[:, 0]
        return np.where(along > self.fence, self.known.log_likelihood(theta), -1e4 + along)


@pytest.fixture(scope="module")
def on_an_arm() -> NestedResult:
    """A run that met nothing of the cross but an arm, from 0.1 outwards."""
    return run_once(Cross(0.1), rng=np.random.default_rng(1), n_live=100)


def climbed_height(run: NestedResult, problem: problems.Known | Cross) -> tuple[float, int]:
    evaluate = Evaluator(problem)
    top = climb_to_top(
        gaussian_of_last_live_points(run, evaluate), evaluate, max_calls=run.n_calls, rng=np.random.default_rng(2)
    )
    return top.highest_log_likelihood, evaluate.n_calls


@pytest.mark.parametrize("name", ["Gaussian 4-D", "Rosenbrock 2-D"])
def test_the_top_of_a_smooth_peak_is_met_to_a_hundredth_of_a_nat(name: str) -> None:
    known = problems.problem(name)
    run = run_once(known, rng=np.random.default_rng(1), n_live=100)
    height, n_calls = climbed_height(run, known)
    best = known.log_likelihood(np.ones((1, 2)))[0] if name == "Rosenbrock 2-D" else peak_of(known)
    assert best - 0.01 < height <= best + 1e-9
    assert n_calls < run.n_calls / 5


def peak_of(known: problems.Known) -> float:
    """Newton's step from the prior's middle: exact for a Gaussian, by finite differences of unit length."""
    n = len(known.prior.names)
    middle = known.prior.from_unit_cube(np.full((1, n), 0.5))[0]
    step = 1e-2 * np.eye(n)

    def height(*at: np.ndarray) -> float:
        return float(known.log_likelihood(sum(at, middle)[None])[0])

    gradient = np.array([(height(e) - height(-e)) / 2e-2 for e in step])
    curvature = np.array(
        [[(height(a, b) - height(a, -b) - height(-a, b) + height(-a, -b)) / 4e-4 for b in step] for a in step]
    )
    return height(-np.linalg.solve(curvature, gradient))


@pytest.mark.slow
def test_along_the_arm_of_a_heavy_tail_the_draws_reach_the_middle(on_an_arm: NestedResult) -> None:
    """The arm is a hundred times as long as wide; at its middle the log likelihood is 0."""
    assert on_an_arm.log_likelihood.max() < -10
    height, n_calls = climbed_height(on_an_arm, Cross(-math.inf))
    assert height > -0.1
    assert n_calls < 5000


@pytest.mark.slow
def test_what_lies_at_the_end_of_the_arm_is_weighed_and_doubts_the_run(on_an_arm: NestedResult) -> None:
    problem = Cross(-math.inf)
    missing = find_missed_hills(on_an_arm, problem, max_calls=on_an_arm.n_calls, rng=np.random.default_rng(3))
    (hill,) = missing.lost
    # Most of the evidence is near the middle; arms hold the rest.
    assert problem.known.log_z - 1.5 < hill.log_z < problem.known.log_z + 0.7
    assert any("has a log Z of about" in note for note in missing.doubts(on_an_arm))
