"""`run_in_few_calls`: few evaluations, for likelihoods that take seconds.

The chains of a nested run spend most evaluations far from the posterior. Here draws from the prior are weighted by a
small power of the likelihood, a density is fitted to the weighted draws, and more are drawn from that density. The
power rises to one as the weights allow (adaptive multiple importance sampling; Cornuet, Marin, Mira & Robert 2012). All
draws count at every power, as draws from the mixture of all densities so far.

Such draws do not show which regions they undersample. So a short nested run follows, from a prior near the posterior
found so far (`probewise.nested.repartition`). Its live points climb to undersampled regions, and a third of its samples
corrects the evidence by bridge sampling (`probewise.nested.importance`). Where no density fits, that run's evidence is
used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise._kinds import checked_finite_number, checked_whole, require_rng
from probewise.errors import ParameterError
from probewise.nested.evaluate import Evaluator, Samplable
from probewise.nested.function_problem import AnyPrior, as_problem
from probewise.nested.importance import (
    HeldOutSamples,
    Weighted,
    draw_and_weigh,
    effective_lineages,
    inherited_doubts,
    resampled_for_fit,
    split_off_held_out,
    with_error_of_lost_parts,
)
from probewise.nested.mixture import fit_mixture, single_student_t
from probewise.nested.proposal import Proposal, mixture_of_proposals
from probewise.nested.repartition import repartitioned
from probewise.nested.result import NestedResult
from probewise.nested.sampler import least_live, run_once
from probewise.nested.space import Space, unbounded_space_of
from probewise.nested.weights import n_effective, power_bracket, resampled_rows

_LEAST_CALLS = 5000
# In more dimensions draws fill the space too thinly. On a curved ridge in five (Rosenbrock's) they missed up to 16 % of
# the posterior without a sign, so the draws claim no smaller error; and narrow parts are lost.
_DENSE, _LEAST_ERROR = 3, 0.1
_THIN = (
    "in more than three dimensions the draws may have missed a narrow part of the posterior; "
    "where it may have one, use nested.run"
)
_N_LIVE, _N_LIVE_ALONE = 50, 100
_LIKE_INDEPENDENT = 0.5  # draws that shape one component together are worth fewer independent ones
# Exploration: draws of a power, grown where it rises slowly; effective sample size that lets the power rise.
_GROWTH, _MOST_DRAWS = 1.3, 2000
_BISECTIONS, _LEAST_LOG_POWER = 50, -60.0
_ENOUGH, _MOST_LAST = 3.0, 5  # at power one: effective sample size in units of the others', and rounds
_MOST_FITTED = 1500
_WIDENING = 1.5
# The final mixture: the density fitted to the posterior, the same wider, and those of the powers above a tenth.
_WIDER, _DEFENSIVE, _FROM_POWER = 1.6, 0.25, 0.1
_FIRST = 0.75
_N_SAMPLES = 2000
# Draws of two densities have two groups of weights, which a longer tail would mix: only its end shows the variance.
_TAIL = 1.0
# Where the error is this many times too large, or doubtful, the draws go into another fit, up to a number of them.
_MUCH, _MOST_FITS = 1.3, 3


@dataclass(frozen=True, eq=False)
class _WeightedDraws:
    """Draws about the posterior.

    `x`, (n, n_params), in unbounded coordinates; `log_weight`, (n,), of weights that sum to one. `least`: the least
    effective sample size at any power; `defensive`: the mixture of the densities fitted at the higher powers.
    """

    x: FloatArray
    log_weight: FloatArray
    least: float
    defensive: Proposal


def run_in_few_calls(
    problem: Samplable | Callable[..., Any],
    prior: AnyPrior | None = None,
    *,
    names: Sequence[str] | None = None,
    vectorized: bool = False,
    pass_dict: bool = False,
    rng: np.random.Generator,
    error: float = 0.1,
    max_calls: int = 100_000,
    progress: Callable[[int], None] | None = None,
    executor: Executor | None = None,
    n_workers: int | None = None,
) -> Weighted:
    """Compute evidence and posterior of a problem in few evaluations, for likelihoods that take seconds.

    In up to ten dimensions it takes about as many evaluations for its error as the best of other nested samplers, or
    fewer (measured on six problems). With more than three parameters the draws may miss a narrow part of the posterior,
    so the result always has a doubt, and `sound` is False. Use `run` where the posterior may have such a part, and for
    fast likelihoods.

    Parameters
    ----------
    problem, prior, names, vectorized, pass_dict
        A problem, or a log likelihood with its prior, as for `run`. The prior needs `to_unit_cube` or coordinates of
        its own.
    rng
        Source of randomness.
    error
        Standard error of log Z at which the draws end; in more than three dimensions at least 0.1. The draws claim no
        smaller error.
    max_calls
        Limit of likelihood evaluations: at least 5000, and at least 700 + 120 n_params; at the limit the error may be
        larger than `error`. If half of it does not suffice for draws to reach the posterior, an ordinary
        run with 100 live points or more follows.
    progress
        Called with the number of evaluations after every batch of draws.
    executor, n_workers
        As for `run`.

    Returns
    -------
    Weighted
        With the doubts of both stages. `run` holds the nested run whose evidence and samples are used where the draws
        are unreliable: the short one from near the posterior (in the repartitioned problem), or the ordinary one.

    Raises
    ------
    ParameterError
        If an option is out of range, or the prior has no `to_unit_cube`.
    NotConvergedError
        If the likelihood fails, or every hypothesis drawn from the prior is impossible.
    """
    require_rng(rng)
    posed = as_problem(problem, prior, names, vectorized, pass_dict, ())
    if not checked_finite_number("error", error) > 0:
        raise ParameterError("error", error, "greater than 0")
    max_calls = checked_whole("max_calls", max_calls, least=_LEAST_CALLS)
    evaluate = Evaluator(posed, executor=executor, n_parts=n_workers)
    report = progress or (lambda n_calls: None)
    n_params = len(evaluate.names)
    least = 2 * _n_first_draws(n_params) + max(least_live(n_params), _N_LIVE_ALONE)
    if max_calls < least:
        raise ParameterError("max_calls", max_calls, f"{least} or more for {n_params} parameters")
    again = partial(run_once, rng=rng, executor=executor, n_workers=n_workers, return_interrupted=False)
    space = unbounded_space_of(posed.prior) if n_params else None
    explored = None
    if space is not None:
        explored = _draw_at_rising_powers(evaluate, space, max_calls=max_calls // 2, report=report, rng=rng)
    if space is None or explored is None:
        n_live = max(least_live(n_params), _N_LIVE_ALONE)
        alone = again(posed, n_live=n_live, max_calls=max_calls - evaluate.n_calls)
        return _weighted_from_run(alone, alone.log_likelihood, evaluate.n_calls + alone.n_calls)
    rows = resampled_rows(np.exp(explored.log_weight), _N_SAMPLES, rng)
    near = repartitioned(posed, space.leave(explored.x[rows])[0])
    n_live = max(least_live(n_params), _N_LIVE)
    second = again(near, n_live=n_live, max_calls=max_calls - evaluate.n_calls)
    original = replace(second, log_likelihood=second.log_likelihood - near.prior.log_prior_ratio(second.theta))
    report(evaluate.n_calls + second.n_calls)
    wanted = error if n_params <= _DENSE else max(error, _LEAST_ERROR)
    found = _draw_until_error_is_reached(
        explored, original, evaluate, space, wanted=wanted, max_calls=max_calls - second.n_calls, rng=rng
    )
    n_calls = evaluate.n_calls + second.n_calls
    report(n_calls)
    thin = () if n_params <= _DENSE else (_THIN,)
    if found.doubts and not found.inherited:
        warned = replace(second, warnings=(*second.warnings, *thin))
        return _weighted_from_run(warned, original.log_likelihood, n_calls, found.pareto_k)
    # Nothing smaller was looked for.
    log_z_error = max(found.log_z_error, wanted)
    return replace(found, n_calls=n_calls, log_z_error=log_z_error, inherited=(*found.inherited, *thin))


def _weighted_from_run(run: NestedResult, log_likelihood: FloatArray, n_calls: int, k: float = math.inf) -> Weighted:
    """Return a nested run's samples and evidence as `Weighted`; `k`: Pareto k of the draws that they replace."""
    return Weighted(
        run.names,
        run.theta,
        log_likelihood=log_likelihood,
        log_weight=run.log_weight,
        log_z=run.log_z,
        log_z_error=run.log_z_error,
        n_eff=run.n_eff,
        n_calls=n_calls,
        pareto_k=k,
        run=run,
    )


