"""Check a run's evidence by a second, independent estimate, and repeat the run where the two disagree.

Chains that are too short bias every shell a little, always in the same direction, so the bias of log Z grows with the
compression. The insertion ranks and the scatter between seeds do not show this bias. The second estimate uses chains
twice as long and compresses by few nats: it runs from a prior near the posterior of the first run (`repartition`).
Where the posterior fills so much of the prior that this saves nothing, it is a small run of the same problem.

Parts of the posterior without live points escape both. So `probewise.nested.peaks` looks for missed peaks first, and
the prior of the second estimate gets a part about each: its posterior tells which of them matter. Where one that the
live points have lost does, the run is repeated with moves that hop between all parts.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError, ParameterError, message_of
from probewise.nested.clusters import Clusters, find_clusters
from probewise.nested.evidence import warning_of_few_lineages, warning_of_few_possible_draws
from probewise.nested.moves import HoppingMove, Move, SliceMove
from probewise.nested.peaks import MissedPeaks, find_missed_peaks
from probewise.nested.problem import Samplable, space_of
from probewise.nested.repartition import repartitioned
from probewise.nested.result import Check, NestedResult, Samples

DISAGREE = 2.5
"""Difference of two estimates of log Z, in combined standard errors, above which they disagree."""

_APART = 2.0  # errors, above which the second estimate is repeated with more live points
_N_SAMPLES = 2000
_GAIN = 0.8  # share of the first run's nats, below which the second estimate is one from near the posterior
_AGAIN = 2.2  # times the first run's evaluations: what it costs to repeat it with chains twice as long
_SHARE = 0.1  # of the first run's live points times nats, spent on the second estimate
_LEAST_LIVE = 40
_SAMPLES_IN_CLUSTER = 20  # per parameter: with fewer, repeated samples look like a cluster
_MET = 0.5  # of the share of a part: with more, a run has met it
_MATTERS = 0.25  # errors by which a lost part raises log Z, above which the run is repeated
_MISSING = 1.0  # the same, above which it is a doubt

Search = Callable[..., NestedResult]
"""Function that runs nested sampling once, without a check, as `run_once` does."""


@dataclass
class _Budget:
    """The likelihood evaluations of a check, the first run's included: at most `limit` in all, `spent` so far."""

    search: Search
    limit: float
    spent: int
    rng: np.random.Generator

    @property
    def left(self) -> int:
        return int(self.limit - self.spent)

    def run(
        self, problem: Samplable, n_live: int, chain: SliceMove, modes: Clusters | None = None
    ) -> NestedResult | None:
        """Run nested sampling, with hops between `modes`; None if too few evaluations are left for a complete run."""
        # A run is worth a start with its first live points, and twice the evaluations of one round.
        if self.left < n_live * (1 + chain.n_steps(len(problem.prior.names)) * chain.target):
            return None
        move = chain if modes is None else HoppingMove(chain, modes)
        found = self.search(problem, n_live=n_live, move=move, max_calls=self.left, rng=self.rng)
        self.spent += found.n_calls
        return found if found.complete else None


@dataclass(frozen=True, eq=False)
class _SecondEstimate:
    """A second estimate of the evidence: one or two runs of `problem`, with `n_live` points in the first of them."""

    problem: Samplable
    n_live: int
    name: str
    runs: tuple[NestedResult, ...] = ()

    @property
    def log_z_and_error(self) -> tuple[float, float]:
        return weighted_mean_and_error([a.log_z for a in self.runs], [a.log_z_error for a in self.runs])

    def distance(self, run: NestedResult) -> float:
        """Return a run's log Z minus this estimate's, in combined standard errors."""
        log_z, error = self.log_z_and_error
        return (run.log_z - log_z) / max(math.hypot(run.log_z_error, error), 1e-12)

    def disagrees_or_is_doubtful(self, run: NestedResult, most: float) -> bool:
        return abs(self.distance(run)) > most or bool(self.runs[-1].warnings)


