"""The nested sampling loop (Skilling 2006): remove the worst live points, shrink the volume, draw new ones above."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import logsumexp

from probewise._kinds import (
    checked_finite_number,
    checked_path,
    checked_whole,
    require_callable,
    require_flag,
    require_like,
    require_rng,
)
from probewise.errors import NotConvergedError, ParameterError
from probewise.nested.checkpoint import (
    BirthRecords,
    CheckpointFile,
    DeadPointsOfRound,
    LivePoints,
    RunState,
    settings_of_run,
)
from probewise.nested.evaluate import Bound, Evaluator, OutOfCallsError, Points, Samplable
from probewise.nested.evidence import DOUBTFUL_P_VALUE, birth_rows, insertion_p_value, integrate, log_volumes
from probewise.nested.genealogy import relative_lineage_variance
from probewise.nested.moves import Move, PriorRejection, SliceMove, Tally
from probewise.nested.result import (
    NestedResult,
    software_versions,
    warning_of_coarse_coordinates,
    warning_of_few_lineages,
    warning_of_few_possible_draws,
)
from probewise.nested.stop import RemainingEvidence, RoundSummary, StopRule

LIVE_PER_PARAM = 2
"""Least number of live points per parameter."""

# Draw from the whole prior while a point costs fewer evaluations than a chain would.
_PRIOR_VOLUME = 0.05
_FEW_EFFECTIVE = 30.0
_STUCK_SHARE = 0.02
# Chains of each first live point where some began at others: after three, ln Z of a prior of which one in 5,000 is
# possible was still 0.7 too low.
_MIXING = 10
_MOST_BYTES = 2**28  # of one array of each kind for all live points; the points that die take tens of times as much


def least_live(n_params: int) -> int:
    """Return the least number of live points for a problem: two per parameter, 10 at least."""
    return max(LIVE_PER_PARAM * n_params, 10)


def checked_n_live(n_live: object, n_params: int) -> int:
    """Return a number of live points for a problem; raise ParameterError where they are too few, or fill the memory."""
    least, most = least_live(n_params), _MOST_BYTES // (8 * (2 * n_params + 3))
    number = checked_whole("n_live", n_live, least=None, most=None)
    if number < least:
        raise ParameterError("n_live", n_live, f"{least} or more for {n_params} parameters")
    if number > most:
        way_out = "for a smaller error merge the results of several runs: nested.merge"
        allowed = f"up to {most:,} for {n_params} parameters, whose arrays take {_MOST_BYTES >> 20} MB; {way_out}"
        raise ParameterError("n_live", n_live, allowed)
    return number


def move_at_volume(move: Move, log_volume: float) -> Move:
    """Return a move that draws from the whole prior while more than a twentieth of its volume is left, then `move`."""
    volume = math.exp(log_volume)
    return move if volume <= _PRIOR_VOLUME else PriorRejection(volume)


def replace_worst_live_points(
    live: LivePoints, move: Move, evaluate: Evaluator, *, n_replaced: int, rng: np.random.Generator
) -> tuple[LivePoints, DeadPointsOfRound, Tally]:
    """Replace the `n_replaced` worst live points by new ones above the best of the replaced.

    Return the new live points, the dead ones, and the statistics of the move.

    The points die one after another, so the volume shrinks by Beta(n, 1), Beta(n - 1, 1), ..., which is counted
    exactly; the new points are drawn together.
    """
    n_live = len(live.points)
    order = live.points.rows_by_rising_likelihood()
    doomed, spared = order[:n_replaced], order[n_replaced:]
    last = doomed[-1]
    bound = Bound(float(live.points.log_likelihood[last]), float(live.points.label[last]))
    survivors = live.points.take_rows(spared)
    begin = rng.permutation(len(spared))[:n_replaced]
    start = survivors.take_rows(begin)
    new, tally = move.draw(start, bound, survivors.u, evaluate, rng)
    points = Points.join(survivors, new)
    place = np.empty(n_live, dtype=np.int64)
    place[points.rows_by_rising_likelihood()] = np.arange(n_live)
    worse = place[None, :] < place[len(spared) :, None]
    n_ranked = len(spared) + np.arange(n_replaced)
    rank = np.where(np.arange(n_live) < n_ranked[:, None], worse, False).sum(axis=1)
    n_at_death = n_live - np.arange(n_replaced)
    dead = DeadPointsOfRound(live.points.take_rows(doomed), live.births.take_rows(doomed), n_at_death, rank, n_ranked)
    known = live.births.take_rows(spared)
    fresh = BirthRecords(
        np.full(n_replaced, bound.log_likelihood),
        np.full(n_replaced, bound.label),
        live.births.ident.max() + 1 + np.arange(n_replaced),
        known.ident[begin],
    )
    log_volume = float(log_volumes(n_at_death, live.log_volume)[-1])
    return LivePoints(points, BirthRecords.join(known, fresh), log_volume), dead, tally


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
    checkpoint_every_s: float = 10.0,
    executor: Executor | None = None,
    n_workers: int | None = None,
    return_interrupted: bool = True,
) -> NestedResult:
    """Run nested sampling once, without the check of the evidence.

    `probewise.nested.run` documents the parameters and errors; here doubts are stored in the result without a warning.
    """
    require_rng(rng)
    _require_options(
        stop=stop,
        move=move,
        progress=progress,
        checkpoint=checkpoint,
        checkpoint_every_s=checkpoint_every_s,
        executor=executor,
        return_interrupted=return_interrupted,
    )
    if n_workers is not None:
        n_workers = checked_whole("n_workers", n_workers)
    evaluate = Evaluator(problem, executor=executor, n_parts=n_workers, most_calls=max_calls)
    n_params = len(evaluate.names)
    n_live, n_replaced = _checked_n_live_and_n_replaced(n_live, n_replaced, max_calls, n_params)
    rule = RemainingEvidence() if stop is None else stop
    seed_state = json.dumps(generator_state_as_json(rng.bit_generator.state))
    if n_params == 0:
        return _result_of_problem_without_parameters(evaluate, n_live, seed_state)
    moving: Move = SliceMove() if move is None else move
    keeper = None
    if checkpoint is not None:
        settings = settings_of_run(evaluate.names, n_live, n_replaced, moving, rule, seed_state)
        with contextlib.suppress(OSError):  # `CheckpointFile` reports a folder that cannot be created
            Path(checkpoint).parent.mkdir(parents=True, exist_ok=True)
        keeper = CheckpointFile(Path(checkpoint), checkpoint_every_s, settings)
    resumed = None if keeper is None else keeper.resume(evaluate, moving, rng)
    now = _initial_run_state(evaluate, moving, n_live, max_calls, rng) if resumed is None else resumed
    if len(now.live.points) < n_live:  # a run with more calls begins anew
        keeper = None
    if keeper is not None and resumed is None:
        keeper.save_if_due(now)
    under_way = _RunUnderWay(
        evaluate, rng, n_live=n_live, n_replaced=n_replaced, rule=rule, seed_state=seed_state, keeper=keeper, now=now
    )
    try:
        return under_way.run_to_end(max_calls, progress)
    except NotConvergedError as error:
        if under_way.now.dead:
            error.partial = under_way.finish("the likelihood failed", f"the likelihood failed: {error}")
        else:
            under_way.save()
        raise
    except KeyboardInterrupt:
        if not under_way.now.dead or not return_interrupted:
            under_way.save()
            raise
        if under_way.now.ended is not None:
            return under_way.finish(under_way.now.ended)
        return under_way.finish("interrupted", "interrupted; log Z lacks what a full run would have found")
    except BaseException:
        # `progress`, `stop` or a signal handler raised.
        under_way.save()
        raise


@dataclass
class _RunUnderWay:
    """A run of nested sampling under way; `now` is its state after the last whole round."""

    evaluate: Evaluator
    rng: np.random.Generator
    n_live: int
    n_replaced: int
    rule: StopRule
    seed_state: str
    keeper: CheckpointFile | None
    now: RunState

    def save(self) -> None:
        if self.keeper is not None:
            self.keeper.save(self.now)

    def finish(self, reason: str, *more_notes: str) -> NestedResult:
        """Save the state and compute the result from it."""
        self.save()
        noted = replace(self.now, notes=(*self.now.notes, *more_notes))
        # Depends only on the state after the last round: not on where in a round an interruption came, nor on
        # the generator's seed sequence, which its state does not include.
        self.rng.bit_generator.state = self.now.rng_state
        summing = np.random.default_rng(self.rng.integers(2**63, size=4))
        return _final_result(self.evaluate, noted, self.n_live, reason, self.seed_state, summing)

    def run_to_end(self, max_calls: int | None, progress: Callable[[RoundSummary], None] | None) -> NestedResult:
        """Do rounds until the rule ends the run or the next round might exceed `max_calls`; return the result."""
        while self.now.ended is None:
            # A round can cost twice the last one: the volume halves while points are drawn from the prior.
            few = max_calls is not None and self.evaluate.n_calls + 2 * self.now.last_cost > max_calls
            if few or len(self.now.live.points) < self.n_live:
                return self._finish_out_of_calls(max_calls)
            try:
                after, state = _do_round(self.now, self.evaluate, self.n_replaced, self.rng)
            except OutOfCallsError:  # the first round, or one that costs more than twice the last
                return self._finish_out_of_calls(max_calls)
            # One assignment, so that an interruption leaves a round either complete or not begun.
            self.now = replace(after, ended=self.rule(state))
            if progress is not None:
                progress(state)
            if self.keeper is not None:
                self.keeper.save_if_due(self.now)
        return self.finish(self.now.ended)

    def _finish_out_of_calls(self, max_calls: int | None) -> NestedResult:
        """Compute the result of the whole rounds so far, with a warning."""
        reason = f"stopped at {self.evaluate.n_calls} of max_calls = {max_calls} likelihood evaluations"
        return self.finish(reason, f"{reason}; log Z lacks what a full run would have found")


def _checked_n_live_and_n_replaced(
    n_live: int, n_replaced: int | None, max_calls: int | None, n_params: int
) -> tuple[int, int]:
    """Return the number of live points and that of those replaced per round, or raise ParameterError."""
    n_live = checked_n_live(n_live, n_params)
    n_replaced = n_live // 2 if n_replaced is None else checked_whole("n_replaced", n_replaced, least=None)
    if not 1 <= n_replaced <= n_live // 2:
        raise ParameterError("n_replaced", n_replaced, f"1 to n_live / 2 = {n_live // 2}")
    if max_calls is not None and checked_whole("max_calls", max_calls, least=None, most=None) < n_live:
        raise ParameterError("max_calls", max_calls, f"n_live = {n_live} or more")
    return n_live, n_replaced


def _require_options(
    *,
    stop: object,
    move: object,
    progress: object,
    checkpoint: object,
    checkpoint_every_s: object,
    executor: object,
    return_interrupted: object,
) -> None:
    """Raise ParameterError for an option of the wrong type, before anything is evaluated."""
    if stop is not None:
        require_callable("stop", stop, "a rule such as RemainingEvidence(dlogz=0.1), of probewise.nested, or None")
    if move is not None:
        require_like("move", move, ("draw", "adapted"), "a move such as SliceMove(), of probewise.nested, or None")
    if progress is not None:
        allowed = "a function called with a RoundSummary after every round, or None; a run shows no bar by itself"
        require_callable("progress", progress, allowed)
    if checkpoint is not None:
        checked_path("checkpoint", checkpoint)
    if not checked_finite_number("checkpoint_every_s", checkpoint_every_s) >= 0:
        raise ParameterError("checkpoint_every_s", checkpoint_every_s, "0 or more")
    if executor is not None:
        allowed = (
            "an executor such as concurrent.futures.ProcessPoolExecutor(), or None; for a count pass n_workers too"
        )
        require_like("executor", executor, ("map", "submit"), allowed)
    require_flag("return_interrupted", return_interrupted)


def _do_round(
    now: RunState, evaluate: Evaluator, n_replaced: int, rng: np.random.Generator
) -> tuple[RunState, RoundSummary]:
    """Replace the worst points once and add the dead ones to the evidence; return the new state and its summary."""
    live, moving = now.live, now.moving
    move = move_at_volume(moving, live.log_volume)
    chains = move is moving
    fresh, gone, tally = replace_worst_live_points(live, move, evaluate, n_replaced=n_replaced, rng=rng)
    edges = live.log_volume + np.concatenate([[0.0], -np.cumsum(1.0 / gone.n_at_death)])
    # Relative to the best likelihood: volumes would vanish in the rounding of a log likelihood such as -1e100.
    best = float(fresh.points.log_likelihood.max())
    log_mass = edges[:-1] + np.log(-np.expm1(np.diff(edges))) + (gone.points.log_likelihood - best)
    so_far = now.log_z_over_best + (now.best - best) if now.dead else -math.inf
    before = float(logsumexp(np.concatenate([[so_far], log_mass[:-1]])))
    log_z = float(np.logaddexp(before, log_mass[-1]))
    state = RoundSummary(
        n_dead=(len(now.dead) + 1) * n_replaced,
        n_calls=evaluate.n_calls,
        log_z=best + log_z,
        log_z_remaining=best + fresh.log_volume,
        log_ratio_remaining=fresh.log_volume - log_z,
        last_change=log_z - before,
        log_volume=fresh.log_volume,
        best_log_likelihood=best,
        level=bool(fresh.points.log_likelihood.min() == best),
    )
    after = replace(
        now,
        live=fresh,
        dead=(*now.dead, gone),
        moving=moving.adapted(tally) if chains else moving,
        best=best,
        log_z_over_best=log_z,
        n_stuck=now.n_stuck + (tally.n_stuck if chains else 0),
        last_cost=tally.n_evaluated,
        n_calls=evaluate.n_calls,
        rng_state=rng.bit_generator.state,
    )
    return after, state


def _initial_run_state(
    evaluate: Evaluator, move: Move, n_live: int, max_calls: int | None, rng: np.random.Generator
) -> RunState:
    """Draw the first live points from the part of the prior with nonzero likelihood; return the run's first state.

    Impossible hypotheses (zero likelihood) are counted and discarded; the initial volume is the share m / n of possible
    ones. Where fewer than `n_live` are found in 100 `n_live` draws or more, chains supply the others, and go on until
    all have forgotten their few starts; where `max_calls` is too few for these chains, the draws found are all live
    points. NotConvergedError if no draw is possible.
    """
    most = max(100 * n_live, 20_000) if max_calls is None else min(max(100 * n_live, 20_000), max_calls)
    n_params = len(evaluate.names)
    parts: list[Points] = []
    found = drawn = 0
    while found < n_live and drawn < most:
        share = max(found, 0.5) / drawn if drawn else 1.0
        batch = min(int(1.1 * (n_live - found) / share) + 1 if drawn else n_live, 4 * n_live, most - drawn)
        tried = evaluate.draw_from_prior(batch, rng)
        possible = np.flatnonzero(np.isfinite(tried.log_likelihood))
        if found + possible.size > n_live:
            possible = possible[: n_live - found]
            drawn += int(possible[-1]) + 1
        else:
            drawn += batch
        parts.append(tried.take_rows(possible))
        found += possible.size
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
        cloud = (
            points.u if found > max(n_params, 2) else np.concatenate([points.u, evaluate.space.draw(n_live, rng=rng)])
        )
        with contextlib.suppress(OutOfCallsError):
            more, _ = move.draw(start, bound, cloud, evaluate, rng)
            mixed, mixing = Points.join(points, more), move
            for _ in range(_MIXING):
                mixed, tally = mixing.draw(mixed, bound, mixed.u, evaluate, rng)
                mixing = mixing.adapted(tally)
            points, move = mixed, mixing
    live = LivePoints(points, BirthRecords.of_prior_draws(len(points)), log_volume)
    return RunState(live, (), move, log_volume, error, (), n_calls=evaluate.n_calls, rng_state=rng.bit_generator.state)


def _final_result(
    evaluate: Evaluator, now: RunState, n_live: int, reason: str, seed_state: str, rng: np.random.Generator
) -> NestedResult:
    """Let the remaining live points die and compute the result."""
    live, dead, notes = now.live, now.dead, now.notes
    n_dead = sum(len(d.points) for d in dead)
    few = warning_of_few_possible_draws(now.log_start, now.log_start_error, n_live)
    if few is not None:
        notes = (*notes, few)
    if now.n_stuck > _STUCK_SHARE * n_dead:
        notes = (*notes, f"{now.n_stuck} of {n_dead} chains could not leave their start")
    order = live.points.rows_by_rising_likelihood()
    parts = [*(d.points for d in dead), live.points.take_rows(order)]
    theta = np.concatenate([part.theta for part in parts])
    log_likelihood, label = (np.concatenate([getattr(p, name) for p in parts]) for name in ("log_likelihood", "label"))
    n_at_death = np.concatenate([*(d.n_at_death for d in dead), np.arange(len(live.points), 0, -1)])
    evidence = integrate(
        log_likelihood, n_at_death, rng=rng, log_start=now.log_start, log_start_error=now.log_start_error
    )
    births = BirthRecords.join(*(d.births for d in dead), live.births.take_rows(order))
    parent = np.where(births.parent >= 0, np.argsort(births.ident)[births.parent], -1)
    born = birth_rows(log_likelihood, label, births.log_birth, births.birth_label)
    remembered = relative_lineage_variance(parent, born, n_at_death, evidence.log_weight)
    empty = np.empty(0, dtype=np.int64)
    rank = np.concatenate([empty, *(d.rank for d in dead)])
    n_ranked = np.concatenate([empty, *(d.n_ranked for d in dead)])
    p_value = insertion_p_value(rank, n_ranked, rng=rng)
    if p_value < DOUBTFUL_P_VALUE:
        notes = (
            *notes,
            f"insertion ranks are not uniform (p = {p_value:.1g}): chains are too short or a mode was lost; "
            "use more steps_per_param or more n_live",
        )
    if (uncertain := warning_of_few_lineages(remembered)) is not None:
        notes = (*notes, uncertain)
    if evidence.n_eff < _FEW_EFFECTIVE:
        notes = (*notes, f"only {evidence.n_eff:.0f} effective samples: use more n_live")
    else:
        u = np.concatenate([part.u for part in parts])
        coarse = warning_of_coarse_coordinates(evaluate.names, u, np.exp(evidence.log_weight))
        notes = notes if coarse is None else (*notes, coarse)
    return NestedResult(
        names=evaluate.names,
        theta=theta,
        log_likelihood=log_likelihood,
        log_weight=evidence.log_weight,
        label=label,
        log_birth=births.log_birth,
        birth_label=births.birth_label,
        parent=parent,
        n_at_death=n_at_death,
        log_start=now.log_start,
        log_start_error=now.log_start_error,
        log_z=evidence.log_z,
        log_z_error=evidence.log_z_error(remembered),
        memory=remembered,
        information=evidence.information,
        n_eff=evidence.n_eff,
        n_calls=evaluate.n_calls,
        n_live=n_live,
        stop_reason=reason,
        complete=now.ended is not None,
        insertion_rank=rank,
        insertion_n_ranked=n_ranked,
        insertion_p_value=p_value,
        seed_state=seed_state,
        versions=software_versions(),
        warnings=notes,
    )


def _result_of_problem_without_parameters(evaluate: Evaluator, n_live: int, seed_state: str) -> NestedResult:
    """Return the result of a problem without free parameters; NotConvergedError if its likelihood is zero."""
    theta = np.empty((1, 0))
    log_likelihood = evaluate.log_likelihood(theta)
    if not np.isfinite(log_likelihood[0]):
        raise NotConvergedError("the only hypothesis has zero likelihood: it excludes what was measured")
    return NestedResult(
        names=(),
        theta=theta,
        log_likelihood=log_likelihood,
        log_weight=np.zeros(1),
        label=np.zeros(1),
        log_birth=np.full(1, -np.inf),
        birth_label=np.ones(1),
        parent=np.full(1, -1),
        n_at_death=np.ones(1, dtype=np.int64),
        log_start=0.0,
        log_start_error=0.0,
        log_z=float(log_likelihood[0]),
        log_z_error=0.0,
        memory=1.0,
        information=0.0,
        n_eff=1.0,
        n_calls=1,
        n_live=n_live,
        complete=True,
        stop_reason="no free parameters: the likelihood is the evidence",
        insertion_rank=np.empty(0, dtype=np.int64),
        insertion_n_ranked=np.empty(0, dtype=np.int64),
        insertion_p_value=1.0,
        seed_state=seed_state,
        versions=software_versions(),
        warnings=(),
    )


def generator_state_as_json(value: object) -> object:
    """Convert a generator's state to JSON types."""
    if isinstance(value, dict):
        return {str(key): generator_state_as_json(item) for key, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
