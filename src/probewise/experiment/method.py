"""Methods of sequential inference: one Protocol, and sequential Monte Carlo, the default."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.experiment.evidence import can_sleep_mask, with_evidence_from_prior
from probewise.experiment.kinds import IMPROBABLE, SUSPECTED, Posterior, n_samples_of_kind
from probewise.experiment.rivals import Pace
from probewise.inquiry.smc import BRIEF, STEADY, THOROUGH, nested_sampling_from_scratch, resample_and_move, update
from probewise.nested import Weighted
from probewise.recordings.plan import Recording


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
        problems = [kind.problem(recording) for kind in previous.kinds]
        if len(problems) == 1:
            from_scratch = partial(nested_sampling_from_scratch, problems[0], n_live=self.n_live, rng=rng)
            found = update(previous.particles[0], problems[0], rng=rng, fall_back=from_scratch)
            return replace(previous, particles=(found,))
        usual, unsuspected = STEADY if previous.doubts_sensor else THOROUGH, SUSPECTED[1][0]
        updated = list(previous.particles)
        probability, can_sleep = previous.probability, can_sleep_mask(previous)
        each_s = [Pace.from_times(times).each_s for times in (recording.plan.time_s[:-1], recording.plan.time_s)]
        for k, (kind, own, problem) in enumerate(zip(previous.kinds, previous.particles, problems, strict=True)):
            if can_sleep[k]:
                updated[k] = own.asleep_with(problem.perfect_log_likelihood)
            else:
                effort = BRIEF if kind.left_out and probability[k] < unsuspected else usual
                updated[k] = update(kind.at_pace(own, *each_s), problem, rng=rng, effort=effort)
        now = replace(previous, particles=tuple(updated))
        now = with_evidence_from_prior(now, problems, self.n_particles, self.n_live, at_end=False, rng=rng)
        if not np.isfinite(now.log_odds).any():
            raise NotConvergedError("no hypothesis of any kind could have given these readings")
        particles = list(now.particles)
        for k, (kind, p) in enumerate(zip(now.kinds, now.probability, strict=True)):
            n = n_samples_of_kind(kind, p, self.n_particles)
            if not particles[k].asleep and (n > len(particles[k].ancestor) or p < IMPROBABLE):
                effort = BRIEF if kind.left_out else THOROUGH
                particles[k] = resample_and_move(particles[k], n, problems[k], rng=rng, effort=effort)
        return replace(now, particles=tuple(particles))

    def reconsidered(self, posterior: Posterior, recording: Recording, *, rng: np.random.Generator) -> Posterior:
        """Return the posterior with kinds sampled again whose samples may have lost the truth."""
        problems = [kind.problem(recording) for kind in posterior.kinds]
        # From a generator of its own: if no mode was lost, the run goes on as without the search.
        search = rng.spawn(1)[0]
        return with_evidence_from_prior(posterior, problems, self.n_particles, self.n_live, at_end=True, rng=search)

    def drawn(
        self, posterior: Posterior, joined: Weighted, recording: Recording, n: int, *, rng: np.random.Generator
    ) -> FloatArray:
        """Resample `n` hypotheses from the joined posterior, (n, n_params)."""
        return joined.samples(n, rng=rng)
