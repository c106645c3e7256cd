"""Check a run's evidence by a second, independent estimate, and repeat the run where the two disagree.

Chains that are too short bias every shell a little, always in the same direction, so the bias of log Z grows with the
compression. The insertion ranks and the scatter between seeds do not show this bias. The second estimate uses chains
twice as long and compresses by few nats: it runs from a prior near the posterior of the first run (`repartition`).
Where the posterior fills so much of the prior that this saves nothing, it is a small run of the same problem.

Two things escape both estimates: a narrow peak whose likelihood exceeds the rest only where both have ended, and a part
of the posterior without live points. `probewise.nested.missed` looks for both. Where a part without live points would
raise log Z noticeably, the run is repeated with moves that hop between the known parts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError, ParameterError, message_of
from probewise.nested.clusters import Clusters
from probewise.nested.evidence import warning_of_few_lineages, warning_of_few_possible_draws
from probewise.nested.missed import (
    DISAGREE,
    HillEstimate,
    MissedHills,
    find_missed_hills,
    log_evidence_of_unmet_hills,
    log_z_rise_in_errors,
)
from probewise.nested.moves import HoppingMove, Move, SliceMove
from probewise.nested.problem import Samplable, space_of
from probewise.nested.repartition import Repartitioned, repartitioned, split_into_clusters
from probewise.nested.result import Check, NestedResult

# Above this many errors the second estimate is repeated with more live points.
_APART = 2.0
_N_SAMPLES = 2000
# The repartitioned run is used only if it needs less than this share of the first run's nats.
_GAIN = 0.8
_FEW_NATS = 3.0  # of a second pass from the clusters of the posterior, below which they are used
_SAME_MEAN = 0.75  # nats; up to 0.5 where such a pass was right, 0.8 to 9 where it overlooked a part of a curve
_MOST_COST = 0.2  # of the first run's evaluations, spent on a second pass from clusters
_AGAIN = 2.2  # times the first run's evaluations: what it costs to repeat it with chains twice as long
_ALIKE = 2.0  # errors within which two runs agree, against a second pass that lies below both
_SHARE = 0.1  # of the first run's live points times nats, spent on the second estimate
_LEAST_LIVE = 40
_MATTERS = 0.25  # errors by which a lost mode raises log Z, above which the run is repeated


class SingleRunFunction(Protocol):
    """A function that runs nested sampling once, without a check; it raises NotConvergedError as `run` does."""

    def __call__(
        self, problem: Samplable, *, n_live: int, move: Move, max_calls: int | None, rng: np.random.Generator
    ) -> NestedResult:
        """Run nested sampling on the problem."""
        ...


@dataclass(frozen=True, eq=False)
class _EvidenceRoute:
    """A way to estimate the evidence again: a problem of the same evidence, the number of live points and the chains.

    `name`: for messages. `modes`: clusters between which a point may hop before its chain; None for no hops.
    `most_calls`: limit of evaluations. `expected`: mean log likelihood over the posterior, nats, that a valid estimate
    has to within `_SAME_MEAN`; None for no such test.
    """

    problem: Samplable
    n_live: int
    chain: SliceMove
    name: str
    most_calls: float = math.inf
    expected: float | None = None
    modes: Clusters | None = None

    @property
    def move(self) -> Move:
        return self.chain if self.modes is None else HoppingMove(self.chain, self.modes)

    def has_expected_mean_likelihood(self, found: NestedResult) -> bool:
        """Return whether a run has the expected posterior mean of its log likelihood (information plus log Z).

        True where the route expects none.
        """
        return self.expected is None or abs(found.information + found.log_z - self.expected) < _SAME_MEAN

    @property
    def least_calls_to_start(self) -> int:
        """Fewest evaluations with which a run is worth a start: its first live points, and twice those of one round."""
        n_steps = self.chain.n_steps(len(self.problem.prior.names))
        return math.ceil(self.n_live * (1 + n_steps * self.chain.target))


@dataclass
class _CallBudget:
    """The likelihood evaluations of a check, the first run's included: at most `limit` in all, `spent` so far."""

    search: SingleRunFunction
    limit: float
    spent: int
    rng: np.random.Generator

    @property
    def calls_left(self) -> int:
        return int(self.limit - self.spent)

    def run_route(self, route: _EvidenceRoute) -> NestedResult | None:
        """Run nested sampling by a route; None if the budget or the route's limit is too small for a complete run."""
        left = int(min(self.calls_left, route.most_calls))
        if left < route.least_calls_to_start:
            return None
        found = self.search(route.problem, n_live=route.n_live, move=route.move, max_calls=left, rng=self.rng)
        self.spent += found.n_calls
        return found if found.complete else None


