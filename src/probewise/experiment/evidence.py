"""The evidence of kinds of hypotheses, from the prior.

Samples that are carried from reading to reading keep only the modes that they have, and their evidence accumulates
errors. One rule sets that right: kinds are solved from the prior, at a doubt a few at a time, and before a run ends
all whose samples had difficulties or may lack a mode that could matter by now. A quick run of nested sampling finds the
modes; importance sampling about its samples and the carried ones gives evidence and samples. A kind that is so far
behind that perfect predictions of all readings since could not bring it back sleeps until they could.
"""

from __future__ import annotations

import math
import operator
import warnings
from dataclasses import replace

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import DoubtfulResultWarning, NotConvergedError
from probewise.experiment.kinds import KindProblem, Posterior, n_samples_of_kind
from probewise.inquiry.smc import BRIEF, LocalKernels, nested_sampling_from_scratch, particles_from_posterior
from probewise.nested import Weighted
from probewise.nested.importance import evenly_weighted, weighted_draws

_MATTERS = 1e-4  # probability, by the raised odds, from which on a kind is solved at a doubt, and wakes
_HAS_A_SAY = 0.02  # probability, by the raised odds, from which on a lost mode is searched for before a run ends
_SLEEPS = 1e-8  # probability, by the raised odds, below which a kind falls asleep
_EACH = 2  # kinds that are solved after a reading: the most probable of the unsure, and those that most could matter
_MOVES = 4.0  # of each new live point: its samples are only where draws are made
_BEHIND = 20.0  # nats behind what the prior's search found, from which on carried samples are not drawn about
_LOST_SHARE = 0.05  # of a posterior that may lie outside the samples' range, besides what chance leaves there
_LOST_NATS = 3.0  # few draws overrate the evidence by as much in 5 % of cases at most (Markov's inequality)
_FOUND, _WELL_FOUND = 15.0, 100.0  # effective draws from which on importance sampling counts, and need not go on
_ROUNDS = 3  # of importance sampling, each about the draws of those before
_WIDE, _OF_WIDE = 3.0, 0.15  # factor on the width of some kernels, beyond the samples they are fitted to; their share


def can_sleep_mask(now: Posterior) -> BoolArray:
    """Mark the kinds whose samples need not follow the next reading, (n_kinds,).

    A search of the prior has found that such a kind is far behind, and even if it had predicted every reading since
    exactly, it would be; which is what its evidence then says.
    """
    raised = now.with_raised_fault_odds().probability
    known = np.array([p.asleep or (p.lost_log_z < math.inf and not p.is_doubtful) for p in now.particles])
    return np.asarray(known & (raised < _SLEEPS) & now.doubts_sensor)