def _draw_until_error_is_reached(
    explored: _WeightedDraws,
    second: NestedResult,
    evaluate: Evaluator,
    space: Space,
    *,
    wanted: float,
    max_calls: int,
    rng: np.random.Generator,
) -> Weighted:
    """Draw from a density fitted to the explored draws and the second run's samples, until the error is `wanted`.

    At most three fits; the draws end before `max_calls` evaluations.
    """
    n_params = len(evaluate.names)
    fitted, held = split_off_held_out(second, effective_lineages(second), space, rng)
    n_known = int(n_effective(explored.log_weight))
    known = [fitted, explored.x[np.unique(resampled_rows(np.exp(explored.log_weight), n_known, rng))]]
    draw = partial(draw_and_weigh, prior_share=0.0, space=space, evaluate=evaluate, rng=rng)
    for _ in range(_MOST_FITS):
        mixture = fit_mixture(np.concatenate(known), rng=rng)
        forms = [mixture, mixture.widened(_WIDER)]
        pilots = [draw(form, held=HeldOutSamples.empty(), n_draws=250 + 75 * n_params) for form in forms]
        first = int(np.argmax([pilot.n_eff for pilot in pilots]))
        share = np.full(2, 1.0 - _FIRST)
        share[first] = _FIRST
        best = mixture_of_proposals([*forms, explored.defensive], [*((1.0 - _DEFENSIVE) * share), _DEFENSIVE])
        variance = _variance_of_weights(pilots[first], forms[first], best, space)
        left = max_calls - evaluate.n_calls
        n_draws = int(min(max(1.3 * variance / wanted**2, 500 * n_params), max(left, 100)))
        found = draw(best, held=held, n_draws=n_draws, tail=_TAIL)
        found = with_error_of_lost_parts(found, _LIKE_INDEPENDENT * explored.least, space, rng)
        if (not found.doubts and found.log_z_error < _MUCH * wanted) or left < 2 * n_draws or not found.n_eff > 1:
            break
        known.append(resampled_for_fit(found.theta, found.log_weight, space, rng))
    return replace(found, inherited=inherited_doubts(found, second))


