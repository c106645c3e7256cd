"""Sequential Monte Carlo: samples reweighted after each reading, and resampled and moved when needed.

Sequential Monte Carlo (Del Moral, Doucet & Jasra 2006). A reading reweights the samples. If the effective share of the
samples falls below a limit, the reading's likelihood is tempered. At each temperature the samples are resampled and
moved by Metropolis-Hastings steps on all readings so far. The evidence is the product of the mean weights. The error of
the evidence is estimated from the genealogy: if few initial samples are ancestors of the current ones, another start
would give another evidence (Lee & Whiteley 2018).

Steps are proposed from Gaussians about the samples with local covariances, since the posterior after a few readings is
a thin curved shell (all circles whose edge passes under one grey reading), for which a global covariance is useless.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol, Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray, frozen_int, logsumexp
from probewise.errors import require
from probewise.nested import (
    LIVE_PER_PARAM,
    KernelMove,
    NestedResult,
    RemainingEvidence,
    Samplable,
    Weighted,
    pareto_k,
    run,
)
from probewise.nested.importance import evenly_weighted
from probewise.nested.weights import largest_power, n_effective, resampled_rows
from probewise.priors import Prior

_SURPRISED = 12.5  # nats by which even the best sample misses the last reading: five sds of Gaussian noise
_STIFF = 0.5  # accepted steps per sample below which the moves are unreliable
_MOST_ROUNDS = 6
_MANY_TEMPERATURES = 4
_LEAST_PART = 0.05  # least share of the samples in a part, to fit kernels

_MOST_KERNELS = 250
_NEIGHBOURS = 10  # neighbours per parameter, enough for a covariance
_RIDGE = 1e-6  # of the overall covariance, to avoid singular ones
_RESOLUTION = 1e-9  # of a coordinate's mean, below which a spread is rounding error
_SMALLEST = 1e-100  # spread of a coordinate that is zero in all points, whose square is still a number
_BLOCK = 256  # points per batch, to fit the cache
_DLOGZ = 0.5  # the final live points are posterior samples too; a smaller value would only refine log Z
_FEW = 600  # points up to which all distances are faster than a tree
_FEW_ROWS, _FEW_FOR_FEW_ROWS = 60, 10_000  # and points up to which they are from that few of them


class SequentialProblem(Protocol):
    """The problem of inferring parameters from readings in order, of which the last is new."""

    @property
    def prior(self) -> Prior:
        """Prior of the parameters."""
        ...

    def evaluate(self, theta: FloatArray) -> Any:
        """Compute once per batch, theta (n_samples, n_params), what the functions below need, such as predictions."""
        ...

    def log_likelihoods(self, evaluated: Any, power: float) -> tuple[FloatArray, FloatArray]:
        """Return log likelihoods without and with the last reading, (n_samples,) each.

        With the last reading's likelihood to the `power` 1, those without it are not used: any number will do.
        """
        ...

    def least_misfit_nats(self, evaluated: Any) -> float:
        """Return by how many nats the best prediction of the last reading misses it."""
        ...


@dataclass(frozen=True)
class UpdateSettings:
    """Settings of an update by one reading: how thoroughly samples are resampled and moved.

    `steps_per_sample` accepted Metropolis-Hastings steps per sample are aimed for, with `n_kernels` kernels, where the
    effective share of the samples is below `least_share`. Samples that need more than `most_temperatures` are far from
    the new posterior, and marked as strained.
    """

    steps_per_sample: float
    n_kernels: int
    least_share: float
    most_temperatures: float


THOROUGH = UpdateSettings(1.5, _MOST_KERNELS, 0.5, math.inf)
STEADY = UpdateSettings(1.2, 120, 0.4, 12)
BRIEF = UpdateSettings(1.0, 75, 0.3, 10)
LIGHT = UpdateSettings(1.2, 40, 0.3, 12)


@dataclass(frozen=True, eq=False)
class Particles:
    """Weighted samples, with diagnostics of their evidence since the last independent start."""

    weighted: Weighted  # the samples with the evidence
    ancestor: IntArray  # index of each sample's ancestor at that start, (n,)
    start_variance: float = 0.0  # variance of the log evidence at that start; 0 for draws from the prior
    n_resampled: int = 0  # number of resampling steps
    # No sample predicted some reading, or the samples could not be moved: the evidence may be wrong by more than the
    # genealogy indicates.
    strained: bool = False
    # A reading needed four temperatures or more: then few samples were near the new posterior, and the product of mean
    # weights is nearly always too small.
    hurried: bool = False
    # Upper bound on the log evidence of a mode that the samples lack: at the last search of the prior it had less than
    # one sample, and it may have given every reading since exactly. Infinite if there was no search.
    lost_log_z: float = math.inf
    suspended: bool = False  # the samples are those of fewer readings, the evidence an upper bound: `suspended_with`

    def __post_init__(self) -> None:
        object.__setattr__(self, "ancestor", frozen_int(self.ancestor))

    @property
    def is_doubtful(self) -> bool:
        """Whether the samples may have lost the truth, and their evidence be wrong."""
        return self.strained or self.hurried

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
        lineages = np.bincount(self.ancestor, weights=self.weighted.weight)
        related = float(lineages @ lineages) - (self.n_resampled + 1) / len(self.ancestor)
        return max(math.sqrt(max(related, 0.0) + self.start_variance), self.weighted.log_z_error)

    def suspended_with(self, log_likelihood: float) -> Self:
        """Return the samples as they are, with the evidence as if they all gave a reading this log likelihood."""
        return replace(self, weighted=replace(self.weighted, log_z=self.log_z + log_likelihood), suspended=True)

    def searched(self, log_z: float) -> Self:
        """Return the samples as those of a search of the prior that gave this log evidence."""
        return replace(self, lost_log_z=log_z - math.log(len(self.ancestor)))

    def with_zero_evidence(self) -> Self:
        """Return the samples with an evidence of zero: none of them could have given the readings."""
        return replace(self, weighted=replace(self.weighted, log_z=-math.inf, log_z_error=math.inf))


def prior_particles(prior: Prior, n_particles: int, *, rng: np.random.Generator) -> Particles:
    """Draw equally weighted samples of the prior, with evidence 1; ParameterError for a prior without mass."""
    theta = prior.from_unit_cube(rng.random((n_particles, len(prior.names))))
    allowed = "one with mass: its draws must have a density above zero. Do its bounds leave room for anything?"
    require(np.isfinite(prior.log_prob(theta)).all(), "prior", prior.names, allowed)
    drawn = evenly_weighted(prior.names, theta, np.zeros(n_particles))
    return Particles(drawn, np.arange(n_particles))


def update(
    previous: Particles,
    problem: SequentialProblem,
    *,
    rng: np.random.Generator,
    fall_back: Callable[[], NestedResult] | None = None,
    effort: UpdateSettings = THOROUGH,
) -> Particles:
    """Update the samples with the last reading of a problem; `previous` are those given the earlier readings.

    `fall_back` solves the whole problem from scratch, if no sample predicts the reading or the samples cannot be moved;
    without it, the samples continue and are marked as strained. `effort` says how thoroughly samples are moved.

    Return as many samples as before; `weighted.run` is the run from scratch, if one was needed. If no sample could have
    given the reading and there is no `fall_back`, the evidence is zero and the samples are unchanged.
    """
    before, n = previous.weighted, len(previous.weighted.theta)
    least = effort.least_share * n
    if before.log_z == -math.inf:
        return previous
    evaluated = problem.evaluate(before.theta)
    log_prior = problem.prior.log_prob(before.theta)
    now = _EvaluatedSamples(before.theta, log_prior, *problem.log_likelihoods(evaluated, 1.0))
    log_weight, base = before.log_weight, before.log_likelihood
    ancestor, strained = previous.ancestor, previous.strained
    log_z, variance, n_calls, power, n_temperatures = before.log_z, before.log_z_error**2, n, 0.0, 0
    stuck = problem.least_misfit_nats(evaluated) > _SURPRISED
    while True:
        all_at_once = n_effective(_updated_log_weights(log_weight, now.with_last, base))
        given_up = n_temperatures >= effort.most_temperatures
        stuck |= all_at_once == 0.0 or (given_up and all_at_once < least)
        if stuck and fall_back is not None:
            return particles_from_posterior(fall_back(), n, problem, rng=rng)
        if all_at_once == 0.0:
            return replace(previous.with_zero_evidence(), strained=True)
        strained |= stuck
        if all_at_once >= least or given_up:
            power = 1.0
        else:
            if n_temperatures == 0:  # the first temperature: only now the readings before count too
                now = replace(now, without_last=problem.log_likelihoods(evaluated, power)[0])
            power = _next_power(log_weight, base, now, power, least)
        weighed = _updated_log_weights(log_weight, now.log_likelihood_at_power(power), base)
        gained = float(logsumexp(weighed))
        log_z, log_weight, base = log_z + gained, weighed - gained, now.log_likelihood_at_power(power)
        n_eff = n_effective(log_weight)
        variance += max(1.0 / n_eff - 1.0 / n, 0.0)
        if power == 1.0 and n_eff >= least:
            break
        rows = resampled_rows(np.exp(log_weight - log_weight.max()), n, rng)
        parts = [np.arange(n)]
        if fall_back is None:  # copies of a sample in the same part, unless one of two is too small to fit kernels
            halves = [np.flatnonzero(rows % 2 == k) for k in (0, 1)]
            parts = halves if min(map(len, halves)) >= _LEAST_PART * n else parts
        now, accepted, n_moves = _move_by_metropolis(now.take_rows(rows), power, problem, rng, parts, effort)
        n_calls, n_temperatures = n_calls + n_moves, n_temperatures + 1
        ancestor, stuck = ancestor[rows], accepted < _STIFF
        base, log_weight = now.log_likelihood_at_power(power), np.full(n, -math.log(n))
        if power == 1.0 and (fall_back is None or not stuck):
            strained |= stuck
            break
    found = Weighted(
        before.names,
        now.theta,
        log_likelihood=now.with_last,
        log_weight=log_weight,
        log_z=log_z,
        log_z_error=math.sqrt(variance),
        n_eff=n_effective(log_weight),
        n_calls=before.n_calls + n_calls,
        pareto_k=pareto_k(log_weight) if n_eff < n else -math.inf,
    )
    return replace(
        previous,
        weighted=found,
        ancestor=ancestor,
        n_resampled=previous.n_resampled + n_temperatures,
        strained=strained,
        hurried=previous.hurried or n_temperatures >= _MANY_TEMPERATURES,
    )


def resample_and_move(
    particles: Particles,
    n: int,
    problem: SequentialProblem,
    *,
    rng: np.random.Generator,
    effort: UpdateSettings = THOROUGH,
) -> Particles:
    """Resample to `n` samples, and move the copies apart; unchanged if there are `n` already or the evidence is 0.

    `problem` holds the readings included so far.
    """
    before = particles.weighted
    if n == len(before.theta) or before.log_z == -math.inf:
        return particles
    rows = resampled_rows(before.weight, n, rng)
    theta, log_likelihood = before.theta[rows], before.log_likelihood[rows]
    start = _EvaluatedSamples(theta, problem.prior.log_prob(theta), log_likelihood, log_likelihood.copy())
    found = _moved_apart(start, before, problem, n_calls=before.n_calls, rng=rng, effort=effort)
    lost, n_resampled = max(particles.lost_log_z, before.log_z - math.log(n)), particles.n_resampled + 1
    ancestor = particles.ancestor[rows]
    return replace(particles, weighted=found, ancestor=ancestor, n_resampled=n_resampled, lost_log_z=lost)


def particles_from_posterior(
    found: Weighted | NestedResult,
    n: int,
    problem: SequentialProblem,
    *,
    rng: np.random.Generator,
    effort: UpdateSettings = THOROUGH,
) -> Particles:
    """Restart with `n` samples resampled from a posterior and moved apart, with that posterior's evidence."""
    start = _EvaluatedSamples.of(found.theta[resampled_rows(found.weight, n, rng)], problem, 1.0)
    drawn = _moved_apart(start, found, problem, n_calls=found.n_calls + n, rng=rng, effort=effort)
    return Particles(drawn, np.arange(n), found.log_z_error**2)


