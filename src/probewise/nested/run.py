"""`run`: nested sampling with a check of the evidence, the entry point for users."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import own_arithmetic
from probewise._kinds import checked_number, require_rng
from probewise.errors import DoubtfulResultWarning, ParameterError
from probewise.nested.check import check_and_repeat
from probewise.nested.evaluate import Samplable
from probewise.nested.function_problem import AnyPrior, as_problem
from probewise.nested.moves import Move, SliceMove
from probewise.nested.result import NestedResult
from probewise.nested.sampler import least_live, run_once
from probewise.nested.stop import RoundSummary, StopRule


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
    checkpoint_every_s: float = 10.0,
    executor: Executor | None = None,
    n_workers: int | None = None,
    return_interrupted: bool = True,
) -> NestedResult:
    """Compute the evidence and posterior samples of a problem (paper, section on SSF estimation).

    Parameters
    ----------
    problem
        A problem with prior and log likelihood, which is evaluated in batches; or a log likelihood, a function of one
        point.
    prior
        With a log likelihood: a prior, distributions by name or in order, or a function from the unit cube.
    names, vectorized, pass_dict, periodic
        With a log likelihood: how the functions are called; see `make_problem`.
    rng
        Source of randomness; its state is stored in the result.
    n_live
        Number of live points: the error of log Z falls as one over its root, the cost rises in proportion.
    stop
        Stopping rule; default `RemainingEvidence(0.05)`. The paper's rule is `EvidenceChange(1e-8)`.
    move
        How new points are drawn; default `SliceMove()`. While more than a twentieth of the prior
        is alive, points are drawn from the prior itself.
    n_replaced
        Points replaced per round; default half of `n_live`. The shrinkage is counted exactly for any
        number. With half, batches are large; compared with one at a time, 28 % fewer points are drawn and
        the variance of log Z is 44 % greater.
    progress
        Called with a `RoundSummary` after every round.
    max_calls
        Limit of likelihood evaluations; at the limit the run ends with a warning.
    max_cost
        Limit of all evaluations in units of those of the first run; 1 means no check. First, modes that died out among
        the live points are looked for; if some of them matter, the run is repeated with hops to them. Then the evidence
        is estimated again, at about a fifth of the first run's cost. Where the two disagree, a more precise second
        estimate and a run with chains twice as long follow. A disagreement or a lost mode that remains is reported as a
        warning, and so is a second estimate that does not end within the limits.
    checkpoint
        File to which the state is saved atomically as the run proceeds; its folder is created if missing. If the file
        exists, the run resumes and ends bit for bit as if it had not been interrupted or killed; `rng` must be in
        the state of the run's start, made from the same seed. `max_calls` may differ.
    checkpoint_every_s
        Least seconds between savings, but no less than ten times the saving time. 0: save after every round.
    executor
        Evaluates a slow likelihood in parallel; by default it is evaluated in this process. Each batch is
        split into `n_workers` parts. The result is the same to the last bit if a hypothesis' likelihood
        does not depend on its batch (for matrix products in NumPy it may).
    n_workers
        Parts of a batch; default the number of processors.
    return_interrupted
        Whether Ctrl-C returns the result so far, with a warning; otherwise it raises `KeyboardInterrupt`.

    Returns
    -------
    NestedResult
        A doubtful result comes with warnings, which it also stores.

    Raises
    ------
    ParameterError
        If an option is out of range.
    NotConvergedError
        If the likelihood fails (`partial` holds the result so far, if there is one), or every
        hypothesis drawn from the prior is impossible.
    FileError
        Before anything is evaluated: if the checkpoint is damaged, belongs to another problem, other settings or
        another seed, or cannot be written. If a later saving fails, the run goes on with a warning.
    """
    require_rng(rng)
    posed = as_problem(problem, prior, names, vectorized, pass_dict, periodic)
    if not checked_number("max_cost", max_cost) >= 1:
        raise ParameterError("max_cost", max_cost, "1 (no check) or more")
    moving: Move = SliceMove() if move is None else move
    once = partial(
        run_once, progress=progress, executor=executor, n_workers=n_workers, return_interrupted=return_interrupted
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
        # A separate generator that depends only on the state after the run, hence is the same after a resumption.
        checking = np.random.default_rng(rng.integers(2**63, size=4))
        try:
            result = check_and_repeat(
                result,
                posed,
                moving,
                partial(once, return_interrupted=False),
                max_cost=max_cost,
                max_calls=max_calls,
                least_live=least_live(len(result.names)),
                rng=checking,
                executor=executor,
                n_workers=n_workers,
            )
        except KeyboardInterrupt:
            if not return_interrupted:
                raise
            note = "interrupted while a second estimate checked the evidence"
            result = replace(result, warnings=(*result.warnings, note))
    for note in result.warnings:
        warnings.warn(note, DoubtfulResultWarning, stacklevel=2)
    return result