def _variance_of_weights(pilot: Weighted, drawn: Proposal, best: Proposal, space: Space) -> float:
    """Estimate the variance of the weights, of mean one, of draws from `best`; `pilot` are draws from `drawn`."""
    if not len(pilot.theta):
        return math.inf
    x = space.enter(pilot.theta)
    log_square = 2 * pilot.log_weight + drawn.log_density(x) - best.log_density(x)
    return max(len(x) * math.exp(float(logsumexp(log_square))) - 1.0, 0.0)


def _draw_at_rising_powers(
    evaluate: Evaluator, space: Space, *, max_calls: int, report: Callable[[int], None], rng: np.random.Generator
) -> _WeightedDraws | None:
    """Draw at rising powers of the likelihood until enough draws represent the posterior; None beyond `max_calls`."""
    n_params = len(evaluate.names)
    n_draws, wanted = _n_first_draws(n_params), 150 + 25 * n_params
    draws = _DrawsOfAllSources(evaluate, space)
    draws.evaluate_and_add(space.draw(2 * n_draws, rng=rng), None)
    power, least, n_last, kept = 0.0, math.inf, 0, list[Proposal]()
    while True:
        report(evaluate.n_calls)
        last = power
        power, log_weight = draws.weigh_at_greatest_power(wanted)
        n_eff = n_effective(log_weight)
        n_last += power >= 1.0
        if n_last and (n_eff >= _ENOUGH * wanted or n_last > _MOST_LAST):
            kept = kept or [_fit_mixture_with_wider_component(draws.x, log_weight, rng)]
            defensive = mixture_of_proposals(kept, [1.0] * len(kept))
            return _WeightedDraws(draws.x, log_weight - float(logsumexp(log_weight)), min(least, n_eff), defensive)
        if evaluate.n_calls + n_draws > max_calls:
            return None
        if n_eff < _DENSE * n_params:
            # Too few possible hypotheses among the prior's draws.
            draws.evaluate_and_add(space.draw(n_draws, rng=rng), None)
            continue
        least = min(least, n_eff)
        proposal = _fit_mixture_with_wider_component(draws.x, log_weight, rng)
        if _FROM_POWER <= power < 1.0:
            kept.append(proposal)
        draws.evaluate_and_add(proposal.draw(n_draws, rng=rng), proposal)
        if power < 2 * last:
            n_draws = int(min(_GROWTH * n_draws, _MOST_DRAWS))


