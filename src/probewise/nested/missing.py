"""Look for parts of the posterior that a run has missed, from its last live points and its dead ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise.nested.ascent import climb_from_end
from probewise.nested.beyond import NOTHING, Beyond, look_beyond
from probewise.nested.evaluate import Evaluator, Samplable
from probewise.nested.lost import NOTHING_LOST, Lost, look_for_lost
from probewise.nested.result import NestedResult

DISAGREE = 2.5
"""Difference of two estimates of log Z, in combined standard errors, above which they disagree."""

_ASCENT_SHARE = 1 / 20  # of a run's evaluations, at most
_MISSING = 1.0  # errors by which a part that has no live points raises log Z, above which it is a doubt


@dataclass(frozen=True, eq=False)
class Missing:
    """Parts of the posterior that a run has missed: parts without live points, and a peak above its end.

    `n_calls`: evaluations that were used to look for them.
    """

    lost: Lost
    above: Beyond
    n_calls: int

    def doubts(self, run: NestedResult) -> tuple[str, ...]:
        """Return a doubt in words for each part that matters for a run and that it has not met either."""
        log_z, mine = self.lost.not_in(run), f"this run's {run.log_z:.2f} ± {run.log_z_error:.2f}"
        notes = list[str]()
        if raised(run, log_z) > _MISSING:
            notes.append(
                f"a mode that died out among the live points has a log Z of about {log_z:.2f}, {mine}; "
                "use more n_live or a greater max_cost"
            )
        # By more errors than two right estimates would differ: the evidence of a peak above the end is a rough one.
        if raised(run, self.above.log_z) > DISAGREE:
            notes.append(
                f"a narrow peak that no live point met lies above the run's end: its log Z is about "
                f"{self.above.log_z:.1f}, {mine}; use more n_live or a prior about the peak"
            )
        return tuple(notes)


NOTHING_MISSING = Missing(NOTHING_LOST, NOTHING, 0)
"""Nothing missing, nothing evaluated."""


def raised(run: NestedResult, log_z: float) -> float:
    """By how many errors the evidence of a part that a run has not met raises log Z."""
    return (float(np.logaddexp(run.log_z, log_z)) - run.log_z) / max(run.log_z_error, 1e-12)


def look_for_missing(
    run: NestedResult, problem: Samplable, *, max_calls: float, rng: np.random.Generator, lost: Lost | None = None
) -> Missing:
    """Look for what a run has missed, where the prior's coordinates allow it.

    Parameters
    ----------
    run, problem
        A run and its problem.
    max_calls
        Limit of evaluations; about a third of the run's are used.
    rng
        Source of randomness.
    lost
        Parts that are known already, from the run that this one repeats; no others are then looked for.

    Raises
    ------
    NotConvergedError
        If the likelihood fails.
    """
    if not run.names or not (hasattr(problem.prior, "to_unit_cube") or hasattr(problem.prior, "coordinates")):
        return NOTHING_MISSING
    evaluate = Evaluator(problem)
    top = climb_from_end(run, evaluate, max_calls=int(min(max_calls, _ASCENT_SHARE * run.n_calls)), rng=rng)
    if lost is None:
        lost = look_for_lost(run, top, evaluate, max_calls=int(max_calls) - evaluate.n_calls, rng=rng)
    above = look_beyond(run, top, evaluate, max_calls=int(max_calls) - evaluate.n_calls, rng=rng)
    return Missing(lost, above, evaluate.n_calls)