@dataclass(frozen=True, eq=False)
class _Parts:
    """The parts of a posterior as clusters in the sampling coordinates: those of a run's samples, then missed peaks.

    `second` is a run from near all of them, whose posterior says how much each holds.
    """

    modes: Clusters
    enter: Callable[[FloatArray], FloatArray]
    n_met: int
    n_lost: int
    second: NestedResult

    @classmethod
    def of(cls, theta: FloatArray, problem: Samplable, peaks: MissedPeaks, second: NestedResult) -> _Parts:
        """Return the parts, from posterior samples of a run, (n, n_params), and the peaks that it has missed."""
        enter = space_of(problem.prior, getattr(problem, "periodic", ())).enter
        u, least = enter(theta), _SAMPLES_IN_CLUSTER * theta.shape[1]
        clusters = find_clusters(u, least=least)
        home = clusters.assign(u)
        met = [u[home == k] for k in range(len(clusters))]
        if min(map(len, met)) < least:  # the last division of space may leave a cluster with fewer
            met = [u]
        modes = Clusters.from_groups([*met, *map(enter, (*peaks.lost, *peaks.above))])
        return cls(modes, enter, len(met), len(peaks.lost), second)

    def missing_shares(self, run: Samples) -> tuple[float, float]:
        """Return the shares of the posterior in lost and in higher peaks of which a run has less than half."""
        has, wanted = (
            np.bincount(self.modes.assign(self.enter(each.theta)), each.weight, len(self.modes))[self.n_met :]
            for each in (run, self.second)
        )
        missing = np.where(has < _MET * wanted, wanted, 0.0)
        return float(missing[: self.n_lost].sum()), float(missing[self.n_lost :].sum())

    def doubts(self, run: Samples) -> tuple[str, ...]:
        """Return doubts in words, at most one a kind of part, about what a run lacks."""
        lost, above = self.missing_shares(run)
        mine, notes = f"this run's {run.log_z:.2f} ± {run.log_z_error:.2f}", list[str]()
        if _rise_in_errors(run, lost) > _MISSING:
            notes.append(
                "a part of the posterior that the live points have lost has a log Z of about "
                f"{self.second.log_z + math.log(lost):.2f}, {mine}; use more n_live or a greater max_cost"
            )
        if _rise_in_errors(run, above) > DISAGREE:
            notes.append(
                "a narrow peak that no live point met lies above the run's end: its log Z is about "
                f"{self.second.log_z + math.log(above):.1f}, {mine}; use more n_live or a prior about the peak"
            )
        return tuple(notes)


def _rise_in_errors(run: Samples, share: float) -> float:
    """Return by how many of its errors a run's log Z would rise with a share of the posterior that it lacks."""
    return -math.log1p(-min(share, 1 - 1e-15)) / max(run.log_z_error, 1e-12)