def _moved_apart(
    start: _EvaluatedSamples,
    found: Weighted | NestedResult,
    problem: SequentialProblem,
    *,
    n_calls: int,
    rng: np.random.Generator,
    effort: UpdateSettings,
) -> Weighted:
    """Move samples, some of them copies; return them equally weighted, with the evidence and the run of `found`."""
    moved, _, n_moves = _move_by_metropolis(start, 1.0, problem, rng, [np.arange(len(start.theta))], effort)
    return evenly_weighted(
        found.names,
        moved.theta,
        moved.with_last,
        log_z=found.log_z,
        log_z_error=found.log_z_error,
        n_calls=n_calls + n_moves,
        run=found if isinstance(found, NestedResult) else found.run,
    )


def nested_sampling_from_scratch(
    problem: Samplable, *, n_live: int, rng: np.random.Generator, moves: float = KernelMove.moves
) -> NestedResult:
    """Solve a problem, all readings at once, by nested sampling; see `KernelMove` for `moves`."""
    return run(
        problem,
        rng=rng,
        n_live=max(n_live, LIVE_PER_PARAM * len(problem.prior.names)),
        move=KernelMove(moves=moves),
        stop=RemainingEvidence(_DLOGZ),
        max_cost=1.0,  # speed matters, since the robot waits
    )