@dataclass(frozen=True, eq=False)
class _SecondEstimate:
    """A second estimate of the evidence: one or two runs of a route.

    `curved`: whether an estimate from clusters of the posterior failed before, as it does along a curved ridge.
    """

    route: _EvidenceRoute
    runs: tuple[NestedResult, ...]
    curved: bool

    @property
    def log_z_and_error(self) -> tuple[float, float]:
        """Weighted mean of the runs' log Z, and its standard error."""
        return weighted_mean_and_error([a.log_z for a in self.runs], [a.log_z_error for a in self.runs])

    @property
    def n_calls(self) -> int:
        return sum(each.n_calls for each in self.runs)

    def signed_distance_in_errors(self, run: NestedResult) -> float:
        """Return a run's log Z minus this estimate's, in combined standard errors."""
        log_z, error = self.log_z_and_error
        return (run.log_z - log_z) / max(math.hypot(run.log_z_error, error), 1e-12)

    def disagrees_or_is_doubtful(self, run: NestedResult, most: float) -> bool:
        """Return whether a run is more than `most` errors away, or the last run of this estimate has warnings."""
        return abs(self.signed_distance_in_errors(run)) > most or bool(self.runs[-1].warnings)

    def misses_part_of_curved_posterior(self, first: NestedResult, longer: NestedResult) -> bool:
        """Return whether this estimate lies below two runs that agree with each other, of a curved posterior.

        Along a curve the prior of a second pass can be thin where the posterior is not, so it misses a part. The chains
        of run `longer` are twice as long as those of `first`: if `first` were biased by short chains, the two would
        differ.
        """
        below = min(self.signed_distance_in_errors(run) for run in (first, longer))
        alike = abs(_SecondEstimate(self.route, (longer,), self.curved).signed_distance_in_errors(first)) < _ALIKE
        return self.curved and below > _APART and alike and not first.warnings


def check_and_repeat(
    first: NestedResult,
    problem: Samplable,
    move: Move,
    search: SingleRunFunction,
    *,
    max_cost: float,
    max_calls: int | None,
    least_live: int,
    rng: np.random.Generator,
    executor: Executor | None = None,
    n_workers: int | None = None,
) -> NestedResult:
    """Check a run that its stopping rule ended; repeat it with longer chains where the second estimate disagrees.

    `search` runs nested sampling once, without a check. Limits on all evaluations, those of `first` included:
    `max_cost` times those of `first`, and `max_calls`, if not None. `least_live`: fewest live points allowed for the
    problem. `executor` and `n_workers` are for the search of missed hills; `search` brings its own.

    Return the first run, or a repetition: with hops between modes where `first` lost one, or with longer chains if only
    that agrees with the second estimate. `check` holds the second estimate; None if it failed or did not end, which
    adds a warning. A warning is also added if the two still disagree. `n_calls` counts all evaluations.
    """
    limit = max_cost * first.n_calls if max_calls is None else min(max_cost * first.n_calls, max_calls)
    budget = _CallBudget(search, limit, first.n_calls, rng)
    now, missing, notes = first, MissedHills(), tuple[str, ...]()
    find = partial(find_missed_hills, problem=problem, rng=rng, executor=executor, n_workers=n_workers)
    try:
        missing = find(first, max_calls=budget.calls_left)
        budget.spent += missing.n_calls
        modes = None
        if log_z_rise_in_errors(first, log_evidence_of_unmet_hills(missing.lost, first)) > _MATTERS:
            modes = _clusters_of_met_and_lost_modes(first, missing.lost, problem, rng)
            chain = move if isinstance(move, SliceMove) else SliceMove()
            again = budget.run_route(_EvidenceRoute(problem, first.n_live, chain, "the run with hops", modes=modes))
            if again is not None:
                now = again
                more = find(now, max_calls=budget.calls_left, lost=missing.lost)
                budget.spent += more.n_calls
                missing = replace(more, n_calls=missing.n_calls + more.n_calls)
        route, second = _route_and_second_estimate(now, problem, move, least_live, budget)
        if second is None:
            # An estimate that should cost a fifth of the run and does not end is itself a sign of trouble.
            notes = (
                f"{route.name}, which checks the evidence, did not end within max_cost and max_calls "
                f"({int(budget.limit)} evaluations in all); use a greater limit, or max_cost=1 for no check",
            )
        else:
            if second.disagrees_or_is_doubtful(now, _APART):
                second = _second_estimate_with_more_live_points(second, now, first, budget)
            n_check = second.n_calls + missing.n_calls
            if second.disagrees_or_is_doubtful(now, DISAGREE):
                again = budget.run_route(
                    _EvidenceRoute(
                        problem, now.n_live, _slice_move_of_longer_chains(move), "the run again", modes=modes
                    )
                )
                now, second = _choose_agreeing_run_and_estimate(second, now, again)
            now = _with_check_stored(now, second, n_check)
    except Exception as error:
        # A second estimate may evaluate hypotheses that the first run never met. Whatever a check meets, a posterior
        # narrower than floats among it, the run that ended is kept.
        why = str(error) if isinstance(error, NotConvergedError) else message_of(error)
        notes = (f"the second pass, which checks the evidence, failed: {why}",)
    return replace(now, n_calls=budget.spent, warnings=(*now.warnings, *notes, *missing.doubts(now)))


