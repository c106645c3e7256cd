"""Check a run's evidence by a second, independent estimate, and repeat the run where the two disagree.

Chains that are too short bias every shell a little in the same direction, which neither insertion ranks nor the scatter
between seeds show. The second estimate uses chains twice as long and compresses by few nats: it runs from a prior near
the posterior of the first run (`repartition`), or, where that saves nothing, is a small run of the same problem.

Parts of the posterior without live points escape both. So `probewise.nested.peaks` looks for missed peaks first, and
the prior of the second estimate gets a part about each: its posterior tells which of them matter. The repetition hops
between all parts.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError, ParameterError, message_of
from probewise.nested.clusters import Clusters, find_clusters
from probewise.nested.evidence import MOST_MEMORY, warning_of_few_lineages, warning_of_few_possible_draws
from probewise.nested.moves import HoppingMove, Move, SliceMove
from probewise.nested.peaks import find_missed_peaks
from probewise.nested.problem import Evaluator, Samplable
from probewise.nested.repartition import repartitioned
from probewise.nested.result import Check, NestedResult

DISAGREE = 2.5
"""Difference of two estimates of log Z, in combined standard errors, above which they disagree."""

_N_SAMPLES = 2000
_GAIN = 0.8  # share of the first run's nats, below which the second estimate is one from near the posterior
_SHARE = 0.1  # of the first run's live points times nats, spent on the second estimate
_LEAST_LIVE = 40
_SAMPLES_IN_CLUSTER = 20  # per parameter: with fewer, repeated samples look like a cluster
_MET = 0.5  # of the share of a peak: with more, a run has met it
_AGAIN = 2.2  # times the first run's evaluations: what it costs to repeat it with chains twice as long
_MISSING = 1.0  # errors by which a missed peak raises log Z, above which it is a doubt

Search = Callable[..., NestedResult]  # runs nested sampling once, without a check, as `run_once` does


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
    """A `run` by the method `name`, whose posterior says how much each missed peak holds."""

    name: str
    run: NestedResult
    # `n_met` clusters of the first run's samples and then the missed peaks, in the coordinates into which `enter` maps
    # parameters; None if no peak was missed.
    parts: Clusters | None
    n_met: int
    enter: Callable[[FloatArray], FloatArray]

    def distance(self, run: NestedResult) -> float:
        return (run.log_z - self.run.log_z) / max(math.hypot(_error_to_trust(run), self.run.log_z_error), 1e-12)

    def doubts(self, run: NestedResult) -> list[str]:
        return [*self.missing_part_in_words(run), *self.disagreement_in_words(run)]

    def missing_part_in_words(self, run: NestedResult) -> list[str]:
        """Describe the missed peaks that matter and of which a run has less than half; empty without any."""
        share = 0.0
        if self.parts is not None:
            has, wanted = (
                np.bincount(self.parts.assign(self.enter(each.theta)), each.weight, len(self.parts))[self.n_met :]
                for each in (run, self.run)
            )
            share = float(wanted[has < _MET * wanted].sum())
        if -math.log1p(-min(share, 1 - 1e-15)) <= _MISSING * _error_to_trust(run):
            return []
        return [
            "a part of the posterior that the live points have lost or never met has a log Z of about "
            f"{self.run.log_z + math.log(share):.2f}, this run's is {run.log_z:.2f} ± {run.log_z_error:.2f}; use more "
            "n_live, or a prior about it"
        ]

    def disagreement_in_words(self, run: NestedResult) -> list[str]:
        """Describe that the evidences disagree, or that this one is itself doubtful; empty if neither."""
        if abs(self.distance(run)) > DISAGREE:
            return [
                f"{self.name} gives log Z = {self.run.log_z:.2f} ± {self.run.log_z_error:.2f}, this run "
                f"{run.log_z:.2f} ± {run.log_z_error:.2f}: {abs(self.distance(run)):.1f} errors apart; chains are too "
                "short or a part of the posterior was lost; use a greater steps_per_param, more n_live, or a greater "
                "max_cost"
            ]
        return [f"{self.name}, which checks the evidence, is itself doubtful: {w}" for w in self.run.warnings[:1]]


def _error_to_trust(run: NestedResult) -> float:
    """Return a run's error, but no more than few lineages can tell: a greater one would excuse any disagreement."""
    return run.log_z_error * math.sqrt(min(MOST_MEMORY / run.memory, 1.0))


