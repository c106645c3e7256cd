"""Evidences re-estimated where their errors could change the probabilities of the kinds of hypotheses.

Sequential evidences accumulate errors. Such an evidence is re-estimated from all readings by bridge sampling or, if the
samples of its kind could not follow the readings, by nested sampling of that kind.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import expit, logsumexp

from probewise.errors import NotConvergedError
from probewise.experiment.evidence import bridged_evidence
from probewise.experiment.particles import Particles, particles_from_posterior
from probewise.experiment.posterior import Posterior
from probewise.experiment.sampled_anew import SolverFromScratch, samples_from_run, with_new_evidence_and_lineages
from probewise.inference.problem import SensorProblem

HAS_A_SAY = 0.02  # probability of a kind in doubt that is solved from scratch; before a run ends, of every kind
CARRIED_ERROR = 0.25  # nats by which a carried evidence may be wrong that genealogies do not tell
_STRAINED = 6.0  # nats, where samples could not follow
TOLD_APART = 1.5  # nats between an evidence carried and one taken anew, from which on the samples are in doubt
_DRAWS = 1000
_LOST = 0.01  # probability of a kind that must not be missed


def with_doubtful_evidences_reestimated(
    now: Posterior,
    problems: list[SensorProblem],
    n: int,
    from_scratch: SolverFromScratch,
    rng: np.random.Generator,
    *,
    most_off: float,
) -> Posterior:
    """Re-estimate evidences until no kind's error of evidence could change its probability by more than `most_off`."""
    particles, settled = list(now.particles), set[int]()
    while (k := _kind_with_most_doubtful_evidence(now, settled, most_off)) is not None:
        settled.add(k)
        particles[k] = _reestimate_kind(particles[k], problems[k], n, from_scratch, rng)
        now = replace(now, particles=tuple(particles))
    return now


def _kind_with_most_doubtful_evidence(now: Posterior, settled: set[int], most_off: float) -> int | None:
    """Return the index of the kind whose error of evidence changes its probability most; None: none above `most_off`.

    A kind with strained samples comes first: with left-out effects among the kinds, if its probability is above 2 %;
    otherwise, if an error of 6 nats could bring its probability above 1 % or below 99 %.
    """
    log_odds = now.log_odds
    doubted = any(kind.left_out for kind in now.kinds)
    off = np.zeros(len(log_odds))
    for k, particles in enumerate(now.particles):
        if k in settled:
            continue
        others = np.delete(log_odds, k)
        if particles.log_z == -math.inf or not np.isfinite(others).any():
            off[k] = 1.0 if particles.strained else 0.0
            continue
        odds = log_odds[k] - float(logsumexp(others))
        doubt = 2 * particles.log_z_error + (CARRIED_ERROR if particles.n_resampled else 0.0)
        p, low, high = (float(expit(odds + by)) for by in (0.0, -doubt, doubt))
        off[k] = max(p - low, high - p)
        least, most = (float(expit(odds + by)) for by in (-_STRAINED, _STRAINED))
        may_be_right = most > _LOST and least < 1 - _LOST
        if particles.strained and (p > HAS_A_SAY if doubted else may_be_right):
            off[k] = 1.0
    return int(off.argmax()) if off.max() > most_off else None


def _reestimate_kind(
    particles: Particles, problem: SensorProblem, n: int, from_scratch: SolverFromScratch, rng: np.random.Generator
) -> Particles:
    """Re-estimate a kind's evidence by bridge sampling; if strained or far off, its samples too, from scratch."""
    had = particles.weighted
    if not particles.strained:
        found = bridged_evidence(had, problem, rng=rng, n_draws=n)
        if abs(found.log_z - had.log_z) < TOLD_APART:
            return with_new_evidence_and_lineages(particles, found)
    try:
        run = from_scratch(problem)
    except NotConvergedError:  # no hypothesis of this kind could have given the readings
        return replace(particles, weighted=replace(had, log_z=-math.inf, log_z_error=math.inf), strained=False)
    drawn = samples_from_run(run, had, problem, n, rng, with_own=particles.log_z > -math.inf)
    fresh = particles_from_posterior(drawn, n, problem, rng=rng)
    fresh = with_new_evidence_and_lineages(fresh, bridged_evidence(fresh.weighted, problem, rng=rng, n_draws=n))
    return replace(fresh, weighted=replace(fresh.weighted, run=run), refitted=True)


def with_bridged_evidence(particles: Particles, problem: SensorProblem, rng: np.random.Generator) -> Particles:
    """Return the same samples with their evidence by bridge sampling; unchanged if that evidence is not finite."""
    found = bridged_evidence(particles.weighted, problem, rng=rng, n_draws=min(2 * len(particles.ancestor), _DRAWS))
    return (
        replace(with_new_evidence_and_lineages(particles, found), strained=particles.strained)
        if math.isfinite(found.log_z)
        else particles
    )
