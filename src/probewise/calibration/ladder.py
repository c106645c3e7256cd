"""Fit one order after another: search the prior of one Gaussian, and climb from each order to the next.

The steps take a tenth of the evaluations of nested sampling of every order. What they cannot see is a peak that is
far from every posterior of the order below. So one short nested search of a whole prior stands beside them, that of the
order after the one with the greatest evidence: where its evidence, or its best likelihood, lies above what the climb
found, no climb is believed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from probewise.calibration.climb import Climb, Rung, climb
from probewise.calibration.compensation import Compensation
from probewise.calibration.order_search import Found, Progress, search_order
from probewise.calibration.posing import Posing
from probewise.calibration.reference import Reference, has_reference
from probewise.nested import NestedResult, least_live
from probewise.nested.sampler import search

__all__ = ["climb_orders", "next_order"]

_N_CLOUDS = 8
_N_PARTICLES = 1000
# Live points of the searches that no evidence is read from.
_FEW_LIVE = 100
_VOUCHING_LIVE = 60
# A peak was missed where the search is this many errors above in ln Z, or this far in ln L, beyond its own scatter.
_ABOVE = 3.0
_BETTER = 6.0


def climb_orders(
    posing: Posing,
    orders: Sequence[int],
    *,
    n_live: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[dict[int, Found], tuple[str, ...]]:
    """Climb as far as the greatest of the orders.

    Returns
    -------
    What was found, by order; and why an order that is lacking must be searched in full.
    """
    highest = max(orders)
    unlike = _unlike(posing, highest)
    if unlike:
        return {}, (unlike,)
    climbing, vouching = rng.spawn(2)
    found = {1: search_order(posing, 1, climbing, n_live=min(n_live, _FEW_LIVE), progress=progress)}
    if found[1].evidence is found[1].result:
        found[1] = search_order(posing, 1, climbing, n_live=n_live, progress=progress)
    for n in range(2, highest + 1):
        found[n] = next_order(posing, n, found[n - 1], climbing, n_live=n_live, progress=progress)
    if highest > 1:
        best = max(found, key=lambda n: found[n].evidence.log_z)
        vouched = min(best + 1, highest)
        missed = _missed(found[vouched], _vouch(posing, vouched, vouching, progress), vouched)
        if missed:
            return {1: found[1]}, (missed,)
    return {n: found[n] for n in orders}, ()


def _unlike(posing: Posing, highest: int) -> str:
    """Say why no order can be climbed to, if so."""
    beliefs = [posing.belief(n) for n in range(1, highest + 1)]
    if not all(has_reference(belief) for belief in beliefs):
        return "searched in full: the prior of a Gaussian's light is not uniform from 0"
    if any(replace(belief, n_gaussians=1) != beliefs[0] for belief in beliefs):
        return "searched in full: the prior of a Gaussian differs from order to order"
    return ""


def next_order(
    posing: Posing, n: int, below: Found, rng: np.random.Generator, *, n_live: int, progress: Progress | None
) -> Found:
    """Climb to an order; search it in full where the climb is doubtful."""
    prior, problem, problem_below = posing.belief(n), posing.problem(n), posing.problem(n - 1)
    coordinates = posing.belief(n - 1).coordinates
    start = below.evidence
    if isinstance(start, Climb):
        rest, log_z, error = start.theta, start.log_z_of_clouds, start.start_error
    else:
        rest, _ = coordinates.leave(coordinates.enter(start.samples(_N_PARTICLES, rng=rng)))
        log_z, error = np.full(_N_CLOUDS, start.log_z), start.log_z_error
    compensation = Compensation.of(problem_below, coordinates, posing.problem(1), rest, rng=rng)
    reference = Reference(prior, problem_below, compensation)
    told: Callable[[Rung], None] | None = None if progress is None else partial(progress, n)
    made = climb(problem, reference, rest, log_z_below=log_z, error_below=error, rng=rng, told=told)
    if not made.warnings:
        return Found(made, None)
    full = search_order(posing, n, rng, n_live=n_live, progress=progress)
    note = f"order {n} was searched in full, since the climb to it is doubtful: {'; '.join(made.warnings)}"
    return replace(full, notes=(*full.notes, note))


def _vouch(posing: Posing, n: int, rng: np.random.Generator, progress: Progress | None) -> NestedResult:
    """Search an order's prior with few live points."""
    report = None if progress is None else partial(progress, n)
    problem = posing.problem(n)
    n_live = max(_VOUCHING_LIVE, least_live(len(problem.prior.names)))
    return search(problem, rng=rng, n_live=n_live, progress=report, return_interrupted=False)


def _missed(found: Found, seen: NestedResult, n: int) -> str:
    """Say what a search of the whole prior saw that the climb did not, if anything."""
    evidence = found.evidence
    more = seen.log_z - evidence.log_z
    if more > _ABOVE * math.hypot(seen.log_z_error, evidence.log_z_error):
        return f"searched in full: a short search of {n} Gaussians finds ln Z higher by {more:.1f} than the climb"
    better = float(seen.log_likelihood.max() - found.result.log_likelihood.max())
    if better > _BETTER:
        return f"searched in full: a short search of {n} Gaussians finds ln L higher by {better:.1f} than the climb"
    return ""
