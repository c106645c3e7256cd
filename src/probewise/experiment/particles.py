"""Sequential Monte Carlo: samples reweighted after each reading, and resampled and moved when needed.

Sequential Monte Carlo (Del Moral, Doucet & Jasra 2006). A reading reweights the samples. If the effective share of the
samples falls below a limit, the reading's likelihood is tempered. At each temperature the samples are resampled and
moved by Metropolis-Hastings steps on all readings so far. The evidence is the product of the mean weights. Thousands of
samples still represent the small parts of the prior that a long search has left. The error of the evidence is estimated
from the genealogy: if few initial samples are ancestors of the current ones, another start would give another evidence
(Lee & Whiteley 2018).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import BoolArray, FloatArray, IntArray, frozen_int
from probewise.errors import ParameterError
from probewise.experiment.kernels import MOST_KERNELS, LocalKernels
from probewise.inference.problem import SensorProblem, checked_log_prob
from probewise.nested import NestedResult, Weighted, pareto_k
from probewise.nested.weights import n_effective, power_bracket, resampled_rows
from probewise.priors import Prior

_KEEP = 0.5  # least effective share of the samples without resampling
_SURPRISED = 12.5  # nats by which even the best sample misses the last reading: five sds of Gaussian noise
_STIFF = 0.5  # accepted steps per sample below which the moves are unreliable
_MOST_ROUNDS = 6
_MANY_DEGREES = 4
_SEARCHED_FOR = 5  # readings that a search from scratch is good for, if its samples follow them with ease
_LEAST_PART = 0.05  # least share of the samples in a part, to fit kernels


@dataclass(frozen=True)
class UpdateSettings:
    """Settings of an update by one reading: how thoroughly samples are resampled and moved.

    Attributes
    ----------
    steps_per_sample
        Accepted Metropolis-Hastings steps per sample to aim for.
    n_kernels
        Number of kernels that propose the steps.
    least_share
        Effective share of the samples below which these are resampled and moved.
    most_temperatures
        Largest number of temperatures. Samples that need more are far from the new posterior, and marked as strained.
    """

    steps_per_sample: float
    n_kernels: int
    least_share: float = _KEEP
    most_temperatures: float = math.inf


THOROUGH = UpdateSettings(1.5, MOST_KERNELS)
STEADY = UpdateSettings(1.2, 120, 0.4, 12)
BRIEF = UpdateSettings(1.0, 75, 0.3, 10)


@dataclass(frozen=True, eq=False)
class Particles:
    """Weighted samples, with diagnostics of their evidence.

    Attributes
    ----------
    weighted
        The samples with the evidence.
    ancestor
        Index of each sample's ancestor at the last independent start, (n,).
    start_variance
        Variance of the log evidence at that start; 0 for draws from the prior.
    n_resampled
        Number of resampling steps since that start.
    strained
        Whether, since that start, no sample predicted some reading, or the samples could not be moved: the evidence may
        be wrong by more than the genealogy indicates.
    hurried
        Whether, since that start, a reading needed four temperatures or more: then few samples were near the new
        posterior, and the product of mean weights is nearly always too small.
    refitted
        Whether the samples come from fits to all readings or from scratch, and have followed later readings with ease.
    log_z_limit
        Upper limit of the log evidence of a kind far below the best kind, by fits or by a search from scratch; infinite
        for others.
    limit_is_searched
        Whether a search from scratch gave that limit. Fits alone may all have missed the best fit.
    searched_at
        Number of readings at the last search from scratch; -inf if there was none.
    """

    weighted: Weighted
    ancestor: IntArray
    start_variance: float = 0.0
    n_resampled: int = 0
    strained: bool = False
    hurried: bool = False
    refitted: bool = False
    log_z_limit: float = math.inf
    limit_is_searched: bool = False
    searched_at: float = -math.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "ancestor", frozen_int(self.ancestor))

    def is_search_old(self, n_readings: int) -> bool:
        """Return whether a search from scratch is due: none in five readings, or samples strained or hurried."""
        return self.strained or self.hurried or n_readings >= self.searched_at + _SEARCHED_FOR

    @property
    def log_z(self) -> float:
        """Natural log of the evidence."""
        return self.weighted.log_z

    @property
    def log_z_error(self) -> float:
        """Standard error of the log evidence by the genealogy (Lee & Whiteley 2018), or the stated one if that is more.

        The stated error assumes independent samples at every step, which moves do not guarantee.
        """
        if self.log_z == -math.inf:
            return math.inf
        n = len(self.ancestor)
        lineages = np.bincount(self.ancestor, weights=self.weighted.weight)
        related = float(lineages @ lineages) - (self.n_resampled + 1) / n
        return max(math.sqrt(max(related, 0.0) + self.start_variance), self.weighted.log_z_error)


def prior_particles(prior: Prior, n_particles: int, *, rng: np.random.Generator) -> Particles:
    """Draw equally weighted samples of the prior, with evidence 1; ParameterError for a prior without mass."""
    theta = prior.from_unit_cube(rng.random((n_particles, len(prior.names))))
    if not np.isfinite(prior.log_prob(theta)).all():
        raise ParameterError(
            "prior",
            prior.names,
            "one with mass: its draws must have a density above zero. Do its bounds leave room for anything?",
        )
    even = np.full(n_particles, -math.log(n_particles))
    drawn = Weighted(
        prior.names,
        theta,
        log_likelihood=np.zeros(n_particles),
        log_weight=even,
        log_z=0.0,
        log_z_error=0.0,
        n_eff=float(n_particles),
        n_calls=0,
        pareto_k=-math.inf,
    )
    return Particles(drawn, np.arange(n_particles))


def update(
    previous: Particles,
    problem: SensorProblem,
    *,
    rng: np.random.Generator,
    fall_back: Callable[[], NestedResult] | None = None,
    effort: UpdateSettings | None = None,
) -> Particles:
    """Update the samples with the last reading of a problem.

    Parameters
    ----------
    previous
        Posterior given the earlier readings.
    problem
        Prior, sensor model, likelihood, and all readings.
    rng
        Source of randomness.
    fall_back
        Function that solves the whole problem from scratch, called if no sample predicts the reading or the samples
        cannot be moved. None: the samples continue and are marked as strained.
    effort
        How thoroughly samples are moved; by default `THOROUGH`, for a probable kind of hypotheses.

    Returns
    -------
    Particles
        As many samples as before; `weighted.run` is the run from scratch, if one was needed. If no sample could have
        given the reading and there is no `fall_back`, the evidence is zero and the samples are unchanged.
    """
    last = _LastReadingEvaluator(problem)
    previous = replace(previous, log_z_limit=previous.log_z_limit + last.perfect_log_likelihood)
    before = previous.weighted
    n = len(before.theta)
    effort = THOROUGH if effort is None else effort
    least = effort.least_share * n
    if before.log_z == -math.inf:
        return previous
    predicted = problem.model.predict(before.theta, problem.recording.plan)
    strained, ancestor, n_resampled = previous.strained, previous.ancestor, previous.n_resampled
    if last.least_misfit_nats(predicted) > _SURPRISED:
        if fall_back is not None:
            return _particles_from_run(fall_back(), n, last, n, rng)
        strained = True
    now = _EvaluatedSamples(
        before.theta, problem.prior.log_prob(before.theta), *last.log_likelihoods_without_and_with(predicted)
    )
    log_weight, base = before.log_weight, before.log_likelihood
    log_z, variance, n_calls, share = before.log_z, before.log_z_error**2, n, 0.0
    while True:
        all_at_once = n_effective(_updated_log_weights(log_weight, now.after, base))
        if all_at_once == 0.0:
            if fall_back is not None:
                return _particles_from_run(fall_back(), n, last, n_calls, rng)
            return replace(previous, weighted=replace(before, log_z=-math.inf, log_z_error=math.inf), strained=True)
        given_up = n_resampled - previous.n_resampled >= effort.most_temperatures
        strained |= given_up and all_at_once < least
        share = 1.0 if all_at_once >= least or given_up else _next_power(log_weight, base, now, share, least)
        weighed = _updated_log_weights(log_weight, now.log_likelihood_at_power(share), base)
        gained = float(logsumexp(weighed))
        log_z, log_weight, base = log_z + gained, weighed - gained, now.log_likelihood_at_power(share)
        n_eff = n_effective(log_weight)
        variance += max(1.0 / n_eff - 1.0 / n, 0.0)
        if share == 1.0 and n_eff >= least:
            break
        rows = resampled_rows(np.exp(log_weight - log_weight.max()), n, rng)
        now, moves = _move_by_metropolis(
            now.take_rows(rows), share, last, rng, _partition_rows(rows) if fall_back is None else None, effort
        )
        n_calls, n_resampled, ancestor = n_calls + moves.n_calls, n_resampled + 1, ancestor[rows]
        if moves.accepted < _STIFF:
            if fall_back is not None:
                return _particles_from_run(fall_back(), n, last, n_calls, rng)
            strained = True
        base, log_weight = now.log_likelihood_at_power(share), np.full(n, -math.log(n))
        if share == 1.0:
            break
    tail = pareto_k(log_weight) if n_eff < n else -math.inf
    found = Weighted(
        before.names,
        now.theta,
        log_likelihood=now.after,
        log_weight=log_weight,
        log_z=log_z,
        log_z_error=math.sqrt(variance),
        n_eff=n_effective(log_weight),
        n_calls=before.n_calls + n_calls,
        pareto_k=tail,
    )
    degrees = n_resampled - previous.n_resampled
    hurried, with_ease = previous.hurried or degrees >= _MANY_DEGREES, degrees <= 1 and not strained
    return replace(
        previous,
        weighted=found,
        ancestor=ancestor,
        n_resampled=n_resampled,
        strained=strained,
        hurried=hurried,
        refitted=previous.refitted and with_ease,
    )


def resample_and_move(
    particles: Particles,
    n: int,
    problem: SensorProblem,
    *,
    rng: np.random.Generator,
    effort: UpdateSettings | None = None,
) -> Particles:
    """Resample to `n` samples, and move the copies apart; unchanged if there are `n` already or the evidence is 0.

    `problem` holds the readings included so far.
    """
    had = particles.weighted
    if n == len(had.theta) or had.log_z == -math.inf:
        return particles
    rows = resampled_rows(had.weight, n, rng)
    start = _EvaluatedSamples(
        had.theta[rows], problem.prior.log_prob(had.theta[rows]), *np.tile(had.log_likelihood[rows], (2, 1))
    )
    moved, moves = (
        _move_by_metropolis(start, 1.0, _LastReadingEvaluator(problem), rng, effort=effort)
        if len(problem.recording)
        else (start, _AcceptedStepsAndCalls(0.0, 0))
    )
    found = replace(_equally_weighted_posterior(moved, had), n_calls=had.n_calls + moves.n_calls)
    return replace(particles, weighted=found, ancestor=particles.ancestor[rows], n_resampled=particles.n_resampled + 1)


def particles_from_posterior(
    found: Weighted, n: int, problem: SensorProblem, *, rng: np.random.Generator, effort: UpdateSettings | None = None
) -> Particles:
    """Restart with `n` samples resampled from a posterior and moved apart, with that posterior's evidence."""
    last = _LastReadingEvaluator(problem)
    cloud = last.evaluate_samples(found.theta[resampled_rows(found.weight, n, rng)])
    moved, moves = _move_by_metropolis(cloud, 1.0, last, rng, effort=effort)
    drawn = replace(_equally_weighted_posterior(moved, found), n_calls=found.n_calls + n + moves.n_calls)
    return Particles(drawn, np.arange(n), found.log_z_error**2)


