"""Methods of sequential inference: one Protocol, and sequential Monte Carlo, the default."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.experiment.lost_modes import with_lost_modes_found
from probewise.experiment.posterior import Posterior
from probewise.experiment.posterior_update import updated, with_rivals_sampled_again
from probewise.experiment.sampled_anew import SolverFromScratch
from probewise.inference.problem import SensorProblem
from probewise.nested import LIVE_PER_PARAM, KernelMove, NestedResult, RemainingEvidence, Weighted, run
from probewise.recordings.plan import Recording

_DLOGZ = 0.5  # the final live points are posterior samples too; a smaller value would only refine log Z


class Method(Protocol):
    """A method of inference after every reading; a frozen dataclass, so that a journal can record the method."""

    @property
    def label(self) -> str:
        """Short name for reports."""
        ...

    def updated(self, previous: Posterior, recording: Recording, *, rng: np.random.Generator) -> Posterior:
        """Update the posterior with the last reading of a recording.

        Raises
        ------
        NotConvergedError
            If no hypothesis of any kind could have given the readings.
        """
        ...

    def reconsidered(self, posterior: Posterior, recording: Recording, *, rng: np.random.Generator) -> Posterior:
        """Return the posterior with kinds sampled again whose samples may have lost the truth, before a run ends."""
        ...

    def drawn(
        self, posterior: Posterior, joined: Weighted, recording: Recording, n: int, *, rng: np.random.Generator
    ) -> FloatArray:
        """Draw the `n` hypotheses that figures show and the paper's utility uses, (n, n_params).

        `posterior` holds the samples of each kind, `joined` the weighted samples of all kinds.
        """
        ...


@dataclass(frozen=True)
class SequentialMonteCarlo:
    """Sequential Monte Carlo with weighted samples; nested sampling takes over if no sample predicts a reading.

    Parameters
    ----------
    n_particles
        Samples of a probable kind of hypotheses.
    n_live
        Live points of nested sampling.
    """

    n_particles: int
    n_live: int

    @property
    def label(self) -> str:
        """Short name for reports."""
        return f"sequential Monte Carlo, {self.n_particles} samples carried from reading to reading"

    def updated(self, previous: Posterior, recording: Recording, *, rng: np.random.Generator) -> Posterior:
        """Reweight, resample and move the samples of every kind by the last reading."""
        return updated(previous, recording, self.n_particles, rng=rng, from_scratch=self._solver_from_scratch(rng))

    def reconsidered(self, posterior: Posterior, recording: Recording, *, rng: np.random.Generator) -> Posterior:
        """Return the posterior with kinds sampled again whose samples may have lost the truth.

        The check for lost modes draws from a generator of its own: if no mode was lost, the run goes on as without it.
        """
        own = rng.spawn(1)[0]
        if any(kind.left_out for kind in posterior.kinds):
            posterior = with_rivals_sampled_again(
                posterior, recording, self.n_particles, rng=rng, from_scratch=self._solver_from_scratch(rng)
            )
        problems = [kind.problem(recording) for kind in posterior.kinds]
        return with_lost_modes_found(posterior, problems, rng=own, from_scratch=self._solver_from_scratch(own))

    def _solver_from_scratch(self, rng: np.random.Generator) -> SolverFromScratch:
        """Return the function that solves a problem by nested sampling."""
        return partial(nested_sampling_from_scratch, n_live=self.n_live, rng=rng)

    def drawn(
        self, posterior: Posterior, joined: Weighted, recording: Recording, n: int, *, rng: np.random.Generator
    ) -> FloatArray:
        """Resample `n` hypotheses from the joined posterior, (n, n_params)."""
        return joined.samples(n, rng=rng)


def nested_sampling_from_scratch(
    problem: SensorProblem, *, n_live: int, rng: np.random.Generator, quick: bool = False
) -> NestedResult:
    """Solve a problem, all readings at once, by nested sampling; with half of `n_live` live points if `quick`."""
    return run(
        problem,
        rng=rng,
        n_live=max(n_live // 2 if quick else n_live, LIVE_PER_PARAM * len(problem.prior.names)),
        move=KernelMove(),
        stop=RemainingEvidence(_DLOGZ),
        max_cost=1.0,  # speed matters, since the robot waits
        return_interrupted=False,
    )