def check_and_repeat(
    first: NestedResult,
    problem: Samplable,
    move: Move,
    search: Search,
    *,
    max_cost: float,
    max_calls: int | None,
    least_live: int,
    rng: np.random.Generator,
    executor: Executor | None = None,
    n_workers: int | None = None,
) -> NestedResult:
    """Check a run that its stopping rule ended; repeat it with longer chains where the second estimate disagrees.

    Limits on all evaluations, those of `first` included: `max_cost` times those of `first`, and `max_calls`, if not
    None. `least_live`: fewest live points allowed for the problem. `executor` and `n_workers` are for the search of
    missed peaks; `search` brings its own.

    Return the first run, or a repetition: with hops between modes where `first` lost one, or with longer chains if only
    that agrees with the second estimate. `check` holds the second estimate; None if it failed or did not end, which
    adds a warning. A warning is also added if the two still disagree. `n_calls` counts all evaluations.
    """
    limit = max_cost * first.n_calls if max_calls is None else min(max_cost * first.n_calls, max_calls)
    budget = _Budget(search, limit, first.n_calls, rng)
    now, longer = first, _with_longer_chains(move)
    notes: tuple[str, ...]
    try:
        peaks = find_missed_peaks(
            first, problem, max_calls=budget.left, rng=rng, executor=executor, n_workers=n_workers
        )
        budget.spent += peaks.n_calls
        theta = first.samples(_N_SAMPLES, rng=rng)
        plan = _plan_second_estimate(first, theta, problem, peaks, least_live)
        found = budget.run(plan.problem, plan.n_live, longer)
        if found is None:
            # An estimate that should cost a fifth of the run and does not end is itself a sign of trouble.
            doubt = (
                f"{plan.name}, which checks the evidence, did not end within max_cost and max_calls "
                f"({int(limit)} evaluations in all); use a greater limit, or max_cost=1 for no check"
            )
            return replace(first, n_calls=budget.spent, warnings=(*first.warnings, doubt))
        second, modes, above = replace(plan, runs=(found,)), None, 0.0
        parts = _Parts.of(theta, problem, peaks, found) if peaks.lost or peaks.above else None
        if parts is not None:
            lost, above = parts.missing_shares(first)
            if _rise_in_errors(first, lost) > _MATTERS:
                modes = parts.modes
                chain = move if isinstance(move, SliceMove) else SliceMove()
                now = budget.run(problem, first.n_live, chain, modes) or first
        # Neither chains nor hops lead to a peak above the end.
        if _rise_in_errors(now, above) <= DISAGREE:
            if second.disagrees_or_is_doubtful(now, _APART):
                second = _with_more_live_points(second, now, first, longer, budget)
            if second.disagrees_or_is_doubtful(now, DISAGREE):
                again = budget.run(problem, first.n_live, longer, modes)
                if again is not None and not again.warnings and not second.disagrees_or_is_doubtful(again, DISAGREE):
                    now = again
        notes = () if parts is None else parts.doubts(now)
        now = _with_check_stored(now, second, sum(r.n_calls for r in second.runs) + peaks.n_calls)
    except Exception as error:
        # A second estimate may evaluate hypotheses that the first run never met. Whatever a check meets, a posterior
        # narrower than floats among it, the run that ended is kept.
        why = str(error) if isinstance(error, NotConvergedError) else message_of(error)
        notes = (f"the second pass, which checks the evidence, failed: {why}",)
    return replace(now, n_calls=budget.spent, warnings=(*now.warnings, *notes))


def doubts_of_missed_parts(
    run: NestedResult, judged: Samples, problem: Samplable, search: Search, *, rng: np.random.Generator
) -> tuple[tuple[str, ...], int]:
    """Look for parts of the posterior that a run has missed; weigh any by a second estimate with a part about each.

    Return doubts about `judged`, such as a refinement of the run, in words; and the number of evaluations, at most
    twice those of the run.
    """
    peaks = find_missed_peaks(run, problem, max_calls=run.n_calls, rng=rng)
    budget = _Budget(search, 2 * run.n_calls, peaks.n_calls, rng)
    if not (peaks.lost or peaks.above):
        return (), budget.spent
    theta = run.samples(_N_SAMPLES, rng=rng)
    plan = _plan_second_estimate(run, theta, problem, peaks, least_live=run.n_live)
    found = budget.run(plan.problem, plan.n_live, _with_longer_chains(SliceMove()))
    if found is None:
        return (f"{plan.name}, which weighs a peak that the run may have missed, did not end",), budget.spent
    return _Parts.of(theta, problem, peaks, found).doubts(judged), budget.spent