def _clusters_of_met_and_lost_modes(
    first: NestedResult, lost: Iterable[HillEstimate], problem: Samplable, rng: np.random.Generator
) -> Clusters:
    """Return the clusters of a run's posterior samples, followed by the modes it lost, in the sampling coordinates."""
    space = space_of(problem.prior, getattr(problem, "periodic", ()))
    met = split_into_clusters(space.enter(first.samples(_N_SAMPLES, rng=rng)))
    return Clusters.from_groups([*met, *(space.enter(hill.theta) for hill in lost)])


def _route_and_second_estimate(
    now: NestedResult, problem: Samplable, move: Move, least_live: int, budget: _CallBudget
) -> tuple[_EvidenceRoute, _SecondEstimate | None]:
    """Estimate the evidence by each route in turn until one has the expected mean log likelihood.

    Return the last route tried and its estimate; None for the estimate if its run did not end.
    """
    curved, second = False, None
    for route in _routes_to_second_estimate(now, problem, move, least_live, budget.rng):
        found = budget.run_route(route)
        second = None if found is None else _SecondEstimate(route, (found,), curved)
        if found is not None and route.has_expected_mean_likelihood(found):
            break
        curved = route.expected is not None
    return route, second


def _second_estimate_with_more_live_points(
    second: _SecondEstimate, now: NestedResult, first: NestedResult, budget: _CallBudget
) -> _SecondEstimate:
    """Repeat a second estimate with more live points, at most as many as `now` has, and combine the two runs.

    Where the first run of the estimate has warnings, the new one replaces it. If the budget does not allow more live
    points, the estimate is returned as it was.
    """
    route, left, again_costs = second.route, budget.calls_left, _AGAIN * first.n_calls
    room = left - again_costs if left > again_costs else left
    n_live = int(min(max(route.n_live, now.n_live), room / second.runs[0].n_calls * route.n_live))
    if n_live <= route.n_live:
        return second
    found = budget.run_route(replace(route, n_live=n_live, most_calls=math.inf))
    if found is None:
        return second
    return replace(second, runs=(found,) if second.runs[0].warnings else (*second.runs, found))


def _choose_agreeing_run_and_estimate(
    second: _SecondEstimate, now: NestedResult, again: NestedResult | None
) -> tuple[NestedResult, _SecondEstimate]:
    """Return `again`, a run with longer chains, where it agrees with the second estimate, else `now`; and the estimate.

    Where the estimate missed a part of a curved posterior, `now` becomes the second estimate of `again`.
    """
    if again is None or again.warnings:
        return now, second
    if not second.disagrees_or_is_doubtful(again, DISAGREE):
        return again, second
    if second.misses_part_of_curved_posterior(now, again):
        shorter = replace(second.route, name="the same run with shorter chains")
        return again, _SecondEstimate(shorter, (now,), second.curved)
    return now, second


