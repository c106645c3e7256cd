"""Nested sampling (Skilling 2006), the inference engine.

Paper, sections 2.3, "The Machine Learning System", and 2.7 (the evidence Z, eq. 18). The worst live points are removed,
which shrinks the volume, and new ones of greater likelihood are drawn.

`run` is the entry point, `replace_worst_live_points` the step, and `RemainingEvidence` and `EvidenceChange` say when to
stop.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from probewise._arrays import logsumexp, own_arithmetic
from probewise._kinds import (
    checked_number,
    checked_path,
    checked_whole,
    require_callable,
    require_flag,
    require_like,
    require_rng,
)
from probewise.errors import DoubtfulResultWarning, NotConvergedError, require, warn
from probewise.nested.check import check_and_repeat
from probewise.nested.evidence import (
    DOUBTFUL_P_VALUE,
    birth_rows,
    insertion_p_value,
    insertion_ranks,
    integrate,
    log_volumes,
    n_independent,
    relative_lineage_variance,
    warning_of_coarse_coordinates,
    warning_of_few_lineages,
    warning_of_few_possible_draws,
)
from probewise.nested.moves import Move, PriorRejection, SliceMove, Tally
from probewise.nested.problem import AnyPrior, Bound, Evaluator, OutOfCallsError, Points, Samplable, as_problem
from probewise.nested.result import NestedResult, as_json, software_versions
from probewise.nested.save import CheckpointFile, LivePoints, RunState, settings_of_run
from probewise.nested.weights import n_effective

LIVE_PER_PARAM = 2
"""Least number of live points per parameter."""

# Draw from the whole prior while a point costs fewer evaluations than a chain would.
_PRIOR_VOLUME = 0.05
_FEW_EFFECTIVE = 30.0  # by the weights alone
_STUCK_SHARE = 0.02
# Chains of each first live point where some began at others: after three, ln Z of a prior of which one in 5,000 is
# possible was still 0.7 too low.
_MIXING = 10
_MOST_BYTES = 2**28  # of one array of each kind for all live points; the points that die take tens of times as much


_MOST_TO_COME = 100.0  # nats, for a number that is finite


@dataclass(frozen=True)
class RoundSummary:
    """Summary of a run after a round, passed to `progress` and to the stopping rule."""

    n_dead: int  # dead points so far
    n_calls: int  # likelihood evaluations so far
    log_z: float  # of the dead points only
    log_z_remaining: float  # log of an upper bound on the live points' evidence: best likelihood times remaining volume
    log_ratio_remaining: float  # log of that bound over the evidence so far
    last_change: float  # increase of `log_z` by the last dead point
    log_volume: float  # log of the remaining share of the prior
    best_log_likelihood: float
    on_plateau: bool = False  # whether all live points have the same likelihood

    @property
    def in_words(self) -> str:
        """The state for a progress bar."""
        to_come = math.exp(min(self.log_ratio_remaining, _MOST_TO_COME))
        return f"{self.n_dead} points, ln Z {self.log_z:.1f}, at most {to_come:.1g} times Z to come"


StopRule: TypeAlias = Callable[[RoundSummary], "str | None"]


@dataclass(frozen=True)
class RemainingEvidence:
    """Stopping rule: the live points can raise log Z by less than `dlogz`; their contribution is added at the end."""

    dlogz: float = 0.05

    def __post_init__(self) -> None:
        require(0 < self.dlogz < math.inf, "dlogz", self.dlogz, "greater than 0, finite")

    def __call__(self, state: RoundSummary) -> str | None:
        """Return the reason to stop, or None."""
        excess = state.log_ratio_remaining
        gain = math.log1p(math.exp(excess)) if excess < 700 else excess
        return f"live points can raise log Z by less than {self.dlogz:g}" if gain < self.dlogz else None


@dataclass(frozen=True)
class EvidenceChange:
    """Stopping rule of the paper: consecutive values of log Z differ by less than `tolerance`, 1e-8.

    On a plateau no point of greater likelihood can be drawn: once all live points have the same likelihood and can
    raise log Z by less than 0.05, the rule ends the run too. Further deaths would leave copies of a few points.
    """

    tolerance: float = 1e-8

    def __post_init__(self) -> None:
        require(0 < self.tolerance < math.inf, "tolerance", self.tolerance, "greater than 0, finite")

    def __call__(self, state: RoundSummary) -> str | None:
        """Return the reason to stop, or None."""
        if state.last_change < self.tolerance:
            return f"consecutive values of log Z differ by less than {self.tolerance:g}"
        rest = RemainingEvidence()(state) if state.on_plateau else None
        return rest and f"all live points have the same likelihood, and {rest}"


NestedStop: TypeAlias = Literal["change", "remaining"]

NESTED_STOP: dict[NestedStop, StopRule] = {"change": EvidenceChange(), "remaining": RemainingEvidence()}
"""Rules by name: the paper's, a change of ln Z below 1e-8; and what remains, at most 0.05 of ln Z."""


