"""Methods of sequential inference: one Protocol; sequential Monte Carlo, the default; and the paper's."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.experiment.evidence import can_suspend_mask, sleeping_mask, to_first_order, with_evidence_from_prior
from probewise.experiment.kinds import IMPROBABLE, SUSPECTED_PROBABILITY, PosteriorByKind, n_samples_of_kind
from probewise.experiment.paper import N_LIVE, N_STEPS
from probewise.experiment.rivals import Pace
from probewise.inquiry.smc import (
    BRIEF,
    STEADY,
    THOROUGH,
    Particles,
    nested_sampling_from_scratch,
    resample_and_move,
    update,
)
from probewise.nested import EvidenceChange, KernelMove, Move, StopRule, Weighted, diversify, run
from probewise.nested.importance import samples_of_run
from probewise.nested.weights import resampled_rows
from probewise.recordings.plan import Recording


class Method(Protocol):
    """A method of inference after every reading; a frozen dataclass, so that a journal can record the method."""

    @property
    def label(self) -> str:
        """Short name for reports."""
        ...

    def updated(self, previous: PosteriorByKind, recording: Recording, *, rng: np.random.Generator) -> PosteriorByKind:
        """Update the posterior with the last reading of a recording; NotConvergedError if no hypothesis allows it."""
        ...

    def reconsidered(self, now: PosteriorByKind, recording: Recording, *, rng: np.random.Generator) -> PosteriorByKind:
        """Return the posterior with a few kinds sampled again whose samples may have lost the truth, before a run ends.

        `now` itself, if there are none left.
        """
        ...

    def drawn(
        self, by_kind: PosteriorByKind, joined: Weighted, recording: Recording, n: int, *, rng: np.random.Generator
    ) -> FloatArray:
        """Draw the `n` hypotheses that figures show and the paper's utility uses, (n, n_params).

        `by_kind` holds the samples of each kind, `joined` the weighted samples of all kinds.
        """
        ...


@dataclass(frozen=True)
class SequentialMonteCarlo:
    """Sequential Monte Carlo with weighted samples; nested sampling takes over if no sample predicts a reading.

    A probable kind of hypotheses has `n_particles` samples, nested sampling `n_live` live points.
    """

    n_particles: int
    n_live: int

    @property
    def label(self) -> str:
        """Short name for reports."""
        return f"sequential Monte Carlo, {self.n_particles} samples carried from reading to reading"

    def updated(self, previous: PosteriorByKind, recording: Recording, *, rng: np.random.Generator) -> PosteriorByKind:
        """Reweight, resample and move the samples of every kind by the last reading.

        A rival whose prior was never searched is only looked at to first order (`to_first_order`).
        """
        problems = [kind.problem(recording) for kind in previous.kinds]
        if len(problems) == 1:
            from_scratch = partial(nested_sampling_from_scratch, problems[0], n_live=self.n_live, rng=rng)
            found = update(previous.particles[0], problems[0], rng=rng, fall_back=from_scratch)
            return replace(previous, particles=(found,))
        usual = STEADY if previous.doubts_sensor else THOROUGH
        updated, plain, sleeping = list(previous.particles), previous.particles[0], sleeping_mask(previous)
        probability, can_suspend = previous.probability, can_suspend_mask(previous)
        time_s = recording.plan.time_s
        s_per_reading = [Pace.from_times(times).s_per_reading for times in (time_s[:-1], time_s)]
        for k, (kind, carried, problem) in enumerate(zip(previous.kinds, previous.particles, problems, strict=True)):
            perfect = problem.perfect_log_likelihood
            if sleeping[k] and plain.log_z > -math.inf:
                found = to_first_order(carried, problem, plain.weighted, rng)
            elif can_suspend[k]:
                found = carried.suspended_with(perfect)
            else:
                effort = BRIEF if kind.left_out and probability[k] < SUSPECTED_PROBABILITY else usual
                found = update(kind.at_pace(carried, *s_per_reading), problem, rng=rng, effort=effort)
            plain = plain if kind.left_out else found  # of each shape the first
            updated[k] = replace(found, lost_log_z=carried.lost_log_z + perfect)
        now = replace(previous, particles=tuple(updated))
        now = with_evidence_from_prior(now, problems, self.n_particles, self.n_live, at_end=False, rng=rng)
        if not np.isfinite(now.log_odds).any():
            raise NotConvergedError("no hypothesis of any kind could have given these readings")
        particles, sleeping = list(now.particles), sleeping_mask(now)
        for k, (kind, p) in enumerate(zip(now.kinds, now.probability, strict=True)):
            n = n_samples_of_kind(kind, p, self.n_particles)
            if not (particles[k].suspended or sleeping[k]) and (n > len(particles[k].ancestor) or p < IMPROBABLE):
                effort = BRIEF if kind.left_out else THOROUGH
                particles[k] = resample_and_move(particles[k], n, problems[k], rng=rng, effort=effort)
        return replace(now, particles=tuple(particles))

    def reconsidered(self, now: PosteriorByKind, recording: Recording, *, rng: np.random.Generator) -> PosteriorByKind:
        """Return the posterior with a few kinds sampled again whose samples may have lost the truth; see `Method`."""
        problems = [kind.problem(recording) for kind in now.kinds]
        # From another generator: if no mode was lost, the run goes on as without the search.
        search = rng.spawn(1)[0]
        return with_evidence_from_prior(now, problems, self.n_particles, self.n_live, at_end=True, rng=search)

    def drawn(
        self, by_kind: PosteriorByKind, joined: Weighted, recording: Recording, n: int, *, rng: np.random.Generator
    ) -> FloatArray:
        """Resample `n` hypotheses from the joined posterior, (n, n_params)."""
        return joined.samples(n, rng=rng)


@dataclass(frozen=True)
class NestedSampling:
    """Nested sampling on all readings after each one, with diversified samples (paper, section 2.3).

    The paper has 300 live points, stops nested sampling at a change of ln Z below 1e-8, and moves each drawn sample by
    about 1000 Metropolis-Hastings steps.
    """

    n_live: int = N_LIVE
    stop: StopRule = field(default_factory=EvidenceChange)
    n_steps: int = N_STEPS
    move: Move = field(default_factory=KernelMove)

    @property
    def label(self) -> str:
        """Short name for reports."""
        return f"the paper's: nested sampling anew after each reading, {self.n_live} live points"

    def updated(self, previous: PosteriorByKind, recording: Recording, *, rng: np.random.Generator) -> PosteriorByKind:
        """Infer from all readings by a new nested sampling run for each kind of hypotheses."""
        found = []
        for kind, before in zip(previous.kinds, previous.particles, strict=True):
            problem, n_live = kind.problem(recording), self.n_live
            try:  # without a check, as the robot waits
                result = run(problem, rng=rng, n_live=n_live, stop=self.stop, move=self.move, max_cost=1.0)
            except NotConvergedError:  # no hypothesis of this kind could have given the readings
                found.append(before.with_zero_evidence())
                continue
            n_calls = before.weighted.n_calls + result.n_calls
            samples = replace(samples_of_run(result), n_calls=n_calls, warnings=())
            found.append(Particles(samples, np.arange(len(samples.theta))))
        now = replace(previous, particles=tuple(found))
        if not np.isfinite(now.log_odds).any():
            raise NotConvergedError("no hypothesis of any kind could have given these readings")
        return now

    def reconsidered(self, now: PosteriorByKind, recording: Recording, *, rng: np.random.Generator) -> PosteriorByKind:
        """Return the posterior as it is: nested sampling starts again at every reading, so no samples lose a mode."""
        return now

    def drawn(
        self, by_kind: PosteriorByKind, joined: Weighted, recording: Recording, n: int, *, rng: np.random.Generator
    ) -> FloatArray:
        """Draw `n` hypotheses, (n, n_params), each moved by `n_steps` steps, since a run's samples may be copies."""
        which = resampled_rows(by_kind.probability, n, rng)
        drawn = []
        for k, (kind, particles) in enumerate(zip(by_kind.kinds, by_kind.particles, strict=True)):
            if n_of_kind := int((which == k).sum()):
                start = particles.weighted.samples(n_of_kind, rng=rng)
                moved = diversify(start, kind.problem(recording), rng=rng, n_steps=self.n_steps)
                drawn.append(kind.member.to_whole_theta(moved, rng))
        return np.concatenate(drawn)
