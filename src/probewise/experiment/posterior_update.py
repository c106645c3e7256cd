"""Updates of the posterior by a reading, and its revision before a run ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise.errors import NotConvergedError
from probewise.experiment.doubtful_evidence import with_bridged_evidence, with_doubtful_evidences_reestimated
from probewise.experiment.particles import BRIEF, STEADY, THOROUGH, Particles, UpdateSettings, resample_and_move, update
from probewise.experiment.posterior import IMPROBABLE, SUSPECTED, Posterior, n_samples_of_kind
from probewise.experiment.rivals_again import sample_rivals_again
from probewise.experiment.sampled_anew import SolverFromScratch
from probewise.inference.problem import SensorProblem
from probewise.recordings.plan import Recording

_MOST_OFF = 0.02  # by which a kind's probability may be wrong
_DOUBTED_OFF = 0.06  # the same in a run that doubts its sensor, where no decision hangs on less
_OFF_AT_THE_END = 0.5  # the same where samples have just been taken anew
_HOPELESS = 60.0  # nats behind the best kind, from which on no evidence is taken anew
_MOST_DRAWS = 1500


def updated(
    previous: Posterior,
    recording: Recording,
    n_particles: int,
    *,
    rng: np.random.Generator,
    from_scratch: SolverFromScratch,
) -> Posterior:
    """Update the posterior with the last reading of a recording.

    Parameters
    ----------
    previous
        Posterior given the earlier readings.
    recording
        All readings.
    n_particles
        Samples of a probable kind.
    rng
        Source of randomness.
    from_scratch
        Function that solves a kind's whole problem by nested sampling.

    Raises
    ------
    NotConvergedError
        If no hypothesis of any kind could have given the readings.
    """
    problems = [kind.problem(recording) for kind in previous.kinds]
    if len(problems) == 1:
        (only,), (problem,) = previous.particles, problems
        found = update(only, problem, rng=rng, fall_back=lambda: from_scratch(problem))
        return replace(previous, particles=(found,))
    doubted = any(kind.left_out for kind in previous.kinds)
    particles = _update_every_kind(previous, problems, STEADY if doubted else THOROUGH, rng)
    now = replace(previous, particles=tuple(particles))
    if doubted:
        particles = sample_rivals_again(now, problems, n_particles, rng, from_scratch)
        now = replace(previous, particles=tuple(particles))
        particles = [
            with_bridged_evidence(p, problem, rng) if p.hurried and odds > now.log_odds.max() - _HOPELESS else p
            for p, problem, odds in zip(particles, problems, now.log_odds, strict=True)
        ]
        now = replace(previous, particles=tuple(particles))
    n = min(n_particles, _MOST_DRAWS) if doubted else n_particles
    now = with_doubtful_evidences_reestimated(
        now, problems, n, from_scratch, rng, most_off=_DOUBTED_OFF if doubted else _MOST_OFF
    )
    particles = list(now.particles)
    if not np.isfinite(now.log_odds).any():
        raise NotConvergedError("no hypothesis of any kind could have given these readings")
    for k, p in enumerate(now.probability):
        had, n = len(particles[k].ancestor), n_samples_of_kind(now.kinds[k], p, n_particles)
        if n > had or p < IMPROBABLE:
            particles[k] = resample_and_move(
                particles[k], n, problems[k], rng=rng, effort=BRIEF if now.kinds[k].left_out else None
            )
    return replace(now, particles=tuple(particles))


def _update_every_kind(
    previous: Posterior, problems: list[SensorProblem], usual: UpdateSettings, rng: np.random.Generator
) -> list[Particles]:
    """Return every kind's samples, updated with the last reading; rivals below 2 % with less effort."""
    return [
        update(particles, problem, rng=rng, effort=BRIEF if kind.left_out and p < SUSPECTED[1][0] else usual)
        for kind, particles, problem, p in zip(
            previous.kinds, previous.particles, problems, previous.probability, strict=True
        )
    ]


def with_rivals_sampled_again(
    posterior: Posterior,
    recording: Recording,
    n_particles: int,
    *,
    rng: np.random.Generator,
    from_scratch: SolverFromScratch,
) -> Posterior:
    """Return the posterior with rivals sampled again and doubtful evidences re-estimated; called before a run ends.

    Rivals stay as they are if they are hopelessly improbable, or were sampled in this way before and have followed the
    readings since.
    """
    problems = [kind.problem(recording) for kind in posterior.kinds]
    now = replace(
        posterior, particles=tuple(sample_rivals_again(posterior, problems, n_particles, rng, from_scratch, each=True))
    )
    return with_doubtful_evidences_reestimated(
        now, problems, min(n_particles, _MOST_DRAWS), from_scratch, rng, most_off=_OFF_AT_THE_END
    )
