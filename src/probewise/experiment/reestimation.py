"""Samples and evidences of kinds of hypotheses, estimated again where those carried along may be wrong.

Samples that are carried from reading to reading keep only the modes that they have, and their evidence accumulates
errors. `reestimated_after_reading` and `reestimated_before_end` set that right; nobody else needs what stands below
them. They draw from fits to all readings that start at samples of other kinds, from kernels about samples, or from
nested sampling. Evidences are by importance sampling or by bridge sampling (Meng & Wong 1996), which do not depend on
the history.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import expit, logsumexp

from probewise._arrays import FloatArray, IntArray
from probewise.errors import DoubtfulResultWarning, NotConvergedError
from probewise.experiment.kinds import HypothesisKind, Posterior, n_samples_of_kind
from probewise.experiment.noise_rivals import DeclaredNoise
from probewise.experiment.rivals import EACH_S, paced_time_s
from probewise.experiment.smc import BRIEF, LocalKernels, Particles, evenly_weighted, particles_from_posterior
from probewise.inference.problem import SensorProblem
from probewise.nested import LIVE_PER_PARAM, KernelMove, NestedResult, RemainingEvidence, Weighted, pareto_k, run
from probewise.nested.weights import n_effective, resampled_rows
from probewise.priors import Prior

# When a kind is estimated again. Thresholds on log evidences are in nats.
_MOST_OFF = 0.02  # by which a kind's probability may be wrong
_DOUBTED_OFF = 0.06  # the same in a run that doubts its sensor, where no decision hangs on less
_OFF_AT_THE_END = 0.5  # the same where samples have just been drawn again
_HOPELESS = 60.0  # behind the best kind, from which on no evidence is estimated again
_HAS_A_SAY = 0.02  # probability of a kind in doubt that is solved from scratch; before a run ends, of every kind
_CARRIED_ERROR = 0.25  # by which a carried evidence may be wrong that genealogies do not tell
_STRAINED = 6.0  # the same where samples could not follow
_TOLD_APART = 1.5  # between an evidence carried and one estimated again, from which on the samples are in doubt
_LOST = 0.01  # probability of a kind that must not be missed
_LOST_SHARE = 0.05  # of a posterior that may lie beyond all of a kind's samples, besides what chance leaves there
_NESTED = 6.0  # by which a rival may be less likely than the plain model, which is a case of it
_BEHIND = 9.0  # behind the best kind, from which on a rival is not sampled again
_RULED_OUT = 10.0  # by which fits and a kind's own samples may miss its evidence, where both are behind
_SEARCHED_PER_READING = 1  # kinds that are searched from scratch after a reading; before a run ends, all that need it

# How many effective draws make a sample good.
_FEWEST = 4.0  # below which a sample replaces none
_LEAST_FOUND = 15.0  # from which on a sample replaces another of about the same evidence
_WELL_FOUND = 100.0  # from which on samples need not be drawn again until a reading strains them
_LEAST_POSSIBLE = 10  # possible draws from which on they are weighed
_MOST_DRAWS = 1500
_BRIDGE_DRAWS = 1000

# Fits of a kind from samples of other kinds.
_STARTS = 90
_STEPS = 8
_REPRODUCED = 5  # of the starts, which must lead to fits as good as the best: otherwise better ones may be missed
_STIFF = 1e12  # stiffness of a parameter that does not move, in inverse squares of its scale
_NUDGE = 1e-3  # of a parameter's scale: the finite difference
_KEPT = 45  # fits that carry a Gaussian
_WORSE = 8.0  # nats behind the best fit, from which on a fit carries none
_AS_GOOD = 0.5  # nats behind the best fit, up to which a fit is as good
_WIDER = 1.4  # factor on the width of these Gaussians
_IN_GAP = 0.4  # of the gap between two readings: sd of a change point within it
_JITTER = 1e-9

# Kernels about samples.
_KERNELS = 75
_FAR = 2.5  # factor on the width of some kernels, so that draws extend beyond the samples of a first draw
_WIDE = 3.0  # the same beyond samples that were carried
_OF_WIDE = 0.15  # share of the draws from those
_BRIDGE_STEPS = 60
_CLOSE = 1e-4
_UNKNOWN = 2.0  # nats: error of an evidence that cannot be estimated again
_DLOGZ = 0.5  # the final live points are posterior samples too; a smaller value would only refine log Z


def reestimated_after_reading(
    now: Posterior, problems: list[SensorProblem], n_particles: int, n_live: int, *, rng: np.random.Generator
) -> Posterior:
    """Return the posterior after a reading, with samples and evidences estimated again where they are in doubt.

    `problems` are those of the kinds, given all readings; `n_particles` the samples of a probable kind, `n_live` the
    live points of nested sampling.
    """
    if not now.doubts_sensor:
        return _with_doubtful_evidences_reestimated(now, problems, n_particles, n_live, rng, most_off=_MOST_OFF)
    now = _with_rivals_sampled_again(now, problems, n_particles, n_live, rng, at_end=False)
    particles = [
        _with_bridged_evidence(p, problem, rng) if p.hurried and odds > now.log_odds.max() - _HOPELESS else p
        for p, problem, odds in zip(now.particles, problems, now.log_odds, strict=True)
    ]
    now = replace(now, particles=tuple(particles))
    n_draws = min(n_particles, _MOST_DRAWS)
    return _with_doubtful_evidences_reestimated(now, problems, n_draws, n_live, rng, most_off=_DOUBTED_OFF)


def reestimated_before_end(
    now: Posterior, problems: list[SensorProblem], n_particles: int, n_live: int, *, rng: np.random.Generator
) -> Posterior:
    """Return the posterior with kinds sampled again whose samples may have lost the truth; parameters as above.

    Rivals stay as they are if they are hopelessly improbable, or were sampled in this way before and have followed the
    readings since. The search for lost modes draws from a generator of its own: if none was lost, the run goes on as
    without it.
    """
    rng_of_search = rng.spawn(1)[0]
    if now.doubts_sensor:
        now = _with_rivals_sampled_again(now, problems, n_particles, n_live, rng, at_end=True)
        n_draws = min(n_particles, _MOST_DRAWS)
        now = _with_doubtful_evidences_reestimated(now, problems, n_draws, n_live, rng, most_off=_OFF_AT_THE_END)
    return _with_lost_modes_found(now, problems, n_live, rng_of_search)


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


def _with_rivals_sampled_again(
    now: Posterior, problems: list[SensorProblem], n_particles: int, n_live: int, rng: np.random.Generator, at_end: bool
) -> Posterior:
    """Return the posterior with rivals sampled again where their samples may have lost the truth.

    A rival (a kind with a left-out effect) is sampled again if its samples are strained or hurried, or if its evidence
    is over 6 nats below that of the sensor model alone, which the rival contains as the case of no effect; `at_end`,
    all rivals are, except those with `refitted` samples. A rival with too low a limit of evidence stays as it is.

    Fits that start at samples of other kinds come first. If few of the fits reach the best one, the rival is searched
    from scratch: one rival per reading in turn; `at_end` as many as need it, and all with a probability above 2 %. A
    search holds for five readings if the samples follow with ease.
    """
    particles, log_odds = list(now.particles), now.log_odds
    probability = now.with_raised_fault_odds().probability
    n_kinds, n_readings = len(now.kinds), len(problems[0].recording)
    n_searches = n_kinds if at_end else _SEARCHED_PER_READING
    for k in np.roll(np.arange(n_kinds), -(n_readings % n_kinds)).tolist():
        kind, problem, own = now.kinds[k], problems[k], particles[k]
        if not kind.left_out:
            continue
        alike = [j for j, other in enumerate(now.kinds) if other.shape == kind.shape and j != k]
        plain = next(j for j in alike if not now.kinds[j].left_out)
        below = own.log_z < particles[plain].log_z - _NESTED
        hopeless = float(log_odds.max()) - kind.log_prior - _BEHIND
        may_search = n_searches > 0 and own.is_search_old(n_readings)
        matters = at_end and may_search and probability[k] > _HAS_A_SAY
        wanted = matters or (at_end and not own.refitted) or below or own.strained or own.hurried
        if not wanted or (own.log_z_limit < hopeless and (own.limit_is_searched or not at_end)):
            continue
        best = max(alike, key=lambda j: log_odds[j])
        donors = [now.particles[j].weighted for j in {plain, best} if now.particles[j].log_z > -math.inf]
        donors += [own.weighted] if own.log_z > hopeless else []
        n = max(len(own.ancestor), n_samples_of_kind(kind, 0.0, n_particles))
        fresh = _sample_near_other_kinds(kind, problem, own.weighted, donors, n, hopeless, rng)
        few = _LEAST_FOUND if kind.effect is not None else _WELL_FOUND
        if may_search and (matters or not fresh.is_reproduced or (at_end and fresh.n_eff < few)):
            n_searches -= 1
            fresh = _sample_from_scratch(problem, own.weighted, n, hopeless, n_live, rng)
            own = replace(own, searched_at=n_readings)
        particles[k] = _replaced_if_better(own, fresh, n, problem, hopeless, rng)
    return replace(now, particles=tuple(particles))


def _replaced_if_better(
    own: Particles, fresh: _FreshSamples, n: int, problem: SensorProblem, hopeless: float, rng: np.random.Generator
) -> Particles:
    """Return `n` of the fresh samples if these have enough evidence and effective draws, else the kind's own.

    If the largest log evidence found is below `hopeless`, return the kind's own samples with a limit of their evidence.
    """
    found = fresh.samples
    if fresh.highest_log_z < hopeless:
        limit = max(fresh.highest_log_z, own.log_z) + _RULED_OUT
        return replace(own, log_z_limit=limit, limit_is_searched=fresh.is_searched) if fresh.is_reproduced else own
    if found is None or found.n_eff < _FEWEST:
        return replace(own, strained=own.strained or own.hurried)
    if found.log_z < own.log_z + (_TOLD_APART if found.n_eff < _LEAST_FOUND else -_CARRIED_ERROR):
        return own
    anew = _with_bridged_evidence(particles_from_posterior(found, n, problem, rng=rng, effort=BRIEF), problem, rng)
    if fresh.is_searched and not own.strained and anew.log_z < own.log_z - _CARRIED_ERROR:
        return own
    return replace(
        anew,
        searched_at=own.searched_at,
        refitted=fresh.is_reproduced and found.n_eff >= _WELL_FOUND,
        strained=found.n_eff < _LEAST_FOUND,
    )


def _with_doubtful_evidences_reestimated(
    now: Posterior, problems: list[SensorProblem], n: int, n_live: int, rng: np.random.Generator, *, most_off: float
) -> Posterior:
    """Re-estimate evidences until no kind's error of evidence could change its probability by more than `most_off`."""
    settled = set[int]()
    while (k := _kind_with_most_doubtful_evidence(now, settled, most_off)) is not None:
        settled.add(k)
        particles = list(now.particles)
        particles[k] = _reestimate_kind(particles[k], problems[k], n, n_live, rng)
        now = replace(now, particles=tuple(particles))
    return now