@own_arithmetic
def run(
    problem: Samplable | Callable[..., Any],
    prior: AnyPrior | None = None,
    *,
    names: Sequence[str] | None = None,
    vectorized: bool = False,
    pass_dict: bool = False,
    periodic: Sequence[str] = (),
    rng: np.random.Generator,
    n_live: int = 300,
    stop: StopRule | None = None,
    move: Move | None = None,
    n_replaced: int | None = None,
    progress: Callable[[RoundSummary], None] | None = None,
    max_calls: int | None = None,
    max_cost: float = 5.0,
    checkpoint: str | Path | None = None,
    executor: Executor | None = None,
    n_workers: int | None = None,
    return_interrupted: bool = False,
) -> NestedResult:
    """Compute the evidence and posterior samples of a problem (paper, section 2.7).

    A doubtful result comes with warnings, which it also stores.

    Parameters
    ----------
    problem
        A problem with prior and log likelihood, evaluated in batches; or a log likelihood, a function of one point.
    prior, names, vectorized, pass_dict, periodic
        With a log likelihood: its prior, and how the functions are called; see `make_problem`.
    rng
        Source of randomness; its state is stored in the result.
    n_live
        Number of live points: the error of log Z falls as one over its root, the cost rises in proportion.
    stop
        Stopping rule; default `RemainingEvidence(0.05)`. The paper's rule is `EvidenceChange(1e-8)`.
    move
        How new points are drawn; default `SliceMove()`. While more than a twentieth of the prior is alive, points are
        drawn from the prior itself.
    n_replaced
        Points replaced per round; default half of `n_live`, for large batches. Compared with one at a time, 28 % fewer
        points are drawn, and the variance of log Z is 44 % greater.
    progress
        Called with a `RoundSummary` after every round.
    max_calls
        Limit of likelihood evaluations; at the limit the run ends with a warning.
    max_cost
        Limit of all evaluations in units of those of the first run; 1 means no check. Else the evidence is estimated a
        second time, and the run repeated where the two disagree or a mode was lost (`probewise.nested.check`); what
        remains in doubt is a warning.
    checkpoint
        File to which the state is saved atomically, at most once in ten seconds and ten times the saving time; its
        folder is created if missing. If the file exists, the run resumes and ends bit for bit as if it had not been
        interrupted or killed; `rng` must be as at the run's start. `max_calls` may differ.
    executor, n_workers
        Evaluates each batch of a slow likelihood in `n_workers` parts, by default the number of processors. The result
        is the same to the last bit if a hypothesis' likelihood does not depend on its batch (for matrix products in
        NumPy it may).
    return_interrupted
        Whether Ctrl-C returns the result so far, with a warning, if there is one. By default it raises
        `KeyboardInterrupt`, so that no script goes on as if the run were complete.

    Raises ParameterError if an option is out of range; NotConvergedError if the likelihood fails (`partial` holds the
    result so far, if there is one), or every hypothesis drawn from the prior is impossible; FileError, before anything
    is evaluated, if the checkpoint is damaged, belongs to another problem, other settings or another seed, or cannot be
    written. If a later saving fails, the run goes on with a warning.
    """
    require_rng(rng)
    posed = as_problem(problem, prior, names, vectorized, pass_dict, periodic)
    require(checked_number("max_cost", max_cost) >= 1, "max_cost", max_cost, "1 (no check) or more")
    moving: Move = SliceMove() if move is None else move
    once = partial(
        run_once, progress=progress, executor=executor, n_workers=n_workers, return_interrupted=return_interrupted
    )
    options: dict[str, Any] = {"n_replaced": n_replaced, "checkpoint": checkpoint, "max_calls": max_calls}
    result = once(posed, rng=rng, n_live=n_live, stop=stop, move=moving, **options)
    if max_cost > 1 and result.names and result.complete:
        # A separate generator that depends only on the state after the run, hence is the same after a resumption.
        checking = np.random.default_rng(rng.integers(2**63, size=4))
        try:
            result = check_and_repeat(
                result,
                Evaluator(posed, executor=executor, n_parts=n_workers),
                moving,
                partial(run_once, progress=progress, executor=executor, n_workers=n_workers),
                max_cost=max_cost,
                max_calls=max_calls,
                least_live=least_live(len(result.names)),
                rng=checking,
            )
        except KeyboardInterrupt:
            if not return_interrupted:
                raise
            note = "interrupted while a second estimate checked the evidence"
            result = replace(result, warnings=(*result.warnings, note))
    for note in result.warnings:
        warn(note, DoubtfulResultWarning)
    return result


