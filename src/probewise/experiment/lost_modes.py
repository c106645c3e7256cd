"""A last check before a run ends: nested sampling on all readings looks for what the samples have lost.

Samples that are carried from reading to reading follow the modes that they have. One that held a percent of the
posterior after six readings may hold all of it after ten; if its last samples died between, nothing brings it back, and
the rest is narrow and wrong.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from probewise.experiment.doubtful_evidence import HAS_A_SAY, with_bridged_evidence
from probewise.experiment.particles import particles_from_posterior
from probewise.experiment.posterior import Posterior
from probewise.experiment.sampled_anew import SolverFromScratch, sample_from_scratch
from probewise.inference.problem import SensorProblem
from probewise.nested.importance import Weighted

_LOST = 0.05  # share of a posterior that may lie beyond all of a kind's samples, besides what chance leaves there


def with_lost_modes_found(
    posterior: Posterior, problems: list[SensorProblem], *, rng: np.random.Generator, from_scratch: SolverFromScratch
) -> Posterior:
    """Return the posterior with modes that its samples had lost; as it is if they had lost none.

    Every probable shape is searched, with the sensor as it is. `problems` are those of the kinds, given all readings.
    Samples are replaced if a twentieth of what was found lies beyond the range of all of them in some parameter.
    """
    particles, n_readings = list(posterior.particles), len(problems[0].recording)
    for k, (kind, probability) in enumerate(zip(posterior.kinds, posterior.probability.tolist(), strict=True)):
        own, problem = particles[k], problems[k]
        if kind.left_out or probability < HAS_A_SAY or not own.is_search_old(n_readings):
            continue
        particles[k] = own = replace(own, searched_at=n_readings)
        n = len(own.ancestor)
        anew = sample_from_scratch(problem, own.weighted, n, -math.inf, rng, from_scratch)
        if anew.samples is not None and _share_beyond_own_samples(own.weighted, anew.samples) > _LOST:
            fresh = particles_from_posterior(anew.samples, n, problem, rng=rng)
            fresh = with_bridged_evidence(fresh, problem, rng)
            particles[k] = replace(fresh, searched_at=n_readings, refitted=True)
    return replace(posterior, particles=tuple(particles))


def _share_beyond_own_samples(own: Weighted, found: Weighted) -> float:
    """Return the share of the samples found beyond the range of a kind's own in some parameter, less chance's part."""
    kept = own.theta[own.weight > 0]
    outside = ((found.theta < kept.min(axis=0)) | (found.theta > kept.max(axis=0))).any(axis=1)
    by_chance: float = 2 * kept.shape[1] / (len(kept) + 1)
    beyond = float(found.weight[outside].sum())
    return beyond - by_chance