@dataclass(frozen=True, eq=False)
class _EvaluatedSamples:
    """Samples with their log prior, and their log likelihoods without and with the last reading."""

    theta: FloatArray
    log_prior: FloatArray
    without_last: FloatArray
    with_last: FloatArray

    @classmethod
    def of(cls, theta: FloatArray, problem: SequentialProblem, power: float) -> _EvaluatedSamples:
        """Evaluate samples (see `SequentialProblem.log_likelihoods`); outside the prior the likelihood is zero."""
        log_prior = problem.prior.log_prob(theta)
        without_last, with_last = np.zeros(len(theta)), np.full(len(theta), -np.inf)
        possible = np.isfinite(log_prior)
        if possible.any():
            evaluated = problem.evaluate(theta[possible])
            without_last[possible], with_last[possible] = problem.log_likelihoods(evaluated, power)
        return cls(theta, log_prior, without_last, with_last)

    def log_likelihood_at_power(self, power: float) -> FloatArray:
        """Return the log likelihood, (n,), with the last reading's likelihood to this power."""
        return self.with_last if power == 1.0 else (1.0 - power) * self.without_last + power * self.with_last

    def take_rows(self, rows: IntArray) -> _EvaluatedSamples:
        return _EvaluatedSamples(self.theta[rows], self.log_prior[rows], self.without_last[rows], self.with_last[rows])

    def with_rows_overwritten(self, rows: BoolArray, other: _EvaluatedSamples) -> _EvaluatedSamples:
        """Return the samples, with those of `other` (as many) in the rows that the mask `rows` marks."""
        return _EvaluatedSamples(
            np.where(rows[:, None], other.theta, self.theta),
            np.where(rows, other.log_prior, self.log_prior),
            np.where(rows, other.without_last, self.without_last),
            np.where(rows, other.with_last, self.with_last),
        )


