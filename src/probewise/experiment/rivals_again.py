"""Rivals sampled again, where their own samples may have lost the truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from probewise.experiment.doubtful_evidence import CARRIED_ERROR, HAS_A_SAY, TOLD_APART, with_bridged_evidence
from probewise.experiment.particles import BRIEF, Particles, particles_from_posterior
from probewise.experiment.posterior import Posterior, n_samples_of_kind
from probewise.experiment.sampled_anew import (
    WELL_FOUND,
    SamplesAnew,
    SolverFromScratch,
    sample_from_scratch,
    sample_near_other_kinds,
)
from probewise.inference.problem import SensorProblem

_NESTED = 6.0  # nats by which a rival may be less likely than the plain model, which is a case of it
_BEHIND = 9.0  # nats behind the best kind, from which on a rival is not sampled anew
_FEWEST = 4.0  # effective draws below which a sample replaces none
_LEAST_FOUND = 15.0  # effective draws from which on a sample replaces another of about the same evidence
_RULED_OUT = 10.0  # nats by which fits and a kind's own samples may miss its evidence, where both are behind
_SEARCHED_PER_READING = 1  # kinds that are searched from scratch after a reading; before a run ends, all that need it


def sample_rivals_again(
    now: Posterior,
    problems: list[SensorProblem],
    n_particles: int,
    rng: np.random.Generator,
    from_scratch: SolverFromScratch,
    *,
    each: bool = False,
) -> list[Particles]:
    """Return the samples of every kind; those of rivals are taken anew where the old ones may have lost the truth.

    A rival (a kind with a left-out effect) is sampled anew if its samples are strained or hurried, or if its evidence
    is over 6 nats below that of the sensor model alone, which the rival contains as the case of no effect. With `each`,
    all rivals are, except those with `refitted` samples. A rival with too low a limit of evidence stays as it is.

    Fits that start at samples of other kinds come first. If few of the fits reach the best one, the rival is searched
    from scratch: one rival per reading in turn; with `each` as many as need it, and all with a probability above 2 %. A
    search holds for five readings if the samples follow with ease.
    """
    particles, log_odds = list(now.particles), now.log_odds
    probability = now.with_raised_fault_odds.probability
    n_kinds, n_searches = len(now.kinds), len(now.kinds) if each else _SEARCHED_PER_READING
    for k in np.roll(np.arange(n_kinds), -(len(problems[0].recording) % n_kinds)).tolist():
        kind, problem = now.kinds[k], problems[k]
        if not kind.left_out:
            continue
        alike = [j for j, other in enumerate(now.kinds) if other.shape == kind.shape and j != k]
        plain = next(j for j in alike if not now.kinds[j].left_out)
        own = particles[k]
        beyond = own.log_z < particles[plain].log_z - _NESTED
        hopeless = float(log_odds.max()) - kind.log_prior - _BEHIND
        may_search = n_searches > 0 and own.is_search_old(len(problem.recording))
        matters = each and may_search and probability[k] > HAS_A_SAY
        wanted = matters or (each and not own.refitted) or beyond or own.strained or own.hurried
        if not wanted or (own.log_z_limit < hopeless and (own.limit_is_searched or not each)):
            continue
        best = max(alike, key=lambda j: log_odds[j])
        donors = [now.particles[j].weighted for j in {plain, best} if now.particles[j].log_z > -math.inf]
        donors += [own.weighted] if own.log_z > hopeless else []
        n = max(len(own.ancestor), n_samples_of_kind(kind, 0.0, n_particles))
        anew = sample_near_other_kinds(kind, problem, own=own.weighted, donors=donors, n=n, hopeless=hopeless, rng=rng)
        few = _LEAST_FOUND if kind.effect is not None else WELL_FOUND
        if may_search and (matters or not anew.is_reproduced or (each and anew.n_eff < few)):
            n_searches -= 1
            anew = sample_from_scratch(problem, own.weighted, n, hopeless, rng, from_scratch)
            own = replace(own, searched_at=len(problem.recording))
        particles[k] = _replaced_if_better(own, anew, n, problem, hopeless, rng)
    return particles


def _replaced_if_better(
    own: Particles, anew: SamplesAnew, n: int, problem: SensorProblem, hopeless: float, rng: np.random.Generator
) -> Particles:
    """Return `n` of the samples taken anew if these have enough evidence and effective draws, else the kind's own.

    If the largest log evidence found is below `hopeless`, return the kind's own samples with a limit of their evidence.
    """
    found = anew.samples
    if anew.highest_log_z < hopeless:
        limit = max(anew.highest_log_z, own.log_z) + _RULED_OUT
        return replace(own, log_z_limit=limit, limit_is_searched=anew.is_searched) if anew.is_reproduced else own
    if found is None or found.n_eff < _FEWEST:
        return replace(own, strained=own.strained or own.hurried)
    if found.log_z < own.log_z + (TOLD_APART if found.n_eff < _LEAST_FOUND else -CARRIED_ERROR):
        return own
    fresh = with_bridged_evidence(particles_from_posterior(found, n, problem, rng=rng, effort=BRIEF), problem, rng)
    if anew.is_searched and not own.strained and fresh.log_z < own.log_z - CARRIED_ERROR:
        return own
    return replace(
        fresh,
        searched_at=own.searched_at,
        refitted=anew.is_reproduced and found.n_eff >= WELL_FOUND,
        strained=found.n_eff < _LEAST_FOUND,
    )