def _kind_with_most_doubtful_evidence(now: Posterior, settled: set[int], most_off: float) -> int | None:
    """Return the index of the kind whose error of evidence changes its probability most; None: none above `most_off`.

    A kind with strained samples comes first: with left-out effects among the kinds, if its probability is above 2 %;
    otherwise, if an error of 6 nats could bring its probability above 1 % or below 99 %.
    """
    log_odds = now.log_odds
    off = np.zeros(len(log_odds))
    for k, particles in enumerate(now.particles):
        if k in settled:
            continue
        others = np.delete(log_odds, k)
        if particles.log_z == -math.inf or not np.isfinite(others).any():
            off[k] = 1.0 if particles.strained else 0.0
            continue
        odds = log_odds[k] - float(logsumexp(others))
        doubt = 2 * particles.log_z_error + (_CARRIED_ERROR if particles.n_resampled else 0.0)
        p, low, high, least, most = (float(expit(odds + by)) for by in (0.0, -doubt, doubt, -_STRAINED, _STRAINED))
        off[k] = max(p - low, high - p)
        may_be_right = most > _LOST and least < 1 - _LOST
        if particles.strained and (p > _HAS_A_SAY if now.doubts_sensor else may_be_right):
            off[k] = 1.0
    return int(off.argmax()) if off.max() > most_off else None


