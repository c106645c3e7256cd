"""Dynamic allocation: add live points to a run where its posterior or its evidence needs them.

A run spends as many points on shells without posterior mass as on those with it. Live points can be added between any
two levels of a run: a *thread* of new points starts at the lower level and ends at the upper one, and more points are
then alive between the two (Higson, Handley, Hobson & Lasenby 2019, Stat. Comput. 29, 891). More posterior samples need
new points in the shells that hold the posterior's mass; a smaller error of log Z needs them from the start up to there.
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from probewise._arrays import IntArray
from probewise._kinds import checked_whole, require_rng
from probewise.errors import DoubtfulResultWarning, ParameterError, ShapeError
from probewise.nested.checkpoint import BirthRecords, LivePoints
from probewise.nested.evaluate import Bound, Evaluator, Points, Samplable
from probewise.nested.evidence import DOUBTFUL_P_VALUE, insertion_p_value, integrate
from probewise.nested.merging import (
    JoinedRecord,
    combined_p_value,
    error_with_scatter_of_runs,
    generator_states_of,
)
from probewise.nested.moves import Move, SliceMove
from probewise.nested.result import NestedResult, software_versions
from probewise.nested.sampler import generator_state_as_json, least_live, move_at_volume, replace_worst_live_points
from probewise.priors import require_prior

Goal: TypeAlias = Literal["posterior", "evidence"]

_BULK = 0.95  # central share of the posterior's mass, in order of death, that a thread for the posterior spans
_SHARE = 0.3  # of the greatest importance for the evidence; a thread for the evidence spans the levels above it
_SAME = 1e-6  # relative difference of a log likelihood computed again


def intensified(
    result: NestedResult,
    problem: Samplable,
    *,
    n_live: int,
    goal: Goal = "posterior",
    move: Move | None = None,
    max_calls: int | None = None,
    rng: np.random.Generator,
) -> NestedResult:
    """Add `n_live` live points to a run, between the levels where they count most for a goal.

    Call it again to add more: after each call the levels are chosen anew.

    Parameters
    ----------
    result
        A complete run of `run`, or the result of this function.
    problem
        Its problem: prior and likelihood.
    n_live
        Number of live points to add.
    goal
        "posterior": between the levels that hold the central 95 % of the posterior's mass, for more posterior samples;
        "evidence": from the start to where little of the evidence is left, for a smaller error of log Z.
    move
        How new points are drawn; default `SliceMove()`.
    max_calls
        Limit of likelihood evaluations for the new points. The new points end at the limit, and the result is valid.
    rng
        Source of randomness, independent of the run's.

    Returns
    -------
    NestedResult
        The run with the new points. `n_live` and `memory` are still the run's, `check` too, with its distance to the
        new log Z; `n_at_death` counts the points alive at each level. If the new points' insertion ranks are not
        uniform, DoubtfulResultWarning is issued and added to `warnings`.

    Raises
    ------
    ParameterError
        If the run is incomplete or of another problem, an option is out of range, or the prior has no `to_unit_cube`.
    ShapeError
        If the problem has other parameters.
    NotConvergedError
        If the likelihood fails.
    """
    require_rng(rng)
    least = least_live(len(result.names))
    if checked_whole("n_live", n_live, least=None) < least:
        raise ParameterError("n_live", n_live, f"{least} or more for {len(result.names)} parameters")
    if goal not in ("posterior", "evidence"):
        raise ParameterError("goal", goal, "'posterior' or 'evidence'")
    if max_calls is not None:
        checked_whole("max_calls", max_calls, least=n_live)
    evaluate = Evaluator(problem)
    _require_complete_run_of(result, evaluate)
    seed_state = generator_state_as_json(rng.bit_generator.state)
    first, last = _first_and_last_row_to_intensify(result, goal)
    thread = _draw_thread(
        result,
        evaluate,
        move=SliceMove() if move is None else move,
        first=first,
        last=last,
        n_live=n_live,
        max_calls=max_calls,
        rng=rng,
    )
    return _join_thread_to_run(result, thread, seed_state, evaluate.n_calls, rng)


@dataclass(frozen=True, eq=False)
class _Thread:
    """New points with the records of their births, in order of death.

    `started`: row of the run's point at which each one's chain began, -1 where there is none (the chain began at
    another new point, or the prior was drawn from), (n,). `rank`: how many of the `n_ranked` points alive at each
    insertion were worse than the new one, (n_inserted,) each.
    """

    points: Points
    births: BirthRecords
    started: IntArray
    rank: IntArray
    n_ranked: IntArray


def _require_complete_run_of(result: NestedResult, evaluate: Evaluator) -> None:
    """Raise ShapeError unless the problem has the run's parameters; ParameterError unless the run is complete.

    ParameterError also for a run without parameters, or if the problem gives its last point another log likelihood.
    """
    if evaluate.names != result.names:
        raise ShapeError(f"the problem has the parameters {evaluate.names}; allowed: those of the run, {result.names}")
    if not result.names:
        raise ParameterError("result", "a run without parameters", "one with some; the evidence is exact without")
    if not result.complete:
        raise ParameterError(
            "result", f"an incomplete run ({result.stop_reason})", "a run that its stopping rule ended"
        )
    if not hasattr(evaluate.problem.prior, "coordinates"):
        require_prior("problem.prior", evaluate.problem.prior, "to_unit_cube")
    known = float(result.log_likelihood[-1])
    again = float(evaluate.log_likelihood(result.theta[-1:])[0])
    if abs(again - known) > _SAME * max(1.0, abs(known)):
        raise ParameterError(
            "problem", f"one whose log likelihood of the run's last point is {again:.6g}", f"{known:.6g}, as in the run"
        )


def _first_and_last_row_to_intensify(result: NestedResult, goal: Goal) -> tuple[int, int]:
    """Return the rows (first, last) of the deaths between which new points count most."""
    weight = result.weight
    if goal == "posterior":
        ladder = np.cumsum(weight) / weight.sum()
        first, last = np.searchsorted(ladder, [0.5 - _BULK / 2, 0.5 + _BULK / 2])
    else:
        # A death at a level moves the log of all volumes above it by an error of about one in the points alive.
        importance = np.cumsum(weight[::-1])[::-1] / result.n_at_death
        first, last = np.flatnonzero(importance >= _SHARE * importance.max())[[0, -1]]
    # One death at least leaves some points alive above the first level.
    return int(min(first, result.n_dead - 2)), int(min(last, result.n_dead - 1))


def _draw_thread(
    result: NestedResult,
    evaluate: Evaluator,
    move: Move,
    first: int,
    last: int,
    n_live: int,
    max_calls: int | None,
    rng: np.random.Generator,
) -> _Thread:
    """Draw new points above the level of row `first`, and replace the worst half again and again.

    It ends when they pass the level of row `last`, or before `max_calls` evaluations are exceeded.
    """
    end = (float(result.log_likelihood[last]), float(result.label[last]))
    bound = Bound(float(result.log_likelihood[first]), float(result.label[first]))
    above = _rows_alive_after(result, first)
    known = evaluate.points_from_known_values(result.theta[above], result.log_likelihood[above], result.label[above])
    log_volume = float(result.log_volume[first])
    begin = np.concatenate([rng.permutation(len(above)) for _ in range(math.ceil(n_live / len(above)))])[:n_live]
    now = move_at_volume(move, log_volume)
    drawn, tally = now.draw(known.take_rows(begin), bound, known.u, evaluate, rng)
    started = np.where(now is move, above[begin], -1)
    births = BirthRecords(
        np.full(n_live, bound.log_likelihood), np.full(n_live, bound.label), np.arange(n_live), np.full(n_live, -1)
    )
    live, moving = LivePoints(drawn, births, log_volume), move.adapted(tally) if now is move else move
    dead, ranks, counts = list[tuple[Points, BirthRecords]](), [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    n_replaced, cost = n_live // 2, tally.n_evaluated
    while True:
        worst = live.points.rows_by_rising_likelihood()[n_replaced - 1]
        reached = (float(live.points.log_likelihood[worst]), float(live.points.label[worst])) >= end
        if reached or (max_calls is not None and evaluate.n_calls + 2 * cost > max_calls):
            break
        now = move_at_volume(moving, live.log_volume)
        live, gone, tally = replace_worst_live_points(live, now, evaluate, n_replaced=n_replaced, rng=rng)
        cost = tally.n_evaluated
        moving = moving.adapted(tally) if now is moving else moving
        dead.append((gone.points, gone.births))
        ranks.append(gone.rank)
        counts.append(gone.n_ranked)
    order = live.points.rows_by_rising_likelihood()
    dead.append((live.points.take_rows(order), live.births.take_rows(order)))
    points, births = Points.join(*(points for points, _ in dead)), BirthRecords.join(*(born for _, born in dead))
    began = np.where(births.ident < n_live, started[np.minimum(births.ident, n_live - 1)], -1)
    return _Thread(points, births, began, np.concatenate(ranks), np.concatenate(counts))


def _rows_alive_after(result: NestedResult, row: int) -> IntArray:
    level = (result.log_likelihood[row], result.label[row])
    born = (result.log_birth < level[0]) | ((result.log_birth == level[0]) & (result.birth_label <= level[1]))
    return np.flatnonzero(born & (np.arange(result.n_dead) > row))


def _join_thread_to_run(
    result: NestedResult,
    thread: _Thread,
    seed_state: object,
    n_calls: int,
    rng: np.random.Generator,
) -> NestedResult:
    """Join a run and new points into one run, in order of death."""
    points, births = thread.points, thread.births
    n_old = result.n_dead
    row_of = np.empty(len(points), dtype=np.int64)
    row_of[births.ident] = n_old + np.arange(len(points))
    parents = np.where(births.parent >= 0, row_of[births.parent], thread.started)
    record = JoinedRecord.from_records(
        [
            (result.log_likelihood, result.label, result.log_birth, result.birth_label),
            (points.log_likelihood, points.label, births.log_birth, births.birth_label),
        ]
    )
    evidence = integrate(
        record.log_likelihood,
        record.n_at_death,
        rng=rng,
        log_start=result.log_start,
        log_start_error=result.log_start_error,
    )
    error = evidence.log_z_error(result.memory)
    if result.agreement is not None:
        error = error_with_scatter_of_runs(error, result.agreement)
    check = result.check
    if check is not None:
        apart = (evidence.log_z - check.log_z) / max(math.hypot(error, check.log_z_error), 1e-12)
        check = replace(check, distance=apart)
    own = insertion_p_value(thread.rank, thread.n_ranked, rng=rng)
    notes = result.warnings
    if own < DOUBTFUL_P_VALUE:
        doubt = f"insertion ranks of the added points are not uniform (p = {own:.1g}); use a greater steps_per_param"
        warnings.warn(doubt, DoubtfulResultWarning, stacklevel=3)
        notes = (*notes, doubt)
    return replace(
        result,
        theta=np.concatenate([result.theta, points.theta])[record.order],
        log_likelihood=record.log_likelihood,
        label=record.label,
        log_weight=evidence.log_weight,
        log_birth=record.log_birth,
        birth_label=record.birth_label,
        parent=record.parents_in_joined_order(np.concatenate([result.parent, parents])),
        n_at_death=record.n_at_death,
        log_z=evidence.log_z,
        log_z_error=error,
        information=evidence.information,
        n_eff=evidence.n_eff,
        n_calls=result.n_calls + n_calls,
        insertion_rank=np.concatenate([result.insertion_rank, thread.rank]),
        insertion_n_ranked=np.concatenate([result.insertion_n_ranked, thread.n_ranked]),
        insertion_p_value=combined_p_value([result.insertion_p_value, own]),
        seed_state=json.dumps([*generator_states_of(result), seed_state]),
        versions=software_versions(),
        warnings=notes,
        check=check,
    )
