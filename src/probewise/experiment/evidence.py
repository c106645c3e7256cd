"""The evidence of kinds of hypotheses, from the prior.

Samples that are carried from reading to reading keep only the modes that they have, and their evidence accumulates
errors. So a rival is looked at to first order, about the samples of the plain sensor, until its prior is searched: in
doubt for a few kinds at a time, and before a run ends for all whose samples are doubtful or may lack a probable mode. A
quick run of nested sampling finds the modes; importance sampling about its samples and the carried ones gives evidence
and samples. A kind so improbable that perfect predictions of all readings since could not revive it is suspended until
they could.
"""

from __future__ import annotations

import math
import operator
import warnings
from dataclasses import replace

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.errors import DoubtfulResultWarning, NotConvergedError
from probewise.experiment.kinds import KindProblem, PosteriorByKind, n_samples_of_kind
from probewise.inquiry.smc import BRIEF, LocalKernels, Particles, nested_sampling_from_scratch, particles_from_posterior
from probewise.nested import Weighted
from probewise.nested.importance import evenly_weighted, weighted_draws
from probewise.priors import Prior

_SEARCH_ABOVE = 1e-4  # raised probability of a doubtful or suspended kind, from which on it is searched
_SEARCH_AT_END_ABOVE = 0.02  # raised probability of a missing mode, from which on it is searched for before the end
_SUSPEND_BELOW = 1e-8  # raised probability below which a kind is suspended
_N_SEARCHED_PER_READING = 2  # of the unsure the most probable, and as many with the most probable missing modes
_MOVES_PER_POINT = 4.0  # of each new live point: its samples are only where draws are made
_FAR_BEHIND_NATS = 20.0  # below the search's log evidence, from which on nothing is drawn about carried samples
_LOST_SHARE = 0.05  # of a posterior that may lie outside the samples' range, besides what chance leaves there
_LOST_NATS = 3.0  # few draws overrate the evidence by as much in 5 % of cases at most (Markov's inequality)
_LEAST_N_EFF, _ENOUGH_N_EFF = 15.0, 100.0  # effective draws for importance sampling to count, and to end
_N_ROUNDS = 3  # of importance sampling, each about the draws of those before
_WIDE_FACTOR, _WIDE_SHARE = 3.0, 0.15  # of kernels that reach beyond the samples: factor on their width; their share


def can_suspend_mask(now: PosteriorByKind) -> BoolArray:
    """Mark the kinds whose samples need not follow the next reading, (n_kinds,).

    A search of the prior gave such a kind a very low evidence, and it would still be improbable if it had predicted
    every reading since exactly, as its stated evidence then assumes.
    """
    raised = now.with_raised_left_out_odds().probability
    known = np.array([p.suspended or (p.lost_log_z < math.inf and not p.is_doubtful) for p in now.particles])
    return np.asarray(known & (raised < _SUSPEND_BELOW) & now.doubts_sensor)


def sleeping_mask(now: PosteriorByKind) -> BoolArray:
    """Mark the rivals whose prior was never searched, which are looked at to first order, (n_kinds,)."""
    kinds = zip(now.kinds, now.particles, strict=True)
    return np.array([kind.left_out != "" and samples.lost_log_z == math.inf for kind, samples in kinds])