def least_live(n_params: int) -> int:
    """Return the least number of live points for a problem: two per parameter, 10 at least."""
    return max(LIVE_PER_PARAM * n_params, 10)


def replace_worst_live_points(
    live: LivePoints, move: Move, evaluate: Evaluator, *, n_replaced: int, rng: np.random.Generator
) -> tuple[LivePoints, LivePoints, Tally]:
    """Replace the `n_replaced` worst live points by new ones above the best of the replaced, drawn together.

    Return the new live points, the dead ones, worst first, and the statistics of the move. The points die one after
    another, so the volume shrinks by Beta(n, 1), Beta(n - 1, 1), ..., which is counted exactly.
    """
    order = live.rows_by_rising_likelihood()
    doomed, survivors = live.take_rows(order[:n_replaced]), live.take_rows(order[n_replaced:])
    bound = Bound(float(doomed.log_likelihood[-1]), float(doomed.label[-1]))
    start = survivors.take_rows(rng.permutation(len(survivors))[:n_replaced])
    new, tally = move.draw(start.without_births(), bound, survivors.u, evaluate, rng)
    ident = live.ident.max() + 1 + np.arange(n_replaced)
    births = {"log_birth": np.full(n_replaced, bound.log_likelihood), "birth_label": np.full(n_replaced, bound.label)}
    born = LivePoints(**vars(new), **births, ident=ident, parent=start.ident)
    return LivePoints.join(survivors, born), doomed, tally


