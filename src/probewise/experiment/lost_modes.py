"""A last check before a run ends: nested sampling on all readings looks for what the samples have lost.

Samples that are carried from reading to reading keep only the modes that they have. A mode that held a percent of the
posterior after six readings may hold all of it after ten; if the last samples of that mode died in between, nothing
brings the mode back, and the posterior is narrow and wrong.
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
from probewise.nested import Weighted

_LOST = 0.05  # share of a posterior that may lie beyond all of a kind's samples, besides what chance leaves there


def with_lost_modes_found(
    posterior: Posterior, problems: list[SensorProblem], *, rng: np.random.Generator, from_scratch: SolverFromScratch
) -> Posterior:
    """Return the posterior with modes that its samples had lost; unchanged if none were lost.

    Kinds without a left-out effect and with 2 % or more are searched, unless a recent search holds. `problems` are
    those of the kinds, given all readings. A kind's samples are replaced by those of the search if 5 % more of the
    latter than by chance lie outside the range of the former in some parameter.
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
    """Return the share of `found` outside the range of `own` in some parameter, less the share expected by chance."""
    kept = own.theta[own.weight > 0]
    outside = ((found.theta < kept.min(axis=0)) | (found.theta > kept.max(axis=0))).any(axis=1)
    by_chance: float = 2 * kept.shape[1] / (len(kept) + 1)
    beyond = float(found.weight[outside].sum())
    return beyond - by_chance