def with_evidence_from_prior(
    now: PosteriorByKind,
    problems: list[KindProblem],
    n_particles: int,
    n_live: int,
    *,
    at_end: bool,
    rng: np.random.Generator,
) -> PosteriorByKind:
    """Return the posterior with evidence and samples of the unsure kinds by a search of the prior.

    `problems` are those of the kinds, given all readings; `n_particles` the samples of a probable kind. A kind is
    unsure if its samples are doubtful (`Particles.is_doubtful`), if it is suspended and its raised probability above
    1e-4, or if its prior was never searched. After a reading, a few unsure kinds are searched; those below 1e-4 or
    merely never searched only in doubt: while doubtful kinds, or left-out effects, have over half of the probability.
    Before the run ends, all are, the most probable four first, and those where a missing mode could have a probability
    above 0.02; where there are none, `now` itself is returned. Where no effect can be left out, only probable kinds
    are, and their samples change only if they had lost a mode.
    """
    possible, by_raised = np.isfinite(now.log_odds).any(), now.with_raised_left_out_odds()
    raised = by_raised.probability if possible else np.ones(len(problems))
    suspended, doubtful = (np.array([getattr(p, name) for p in now.particles]) for name in ("suspended", "is_doubtful"))
    lost_log_z, matters = np.array([p.lost_log_z for p in now.particles]), raised > _SEARCH_ABOVE
    unsure = np.where(suspended, matters, doubtful | (lost_log_z == math.inf))
    log_lost = lost_log_z + np.array([kind.log_prior for kind in by_raised.kinds])
    if at_end:
        unsure |= log_lost > by_raised.log_z + math.log(_SEARCH_AT_END_ABOVE)
        due = np.flatnonzero(unsure & (now.doubts_sensor | (raised > _SEARCH_AT_END_ABOVE)))
        due = due[np.argsort(-raised[due], kind="stable")][: 2 * _N_SEARCHED_PER_READING]
    else:
        in_doubt = raised[doubtful].sum() > 0.5 or (now.doubts_sensor and possible and now.left_out[""] < 0.5)
        unsure &= np.full(len(raised), in_doubt) | ((doubtful | suspended) & matters)
        likely, open_ones = np.lexsort((-raised, ~unsure)), np.lexsort((-raised, -log_lost, ~unsure))
        due = np.unique(np.concatenate([likely[:_N_SEARCHED_PER_READING], open_ones[:_N_SEARCHED_PER_READING]]))
        due = due[unsure[due]]
    if not due.size:
        return now
    particles, leader = list(now.particles), now.most_probable_kind_index
    leading = now.particles[leader].weighted
    for k in due.tolist():
        carried, kind, problem = particles[k], now.kinds[k], problems[k]
        n = max(len(carried.ancestor), n_samples_of_kind(kind, float(raised[k]), n_particles))
        start = carried.with_zero_evidence() if carried.suspended else carried
        others = None
        if kind.shape == now.kinds[leader].shape and k != leader:
            others = _beside(leading, leading.draw_rows(n // 2, rng=rng), kind.prior, rng)
        found = posterior_from_prior(start.weighted, problem, n, n_live, rng, others=others)
        if found is None:
            none = carried.with_zero_evidence()
            particles[k] = replace(none, strained=False, hurried=False, suspended=False, lost_log_z=-math.inf)
        elif not (carried.is_doubtful or now.doubts_sensor or _has_lost_mode(carried.weighted, found)):
            particles[k] = carried.searched(found.log_z)
        else:
            fresh = particles_from_posterior(found, n, problem, rng=rng, effort=BRIEF)
            particles[k] = fresh.searched(found.log_z)
    return replace(now, particles=tuple(particles))


def to_first_order(carried: Particles, problem: KindProblem, plain: Weighted, rng: np.random.Generator) -> Particles:
    """Return a rival's samples and evidence about those of the `plain` sensor over the same shape.

    Shapes are drawn from the plain sensor's posterior and the effect from its prior; the mean ratio of the likelihoods
    is that of the evidences. It is seldom precise, and tells whether anything speaks for the rival.
    """
    rows = plain.draw_rows(len(carried.ancestor), rng=rng)
    theta = _beside(plain, rows, problem.prior, rng)
    log_likelihood = problem.log_likelihood(theta)
    if not np.isfinite(log_likelihood).any():
        return carried.with_zero_evidence()
    log_ratio = log_likelihood - plain.log_likelihood[rows]
    drawn = weighted_draws(problem.prior.names, theta, log_likelihood, log_ratio, len(rows))
    n_calls = carried.weighted.n_calls + len(rows)
    return replace(carried, weighted=replace(drawn, log_z=plain.log_z + drawn.log_z, n_calls=n_calls))


def _beside(samples: Weighted, rows: IntArray, prior: Prior, rng: np.random.Generator) -> FloatArray:
    """Draw from a prior, with the sensor's and the shape's parameters, which come first, from `rows` of samples."""
    theta = prior.from_unit_cube(rng.random((len(rows), len(prior.names))))
    n_shared = sum(map(operator.eq, prior.names, samples.names))
    theta[:, :n_shared] = samples.theta[rows, :n_shared]
    return theta


def posterior_from_prior(
    carried: Weighted,
    problem: KindProblem,
    n: int,
    n_live: int,
    rng: np.random.Generator,
    *,
    others: FloatArray | None = None,
) -> Weighted | None:
    """Return samples and evidence of a problem by a search of the prior; None if nothing could give the readings.

    `carried` are the samples so far; `others` have the leading kind's shape and all else from the prior, for modes that
    the search may miss. Where importance sampling has few effective draws (modes too many or too bent),
    the better of search and carried samples counts as it is, unless both have lost a mode that the draws found.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DoubtfulResultWarning)
            result = nested_sampling_from_scratch(problem, n_live=n_live, moves=_MOVES_PER_POINT, rng=rng)
    except NotConvergedError:
        return None
    points = result.samples(n, rng=rng)
    at = problem.log_likelihood(points)
    log_z, error = result.log_z, result.log_z_error
    best = evenly_weighted(problem.prior.names, points, at, log_z=log_z, log_z_error=error)
    if carried.log_z > result.log_z - _FAR_BEHIND_NATS:
        best = max(best, carried, key=lambda samples: samples.log_z)
        points = np.concatenate([points, carried.samples(n // 2, rng=rng)])
    if others is not None:
        points = np.concatenate([points, others])
    for _ in range(_N_ROUNDS):
        drawn = sampled_about_points(points, problem, 2 * n, rng)
        if drawn is None:
            break
        if drawn.n_eff > _LEAST_N_EFF or drawn.log_z > best.log_z + _LOST_NATS:
            best = drawn
        if drawn.n_eff > _ENOUGH_N_EFF:
            break
        points = np.concatenate([points, drawn.samples(n, rng=rng)])
    return replace(best, n_calls=carried.n_calls + result.n_calls + 2 * n)


def _has_lost_mode(carried: Weighted, found: Weighted) -> bool:
    """Return whether 5 % more of a posterior than by chance lies outside the samples' range in some parameter."""
    kept = carried.theta[carried.weight > 0]
    outside = ((found.theta < kept.min(axis=0)) | (found.theta > kept.max(axis=0))).any(axis=1)
    return bool(found.weight[outside].sum() - 2 * kept.shape[1] / (len(kept) + 1) > _LOST_SHARE)


def sampled_about_points(
    points: FloatArray, problem: KindProblem, n_draws: int, rng: np.random.Generator
) -> Weighted | None:
    """Sample a posterior by draws from kernels about points near it, (n_points, n_params); None if none is possible."""
    near, far = (LocalKernels.fitted_to(points, rng=rng, widened=times) for times in (1.0, _WIDE_FACTOR))
    n_far = round(_WIDE_SHARE * n_draws)
    draws = np.concatenate([near.draw(n_draws - n_far, rng=rng), far.draw(n_far, rng=rng)])
    theta = draws[np.isfinite(problem.prior.log_prob(draws))]
    log_likelihood = problem.log_likelihood(theta) if len(theta) else np.empty(0)
    alive = np.isfinite(log_likelihood)
    if not alive.any():
        return None
    theta, log_likelihood = theta[alive], log_likelihood[alive]
    log_near, log_far = (kernels.log_density(theta) for kernels in (near, far))
    log_density = np.logaddexp(log_near + math.log1p(-_WIDE_SHARE), log_far + math.log(_WIDE_SHARE))
    log_ratio = problem.prior.log_prob(theta) + log_likelihood - log_density
    return weighted_draws(problem.prior.names, theta, log_likelihood, log_ratio, n_draws)