def _move_by_metropolis(
    start: _EvaluatedSamples,
    power: float,
    problem: SequentialProblem,
    rng: np.random.Generator,
    parts: Sequence[IntArray],
    effort: UpdateSettings,
) -> tuple[_EvaluatedSamples, float, int]:
    """Move equally weighted samples by Metropolis-Hastings steps that leave their density invariant.

    That density has the last reading's likelihood to this power. A round is a proposal from kernels fitted to
    the samples, then one along the difference of two samples (ter Braak 2006): the first follows curved shells in few
    dimensions, the second works in many. Each of `parts` (rows of the samples) is moved by kernels fitted to the
    previous part, since kernels fitted to the moved samples themselves would be biased. Return the samples, the mean
    number of accepted steps per sample, and the number of likelihood evaluations.
    """
    n, n_params = start.theta.shape
    if len(np.unique(start.theta[:, 0])) <= 2 * n_params:  # too few distinct samples to fit kernels
        return start, 0.0, 0
    kernels = [LocalKernels.fitted_to(start.theta[rows], rng=rng, most=effort.n_kernels) for rows in parts]
    now, accepted, n_calls = start, 0.0, 0
    for _ in range(_MOST_ROUNDS):
        for propose in (_propose_from_kernels, _propose_along_differences):
            theta, log_ratio = np.empty_like(now.theta), np.empty(n)
            for k, rows in enumerate(parts):
                theta[rows], log_ratio[rows] = propose(now.theta[rows], kernels[k - 1], rng)
            proposed = _EvaluatedSamples.of(theta, problem, power)
            odds = proposed.log_prior + proposed.log_likelihood_at_power(power)
            odds = odds - now.log_prior - now.log_likelihood_at_power(power) + log_ratio
            taken = np.log(rng.random(n)) < odds
            now = now.with_rows_overwritten(taken, proposed)
            n_calls += n
            accepted += float(taken.mean())
        if accepted >= effort.steps_per_sample:
            break
    return now, accepted, n_calls


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


def _next_power(log_weight: FloatArray, base: FloatArray, now: _EvaluatedSamples, power: float, enough: float) -> float:
    """Return the largest power, above this one, of the last reading's likelihood with `enough` effective samples."""

    def log_weights_at(power: float) -> FloatArray:
        return _updated_log_weights(log_weight, now.log_likelihood_at_power(power), base)

    low = largest_power(log_weights_at, power, wanted=enough)
    return max(low, power + 1e-6)