def run_once(
    problem: Samplable,
    *,
    rng: np.random.Generator,
    n_live: int,
    stop: StopRule | None = None,
    move: Move | None = None,
    n_replaced: int | None = None,
    progress: Callable[[RoundSummary], None] | None = None,
    max_calls: int | None = None,
    checkpoint: str | Path | None = None,
    executor: Executor | None = None,
    n_workers: int | None = None,
    return_interrupted: bool = False,
) -> NestedResult:
    """Run nested sampling once, without the check of the evidence.

    `probewise.nested.run` documents the parameters and errors; here doubts are stored in the result without a warning.
    """
    require_rng(rng)
    rule = RemainingEvidence() if stop is None else stop
    moving: Move = SliceMove() if move is None else move
    require_callable("stop", rule, "a rule such as RemainingEvidence(dlogz=0.1), of probewise.nested, or None")
    require_like("move", moving, ("draw", "adapted"), "a move such as SliceMove(), of probewise.nested, or None")
    if progress is not None:
        allowed = "a function called with a RoundSummary after every round, or None; a run shows no bar by itself"
        require_callable("progress", progress, allowed)
    if checkpoint is not None:
        checkpoint = checked_path("checkpoint", checkpoint)
    if executor is not None:
        made = "an executor such as concurrent.futures.ProcessPoolExecutor(), or None; for a count pass n_workers too"
        require_like("executor", executor, ("map", "submit"), made)
    require_flag("return_interrupted", return_interrupted)
    n_workers = n_workers if n_workers is None else checked_whole("n_workers", n_workers)
    evaluate = Evaluator(problem, executor=executor, n_parts=n_workers, most_calls=max_calls)
    n_params = len(evaluate.names)
    least, most = least_live(n_params), _MOST_BYTES // (8 * (2 * n_params + 3))
    n_live = checked_whole("n_live", n_live, least=None, most=None)
    require(n_live >= least, "n_live", n_live, f"{least} or more for {n_params} parameters")
    way_out = "for a smaller error merge the results of several runs: nested.merge"
    allowed = f"up to {most:,} for {n_params} parameters, whose arrays take {_MOST_BYTES >> 20} MB; {way_out}"
    require(n_live <= most, "n_live", n_live, allowed)
    n_replaced = n_live // 2 if n_replaced is None else checked_whole("n_replaced", n_replaced, least=None)
    require(1 <= n_replaced <= n_live // 2, "n_replaced", n_replaced, f"1 to n_live / 2 = {n_live // 2}")
    enough = max_calls is None or checked_whole("max_calls", max_calls, least=None, most=None) >= n_live
    require(enough, "max_calls", max_calls, f"n_live = {n_live} or more")
    seed_state = json.dumps(rng.bit_generator.state, default=as_json)
    if n_params == 0:
        only = np.empty((1, 0))
        log_likelihood = evaluate.log_likelihood(only)
        if not np.isfinite(log_likelihood[0]):
            raise NotConvergedError("the only hypothesis has zero likelihood: it excludes what was measured")
        live = LivePoints.drawn_from_prior(Points(only, only, np.zeros(1), log_likelihood, np.zeros(1)))
        reason = "no free parameters: the likelihood is the evidence"
        now = RunState(live, (), moving, 0.0, 0.0, 0.0, ended=reason)
        return _final_result(evaluate, now, n_live, 1, reason, seed_state, np.random.default_rng(0))
    keeper = resumed = None
    if checkpoint is not None:
        settings = settings_of_run(evaluate.names, n_live, n_replaced, moving, rule, seed_state)
        keeper = CheckpointFile(checkpoint, settings)
        resumed = keeper.resume(evaluate, moving, rng)
    now = _initial_run_state(evaluate, moving, n_live, max_calls, rng) if resumed is None else resumed
    if len(now.live) < n_live:  # a run with more calls begins again
        keeper = None
    if keeper is not None and resumed is None:
        keeper.save_if_due(now)

    def save() -> None:
        if keeper is not None:
            keeper.save(now)

    def finish(reason: str, *notes: str) -> NestedResult:
        save()
        # Depends only on the state after the last round: not on where in a round an interruption came, nor on
        # the generator's seed sequence, which its state does not include.
        rng.bit_generator.state = now.rng_state
        summing = np.random.default_rng(rng.integers(2**63, size=4))
        return _final_result(evaluate, now, n_live, n_replaced, reason, seed_state, summing, notes)

    try:
        while now.ended is None:
            # A round can cost twice the last one: the volume halves while points are drawn from the prior.
            few = max_calls is not None and evaluate.n_calls + 2 * now.last_cost > max_calls
            try:
                if few or len(now.live) < n_live:
                    raise OutOfCallsError
                after, state = _do_round(now, evaluate, n_replaced, rng)
            except OutOfCallsError:  # also the first round, or one that costs more than twice the last
                reason = f"stopped at {evaluate.n_calls} of max_calls = {max_calls} likelihood evaluations"
                return finish(reason, f"{reason}; log Z lacks what a full run would have found")
            # One assignment, so that an interruption leaves a round either complete or not begun.
            now = replace(after, ended=rule(state))
            if progress is not None:
                progress(state)
            if keeper is not None:
                keeper.save_if_due(now)
        return finish(now.ended)
    except NotConvergedError as error:
        if now.dead:
            error.partial = finish("the likelihood failed", f"the likelihood failed: {error}")
        else:
            save()
        raise
    except KeyboardInterrupt:
        if not now.dead or not return_interrupted:
            save()
            raise
        if now.ended is not None:
            return finish(now.ended)
        return finish("interrupted", "interrupted; log Z lacks what a full run would have found")
    except BaseException:
        # `progress`, `stop` or a signal handler raised.
        save()
        raise


def _do_round(
    now: RunState, evaluate: Evaluator, n_replaced: int, rng: np.random.Generator
) -> tuple[RunState, RoundSummary]:
    """Replace the worst points once and add the dead ones to the evidence; return the new state and its summary."""
    volume = math.exp(now.log_volume)
    chains = volume <= _PRIOR_VOLUME  # else new points are drawn from the whole prior
    move = now.moving if chains else PriorRejection(volume)
    live, gone, tally = replace_worst_live_points(now.live, move, evaluate, n_replaced=n_replaced, rng=rng)
    edges = np.concatenate([[now.log_volume], log_volumes(len(live) - np.arange(n_replaced), now.log_volume)])
    log_volume = float(edges[-1])
    # Relative to the best likelihood: volumes would vanish in the rounding of a log likelihood such as -1e100.
    best = float(live.log_likelihood.max())
    log_mass = edges[:-1] + np.log(-np.expm1(np.diff(edges))) + (gone.log_likelihood - best)
    so_far = now.log_z_over_best + (now.best - best) if now.dead else -math.inf
    before = float(logsumexp(np.concatenate([[so_far], log_mass[:-1]])))
    log_z = float(np.logaddexp(before, log_mass[-1]))
    after = replace(
        now,
        live=live,
        dead=(*now.dead, gone),
        moving=now.moving.adapted(tally) if chains else now.moving,
        log_volume=log_volume,
        best=best,
        log_z_over_best=log_z,
        n_stuck=now.n_stuck + (tally.n_stuck if chains else 0),
        last_cost=tally.n_evaluated,
        n_calls=evaluate.n_calls,
        rng_state=rng.bit_generator.state,
    )
    return after, RoundSummary(
        n_dead=sum(map(len, after.dead)),
        n_calls=evaluate.n_calls,
        log_z=best + log_z,
        log_z_remaining=best + log_volume,
        log_ratio_remaining=log_volume - log_z,
        last_change=log_z - before,
        log_volume=log_volume,
        best_log_likelihood=best,
        on_plateau=bool(live.log_likelihood.min() == best),
    )


def _initial_run_state(
    evaluate: Evaluator, move: Move, n_live: int, max_calls: int | None, rng: np.random.Generator
) -> RunState:
    """Draw the first live points from the part of the prior with nonzero likelihood; return the run's first state.

    Impossible hypotheses (zero likelihood) are counted and discarded; the initial volume is the share m / n of possible
    ones. Where fewer than `n_live` are found in 100 `n_live` draws or more, chains supply the others, and go on until
    all have forgotten their few starts; where `max_calls` is too few for these chains, the draws found are all live
    points. NotConvergedError if no draw is possible.
    """
    most = min(max(100 * n_live, 20_000), math.inf if max_calls is None else max_calls)
    parts, found, drawn = list[Points](), 0, 0
    while found < n_live and drawn < most:
        share = max(found, 0.5) / drawn if drawn else 1.0
        batch = int(min(1.1 * (n_live - found) / share + 1 if drawn else n_live, 4 * n_live, most - drawn))
        tried = evaluate(evaluate.space.draw(batch, rng=rng), rng)
        possible = np.flatnonzero(np.isfinite(tried.log_likelihood))
        kept = possible[: n_live - found]
        drawn += batch if kept.size == possible.size else int(kept[-1]) + 1
        parts.append(tried.take_rows(kept))
        found += kept.size
    points = Points.join(*parts)
    if found == 0:
        raise NotConvergedError(
            f"none of {drawn} hypotheses drawn from the prior of ({', '.join(evaluate.names)}) could have given "
            "these readings (all have zero likelihood): the hypothesis space excludes what was measured; "
            "widen the priors, or question the readings or the noise level"
        )
    log_volume, error = math.log(found / drawn), math.sqrt((1.0 - found / drawn) / found)
    if found < n_live:
        bound = Bound(-math.inf, 1.0)
        start = points.take_rows(rng.integers(found, size=n_live - found))
        # Differences of live points need two besides the start.
        few = found <= max(len(evaluate.names), 2)
        cloud = np.concatenate([points.u, evaluate.space.draw(n_live, rng=rng)]) if few else points.u
        with contextlib.suppress(OutOfCallsError):
            more, _ = move.draw(start, bound, cloud, evaluate, rng)
            mixed, mixing = Points.join(points, more), move
            for _ in range(_MIXING):
                mixed, tally = mixing.draw(mixed, bound, mixed.u, evaluate, rng)
                mixing = mixing.adapted(tally)
            points, move = mixed, mixing
    live, state = LivePoints.drawn_from_prior(points), rng.bit_generator.state
    return RunState(live, (), move, log_volume, error, log_volume, n_calls=evaluate.n_calls, rng_state=state)


def _final_result(
    evaluate: Evaluator,
    now: RunState,
    n_live: int,
    n_replaced: int,
    reason: str,
    seed_state: str,
    rng: np.random.Generator,
    notes: Sequence[str] = (),
) -> NestedResult:
    n_dead = sum(map(len, now.dead))
    last = now.live.take_rows(now.live.rows_by_rising_likelihood())
    points = LivePoints.join(*now.dead, last)
    n_at_death = np.concatenate([len(last) - np.arange(n_dead) % n_replaced, np.arange(len(last), 0, -1)])
    rank, n_ranked = insertion_ranks(points.ident, len(last), n_replaced)
    evidence = integrate(points.log_likelihood, n_at_death, rng=rng, log_start=now.log_start)
    parent = np.where(points.parent >= 0, np.argsort(points.ident)[points.parent], -1)
    born = birth_rows(points.log_likelihood, points.label, points.log_birth, points.birth_label)
    weight = np.exp(evidence.log_weight)
    remembered = relative_lineage_variance(parent, born, n_at_death, weight)
    p_value = insertion_p_value(rank, n_ranked, rng=rng)
    doubts = [*notes, warning_of_few_possible_draws(now.log_start, now.log_start_error, n_live)]
    if now.n_stuck > _STUCK_SHARE * n_dead:
        doubts.append(f"{now.n_stuck} of {n_dead} chains could not leave their start")
    if p_value < DOUBTFUL_P_VALUE:
        doubts.append(
            f"insertion ranks are not uniform (p = {p_value:.1g}): chains are too short or a mode was lost; "
            "use move=nested.SliceMove(steps_per_param=4) or more n_live"
        )
    doubts.append(warning_of_few_lineages(remembered))
    if not evaluate.names:
        pass  # the evidence is exact
    elif (n_of_weight := n_effective(evidence.log_weight)) < _FEW_EFFECTIVE:
        doubts.append(f"only {n_of_weight:.0f} effective samples: use more n_live")
    else:
        doubts.append(warning_of_coarse_coordinates(evaluate.names, points.u, weight))
    of_points = ("theta", "log_likelihood", "label", "log_birth", "birth_label")
    return NestedResult(
        names=evaluate.names,
        **{name: getattr(points, name) for name in of_points},
        log_weight=evidence.log_weight,
        parent=parent,
        n_at_death=n_at_death,
        log_start=now.log_start,
        log_start_error=now.log_start_error,
        log_z=evidence.log_z,
        log_z_error=math.hypot(math.sqrt(remembered) * evidence.spread, now.log_start_error),
        memory=remembered,
        information=evidence.information,
        n_eff=n_independent(points.theta, weight, parent),
        n_calls=evaluate.n_calls,
        n_live=n_live,
        stop_reason=reason,
        complete=now.ended is not None,
        insertion_rank=rank,
        insertion_n_ranked=n_ranked,
        insertion_p_value=p_value,
        seed_state=seed_state,
        versions=software_versions(),
        warnings=tuple(note for note in doubts if note is not None),
    )
