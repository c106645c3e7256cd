"""This project's own sampler, as its users call it."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial

import numpy as np

from nested_sampling.problems import Known
from nested_sampling.sampler import Counted, Outcome, Sampler
from probewise.errors import DoubtfulResultWarning
from probewise.nested import KernelMove, Move, NestedResult, refine, run


def ours_result(
    problem: Counted | Known, seed: int, n_live: int | None = None, move: Move | None = None, max_cost: float = 1.0
) -> NestedResult:
    """Run this project's sampler, by default without the check: every call of it in these benchmarks is here."""
    n_live = n_live or 300
    # A doubtful run is counted, not shouted about.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        return run(problem, rng=np.random.default_rng(seed), n_live=n_live, move=move, max_cost=max_cost)


def ours(problem: Counted, seed: int, n_live: int | None = None, max_cost: float = 1.0) -> Outcome:
    """Run this project's sampler; with a `max_cost` of 5 as users get it, with the check of its evidence."""
    return outcome_of(ours_result(problem, seed, n_live, max_cost=max_cost), problem.n_evaluations)


def ours_refined(problem: Counted, seed: int, n_live: int | None = None) -> Outcome:
    """Run it and sharpen the result by importance sampling."""
    return _refined(problem, seed, n_live or 300, 10_000)


def ours_quick(problem: Counted, seed: int, n_live: int | None = None) -> Outcome:
    """Run it as for a robot that waits: few live points, proposals in one batch a round, 50 independent draws."""
    least = max(50, 2 * problem.n_params + 10)
    found = _refined(problem, seed, least, 1000, KernelMove(moves=5.0))
    return replace(found, theta=found.samples(50, seed), log_weight=np.zeros(50))


def _refined(problem: Counted, seed: int, n_live: int, n_draws: int, move: Move | None = None) -> Outcome:
    result = ours_result(problem, seed, max(n_live, 2 * problem.n_params + 10), move)
    sharp = refine(result, problem, rng=np.random.default_rng([seed, 1]), n_draws=n_draws)
    found = outcome_of(result, problem.n_evaluations)
    if not sharp.sound:
        return replace(found, doubts=(*found.doubts, f"not refined: Pareto k = {sharp.pareto_k:.2f}"))
    return replace(
        found, log_z=sharp.log_z, log_z_error=sharp.log_z_error, theta=sharp.theta, log_weight=sharp.log_weight
    )


def outcome_of(result: NestedResult, n_evaluations: int) -> Outcome:
    """Read a result of this project."""
    return Outcome(
        log_z=result.log_z,
        log_z_error=result.log_z_error,
        n_evaluations=n_evaluations,
        theta=result.theta,
        log_weight=result.log_weight,
        n_live=result.n_live,
        insertion_p_value=result.insertion_p_value,
        doubts=result.warnings,
    )


SAMPLERS = {
    "ours": Sampler((), ours),
    "ours-checked": Sampler((), partial(ours, max_cost=5.0)),
    "ours-refined": Sampler((), ours_refined),
    "ours-quick": Sampler((), ours_quick),
}