def with_evidence_from_prior(
    now: Posterior,
    problems: list[KindProblem],
    n_particles: int,
    n_live: int,
    *,
    at_end: bool,
    rng: np.random.Generator,
) -> Posterior:
    """Return the posterior with the kinds in doubt solved from the prior; before a run ends, all that could matter.

    `problems` are those of the kinds, given all readings; `n_particles` the samples of a probable kind. Unsure is a
    kind whose samples followed a reading with difficulty or were woken, and in doubt one never solved, too. After a
    reading, a few of these are solved; before a run ends, all, with those in which a mode could matter that the samples
    lack: they lose one without a sign. Where no effect can be left out, the end changes samples only if they had lost
    a mode.
    """
    possible, by_raised = np.isfinite(now.log_odds).any(), now.with_raised_fault_odds()
    raised = by_raised.probability if possible else np.ones(len(problems))
    asleep, doubtful = (np.array([getattr(p, name) for p in now.particles]) for name in ("asleep", "is_doubtful"))
    lost, matters = np.array([p.lost_log_z for p in now.particles]), raised > _MATTERS
    unsure = np.where(asleep, matters, doubtful | (lost == math.inf))
    log_lost = lost + np.array([kind.log_prior for kind in by_raised.kinds])
    if at_end:
        unsure |= log_lost > by_raised.log_z + math.log(_HAS_A_SAY)
        due = np.flatnonzero(unsure & (now.doubts_sensor | (raised > _HAS_A_SAY)))
    else:
        in_doubt = raised[doubtful].sum() > 0.5 or (now.doubts_sensor and possible and now.left_out[""] < 0.5)
        unsure &= np.full(len(raised), in_doubt) | ((doubtful | asleep) & matters)
        likely, open_ones = np.lexsort((-raised, ~unsure)), np.lexsort((-raised, -log_lost, ~unsure))
        due = np.unique(np.concatenate([likely[:_EACH], open_ones[:_EACH]]))
        due = due[unsure[due]]
    particles, leader = list(now.particles), now.most_probable_kind_index
    leading = now.particles[leader].weighted
    for k in due.tolist():
        own, kind, problem = particles[k], now.kinds[k], problems[k]
        n = max(len(own.ancestor), n_samples_of_kind(kind, float(raised[k]), n_particles))
        carried = own.with_zero_evidence() if own.asleep else own
        others = None
        if kind.shape == now.kinds[leader].shape and k != leader:
            others = kind.prior.from_unit_cube(rng.random((n // 2, len(kind.prior.names))))
            n_shared = sum(map(operator.eq, kind.prior.names, leading.names))  # the sensor's and the shape's come first
            others[:, :n_shared] = leading.samples(n // 2, rng=rng)[:, :n_shared]
        found = posterior_from_prior(carried.weighted, problem, n, n_live, rng, others=others)
        keep = not own.is_doubtful and not now.doubts_sensor and not (found and _has_lost_mode(own.weighted, found))
        if found is None:
            none = own.with_zero_evidence()
            particles[k] = replace(none, strained=False, hurried=False, asleep=False, lost_log_z=-math.inf)
        elif keep:
            particles[k] = own.searched(found.log_z)
        else:
            fresh = particles_from_posterior(found, n, problem, rng=rng, effort=BRIEF)
            particles[k] = fresh.searched(found.log_z)
    return replace(now, particles=tuple(particles))


def posterior_from_prior(
    own: Weighted,
    problem: KindProblem,
    n: int,
    n_live: int,
    rng: np.random.Generator,
    *,
    others: FloatArray | None = None,
) -> Weighted | None:
    """Return samples and evidence of a problem by a search of the prior; None if nothing could give the readings.

    `own` are samples that were carried; `others` have the shape as the leading kind has it, all else from the prior,
    for modes that the search may miss. Where importance sampling has few effective draws (modes too many or too bent),
    the better of search and carried samples counts as it is, unless both have lost a mode that the draws found.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DoubtfulResultWarning)
            result = nested_sampling_from_scratch(problem, n_live=n_live, moves=_MOVES, rng=rng)
    except NotConvergedError:
        return None
    points = result.samples(n, rng=rng)
    at = problem.log_likelihood(points)
    log_z, error = result.log_z, result.log_z_error
    best = evenly_weighted(problem.prior.names, points, at, log_z=log_z, log_z_error=error)
    if own.log_z > result.log_z - _BEHIND:
        best = max(best, own, key=lambda found: found.log_z)
        points = np.concatenate([points, own.samples(n // 2, rng=rng)])
    if others is not None:
        points = np.concatenate([points, others])
    for _ in range(_ROUNDS):
        drawn = sampled_about_points(points, problem, 2 * n, rng)
        if drawn is None:
            break
        if drawn.n_eff > _FOUND or drawn.log_z > best.log_z + _LOST_NATS:
            best = drawn
        if drawn.n_eff > _WELL_FOUND:
            break
        points = np.concatenate([points, drawn.samples(n, rng=rng)])
    return replace(best, n_calls=own.n_calls + result.n_calls + 2 * n)


def _has_lost_mode(own: Weighted, found: Weighted) -> bool:
    """Return whether 5 % more of a posterior than by chance lies outside the samples' range in some parameter."""
    kept = own.theta[own.weight > 0]
    outside = ((found.theta < kept.min(axis=0)) | (found.theta > kept.max(axis=0))).any(axis=1)
    return bool(found.weight[outside].sum() - 2 * kept.shape[1] / (len(kept) + 1) > _LOST_SHARE)


def sampled_about_points(
    points: FloatArray, problem: KindProblem, n_draws: int, rng: np.random.Generator
) -> Weighted | None:
    """Sample a posterior by draws from kernels about points near it, (n_points, n_params); None if none is possible."""
    near, far = (LocalKernels.fitted_to(points, rng=rng, widened=times) for times in (1.0, _WIDE))
    n_far = round(_OF_WIDE * n_draws)
    draws = np.concatenate([near.draw(n_draws - n_far, rng=rng), far.draw(n_far, rng=rng)])
    theta = draws[np.isfinite(problem.prior.log_prob(draws))]
    log_likelihood = problem.log_likelihood(theta) if len(theta) else np.empty(0)
    alive = np.isfinite(log_likelihood)
    if not alive.any():
        return None
    theta, log_likelihood = theta[alive], log_likelihood[alive]
    log_near, log_far = (kernels.log_density(theta) for kernels in (near, far))
    log_density = np.logaddexp(log_near + math.log1p(-_OF_WIDE), log_far + math.log(_OF_WIDE))
    log_ratio = problem.prior.log_prob(theta) + log_likelihood - log_density
    return weighted_draws(problem.prior.names, theta, log_likelihood, log_ratio, n_draws)
