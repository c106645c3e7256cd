"""Refine the evidence and the posterior of a run by importance sampling; see `probewise.nested.importance`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise._arrays import own_arithmetic
from probewise._kinds import checked_whole, require_rng
from probewise.errors import ParameterError
from probewise.nested.evaluate import Evaluator, Samplable
from probewise.nested.importance import (
    HeldOutSamples,
    Posterior,
    Weighted,
    draw_and_weigh,
    effective_lineages,
    inherited_doubts,
    resampled_for_fit,
    split_off_held_out,
    with_error_of_lost_parts,
)
from probewise.nested.missed_hills import find_missed_hills
from probewise.nested.proposal import fit_wide_and_narrow_proposals, mixture_of_proposals
from probewise.nested.result import NestedResult
from probewise.nested.space import unbounded_space_of

_FIRST = 0.75  # share of the better form of density in the mixture


@own_arithmetic
def refine(
    result: Posterior,
    problem: Samplable,
    *,
    rng: np.random.Generator,
    n_draws: int = 5000,
    n_pilots: int = 2,
    look: bool = True,
) -> Weighted:
    """Reduce the error of a run's evidence and posterior by importance sampling.

    Two forms of proposal density are fitted to two thirds of the run's posterior samples. In each pilot round a few
    draws of each are weighted; the form with the larger effective sample size gets the larger share of the mixture, and
    its weighted draws are added to the samples for the next fit. Finally `n_draws` points are drawn. Only these count,
    so they are independent.

    The error includes three corrections. The held-out third of the samples is combined with the draws by bridge
    sampling (Meng & Wong 1996), which estimates the share of the posterior that the proposal misses. A heavy tail of
    the weights, which slows the convergence of their mean, increases the error. And the run may have lost a mode: with
    n_live points and information H (nats) it knows the shares of modes as precisely as n_live / H independent samples.
    So a mode of share s is lost with probability exp(-s n_live / H); the sum of s times that over the modes found is
    added.

    Parameters
    ----------
    result
        A run of the same problem, or an earlier refinement.
    problem
        Prior and likelihood.
    rng
        Source of randomness.
    n_draws
        Number of final draws, 100 or more; every pilot round takes a quarter of that, at least 100, in addition.
    n_pilots
        Number of pilot rounds, 1 or more.
    look
        Whether to look for parts of the posterior that the run has missed, if the run has no check (it was made with
        `max_cost=1`): for at most about a quarter of the run's evaluations. A part that matters is added to the doubts.

    Returns
    -------
    Weighted
        Check `sound` before using it instead of the run's evidence.

    Raises
    ------
    ParameterError
        If an option is out of range, the run has other parameters, or the prior has neither `to_unit_cube` nor
        coordinates.
    NotConvergedError
        If the likelihood fails.
    """
    require_rng(rng)
    n_draws = checked_whole("n_draws", n_draws, least=100)
    n_pilots = checked_whole("n_pilots", n_pilots)
    evaluate = Evaluator(problem)
    if result.names != evaluate.names:
        raise ParameterError("result.names", result.names, f"the problem's names {evaluate.names}")
    if not result.names:
        raise ParameterError("result", "a run without parameters", "one with some; the evidence is exact without")
    space = unbounded_space_of(problem.prior)
    n_lineages = effective_lineages(result)
    fitted, held = split_off_held_out(result, n_lineages, space, rng)
    known = [fitted]
    for _ in range(n_pilots):
        proposals = fit_wide_and_narrow_proposals(np.concatenate(known), rng=rng)
        pilots = [
            draw_and_weigh(p, 0.0, HeldOutSamples.empty(), space, evaluate, n_draws=max(n_draws // 8, 50), rng=rng)
            for p in proposals
        ]
        first = int(np.argmax([pilot.n_eff for pilot in pilots]))
        better = pilots[first]
        # The other form keeps a share: it may cover what the better one does not.
        others = (1.0 - _FIRST) / max(len(proposals) - 1, 1)
        best = mixture_of_proposals(proposals, [_FIRST if k == first else others for k in range(len(proposals))])
        if better.n_eff > 2 * len(evaluate.names):
            known.append(resampled_for_fit(better.theta, better.log_weight, space, rng))
    found = with_error_of_lost_parts(
        draw_and_weigh(best, 0.0, held, space, evaluate, n_draws=n_draws, rng=rng), n_lineages, space, rng
    )
    doubts = inherited_doubts(found, result)
    if look and isinstance(result, NestedResult) and result.check is None:
        # A generator of its own: the refined evidence is the same with and without the look.
        missing = find_missed_hills(result, problem, max_calls=result.n_calls, rng=rng.spawn(1)[0])
        found = replace(found, n_calls=found.n_calls + missing.n_calls)
        doubts = (*doubts, *missing.doubts(found))
    return replace(found, inherited=doubts)