def _equally_weighted_posterior(cloud: _EvaluatedSamples, of: Weighted) -> Weighted:
    """Return `of` with its own samples replaced by those of `cloud`, equally weighted; the evidence stays."""
    n = len(cloud.theta)
    even = np.full(n, -math.log(n))
    return replace(
        of, theta=cloud.theta, log_likelihood=cloud.after, log_weight=even, n_eff=float(n), pareto_k=-math.inf
    )


@dataclass(frozen=True, eq=False)
class _EvaluatedSamples:
    """Samples with their log prior, and their log likelihood without (`before`) and with (`after`) the last reading."""

    theta: FloatArray
    log_prior: FloatArray
    before: FloatArray
    after: FloatArray

    def log_likelihood_at_power(self, share: float) -> FloatArray:
        """Return the log likelihood, (n,), with the last reading's likelihood raised to the power `share`."""
        return self.after if share == 1.0 else (1.0 - share) * self.before + share * self.after

    def take_rows(self, rows: IntArray) -> _EvaluatedSamples:
        return _EvaluatedSamples(self.theta[rows], self.log_prior[rows], self.before[rows], self.after[rows])

    def with_rows_overwritten(self, rows: BoolArray, other: _EvaluatedSamples) -> _EvaluatedSamples:
        """Return the samples, with those of `other` (as many) in the rows that the mask `rows` marks."""
        return _EvaluatedSamples(
            np.where(rows[:, None], other.theta, self.theta),
            np.where(rows, other.log_prior, self.log_prior),
            np.where(rows, other.before, self.before),
            np.where(rows, other.after, self.after),
        )


