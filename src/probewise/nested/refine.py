"""Refine a run's evidence and posterior by importance sampling, or update them with new readings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from probewise._arrays import FloatArray, logsumexp, own_arithmetic
from probewise._kinds import checked_whole, require_callable, require_rng
from probewise.errors import require
from probewise.nested.check import check_and_repeat
from probewise.nested.clusters import find_disconnected_clusters
from probewise.nested.importance import (
    MOST_LOST,
    HeldOut,
    Weighted,
    draw_and_weigh,
    fit_wide_and_narrow_proposals,
    mixture_of_proposals,
)
from probewise.nested.moves import SliceMove
from probewise.nested.problem import Evaluator, Samplable, Space, unbounded_space_of
from probewise.nested.result import NestedResult
from probewise.nested.sampler import least_live, run_once
from probewise.nested.weights import n_effective, resampled_rows

_MOST_FITTED = 2000
_SURPRISED = 0.01
_HELD_OUT = 1 / 3
_MOST_HELD = 1000
_N_UPDATED = 1000  # samples of the old posterior whose likelihood is evaluated anew
_APART = 4.0  # errors between the log Z of draws and of the refined run, above which they disagree
_N_PILOTS = 2
_FIRST = 0.75  # share of the better form of density in the mixture

Posterior: TypeAlias = NestedResult | Weighted


@own_arithmetic
def refine(
    result: Posterior,
    problem: Samplable,
    *,
    rng: np.random.Generator,
    n_draws: int = 5000,
    look: bool = True,
) -> Weighted:
    """Reduce the error of a run's evidence and posterior by importance sampling; see `Weighted.sound` before its use.

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

    `result` is a run of the same problem, or an earlier refinement. `n_draws`: number of final draws, 100 or more; each
    of two pilot rounds takes a quarter of that, at least 100, in addition. `look`: whether to check the run, if it has
    no check (it was made with `max_cost=1`), for at most as many evaluations again; parts of the posterior that it has
    missed are among the warnings.

    Raises ParameterError if an option is out of range, the run has other parameters, or the prior has neither
    `to_unit_cube` nor coordinates; NotConvergedError if the likelihood fails.
    """
    require_rng(rng)
    n_draws = checked_whole("n_draws", n_draws, least=100)
    evaluate, space = _evaluator_and_space(problem, result, "result")
    require(result.names, "result", "a run without parameters", "one with some; the evidence is exact without")
    n_lineages = effective_lineages(result)
    fitted, held = _split_off_held_out(result, n_lineages, space, rng)
    known = [fitted]
    for _ in range(_N_PILOTS):
        proposals = fit_wide_and_narrow_proposals(np.concatenate(known), rng=rng)
        pilots = [draw_and_weigh(p, None, space, evaluate, n_draws=max(n_draws // 8, 50), rng=rng) for p in proposals]
        first = int(np.argmax([pilot.n_eff for pilot in pilots]))
        better = pilots[first]
        # The other form keeps a share: it may cover what the better one does not.
        others = (1.0 - _FIRST) / max(len(proposals) - 1, 1)
        best = mixture_of_proposals(proposals, [_FIRST if k == first else others for k in range(len(proposals))])
        if better.n_eff > 2 * len(evaluate.names):
            known.append(_resampled_for_fit(better.theta, better.log_weight, space, rng))
    found = draw_and_weigh(best, held, space, evaluate, n_draws=n_draws, rng=rng)
    found = with_error_of_lost_parts(found, n_lineages, space, rng)
    if look and isinstance(result, NestedResult) and result.check is None:
        checked = check_and_repeat(
            result,
            Evaluator(problem),
            SliceMove(),
            run_once,
            max_cost=2.0,
            max_calls=None,
            least_live=least_live(len(result.names)),
            rng=rng.spawn(1)[0],  # of its own: the refined evidence is the same with and without the look
            repeat=False,
        )
        found, result = replace(found, n_calls=found.n_calls + checked.n_calls - result.n_calls), checked
    return replace(found, warnings=(*found.warnings, *_inherited_warnings(found, result)))


@own_arithmetic
def update(
    previous: Posterior,
    problem: Samplable,
    *,
    rng: np.random.Generator,
    fall_back: Callable[[], NestedResult],
    n_draws: int = 2000,
) -> Weighted:
    """Update a posterior with new readings by importance sampling.

    The previous samples are reweighted by the new readings' likelihood, and refined as those of a run are. The draws
    are weighted against the whole new problem, so the evidence is absolute and errors do not accumulate from reading to
    reading. Where the new readings are surprising (too few effective samples or too heavy a tail of the weights),
    `fall_back` starts from scratch.

    `previous` is the posterior of the same parameters given fewer readings; `problem` has the prior, and the likelihood
    of all readings; `fall_back` solves the new problem, as `lambda: run(problem, rng=rng)`: then its samples are
    returned, and its result as `run`. `n_draws`: number of draws, 100 or more; half as many are pilots, and each old
    sample, at most 1000, is evaluated once. Errors as of `refine`.
    """
    require_rng(rng)
    require_callable(
        "fall_back", fall_back, "a function that solves the problem, such as lambda: run(problem, rng=rng)"
    )
    n_draws = checked_whole("n_draws", n_draws, least=100)
    evaluate, _ = _evaluator_and_space(problem, previous, "previous")
    rows = np.unique(previous.draw_rows(_N_UPDATED, rng=rng))
    theta, before = previous.theta[rows], previous.log_weight[rows]
    log_likelihood = evaluate.log_likelihood(theta)
    # Rows of weight above 1 / 1000 were drawn several times and kept once: their weight makes up for it.
    log_weight = np.maximum(before, -math.log(_N_UPDATED)) + log_likelihood - previous.log_likelihood[rows]
    n_eff, k = n_effective(log_weight), math.inf
    # Without parameters there is no density to fit: the fallback evaluates the only hypothesis.
    if evaluate.names and n_eff >= max(_SURPRISED * len(rows), 3 * len(evaluate.names)):
        total = float(logsumexp(log_weight))
        now = previous.log_z + total, math.hypot(previous.log_z_error, n_eff**-0.5)
        n_own = effective_lineages(previous) * n_eff / len(rows)
        old = Weighted(evaluate.names, theta, log_likelihood, log_weight - total, *now, n_own, 0, pareto_k=-math.inf)
        found = refine(old, problem, rng=rng, n_draws=n_draws, look=False)
        if found.sound:
            return replace(found, n_calls=found.n_calls + evaluate.n_calls)
        k = found.pareto_k
    fallen = fall_back()
    samples = fallen.names, fallen.theta, fallen.log_likelihood, fallen.log_weight
    evidence = fallen.log_z, fallen.log_z_error, fallen.n_eff
    n_calls = evaluate.n_calls + fallen.n_calls
    return Weighted(*samples, *evidence, n_calls, k, run=fallen, warnings=fallen.warnings)


def _evaluator_and_space(problem: Samplable, found: Posterior, name: str) -> tuple[Evaluator, Space]:
    """Return a problem's evaluator and unbounded coordinates; ParameterError if `found` has other parameters."""
    evaluate = Evaluator(problem)
    require(found.names == evaluate.names, f"{name}.names", found.names, f"the problem's names {evaluate.names}")
    return evaluate, unbounded_space_of(problem.prior)