def check_and_repeat(
    first: NestedResult,
    evaluate: Evaluator,
    move: Move,
    search: Search,
    *,
    max_cost: float,
    max_calls: int | None,
    least_live: int,
    rng: np.random.Generator,
    repeat: bool = True,
) -> NestedResult:
    """Check a run that its stopping rule ended; `repeat` it with longer chains where there are doubts.

    Limits on all evaluations, those of `first` included: `max_cost` times those of `first`, and `max_calls`, if not
    None. `least_live`: fewest live points allowed for the problem. `evaluate`: of the problem, for the search of missed
    peaks; `search` brings its own.

    Return the first run, or a repetition if only that has no doubts. `check` holds the second estimate; None if it
    failed or did not end, which adds a warning. `n_calls` counts all evaluations.
    """
    limit = min(max_cost * first.n_calls, math.inf if max_calls is None else max_calls)
    budget, now, check = _Budget(search, limit, first.n_calls, rng), first, None
    try:
        chain = _with_longer_chains(move)
        second = _second_estimate(first, evaluate, budget, chain, least_live)
        if second is None:
            # An estimate that should cost a fifth of the run and does not end is itself a sign of trouble.
            notes = [
                "a second estimate, which checks the evidence, did not end within max_cost and max_calls "
                f"({int(limit)} evaluations in all); use a greater limit, or max_cost=1 for no check"
            ]
        else:
            n_check, notes = budget.spent - first.n_calls, second.doubts(first)
            if notes and repeat and not second.run.warnings:
                again = budget.run(evaluate.problem, first.n_live, chain, second.parts)
                if again is not None and not again.warnings and not second.doubts(again):
                    now, notes = again, []
            log_z, error = second.run.log_z, second.run.log_z_error
            check = Check(second.name, log_z, error, second.distance(now), n_check)
            if not notes:
                # A poorly known share of possible hypotheses, or error, no longer matters once both agree.
                settled = [warning_of_few_possible_draws(now.log_start, now.log_start_error, now.n_live)]
                settled += [warning_of_few_lineages(now.memory)] if error < now.log_z_error else []
                now = replace(now, warnings=tuple(note for note in now.warnings if note not in settled))
    except Exception as error:
        # A second estimate may evaluate hypotheses that the first run never met. Whatever a check meets, a posterior
        # narrower than floats among it, the run that ended is kept.
        why = str(error) if isinstance(error, NotConvergedError) else message_of(error)
        notes = [f"a second estimate, which checks the evidence, failed: {why}"]
    return replace(now, n_calls=budget.spent, check=check, warnings=(*now.warnings, *notes))


def _second_estimate(
    first: NestedResult, evaluate: Evaluator, budget: _Budget, chain: SliceMove, least_live: int
) -> _SecondEstimate | None:
    """Run from near the posterior and the missed peaks, or a small run; None if it did not end.

    Where the two estimates disagree it is repeated with more live points.
    """
    problem, enter, n_before = evaluate.problem, evaluate.space.enter, evaluate.n_calls
    invertible = hasattr(problem.prior, "to_unit_cube") or hasattr(problem.prior, "coordinates")
    peaks = find_missed_peaks(first, evaluate, max_calls=budget.left, rng=budget.rng) if invertible else []
    budget.spent += evaluate.n_calls - n_before
    theta = first.samples(_N_SAMPLES, rng=budget.rng)
    least = max(least_live, min(_LEAST_LIVE, first.n_live))
    name, posed, n_live = "a second run with longer chains", problem, max(first.n_live // 8, least)
    if first.information > 0 and hasattr(problem.prior, "log_prob"):
        with contextlib.suppress(ParameterError, np.linalg.LinAlgError):  # too few samples, or they hardly vary
            near = repartitioned(problem, theta, peaks=peaks)
            possible = first.log_weight > -math.inf
            gained = first.log_likelihood[possible] + near.prior.log_prior_ratio(first.theta[possible])
            # With a log Z that is far too large the nats come out too few, or negative.
            nats = float(first.weight[possible] @ gained) - first.log_z
            if near.prior.has_invertible_axes and (peaks or nats < _GAIN * first.information):
                wanted = _SHARE * first.n_live * first.information / max(nats, 1.0)
                enough = 2.0 * first.n_live * nats / first.information  # for an error below the first run's
                name, posed = "a second pass from near the posterior", near
                n_live = int(max(min(wanted, enough, first.n_live / 2), least))
    found = budget.run(posed, n_live, chain)
    if found is None:
        return None
    parts, n_met = None, 1
    if peaks:
        whole, fewest = enter(theta), _SAMPLES_IN_CLUSTER * theta.shape[1]
        clusters, met = find_clusters(whole, least=fewest), [whole]
        home = clusters.assign(whole)
        if np.bincount(home, minlength=len(clusters)).min() >= fewest:  # the last division of space may leave fewer
            met = [whole[home == k] for k in range(len(clusters))]
        parts, n_met = Clusters.from_groups([*met, *map(enter, peaks)]), len(met)
    second, again = _SecondEstimate(name, found, parts, n_met, enter), _AGAIN * first.n_calls
    room = budget.left - again if budget.left > again else budget.left
    n_more = int(min(first.n_live, n_live * room / found.n_calls))
    if second.disagreement_in_words(first) and not second.missing_part_in_words(first) and n_more > n_live:
        second = replace(second, run=budget.run(posed, n_more, chain) or found)
    return second


def _with_longer_chains(move: Move) -> SliceMove:
    least = SliceMove()
    chain = move if isinstance(move, SliceMove) else least
    steps, fewest = max(chain.steps_per_param, least.steps_per_param), max(chain.fewest_steps, least.fewest_steps)
    return replace(chain, steps_per_param=2.0 * steps, fewest_steps=2 * fewest)