def _reestimate_kind(
    particles: Particles, problem: SensorProblem, n: int, n_live: int, rng: np.random.Generator
) -> Particles:
    """Re-estimate a kind's evidence by bridge sampling; if strained or far off, its samples too, from scratch."""
    had = particles.weighted
    if not particles.strained:
        found = bridged_evidence(had, problem, rng=rng, n_draws=n)
        if abs(found.log_z - had.log_z) < _TOLD_APART:
            return _restarted_with_evidence(particles, found)
    try:
        result = nested_sampling_from_scratch(problem, n_live=n_live, rng=rng)
    except NotConvergedError:  # no hypothesis of this kind could have given the readings
        return replace(particles.with_zero_evidence(), strained=False)
    drawn = _samples_from_run(result, had, problem, n, rng, with_own=particles.log_z > -math.inf)
    fresh = particles_from_posterior(drawn, n, problem, rng=rng)
    fresh = _restarted_with_evidence(fresh, bridged_evidence(fresh.weighted, problem, rng=rng, n_draws=n))
    return replace(fresh, weighted=replace(fresh.weighted, run=result), refitted=True)


def _with_lost_modes_found(
    posterior: Posterior, problems: list[SensorProblem], n_live: int, rng: np.random.Generator
) -> Posterior:
    """Return the posterior with modes that its samples had lost; unchanged if none were lost.

    A mode that held a percent of the posterior after six readings may hold all of it after ten; if its last samples
    died in between, nothing brings it back. Kinds without a left-out effect and with 2 % or more are searched, unless a
    recent search holds. A kind's samples are replaced by those of the search if 5 % more of the latter than by chance
    lie outside the range of the former in some parameter.
    """
    particles, n_readings = list(posterior.particles), len(problems[0].recording)
    for k, (kind, probability) in enumerate(zip(posterior.kinds, posterior.probability.tolist(), strict=True)):
        own, problem = particles[k], problems[k]
        if kind.left_out or probability < _HAS_A_SAY or not own.is_search_old(n_readings):
            continue
        particles[k] = own = replace(own, searched_at=n_readings)
        n = len(own.ancestor)
        found = _sample_from_scratch(problem, own.weighted, n, -math.inf, n_live, rng).samples
        if found is None:
            continue
        kept = own.weighted.theta[own.weighted.weight > 0]
        outside = ((found.theta < kept.min(axis=0)) | (found.theta > kept.max(axis=0))).any(axis=1)
        by_chance = 2 * kept.shape[1] / (len(kept) + 1)
        if float(found.weight[outside].sum()) - by_chance > _LOST_SHARE:
            fresh = _with_bridged_evidence(particles_from_posterior(found, n, problem, rng=rng), problem, rng)
            particles[k] = replace(fresh, searched_at=n_readings, refitted=True)
    return replace(posterior, particles=tuple(particles))


