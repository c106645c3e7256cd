"""Look for parts of the posterior that a run has missed, from its last live points and its dead ones.

Candidates come from three searches. Early dead points climb to modes that died out (`lost_modes`). Draws about the last
live points climb to the top of their peak (`ascent`): a top far above all points of the run means that the run ended on
the arm of a heavy tail, along which its chains hardly moved, beside the bulk of its posterior. Draws about that top
meet narrow peaks above the end (`higher_peaks`). The evidence of each hill is estimated by importance sampling and
compared with that of the run in the same region (`hills`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from probewise.nested.ascent import GaussianAtPeak, climb_to_top, gaussian_of_last_live_points
from probewise.nested.evaluate import Evaluator, Points, Samplable
from probewise.nested.higher_peaks import find_higher_peaks
from probewise.nested.hills import (
    HillEstimate,
    calls_for_hill_evidence,
    draw_uniformly_near_hilltop,
    estimate_hill,
    log_evidence_of_unmet_hills,
)
from probewise.nested.importance import Posterior
from probewise.nested.lost_modes import (
    peaks_climbed_from_early_points,
    sds_after_early_dead_points,
    separated_by_dip_mask,
)
from probewise.nested.result import NestedResult

DISAGREE = 2.5
"""Difference of two estimates of log Z, in combined standard errors, above which they disagree."""

_ASCENT_SHARE = 1 / 20  # of a run's evaluations, at most
_WEIGHING_SHARE = 1 / 6  # up to which another hill is weighed
# Nats a parameter by which a top lies above all points of a run: of a normal posterior it is below half of that.
_FAR_ABOVE = 0.5
_MISSING = 1.0  # errors by which a part that has no live points raises log Z, above which it is a doubt


@dataclass(frozen=True, eq=False)
class MissedHills:
    """Hills that a run has missed: hills `lost` by its live points, and narrow peaks `above` its end.

    `n_calls`: evaluations that were used to look for the hills.
    """

    lost: tuple[HillEstimate, ...] = ()
    above: tuple[HillEstimate, ...] = ()
    n_calls: int = 0

    def doubts(self, run: Posterior) -> tuple[str, ...]:
        """Return doubts in words, at most one per kind of hill, about hills that `run` has not met.

        Lost hills count if together they would raise log Z by more than 1 of its errors, higher peaks by more than 2.5.
        """
        lost, above = (log_evidence_of_unmet_hills(hills, run) for hills in (self.lost, self.above))
        mine, notes = f"this run's {run.log_z:.2f} ± {run.log_z_error:.2f}", list[str]()
        if log_z_rise_in_errors(run, lost) > _MISSING:
            notes.append(
                f"a part of the posterior that the live points have lost has a log Z of about {lost:.2f}, {mine}; "
                "use more n_live or a greater max_cost"
            )
        if log_z_rise_in_errors(run, above) > DISAGREE:
            notes.append(
                f"a narrow peak that no live point met lies above the run's end: its log Z is about {above:.1f}, "
                f"{mine}; use more n_live or a prior about the peak"
            )
        return tuple(notes)


def log_z_rise_in_errors(run: Posterior, log_z: float) -> float:
    """Return by how many of its errors a run's log Z would rise if a part of log evidence `log_z` were added."""
    return (float(np.logaddexp(run.log_z, log_z)) - run.log_z) / max(run.log_z_error, 1e-12)


def find_missed_hills(
    run: NestedResult,
    problem: Samplable,
    *,
    max_calls: float,
    rng: np.random.Generator,
    lost: tuple[HillEstimate, ...] | None = None,
    executor: Executor | None = None,
    n_workers: int | None = None,
) -> MissedHills:
    """Look for parts of the posterior that a run has missed; nothing is found for a prior without an inverse.

    `max_calls`: limit of evaluations; at most about a quarter of the run's are used. `lost`: parts that are known
    already, from the run that this one repeats; no others are then looked for. `executor` evaluates batches of the
    likelihood in `n_workers` parts, as for `run`. NotConvergedError if the likelihood fails.
    """
    if not run.names or not (hasattr(problem.prior, "to_unit_cube") or hasattr(problem.prior, "coordinates")):
        return MissedHills()
    evaluate = Evaluator(problem, executor=executor, n_parts=n_workers)

    def calls_left(share: float = math.inf) -> int:
        return int(min(max_calls - evaluate.n_calls, share * run.n_calls))

    top = climb_to_top(
        gaussian_of_last_live_points(run, evaluate), evaluate, max_calls=calls_left(_ASCENT_SHARE), rng=rng
    )
    if lost is None:
        tops = peaks_climbed_from_early_points(run, evaluate, max_calls=calls_left(), rng=rng)
        if top.highest_log_likelihood > float(run.log_likelihood.max()) + _FAR_ABOVE * len(run.names):
            tops.append(top)
        lost = _weigh_hills_and_keep_unmet(tops, run, evaluate, max_calls=calls_left(_WEIGHING_SHARE), rng=rng)
    peaks = find_higher_peaks(run, top, evaluate, max_calls=calls_left(), rng=rng)
    above = _weigh_hills_and_keep_unmet(peaks, run, evaluate, max_calls=calls_left(), rng=rng)
    return MissedHills(lost, above, evaluate.n_calls)


def _weigh_hills_and_keep_unmet(
    tops: Iterable[GaussianAtPeak], run: NestedResult, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> tuple[HillEstimate, ...]:
    """Estimate the evidence of the hill under each top, the highest first; return the hills that a run has not met.

    Tops that no dip separates from a hill already estimated are skipped.
    """
    hills, most = list[HillEstimate](), evaluate.n_calls + max_calls
    rest = sorted(tops, key=lambda top: top.highest_log_likelihood)
    scale = sds_after_early_dead_points(run, evaluate.space)
    while rest and evaluate.n_calls + calls_for_hill_evidence(len(run.names)) < most:
        settled = draw_uniformly_near_hilltop(rest.pop(), evaluate, rng)
        if rest:
            points = Points.join(*(top.highest for top in rest))
            apart = separated_by_dip_mask(points, settled, scale, 1, evaluate, rng)
            rest = [top for top, is_apart in zip(rest, apart, strict=True) if is_apart]
        hill = estimate_hill(settled, evaluate, rng)
        hills += [] if hill is None or hill.is_met_by(run) else [hill]
    return tuple(hills)