def _inherited_warnings(found: Weighted, result: Posterior) -> tuple[str, ...]:
    """Return the warnings of `result`; of a run also where its log Z, or its check's, is four errors from `found`'s."""
    if isinstance(result, Weighted):
        return result.warnings
    routes = [("the run", result.log_z, result.log_z_error)]
    if result.check is not None:
        routes.append((result.check.route, result.check.log_z, result.check.log_z_error))
    apart = tuple(
        f"{name} gives log Z = {log_z:.2f} ± {error:.2f}, the draws {found.log_z:.2f} ± {found.log_z_error:.2f}"
        for name, log_z, error in routes
        if not abs(log_z - found.log_z) <= _APART * math.hypot(error, found.log_z_error)
    )
    return (*result.warnings, *apart)


def effective_lineages(found: Posterior) -> float:
    """Return the number of independent samples that would give the share of a mode as precisely as this posterior.

    Many samples of a run descend from one live point. The log evidence of a mode has the error sqrt(H memory / n_live),
    with H the information and `memory` the variance factor of correlated chains; a share estimated from n independent
    samples has the relative error 1 / sqrt(n). So n is n_live / (H memory); for `Weighted` without a run it is `n_eff`.
    """
    if isinstance(found, Weighted):
        return found.n_eff if found.run is None else effective_lineages(found.run)
    return found.n_live / max(found.information * found.memory, 1.0)


def _split_off_held_out(
    found: Posterior, n_lineages: float, space: Space, rng: np.random.Generator
) -> tuple[FloatArray, HeldOut]:
    """Split samples at random, two to one, into those for fitting a density, by weight, and held-out ones."""
    lot = rng.random(len(found.theta)) < _HELD_OUT
    chosen = np.flatnonzero(lot & (found.log_weight > -math.inf))
    weight = np.exp(found.log_weight[chosen])
    rows = chosen[resampled_rows(weight, min(_MOST_HELD, chosen.size), rng)]
    x = space.enter(found.theta[rows])
    held = x, space.leave(x)[1] + found.log_likelihood[rows], _HELD_OUT * n_lineages
    return _resampled_for_fit(found.theta[~lot], found.log_weight[~lot], space, rng), held


def _resampled_for_fit(theta: FloatArray, log_weight: FloatArray, space: Space, rng: np.random.Generator) -> FloatArray:
    """Resample for fitting a density; return distinct samples in coordinates of `space`, (n, n_params).

    A third as many are drawn by the square root of the weights: a proposal must have wider tails than the posterior.
    """
    weight = np.exp(log_weight - log_weight.max())
    n = int(min(max(n_effective(log_weight), 4 * theta.shape[1] + 4), _MOST_FITTED))
    rows = [resampled_rows(weight, n, rng), resampled_rows(np.sqrt(weight), n // 3, rng)]
    return space.enter(theta[np.unique(np.concatenate(rows))])


def with_error_of_lost_parts(found: Weighted, n_lineages: float, space: Space, rng: np.random.Generator) -> Weighted:
    """Add to the error, in quadrature, the share of the posterior that a run of `n_lineages` samples may have lost."""
    if not found.n_eff > 1:
        return found
    n = int(min(found.n_eff, 1000))
    parts = find_disconnected_clusters(space.enter(found.theta[np.unique(found.draw_rows(n, rng=rng))]))
    share = parts.size / parts.size.sum()
    lost = float(share @ np.exp(-n_lineages * share))
    doubt = f"{100 * lost:.0f} % of the posterior may be lost: too few live points for its parts"
    warnings = found.warnings if lost < MOST_LOST else (*found.warnings, doubt)
    return replace(found, warnings=warnings, log_z_error=math.hypot(found.log_z_error, lost))