@dataclass(frozen=True, eq=False)
class _LastReadingEvaluator:
    """Evaluator of samples without and with the last reading of a problem, from one prediction of all readings."""

    problem: SensorProblem

    def least_misfit_nats(self, predicted: FloatArray) -> float:
        """Return by how many nats the best of the predictions falls short of a perfect one at the last reading.

        If that reading is missing, return 0.
        """
        recording = self.problem.recording
        if not recording.usable[-1]:
            return 0.0
        best = checked_log_prob(self.problem.likelihood, recording.readings[-1:], predicted[:, -1:]).max()
        return float(self.perfect_log_likelihood - best)

    @property
    def perfect_log_likelihood(self) -> float:
        """Log likelihood of the last reading if predicted exactly; 0 if that reading is missing."""
        recording = self.problem.recording
        reading = recording.readings[-1:]
        return (
            float(checked_log_prob(self.problem.likelihood, reading, reading[None])[0]) if recording.usable[-1] else 0.0
        )

    def log_likelihoods_without_and_with(self, predicted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log likelihoods without and with the last reading, from predictions, -> (n_samples,) each."""
        usable = self.problem.recording.usable
        earlier = usable.copy()
        earlier[-1] = False
        return self._log_likelihood_of_rows(predicted, earlier), self._log_likelihood_of_rows(predicted, usable)

    def _log_likelihood_of_rows(self, predicted: FloatArray, rows: BoolArray) -> FloatArray:
        """Return the log likelihood, (n_samples,), of the readings that the mask `rows` marks; 0 for none."""
        if not rows.any():
            return np.zeros(len(predicted))
        return checked_log_prob(self.problem.likelihood, self.problem.recording.readings[rows], predicted[:, rows])

    def evaluate_samples(self, theta: FloatArray) -> _EvaluatedSamples:
        """Evaluate prior and likelihoods of samples; those outside the prior get a likelihood of zero."""
        problem = self.problem
        log_prior = problem.prior.log_prob(theta)
        before, after = np.zeros(len(theta)), np.full(len(theta), -np.inf)
        possible = np.isfinite(log_prior)
        if possible.any():
            predicted = problem.model.predict(theta[possible], problem.recording.plan)
            before[possible], after[possible] = self.log_likelihoods_without_and_with(predicted)
        return _EvaluatedSamples(theta, log_prior, before, after)


@dataclass(frozen=True)
class _AcceptedStepsAndCalls:
    """Mean number of accepted steps per sample, and number of likelihood evaluations."""

    accepted: float
    n_calls: int


def _move_by_metropolis(
    start: _EvaluatedSamples,
    share: float,
    last: _LastReadingEvaluator,
    rng: np.random.Generator,
    parts: Sequence[IntArray] | None = None,
    effort: UpdateSettings | None = None,
) -> tuple[_EvaluatedSamples, _AcceptedStepsAndCalls]:
    """Move equally weighted samples by Metropolis-Hastings steps that leave their density invariant.

    That density has the last reading's likelihood to the power `share`. A round is a proposal from kernels fitted to
    the samples, then one along the difference of two samples (ter Braak 2006): the first follows curved shells in few
    dimensions, the second works in many. Each of `parts` (rows of the samples) is moved by kernels fitted to the
    previous part, since kernels fitted to the moved samples themselves would be biased.
    """
    n, n_params = start.theta.shape
    if len(np.unique(start.theta[:, 0])) <= 2 * n_params:  # too few distinct samples to fit kernels
        return start, _AcceptedStepsAndCalls(0.0, 0)
    parts = [np.arange(n)] if parts is None else parts
    effort = THOROUGH if effort is None else effort
    kernels = [LocalKernels.fitted_to(start.theta[rows], rng=rng, most=effort.n_kernels) for rows in parts]
    now, accepted, n_calls = start, 0.0, 0
    for _ in range(_MOST_ROUNDS):
        for propose in (_propose_from_kernels, _propose_along_differences):
            theta, log_ratio = np.empty_like(now.theta), np.empty(n)
            for k, rows in enumerate(parts):
                theta[rows], log_ratio[rows] = propose(now.theta[rows], kernels[k - 1], rng)
            proposed = last.evaluate_samples(theta)
            odds = (
                proposed.log_prior
                + proposed.log_likelihood_at_power(share)
                - now.log_prior
                - now.log_likelihood_at_power(share)
                + log_ratio
            )
            taken = np.log(rng.random(n)) < odds
            now = now.with_rows_overwritten(taken, proposed)
            n_calls += n
            accepted += float(taken.mean())
        if accepted >= effort.steps_per_sample:
            break
    return now, _AcceptedStepsAndCalls(accepted, n_calls)


def _propose_from_kernels(
    theta: FloatArray, kernels: LocalKernels, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Propose from the kernels; also return the log ratio of the kernels' density, current to proposed samples."""
    proposed = kernels.draw(len(theta), rng=rng)
    return proposed, kernels.log_density(theta) - kernels.log_density(proposed)


def _propose_along_differences(
    theta: FloatArray, kernels: LocalKernels, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Propose steps along differences of two samples, randomly scaled; also return the log ratios of densities, 0."""
    n, n_params = theta.shape
    one, other = rng.integers(n, size=(2, n))
    length = 2.38 / math.sqrt(2 * n_params) * 10.0 ** rng.uniform(-2.0, 0.0, (n, 1))
    return theta + length * (theta[one] - theta[other]), np.zeros(n)


def _partition_rows(rows: IntArray) -> list[IntArray]:
    """Split the samples resampled by `rows` into two parts, with copies of a sample in the same part.

    Return the indices of each part's samples; a single part if one of the two would be too small to fit kernels.
    """
    parts = [np.flatnonzero(rows % 2 == k) for k in (0, 1)]
    return parts if min(map(len, parts)) >= _LEAST_PART * len(rows) else [np.arange(len(rows))]


def _next_power(log_weight: FloatArray, base: FloatArray, now: _EvaluatedSamples, share: float, enough: float) -> float:
    """Return the largest power above `share` of the last reading's likelihood with `enough` effective samples."""
    low, _ = power_bracket(
        lambda power: _updated_log_weights(log_weight, now.log_likelihood_at_power(power), base),
        share,
        1.0,
        wanted=enough,
        n_steps=30,
    )
    return max(low, share + 1e-6)


def _updated_log_weights(log_weight: FloatArray, after: FloatArray, before: FloatArray) -> FloatArray:
    """Return log weights updated from log likelihoods `before` to those `after`; excluded samples remain excluded."""
    alive = np.isfinite(log_weight)
    return np.asarray(np.where(alive, log_weight + after - np.where(alive, before, 0.0), -np.inf))


def _particles_from_run(
    run: NestedResult,
    n: int,
    last: _LastReadingEvaluator,
    n_calls: int,
    rng: np.random.Generator,
) -> Particles:
    """Start from a nested sampling run: resample `n` samples from it, and move them apart."""
    found = last.evaluate_samples(run.samples(n, rng=rng))
    moved, moves = _move_by_metropolis(found, 1.0, last, rng)
    even = np.full(n, -math.log(n))
    calls = n_calls + run.n_calls + n + moves.n_calls
    drawn = Weighted(
        run.names,
        moved.theta,
        log_likelihood=moved.after,
        log_weight=even,
        log_z=run.log_z,
        log_z_error=run.log_z_error,
        n_eff=float(n),
        n_calls=calls,
        pareto_k=-math.inf,
        run=run,
    )
    return Particles(drawn, np.arange(n), run.log_z_error**2)