def _n_first_draws(n_params: int) -> int:
    """Return the number of draws of the first density; twice as many come from the prior before."""
    return 300 + 60 * n_params


class _DrawsOfAllSources:
    """All draws so far, with the log density there of the prior and of every fit drawn from, (n, n_sources)."""

    def __init__(self, evaluate: Evaluator, space: Space) -> None:
        self._evaluate, self._space = evaluate, space
        self._sources: list[Proposal | None] = []
        self._size: list[int] = []
        self.x = np.empty((0, len(evaluate.names)))
        self._log_density, self._log_likelihood = np.empty(0), np.empty(0)
        self._log_q = np.empty((0, 0))

    def evaluate_and_add(self, x: FloatArray, source: Proposal | None) -> None:
        """Evaluate draws `x`, (n, n_params), from the density `source` (None: the prior) and add them to the others."""
        theta, log_density = self._space.leave(x)
        log_likelihood = np.full(len(x), -np.inf)
        possible = np.isfinite(log_density)
        if possible.any():
            log_likelihood[possible] = self._evaluate.log_likelihood(theta[possible])
        added = [_log_density_of_source(one, x, log_density) for one in self._sources]
        self.x = np.concatenate([self.x, x])
        self._log_density = np.concatenate([self._log_density, log_density])
        self._log_likelihood = np.concatenate([self._log_likelihood, log_likelihood])
        known = np.concatenate([self._log_q, np.array(added).reshape(len(added), len(x)).T])
        self._log_q = np.column_stack([known, _log_density_of_source(source, self.x, self._log_density)])
        self._sources.append(source)
        self._size.append(len(x))

    def weigh_at_greatest_power(self, wanted: float) -> tuple[float, FloatArray]:
        """Weigh all draws by a power of the likelihood; return the power and the log weights, (n,).

        It is the greatest power, 1 at most, at which the effective sample size is at least `wanted`.
        """
        log_share = np.log(np.array(self._size) / sum(self._size))
        alive = np.flatnonzero(np.isfinite(self._log_likelihood))
        base = self._log_density[alive] - logsumexp(self._log_q[alive] + log_share, axis=1)

        def log_weights_at(log_power: float) -> FloatArray:
            """Return the log weights at a power of the likelihood, (n,); -inf where it is zero."""
            out = np.full(len(self.x), -np.inf)
            out[alive] = base + math.exp(log_power) * self._log_likelihood[alive]
            return out

        if n_effective(log_weights_at(0.0)) >= wanted:
            return 1.0, log_weights_at(0.0)
        low, _ = power_bracket(log_weights_at, _LEAST_LOG_POWER, 0.0, wanted=wanted, n_steps=_BISECTIONS)
        return math.exp(low), log_weights_at(low)


def _log_density_of_source(source: Proposal | None, x: FloatArray, log_density: FloatArray) -> FloatArray:
    """Log density of a source at draws `x`, (n,); for None that of the prior, `log_density`."""
    return log_density if source is None else source.log_density(x)


def _fit_mixture_with_wider_component(x: FloatArray, log_weight: FloatArray, rng: np.random.Generator) -> Proposal:
    """Fit a mixture to weighted draws, (n, n_params); a quarter of it is one component wider than all draws."""
    # Weights are cut at their mean times sqrt(n) (Ionides 2008), lest one draw take the fit.
    alive = np.flatnonzero(np.isfinite(log_weight))
    cut = np.minimum(log_weight[alive], float(logsumexp(log_weight)) - 0.5 * math.log(alive.size))
    weight = np.exp(cut - float(logsumexp(cut)))
    # Draws of little weight are thinned, and stand for the others.
    rows = np.unique(resampled_rows(weight, _MOST_FITTED, rng))
    x, weight = x[alive[rows]], np.maximum(weight[rows], 1.0 / _MOST_FITTED)
    weight = weight / weight.sum()
    off = x - weight @ x
    wide = single_student_t(weight @ x, _WIDENING**2 * (off * weight[:, None]).T @ off)
    return mixture_of_proposals([fit_mixture(x, weight, rng=rng), wide], [0.75, 0.25])
