"""Run nested sampling and check what it found: the door that users come through."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from probewise._kinds import require_number, require_rng
from probewise.errors import DoubtfulResultWarning, ParameterError
from probewise.nested.check import checked
from probewise.nested.evaluate import Samplable
from probewise.nested.moves import Move, SliceMove
from probewise.nested.pose import AnyPrior, pose
from probewise.nested.result import NestedResult
from probewise.nested.sampler import least_live, search
from probewise.nested.stop import State, StopRule

__all__ = ["run"]


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
    progress: Callable[[State], None] | None = None,
    max_calls: int | None = None,
    max_cost: float = 5.0,
    checkpoint: str | Path | None = None,
    checkpoint_every_s: float = 10.0,
    executor: Executor | None = None,
    n_workers: int | None = None,
    return_interrupted: bool = True,
) -> NestedResult:
    """Compute the evidence of a problem and draw from its posterior (paper, section on SSF estimation).

    Parameters
    ----------
    problem
        Prior and likelihood in one, whose likelihood is asked in batches; or a log likelihood, a function of one point.
    prior
        The prior of a log likelihood: a prior, distributions by name or in order, or a function from the unit cube.
    names, vectorized, pass_dict, periodic
        How the functions are called; see `pose`. Not for a problem in one.
    rng
        Source of randomness; its state is stored in the result.
    n_live
        Live points: the error of log Z falls as its root, the cost rises in proportion.
    stop
        When to stop; default `RemainingEvidence(0.05)`. The paper's rule is `EvidenceChange(1e-8)`.
    move
        How new points are drawn; default `SliceMove()`. While more than a twentieth of the prior
        is alive, points are drawn from the prior itself.
    n_replaced
        Points replaced in one round; default half of `n_live`. The volume lost is counted exactly
        whatever it is; with half, batches are large, 28 % fewer points are drawn than one by one
        and the variance of log Z is 44 % greater.
    progress
        Called with a `State` after every round.
    max_calls
        Likelihood evaluations after which the run ends early with what it has.
    max_cost
        Evaluations in all, in units of those of the search itself; 1: no check. What exceeds 1 goes into a second
        route to the evidence, about a fifth of the search, and where the two disagree into a sharper second
        route and a search with chains twice as long. What cannot be cured so is told as a warning.
    checkpoint
        File that the search is saved to as it goes, whole or not at all, in a folder that is made if missing. Where it
        exists already the run resumes, and ends bit for bit as if it had never been interrupted, also by a kill;
        `rng` must be as it was at the run's start, made anew from its seed. `max_calls` may be another.
    checkpoint_every_s
        Seconds between savings, at least; ten times as long as a saving takes if that is more. 0: after every round.
    executor
        Where the likelihood is evaluated, for one that is slow; by default here. Each batch is
        dealt out in `n_workers` parts. The result is the same to the last bit if the likelihood of
        a hypothesis is, whatever others are in the batch (matrix products in NumPy need not be).
    n_workers
        Parts of a batch; default the number of processors.
    return_interrupted
        Whether Ctrl-C returns the result so far, doubtful and saying so; else it raises `KeyboardInterrupt`.

    Returns
    -------
    NestedResult
        With a warning, stored in it too, where it should not be trusted blindly.

    Raises
    ------
    ParameterError
        If an option is out of range.
    NotConvergedError
        If the likelihood fails (`partial` holds the result so far, if there is one), or every
        hypothesis drawn from the prior is impossible.
    FileError
        If the checkpoint is damaged, or of a run with another problem, other settings or another seed, or
        cannot be written: before anything is evaluated. Where a later saving fails, the run goes on and warns.
    """
    require_rng(rng)
    posed = _posed(problem, prior, names, vectorized, pass_dict, periodic)
    if not require_number("max_cost", max_cost) >= 1:
        raise ParameterError("max_cost", max_cost, "1 (no check) or more")
    moving: Move = SliceMove() if move is None else move
    once = partial(
        search, progress=progress, executor=executor, n_workers=n_workers, return_interrupted=return_interrupted
    )
    result = once(
        posed,
        rng=rng,
        n_live=n_live,
        stop=stop,
        move=moving,
        n_replaced=n_replaced,
        max_calls=max_calls,
        checkpoint=checkpoint,
        checkpoint_every_s=checkpoint_every_s,
    )
    if max_cost > 1 and result.names and result.complete:
        # A generator of its own, which depends on the state after the search: so also after a resumption.
        checking = np.random.default_rng(rng.integers(2**63, size=4))
        try:
            result = checked(
                result,
                posed,
                moving,
                partial(once, return_interrupted=False),
                max_cost=max_cost,
                max_calls=max_calls,
                least_live=least_live(len(result.names)),
                rng=checking,
            )
        except KeyboardInterrupt:
            if not return_interrupted:
                raise
            note = "interrupted while the evidence was checked by a second route"
            result = replace(result, warnings=(*result.warnings, note))
    for note in result.warnings:
        warnings.warn(note, DoubtfulResultWarning, stacklevel=2)
    return result


def _posed(
    problem: object,
    prior: AnyPrior | None,
    names: Sequence[str] | None,
    vectorized: bool,
    pass_dict: bool,
    periodic: Sequence[str],
) -> Samplable:
    """Take a problem in one, or make one of a function and its prior."""
    if hasattr(problem, "log_likelihood") or isinstance(problem, type):
        if prior is not None or names is not None or vectorized or pass_dict or periodic:
            raise ParameterError(
                "prior, names, vectorized, pass_dict, periodic",
                "given beside a problem that has its own",
                "these beside a log likelihood, a function; or nested.run(problem, rng=rng)",
            )
        return cast(Samplable, problem)
    if prior is None:
        allowed = "a problem with a prior and a log_likelihood(theta), such as inference.SensorProblem; or a function"
        raise ParameterError(
            "problem", problem, f"{allowed} with its prior: nested.run(log_likelihood, prior, rng=rng)"
        )
    return pose(
        cast("Callable[..., Any]", problem),
        prior,
        names=names,
        vectorized=vectorized,
        pass_dict=pass_dict,
        periodic=periodic,
    )