def _plan_second_estimate(
    first: NestedResult, theta: FloatArray, problem: Samplable, peaks: MissedPeaks, least_live: int
) -> _SecondEstimate:
    """Plan a second estimate from near the posterior samples `theta` and the missed peaks, or by a small run."""
    least = max(least_live, min(_LEAST_LIVE, first.n_live))
    near = None
    if first.information > 0 and hasattr(problem.prior, "log_prob"):
        with contextlib.suppress(ParameterError, np.linalg.LinAlgError):  # too few samples, or they hardly vary
            near = repartitioned(problem, theta, peaks=(*peaks.lost, *peaks.above))
    if near is not None and near.prior.has_invertible_axes:
        possible = first.log_weight > -math.inf
        gained = first.log_likelihood[possible] + near.prior.log_prior_ratio(first.theta[possible])
        # With a log Z that is far too large the nats come out too few, or negative.
        nats = float(first.weight[possible] @ gained) - first.log_z
        if peaks.lost or peaks.above or nats < _GAIN * first.information:
            wanted = _SHARE * first.n_live * first.information / max(nats, 1.0)
            enough = 2.0 * first.n_live * nats / first.information  # for an error below the first run's
            n_live = int(max(min(wanted, enough, first.n_live / 2), least))
            return _SecondEstimate(near, n_live, "a second pass from near the posterior")
    return _SecondEstimate(problem, max(first.n_live // 8, least), "a second run with longer chains")


def _with_more_live_points(
    second: _SecondEstimate, now: NestedResult, first: NestedResult, chain: SliceMove, budget: _Budget
) -> _SecondEstimate:
    """Repeat a second estimate with more live points, as many as `now` has or the budget allows; combine the two runs.

    The new run replaces a first one with warnings.
    """
    again_costs = _AGAIN * first.n_calls
    room = budget.left - again_costs if budget.left > again_costs else budget.left
    n_live = int(min(max(second.n_live, now.n_live), room / second.runs[0].n_calls * second.n_live))
    found = budget.run(second.problem, n_live, chain) if n_live > second.n_live else None
    if found is None:
        return second
    return replace(second, runs=(found,) if second.runs[0].warnings else (*second.runs, found))


def _with_longer_chains(move: Move) -> SliceMove:
    """Double the chains' length, to twice the default at least; any other move is replaced by slice sampling."""
    least = SliceMove()
    chain = move if isinstance(move, SliceMove) else least
    return replace(
        chain,
        steps_per_param=2.0 * max(chain.steps_per_param, least.steps_per_param),
        fewest_steps=2 * max(chain.fewest_steps, least.fewest_steps),
    )


def weighted_mean_and_error(log_z: Sequence[float], log_z_error: Sequence[float]) -> tuple[float, float]:
    """Return the inverse-variance weighted mean of independent estimates of log Z, and its error."""
    # A constant likelihood has an exact evidence: the error is nought, or a last digit.
    weight: FloatArray = np.maximum(log_z_error, 1e-12) ** -2.0
    return float(weight @ np.asarray(log_z) / weight.sum()), float(weight.sum() ** -0.5)


def _with_check_stored(now: NestedResult, second: _SecondEstimate, n_check: int) -> NestedResult:
    """Store the check in the result, with a warning where the estimates disagree or the second one has warnings.

    If they agree, drop the warnings on few possible draws and on few lineages that the check has settled.
    """
    (log_z, error), distance, name = second.log_z_and_error, second.distance(now), second.name
    warnings = now.warnings
    if abs(distance) > DISAGREE:
        warnings = (
            *warnings,
            f"{name} gives log Z = {log_z:.2f} ± {error:.2f}, this run {now.log_z:.2f} ± {now.log_z_error:.2f}: "
            f"{abs(distance):.1f} errors apart; chains are too short or a part of the posterior was lost; "
            "use a greater steps_per_param, more n_live, or a greater max_cost",
        )
    elif second.runs[-1].warnings:
        warnings = (*warnings, f"{name}, which checks the evidence, is itself doubtful: {second.runs[-1].warnings[0]}")
    else:
        # A poorly known share of possible hypotheses, or error, no longer matters once a second estimate agrees.
        settled = [warning_of_few_possible_draws(now.log_start, now.log_start_error, now.n_live)]
        if error < now.log_z_error:
            settled.append(warning_of_few_lineages(now.memory))
        warnings = tuple(note for note in warnings if note not in settled)
    return replace(now, check=Check(name, log_z, error, distance, n_check), warnings=warnings)