def _routes_to_second_estimate(
    first: NestedResult, problem: Samplable, move: Move, least_live: int, rng: np.random.Generator
) -> Iterator[_EvidenceRoute]:
    """Yield the routes to a second estimate, the cheapest first; the last one expects no mean log likelihood."""

    def route_near_posterior(near: Repartitioned, nats: float) -> _EvidenceRoute:
        wanted = _SHARE * first.n_live * first.information / max(nats, 1.0)
        enough = 2.0 * first.n_live * nats / first.information  # for an error below the first run's
        n_live = int(max(min(wanted, enough, first.n_live / 2), least_live, min(_LEAST_LIVE, first.n_live)))
        return _EvidenceRoute(near, n_live, _slice_move_of_longer_chains(move), "a second pass from near the posterior")

    if first.information > 0:
        theta = first.samples(_N_SAMPLES, rng=rng)
        # Clusters describe a posterior that they cover. A curved ridge they may not, and then mislead the live points.
        clustered = _repartitioned_if_possible(problem, theta, clustered=True)
        if clustered is not None and len(clustered.prior.parts) == 1:
            clustered = None  # the single prior below
        if (
            clustered is not None
            and (nats := _information_of_second_pass(first, clustered)) < _FEW_NATS < _GAIN * first.information
        ):
            most, expected = _MOST_COST * first.n_calls, nats + first.log_z
            yield replace(route_near_posterior(clustered, nats), most_calls=most, expected=expected)
        single = _repartitioned_if_possible(problem, theta, clustered=False)
        # With a log Z that is far too large the nats come out too few, or negative.
        if single is not None and (nats := _information_of_second_pass(first, single)) < _GAIN * first.information:
            yield route_near_posterior(single, nats)
            return
    n_live = max(first.n_live // 8, least_live, min(_LEAST_LIVE, first.n_live))
    yield _EvidenceRoute(problem, n_live, _slice_move_of_longer_chains(move), "a second run with longer chains")


def _repartitioned_if_possible(problem: Samplable, theta: FloatArray, *, clustered: bool) -> Repartitioned | None:
    """Give the problem a prior near its posterior samples; None where the prior or the samples do not allow it."""
    if not hasattr(problem.prior, "log_prob"):
        return None
    try:
        near = repartitioned(problem, theta, clustered=clustered)
        return near if near.prior.has_invertible_axes else None
    except (ParameterError, np.linalg.LinAlgError):
        return None


def _information_of_second_pass(first: NestedResult, near: Repartitioned) -> float:
    """Return the nats by which a run from the prior `near` would compress, estimated from the first run's posterior."""
    possible = first.log_weight > -math.inf
    log_prior_ratio = near.prior.log_prior_ratio(first.theta[possible])
    return float(first.weight[possible] @ (first.log_likelihood[possible] + log_prior_ratio)) - first.log_z


def _slice_move_of_longer_chains(move: Move) -> SliceMove:
    """Double the chains' length, to twice the default at least; any other move is replaced by slice sampling."""
    least = SliceMove().with_twice_the_steps()
    if not isinstance(move, SliceMove):
        return least
    double = move.with_twice_the_steps()
    return replace(
        double,
        steps_per_param=max(double.steps_per_param, least.steps_per_param),
        fewest_steps=max(double.fewest_steps, least.fewest_steps),
    )


def weighted_mean_and_error(log_z: Sequence[float], log_z_error: Sequence[float]) -> tuple[float, float]:
    """Return the inverse-variance weighted mean of independent estimates of log Z, and its error."""
    weight: FloatArray = np.maximum(log_z_error, 1e-12) ** -2.0
    return float(weight @ np.asarray(log_z) / weight.sum()), float(weight.sum() ** -0.5)


def _with_check_stored(now: NestedResult, second: _SecondEstimate, n_check: int) -> NestedResult:
    """Store the check in the result, with a warning where the estimates disagree or the second one has warnings.

    If they agree, drop the warnings on few possible draws and on few lineages that the check has settled.
    """
    (log_z, error), distance, name = second.log_z_and_error, second.signed_distance_in_errors(now), second.route.name
    warnings = now.warnings
    if abs(distance) > DISAGREE:
        warnings = (
            *warnings,
            f"{name} gives log Z = {log_z:.2f} ± {error:.2f}, this run {now.log_z:.2f} ± {now.log_z_error:.2f}: "
            f"{abs(distance):.1f} errors apart; chains are too short or a part of the posterior was lost; "
            "use a greater steps_per_param, more n_live, or a greater max_cost",
        )
    elif second.runs[-1].warnings:
        why = second.runs[-1].warnings[0]
        warnings = (*warnings, f"{name}, which checks the evidence, is itself doubtful: {why}")
    else:
        # A poorly known share of possible hypotheses, or error, no longer matters once a second estimate agrees.
        settled = [warning_of_few_possible_draws(now.log_start, now.log_start_error, now.n_live)]
        if error < now.log_z_error:
            settled.append(warning_of_few_lineages(now.memory))
        warnings = tuple(note for note in warnings if note not in settled)
    return replace(now, check=Check(name, log_z, error, distance, n_check), warnings=warnings)