@dataclass(frozen=True, eq=False)
class _FreshSamples:
    """Samples of a kind drawn from all readings; None if none were found.

    `highest_log_z` is the largest log evidence by fits or by a search from scratch, infinite if neither was made;
    `is_reproduced` whether five starts or more led to fits as good as the best (True without fits); `is_searched`
    whether the samples come from a search from scratch.
    """

    samples: Weighted | None
    highest_log_z: float = math.inf
    is_reproduced: bool = True
    is_searched: bool = False

    @property
    def n_eff(self) -> float:
        """Effective number of the samples; 0 if `samples` is None."""
        return 0.0 if self.samples is None else self.samples.n_eff


def _sample_near_other_kinds(
    kind: HypothesisKind,
    problem: SensorProblem,
    own: Weighted,
    donors: list[Weighted],
    n: int,
    hopeless: float,
    rng: np.random.Generator,
) -> _FreshSamples:
    """Sample a kind's posterior starting from `donors`, samples of other kinds.

    A kind with an effect is fitted from these; a noise model is sampled by importance sampling about them. No samples
    are drawn if the largest log evidence by fits is below `hopeless`.
    """
    with_own = own.log_z > hopeless
    if kind.effect is None:
        n_own = len(kind.prior.names)
        points = [donor.samples(n // 2, rng=rng)[:, :n_own] for donor in (*donors, *([own] if with_own else ()))]
        return _FreshSamples(sampled_about_points(np.concatenate(points), problem, n, rng))
    noise = DeclaredNoise.from_likelihood(kind.likelihood)
    if noise is None:
        return _FreshSamples(None)
    fits = fit_kind(kind, problem, donors, noise_sd=math.hypot(noise.sd, noise.step / math.sqrt(12.0)), rng=rng)
    samples = None
    if fits.highest_log_z >= hopeless:
        samples = sampled_about_fits(fits, kind, problem, own, n_draws=2 * n, with_own=with_own, rng=rng)
    return _FreshSamples(samples, fits.highest_log_z, fits.n_as_good_as_best >= _REPRODUCED)


def _sample_from_scratch(
    problem: SensorProblem, own: Weighted, n: int, hopeless: float, n_live: int, rng: np.random.Generator
) -> _FreshSamples:
    """Sample a kind's posterior by a quick run of nested sampling, and near `own` unless its evidence is `hopeless`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DoubtfulResultWarning)  # its samples are only where draws are made
            result = nested_sampling_from_scratch(problem, n_live=n_live, rng=rng, quick=True)
    except NotConvergedError:
        return _FreshSamples(None, -math.inf, is_searched=True)
    samples = _samples_from_run(result, own, problem, n, rng, with_own=own.log_z > hopeless)
    return _FreshSamples(samples, result.log_z, is_searched=True)


def _samples_from_run(
    result: NestedResult, own: Weighted, problem: SensorProblem, n: int, rng: np.random.Generator, *, with_own: bool
) -> Weighted:
    """Return a kind's samples by importance sampling about those of a nested sampling run (and its own if `with_own`).

    If fewer than 100 effective draws result (modes too many or too bent), return the run's samples and evidence.
    """
    points = result.samples(n, rng=rng)
    about = np.concatenate([points, own.samples(n // 2, rng=rng)]) if with_own else points
    drawn = sampled_about_points(about, problem, 2 * n, rng)
    if drawn is None or drawn.n_eff < _WELL_FOUND:
        drawn = evenly_weighted(
            problem.prior.names,
            points,
            problem.log_likelihood(points),
            log_z=result.log_z,
            log_z_error=result.log_z_error,
            n_calls=n,
        )
    return replace(drawn, n_calls=own.n_calls + result.n_calls + drawn.n_calls)


@dataclass(frozen=True, eq=False)
class Fits:
    """Fits of a kind to all readings, `theta` (n_starts, n_params), from several starts.

    `score` is the log likelihood plus log prior of each fit, minus infinity if the fit failed; `precision` the inverse
    covariance about it, (n_starts, n_params, n_params).
    """

    theta: FloatArray
    score: FloatArray
    precision: FloatArray

    @cached_property
    def good_fit_rows(self) -> IntArray:
        """Rows of the fits whose `score` is less than 8 nats below the best, best first; empty if every fit failed."""
        order = np.argsort(-self.score)
        best = self.score[order[0]]
        return order[self.score[order] > best - _WORSE] if math.isfinite(best) else order[:0]

    @property
    def n_as_good_as_best(self) -> int:
        """Number of fits whose `score` is within 0.5 nats of the best, the best included."""
        return int(np.count_nonzero(self.score > self.score.max() - _AS_GOOD))

    @cached_property
    def log_z_by_fit(self) -> FloatArray:
        """Log evidence of the Gaussian about each good fit (Laplace), (n_good,), in the order of `good_fit_rows`."""
        log_det = np.linalg.slogdet(self.precision[self.good_fit_rows])[1]
        log_volume = 0.5 * self.theta.shape[1] * math.log(2 * math.pi) - 0.5 * log_det
        return np.asarray(self.score[self.good_fit_rows] + log_volume)

    @property
    def highest_log_z(self) -> float:
        """Largest of `log_z_by_fit`; minus infinity if no fit is good."""
        return float(self.log_z_by_fit.max(initial=-math.inf))


def fit_kind(
    kind: HypothesisKind,
    problem: SensorProblem,
    donors: Sequence[Weighted],
    *,
    noise_sd: float,
    rng: np.random.Generator,
) -> Fits:
    """Fit a kind with an effect on the noise-free reading to all readings, from 90 starts at samples of other kinds.

    The samples of a rival may have gathered where the earlier readings led them, with none where the truth is; other
    kinds may have samples there. Starts are samples of `donors`, with the effect's parameters drawn from their prior,
    and are fitted side by side (Levenberg-Marquardt); `noise_sd` is the sd of a reading's noise.
    """
    assert kind.effect is not None
    usable, plan = problem.recording.usable, problem.recording.plan
    readings = problem.recording.readings[usable]
    drawn = kind.prior.from_unit_cube(rng.random((2000, len(kind.prior.names))))
    low, high = np.quantile(drawn, [0.16, 0.84], axis=0)
    scale = np.maximum(0.5 * (high - low), 1e-12)
    theta = drawn[:_STARTS].copy()
    moments = [j for j, name in enumerate(kind.prior.names) if name.endswith(".at_s")]
    times_s = paced_time_s(plan)
    if moments and times_s is not None and len(times_s) > 1:
        # A change is seen by the gap between readings that it falls into, whatever the slope says.
        gap = rng.integers(1, len(times_s), len(theta))
        theta[:, moments] = (times_s[gap - 1] + rng.random(len(theta)) * (times_s[gap] - times_s[gap - 1]))[:, None]
        scale[moments] = _IN_GAP * EACH_S
    n, n_params = theta.shape
    n_shape = n_params - len(kind.effect.prior.names)
    for k, donor in enumerate(donors):
        theta[k :: len(donors), :n_shape] = donor.samples(_STARTS, rng=rng)[k :: len(donors), :n_shape]

    def predict(at: FloatArray) -> FloatArray:
        return np.asarray(problem.model.predict(at, plan)[:, usable])

    def negative_log_posterior(residual: FloatArray, at: FloatArray) -> FloatArray:
        cost = 0.5 * (residual**2).sum(axis=1) - kind.prior.log_prob(at)
        return np.where(np.isfinite(cost), cost, np.inf)

    ridge = np.eye(n_params) / scale**2
    residual = (readings - predict(theta)) / noise_sd
    cost, damping = negative_log_posterior(residual, theta), np.full(n, 1.0)
    normal = np.broadcast_to(ridge, (n, n_params, n_params)).copy()
    # Half of the starts keep their effect and fit the shape alone, so that fits lie along a ridge, not at its top only.
    of_effect = np.arange(n_params) >= n_shape
    stiffness = (np.arange(n) >= n // 2)[:, None, None] * np.diag(_STIFF * of_effect / scale**2)
    slope = np.empty((n, residual.shape[1], n_params))
    moved = np.arange(n)
    for _ in range(_STEPS):
        # A start that no step has moved keeps its slopes.
        if len(moved):
            at_theta = readings - noise_sd * residual[moved]
            own = _prediction_slopes(predict, theta[moved], at_theta, _NUDGE * scale) / noise_sd
            normal[moved] = own.transpose(0, 2, 1) @ own + ridge
            slope[moved] = own
        pull = (slope.transpose(0, 2, 1) @ residual[:, :, None])[:, :, 0]
        damped = normal + damping[:, None, None] * ridge * 10.0 + stiffness
        tried = theta + np.linalg.solve(damped, pull[:, :, None])[:, :, 0]
        possible = np.isfinite(kind.prior.log_prob(tried))
        tried = np.where(possible[:, None], tried, theta)
        at = (readings - predict(tried)) / noise_sd
        cost_there = negative_log_posterior(at, tried)
        better = cost_there < cost
        theta = np.where(better[:, None], tried, theta)
        residual = np.where(better[:, None], at, residual)
        cost = np.where(better, cost_there, cost)
        damping = np.clip(np.where(better, damping / 5.0, damping * 5.0), 1e-4, 1e8)
        moved = np.flatnonzero(better)
    score = np.full(n, -np.inf)
    alive = np.isfinite(cost)
    if alive.any():
        score[alive] = problem.log_likelihood(theta[alive]) + kind.prior.log_prob(theta[alive])
    return Fits(theta, np.where(np.isfinite(normal).all(axis=(1, 2)), score, -np.inf), normal)


def _prediction_slopes(
    predict: Callable[[FloatArray], FloatArray], theta: FloatArray, at_theta: FloatArray, nudge: FloatArray
) -> FloatArray:
    """Return the slopes of the predictions at theta, (n, n_points, n_params), by forward differences of `nudge`."""
    n_params = theta.shape[1]
    nudged = theta + (np.eye(n_params) * nudge)[:, None]
    there = predict(nudged.reshape(-1, n_params)).reshape(n_params, *at_theta.shape)
    return np.ascontiguousarray(((there - at_theta) / nudge[:, None, None]).transpose(1, 2, 0))


def sampled_about_fits(
    fits: Fits,
    kind: HypothesisKind,
    problem: SensorProblem,
    own: Weighted,
    *,
    n_draws: int,
    with_own: bool,
    rng: np.random.Generator,
) -> Weighted | None:
    """Sample a kind's posterior by `n_draws` draws about fits and, if `with_own`, about its own samples, weighted.

    At least one of the fits has to be good. None if fewer than ten draws are possible.
    """
    assert kind.effect is not None
    n_params, n_effect = fits.theta.shape[1], len(kind.effect.prior.names)
    best = fits.good_fit_rows[np.argsort(-fits.log_z_by_fit)][:_KEPT]
    covariance = _inverse_precision(fits.precision[best])
    of_effect = LocalKernels.from_moments(
        fits.theta[best, -n_effect:], _WIDER**2 * covariance[:, -n_effect:, -n_effect:]
    )
    densities: list[_Density] = [
        LocalKernels.from_moments(fits.theta[best], _WIDER**2 * covariance),
        _ShapePriorAndEffectKernels(kind.prior, kind.effect.prior, of_effect),
    ]
    if with_own and len(rows := _resampled_rows_if_distinct(own, n_params, rng)):
        densities.append(LocalKernels.fitted_to(own.theta[rows], rng=rng, widened=1.2, most=_KERNELS))
    first = _importance_sampled(own, problem, densities, n_draws // 2, rng)
    if first is None or not len(rows := _resampled_rows_if_distinct(first, n_params, rng)):
        return first
    # A posterior is more curved than the Gaussians about its fits: once more, about what these have found.
    near = LocalKernels.fitted_to(first.theta[rows], rng=rng, most=_KERNELS)
    far = LocalKernels.fitted_to(first.theta[rows], rng=rng, widened=_FAR, most=_KERNELS)
    return _importance_sampled(first, problem, [near, near, far, *densities], n_draws, rng) or first


@dataclass(frozen=True, eq=False)
class _ShapePriorAndEffectKernels:
    """A density over a kind's parameters: the prior for the shape's parameters, kernels about fits for the effect's.

    Where the readings leave the shape open (a step of the light, and no white yet), Gaussians about fits cover little
    of the posterior.
    """

    prior: Prior
    effect_prior: Prior
    of_effect: LocalKernels

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        out = self.prior.from_unit_cube(rng.random((n, len(self.prior.names))))
        out[:, -len(self.effect_prior.names) :] = self.of_effect.draw(n, rng=rng)
        return out

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the natural log of the density at possible points, (n, n_params) -> (n,)."""
        own = points[:, -len(self.effect_prior.names) :]
        of_shape = self.prior.log_prob(points) - self.effect_prior.log_prob(own)
        return np.asarray(of_shape + self.of_effect.log_density(own))


_Density = LocalKernels | _ShapePriorAndEffectKernels


def _inverse_precision(precision: FloatArray) -> FloatArray:
    """Return the inverses, (n, n_params, n_params), stably if parameters differ by many powers of ten."""
    size = 1.0 / np.sqrt(np.diagonal(precision, axis1=1, axis2=2))
    both = size[:, :, None] * size[:, None, :]
    return np.asarray(np.linalg.inv(precision * both + _JITTER * np.eye(precision.shape[1])) * both)


def _resampled_rows_if_distinct(posterior: Weighted, n_params: int, rng: np.random.Generator) -> IntArray:
    """Return resampled rows of a posterior; no rows if too few are distinct to fit kernels."""
    rows = resampled_rows(posterior.weight, len(posterior.theta), rng)
    return rows if len(np.unique(rows)) > 4 * n_params else rows[:0]


def _importance_sampled(
    own: Weighted, problem: SensorProblem, densities: Sequence[_Density], n: int, rng: np.random.Generator
) -> Weighted | None:
    """Sample by importance sampling from an even mixture of densities; None if fewer than ten draws are possible."""
    shares = np.bincount(rng.permutation(n) % len(densities), minlength=len(densities))
    draws = np.concatenate([d.draw(int(k), rng=rng) for d, k in zip(densities, shares, strict=True)])

    def log_density(points: FloatArray) -> FloatArray:
        return np.asarray(logsumexp([d.log_density(points) for d in densities], axis=0) - math.log(len(densities)))

    found = _weighted_draws(draws, log_density, problem, least=_LEAST_POSSIBLE)
    return None if found is None else replace(found, n_calls=own.n_calls + n)


def sampled_about_points(
    points: FloatArray, problem: SensorProblem, n_draws: int, rng: np.random.Generator
) -> Weighted | None:
    """Sample a posterior by draws from kernels about points near it, (n_points, n_params); None if none is possible."""
    density = _KernelDensity.fitted_to(points, rng=rng)
    return _weighted_draws(density.draw(n_draws, rng=rng), density.log_density, problem)


def _weighted_draws(
    draws: FloatArray, log_density: Callable[[FloatArray], FloatArray], problem: SensorProblem, *, least: int = 1
) -> Weighted | None:
    """Weight draws from a density, (n_draws, n_params), by prior times likelihood over that density.

    Impossible draws are dropped; None if fewer than `least` remain.
    """
    theta = draws[np.isfinite(problem.prior.log_prob(draws))]
    log_likelihood = problem.log_likelihood(theta) if len(theta) else np.empty(0)
    alive = np.isfinite(log_likelihood)
    if np.count_nonzero(alive) < least:
        return None
    theta, log_likelihood, n = theta[alive], log_likelihood[alive], len(draws)
    log_ratio = problem.prior.log_prob(theta) + log_likelihood - log_density(theta)
    log_sum = float(logsumexp(log_ratio))
    n_eff = n_effective(log_ratio - log_sum)
    return Weighted(
        problem.prior.names,
        theta,
        log_likelihood=log_likelihood,
        log_weight=log_ratio - log_sum,
        log_z=log_sum - math.log(n),
        log_z_error=math.sqrt(max(1.0 / n_eff - 1.0 / n, 0.0)),
        n_eff=n_eff,
        n_calls=n,
        pareto_k=pareto_k(log_ratio),
    )


@dataclass(frozen=True, eq=False)
class _KernelDensity:
    """A density of local kernels, mixed with the same kernels three times as wide (15 %)."""

    near: LocalKernels
    far: LocalKernels

    @classmethod
    def fitted_to(cls, points: FloatArray, *, rng: np.random.Generator) -> _KernelDensity:
        return cls(LocalKernels.fitted_to(points, rng=rng), LocalKernels.fitted_to(points, rng=rng, widened=_WIDE))

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        n_far = round(_OF_WIDE * n)
        return np.concatenate([self.near.draw(n - n_far, rng=rng), self.far.draw(n_far, rng=rng)])

    def log_density(self, points: FloatArray) -> FloatArray:
        near, far = self.near.log_density(points), self.far.log_density(points)
        return np.asarray(np.logaddexp(near + math.log1p(-_OF_WIDE), far + math.log(_OF_WIDE)))


@dataclass(frozen=True)
class BridgedEvidence:
    """Log evidence, its standard error, and the number of likelihood evaluations."""

    log_z: float
    error: float
    n_calls: int


def bridged_evidence(
    posterior: Weighted, problem: SensorProblem, *, rng: np.random.Generator, n_draws: int
) -> BridgedEvidence:
    """Estimate the evidence by bridge sampling between samples and `n_draws` draws from kernels fitted to them.

    Each half of the samples is compared with kernels fitted to the other half, to avoid the bias of evaluating a
    density at its own points. The evidence is the mean of both; its error is their standard error, or half the
    difference of their logs if larger. If too few samples are distinct: the posterior's own, its error 2 nats or more.
    """
    n = len(posterior.theta) // 2 * 2
    rows = resampled_rows(posterior.weight, n, rng)
    # Copies of a sample are adjacent, and so are in the same half.
    halves = np.split(rows, 2)
    if min(len(np.unique(posterior.theta[half, 0])) for half in halves) <= 2 * posterior.theta.shape[1]:
        return BridgedEvidence(posterior.log_z, max(posterior.log_z_error, _UNKNOWN), 0)  # too few to fit kernels
    found = []
    for own, other in (halves, halves[::-1]):
        density = _KernelDensity.fitted_to(posterior.theta[other], rng=rng)
        drawn = density.draw(n_draws // 2, rng=rng)
        log_prior = problem.prior.log_prob(drawn)
        possible = np.isfinite(log_prior)
        log_ratio = np.full(len(drawn), -np.inf)
        if possible.any():
            likely = problem.log_likelihood(drawn[possible])
            log_ratio[possible] = log_prior[possible] + likely - density.log_density(drawn[possible])
        theta = posterior.theta[own]
        at_samples = problem.prior.log_prob(theta) + posterior.log_likelihood[own] - density.log_density(theta)
        found.append(_bridged_log_z_and_error(log_ratio, at_samples, len(np.unique(own))))
    (one, one_error), (other_one, other_error) = found
    log_z = float(logsumexp([one, other_one])) - math.log(2.0)
    error = max(0.5 * math.hypot(one_error, other_error), 0.5 * abs(one - other_one))
    return BridgedEvidence(log_z, error, n_draws)


def _bridged_log_z_and_error(at_draws: FloatArray, at_samples: FloatArray, n_samples: float) -> tuple[float, float]:
    """Return log evidence and error, from log ratios (prior times likelihood over density) at draws and at samples."""
    n_draws = len(at_draws)
    if not np.isfinite(at_draws).any():
        return -math.inf, math.inf
    lean = math.log(n_samples / n_draws)
    log_z = _log_mean_exp(at_draws)
    for _ in range(_BRIDGE_STEPS):
        # expit weights each point between the two ends of the bridge.
        up = _log_mean_exp(np.log(np.maximum(expit(at_draws - log_z + lean), 1e-300)))
        down = _log_mean_exp(np.log(np.maximum(expit(-(at_samples - log_z + lean)), 1e-300)))
        step = up - down - lean
        log_z += step
        if abs(step) < _CLOSE:
            break
    of_draws, of_samples = expit(at_draws - log_z + lean), expit(-(at_samples - log_z + lean))
    variance = sum(
        float(v.var()) / max(float(v.mean()) ** 2, 1e-300) / n
        for v, n in ((of_draws, n_draws), (of_samples, n_samples))
    )
    return log_z, math.sqrt(variance)


def _log_mean_exp(log_values: FloatArray) -> float:
    return float(logsumexp(log_values)) - math.log(len(log_values))


def _with_bridged_evidence(particles: Particles, problem: SensorProblem, rng: np.random.Generator) -> Particles:
    """Return the same samples with their evidence by bridge sampling; unchanged if that evidence is not finite."""
    n_draws = min(2 * len(particles.ancestor), _BRIDGE_DRAWS)
    found = bridged_evidence(particles.weighted, problem, rng=rng, n_draws=n_draws)
    if not math.isfinite(found.log_z):
        return particles
    return replace(_restarted_with_evidence(particles, found), strained=particles.strained)


def _restarted_with_evidence(particles: Particles, found: BridgedEvidence) -> Particles:
    """Return the samples with another evidence and as an independent start: each sample is its own ancestor."""
    had = particles.weighted
    return replace(
        particles,
        weighted=replace(had, log_z=found.log_z, log_z_error=found.error, n_calls=had.n_calls + found.n_calls),
        ancestor=np.arange(len(had.theta)),
        start_variance=found.error**2,
        n_resampled=0,
        strained=False,
        hurried=False,
    )