def _updated_log_weights(log_weight: FloatArray, after: FloatArray, before: FloatArray) -> FloatArray:
    """Return log weights updated from log likelihoods `before` to those `after`; excluded samples remain excluded."""
    alive = np.isfinite(log_weight)
    return np.asarray(np.where(alive, log_weight + after - np.where(alive, before, 0.0), -np.inf))


@dataclass(frozen=True, eq=False)
class LocalKernels:
    """A mixture of equally weighted Gaussians.

    `centre` (n_kernels, n_params) are the means relative to `origin`, `root` (n_kernels, n_params, n_params) the
    Cholesky factors of the covariances. A point's features (1, its coordinates relative to `origin`, the products of
    two coordinates) times `form` (n_features, n_kernels) are the log densities of the kernels there.
    """

    origin: FloatArray
    centre: FloatArray
    root: FloatArray
    form: FloatArray

    @classmethod
    def fitted_to(
        cls, points: FloatArray, *, rng: np.random.Generator, widened: float = 1.0, most: int = _MOST_KERNELS
    ) -> Self:
        """Fit at most `most` kernels to equally weighted samples, (n_samples, n_params), `widened` times as wide."""
        n_samples, n_params = points.shape
        origin = points.mean(axis=0)
        away = points - origin
        scale = np.maximum(points.std(axis=0), np.maximum(_RESOLUTION * np.abs(origin), _SMALLEST))
        rows = rng.permutation(n_samples)[: min(most, (n_samples + 1) // 2)]
        n_near = min(max(_NEIGHBOURS * n_params, 2 * n_samples // len(rows)), n_samples)
        near = _nearest_rows(away / scale, rows, n_near)
        spread = away[near] - away[near].mean(axis=1, keepdims=True)
        overall = np.atleast_2d(np.cov(points, rowvar=False))
        covariance = np.einsum("kni,knj->kij", spread, spread) / n_near
        covariance += _RIDGE * (overall + np.diag(scale**2))
        covariance *= widened**2
        centre = away[rows]
        root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
        precision = np.linalg.inv(covariance)
        log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        pull = np.einsum("kij,kj->ki", precision, centre)
        constant = -0.5 * (np.einsum("ki,ki->k", pull, centre) + log_det + n_params * math.log(2 * math.pi))
        upper = _upper_triangle_indices(n_params)
        product = -np.where(upper[0] == upper[1], 0.5, 1.0) * precision[:, upper[0], upper[1]]
        return cls(origin, centre, root, np.concatenate([constant[:, None], pull, product], axis=1).T)

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, n_params)."""
        which = rng.integers(len(self.centre), size=n)
        white = rng.standard_normal((n, self.centre.shape[1]))
        return np.asarray(self.origin + self.centre[which] + np.einsum("nij,nj->ni", self.root[which], white))

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the natural log of the mixture's density at points, (n, n_params) -> (n,)."""
        upper = _upper_triangle_indices(points.shape[1])
        out = np.empty(len(points))
        for start in range(0, len(points), _BLOCK):
            away = points[start : start + _BLOCK] - self.origin
            features = np.concatenate([np.ones((len(away), 1)), away, away[:, upper[0]] * away[:, upper[1]]], axis=1)
            each = features @ self.form
            most = each.max(axis=1)
            # Only the nearest kernels matter, and single precision suffices for a proposal density.
            each -= most[:, None]
            out[start : start + _BLOCK] = most + np.log(np.exp(each.astype(np.float32)).sum(axis=1))
        return out - math.log(len(self.centre))


def _nearest_rows(points: FloatArray, rows: IntArray, n: int) -> IntArray:
    """Return the indices, (n_rows, n), of the `n` points nearest to each point of `rows`, itself included; no order."""
    if len(points) > (_FEW if len(rows) > _FEW_ROWS else _FEW_FOR_FEW_ROWS):
        from scipy.spatial import cKDTree  # slow to import, and few need it

        return np.asarray(cKDTree(points).query(points[rows], k=n)[1].reshape(len(rows), n))
    square = (points**2).sum(axis=1)
    away = square - 2.0 * points[rows] @ points.T  # less the row's own square, the same for all
    return np.asarray(np.argpartition(away, n - 1, axis=1)[:, :n])


@cache
def _upper_triangle_indices(n_params: int) -> tuple[IntArray, IntArray]:
    return np.triu_indices(n_params)
