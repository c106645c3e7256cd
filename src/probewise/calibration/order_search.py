"""Find the evidence and the posterior of one order by searching its whole prior."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from probewise.calibration.order_problems import ProblemsByOrder
from probewise.calibration.smc import SMCResult, TemperatureSummary
from probewise.nested import NestedResult, RoundSummary, StopRule, Weighted, refine, run

Progress = Callable[[int, RoundSummary | TemperatureSummary], None]

_N_DRAWS = 8000
# Two estimates of the evidence this many errors apart disagree: one false alarm in 16 000.
_DISAGREE = 4.0


@dataclass(frozen=True, eq=False)
class OrderPosterior:
    """Posterior samples and evidence of an order, before a sensor is made of them.

    `result` is a nested sampling run or an SMC run; `refined` the evidence of a nested run by importance sampling, or
    None.
    """

    result: NestedResult | SMCResult
    refined: Weighted | None
    notes: tuple[str, ...] = ()

    @property
    def evidence_result(self) -> NestedResult | SMCResult | Weighted:
        """The result whose log Z is used: `refined` if its error is reliable (`Weighted.sound`), else `result`."""
        return self.refined if self.refined is not None and self.refined.sound else self.result


Search = Callable[[int, np.random.Generator], OrderPosterior]
"""Function that searches the whole prior of an order."""


def search_prior_of_order(
    problems: ProblemsByOrder,
    n_gaussians: int,
    rng: np.random.Generator,
    *,
    n_live: int,
    stop: StopRule | None = None,
    refined: bool = True,
    progress: Progress | None = None,
) -> OrderPosterior:
    """Search the prior of an order by nested sampling, and refine the evidence if `refined`; return the posterior."""
    problem = problems.problem(n_gaussians)
    report = None if progress is None else round_reporter(progress, n_gaussians)
    result = run(problem, rng=rng, n_live=n_live, stop=stop, progress=report, max_cost=1.0, return_interrupted=False)
    if not refined:
        note = f"the log evidence is that of nested sampling alone, which ended as {result.stop_reason}"
        return OrderPosterior(result, None, (note,))
    more_precise = refine(result, problem, rng=rng, n_draws=_N_DRAWS, look=False)
    return OrderPosterior(result, more_precise, _notes_on_disagreement(n_gaussians, result, more_precise))


def _notes_on_disagreement(n_gaussians: int, result: NestedResult, refined: Weighted) -> tuple[str, ...]:
    """Return one note if two estimates of an evidence are more than four errors apart, else none.

    Also none if the refined estimate has doubts of its own.
    """
    apart = abs(refined.log_z - result.log_z) / math.hypot(refined.log_z_error, result.log_z_error)
    if apart <= _DISAGREE or not set(refined.doubts) <= set(refined.inherited):
        return ()
    return (
        f"two estimates of the evidence of {n_gaussians} Gaussians disagree: {result.log_z:.2f} ± "
        f"{result.log_z_error:.2f} and {refined.log_z:.2f} ± {refined.log_z_error:.2f}; use more live points",
    )


def round_reporter(progress: Progress, n_gaussians: int) -> Callable[[RoundSummary], None]:
    """Return a function that reports the rounds of an order's nested sampling to `progress`."""
    return lambda state: progress(n_gaussians, state)
