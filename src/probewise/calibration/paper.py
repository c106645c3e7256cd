"""The SSF of a recording by the paper's method: nested sampling of each number of Gaussians; the evidence chooses one.

Paper, section 2.7, "Estimating SSF MoG Model Parameters": Pr(theta | D, I) = Pr(theta | I) Pr(D | theta, I) / Z (eq.
17), with the parameters theta of N Gaussians and the two levels, and the evidence Z = Pr(D | I) of the order N (eq.
18). `estimate_ssf` is its loop; `calibrate` searches each order by `search_prior_of_order`, which can refine the
evidence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from probewise.calibration.fields import posterior_mean_ssf_field
from probewise.calibration.priors import SSFPrior, paper_prior
from probewise.errors import require
from probewise.inference import SensorProblem, student_t_of
from probewise.nested import EvidenceChange, NestedResult, RoundSummary, StopRule, Weighted, refine, run
from probewise.nested.importance import MOST_K
from probewise.recordings import Recording
from probewise.scene import KnownScene
from probewise.sensor import FAST_NODES, Chain, FreeLevels, FreeMixture, SSFField

Progress = Callable[[int, RoundSummary], None]

_N_DRAWS = 8000
# Two estimates of the evidence this many errors apart disagree: one false alarm in 16 000.
_DISAGREE = 4.0


def problem_for(recording: Recording, prior: SSFPrior) -> SensorProblem:
    """Make the inference problem of one order: a chain over known patterns, Student-t with one sigma per scan.

    Quadrature over curved edges errs by 1e-4 of I_max - I_min, below a tenth of the least noise sd of the prior.
    """
    plan = recording.plan
    chain = Chain(FreeMixture(prior.n_gaussians), FreeLevels(), KnownScene(plan.patterns), n_nodes=FAST_NODES)
    return SensorProblem(prior, chain, student_t_of(recording), recording)


def estimate_ssf(
    recording: Recording,
    *,
    orders: Sequence[int] = (1, 2, 3, 4),
    n_live: int = 300,
    pixel_mm: float = 1.0,
    rng: np.random.Generator,
) -> Generator[tuple[int, NestedResult, SSFField], None, None]:
    """Estimate the SSF as a mixture of each number of Gaussians; the most probable number has the largest log Z.

    Parameters
    ----------
    recording
        Readings over known patterns.
    orders
        Numbers of Gaussians.
    n_live
        Live points of nested sampling.
    pixel_mm
        Width of a field's pixels.
    rng
        Source of randomness.

    Yields
    ------
    The number of Gaussians, its posterior with the log evidence, and the weighted mean of the sampled SSF fields.
    """
    for n_gaussians in orders:
        problem = problem_for(recording, paper_prior(recording, n_gaussians))
        posterior = run(problem, n_live=n_live, stop=EvidenceChange(1e-8), max_cost=1.0, rng=rng)
        yield (
            n_gaussians,
            posterior,
            posterior_mean_ssf_field(posterior.theta, n_gaussians, pixel_mm=pixel_mm, weight=posterior.weight),
        )


@dataclass(frozen=True, eq=False)
class ProblemsByOrder:
    """A recording and the prior of each order."""

    recording: Recording
    prior: Callable[[Recording, int], SSFPrior]

    def prior_of(self, n_gaussians: int) -> SSFPrior:
        """Return the prior of an order; ParameterError if it is no `SSFPrior`."""
        found = self.prior(self.recording, n_gaussians)
        require(isinstance(found, SSFPrior), "prior", found, "an SSFPrior")
        return found

    def problem(self, n_gaussians: int) -> SensorProblem:
        """Return the inference problem of an order."""
        return problem_for(self.recording, self.prior_of(n_gaussians))


@dataclass(frozen=True, eq=False)
class OrderPosterior:
    """Posterior samples and evidence of an order, before a sensor is made of them.

    `result` is a nested sampling run, or the weighted samples of the quick way; `refined` the evidence of a nested run
    by importance sampling, or None.
    """

    result: NestedResult | Weighted
    refined: Weighted | None
    notes: tuple[str, ...] = ()

    @property
    def evidence_result(self) -> NestedResult | Weighted:
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
    report = None if progress is None else partial(progress, n_gaussians)
    result = run(problem, rng=rng, n_live=n_live, stop=stop, progress=report, max_cost=1.0)
    if not refined:
        note = f"the log evidence is that of nested sampling alone, which ended as {result.stop_reason}"
        return OrderPosterior(result, None, (note,))
    more = refine(result, problem, rng=rng, n_draws=_N_DRAWS)
    apart = abs(more.log_z - result.log_z) / math.hypot(more.log_z_error, result.log_z_error)
    if apart <= _DISAGREE or not more.pareto_k < MOST_K:
        return OrderPosterior(result, more)
    note = (
        f"two estimates of the evidence of {n_gaussians} Gaussians disagree: {result.log_z:.2f} ± "
        f"{result.log_z_error:.2f} and {more.log_z:.2f} ± {more.log_z_error:.2f}; use more live points"
    )
    return OrderPosterior(result, more, (note,))
