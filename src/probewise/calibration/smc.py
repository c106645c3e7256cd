"""Sample the posterior of N Gaussians by sequential Monte Carlo (SMC; Del Moral, Doucet & Jasra 2006).

Particles are drawn from a known density, made from the posterior of N - 1 or about a peak. In small changes of
temperature they become samples of the posterior of N: weighted, resampled, and moved by Metropolis steps. They form
clouds, each weighted and resampled by itself. The scatter of the clouds' evidences is a valid error: it covers parts
that one cloud found and another missed. Notes and documentation call such a run a climb.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import expit, logsumexp

from probewise._arrays import FloatArray, IntArray, read_only_floats
from probewise._display import ShowsItself
from probewise.calibration.reference_density import ReferenceDensity
from probewise.inference import SensorProblem
from probewise.nested.weights import n_effective, power_bracket, resampled_rows
from probewise.priors import Coordinates

# A change of temperature leaves at least this share of the particles effective.
_KEPT = 0.25
_N_STEPS = 3
_BISECTIONS = 40
_BRIDGE_STEPS = 30
# Draws of the reference for each particle that is kept: so many at a time, until enough are effective, and at most.
_DRAWS, _MOST_DRAWS = 2, 16
# Number of snapshots of the posterior's samples that are kept.
N_SNAPSHOTS = 4
# Clouds of particles, whose scatter gives the error of an evidence.
N_CLOUDS = 8
# Moves of each particle once the posterior is reached; an independent proposal after every second one.
_N_MORE, _AFRESH = 16, 2
# A posterior that takes more temperatures lies far from the reference, and is left to a search of the prior.
_MOST_TEMPERATURES = 12
# Share of the moves that change the coordinates of one Gaussian, or the levels, alone.
_BY_BLOCK = 0.5
_WHOLE_JUMP = 0.1
_JITTER = 1e-5
# Limits beyond which a run is doubtful: error of ln Z, effective share of the clouds, moves accepted, overlap.
_MOST_ERROR = 0.5
_LEAST_CLOUDS = 0.3
_LEAST_ACCEPTED = 0.02
_LEAST_OVERLAP = 0.02


@dataclass(frozen=True)
class TemperatureSummary:
    """Progress of a run after a temperature: the temperature, 0 to 1, ln Z and likelihood evaluations so far."""

    temperature: float
    log_z: float
    n_calls: int


@dataclass(frozen=True, eq=False)
class SMCResult(ShowsItself):
    """Weighted samples of a posterior and its evidence, by sequential Monte Carlo.

    Attributes
    ----------
    names
        Parameter names, one per column of theta.
    theta
        Samples, (n, n_params), cloud after cloud, in each the earlier snapshots first; the Gaussians are sorted by
        mass.
    log_likelihood, log_weight
        Of each sample, (n,); the weights sum to one.
    log_z_of_clouds
        Natural log of the evidence from each cloud, (n_clouds,).
    start_error
        Standard error of ln Z that all clouds share: from the order below, and from samples that still drift.
    temperatures
        From 0, the reference, to 1, the posterior, (n_temperatures,).
    accepted
        Share of the moves accepted at the last temperature.
    n_calls
        Number of likelihood evaluations, those of the order below included.
    doubts
        Further reasons to doubt the result, in words.
    """

    names: tuple[str, ...]
    theta: FloatArray
    log_likelihood: FloatArray
    log_weight: FloatArray
    log_z_of_clouds: FloatArray
    start_error: float
    temperatures: FloatArray
    accepted: float
    n_calls: int
    doubts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("theta", "log_likelihood", "log_weight", "log_z_of_clouds", "temperatures"):
            object.__setattr__(self, name, read_only_floats(getattr(self, name)))

    @property
    def log_z(self) -> float:
        """Natural log of the mean of the clouds' evidences."""
        return float(logsumexp(self.log_z_of_clouds)) - math.log(len(self.log_z_of_clouds))

    @property
    def log_z_error(self) -> float:
        """Standard error of log Z: `start_error` and the scatter of the few clouds as of a Student t, in quadrature."""
        relative = np.exp(self.log_z_of_clouds - self.log_z)
        n = len(relative)
        return math.hypot(float(relative.std(ddof=1)) * math.sqrt((n - 1) / (n - 3) / n), self.start_error)

    @property
    def weight(self) -> FloatArray:
        """Posterior weights, summing to one, (n,)."""
        return np.asarray(np.exp(self.log_weight))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt the evidence, in words; empty if there are none."""
        share = n_effective(self.log_z_of_clouds) / len(self.log_z_of_clouds)
        told = (
            (self.temperatures[-1] != 1.0, f"the posterior was not reached in {_MOST_TEMPERATURES} temperatures"),
            (not self.log_z_error < _MOST_ERROR, f"the error of ln Z is {self.log_z_error:.2f}"),
            (not share >= _LEAST_CLOUDS, f"{len(self.log_z_of_clouds)} clouds are worth {share:.0%} of them"),
            (not self.accepted >= _LEAST_ACCEPTED, f"{self.accepted:.1%} of the moves were accepted"),
        )
        return (*(words for so, words in told if so), *self.doubts)

    def samples(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` equally weighted posterior samples, (n, n_params), in random order."""
        return np.asarray(self.theta[rng.permutation(resampled_rows(self.weight, n, rng))])

    def summary(self) -> str:
        """Describe evidence and cost in plain text."""
        lines = [
            f"log Z        {self.log_z:.3f} ± {self.log_z_error:.3f}",
            f"samples      {len(self.theta)} in {len(self.log_z_of_clouds)} clouds",
            f"cost         {self.n_calls} likelihood evaluations, {len(self.temperatures) - 1} temperatures",
        ]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.warnings)])


@dataclass(frozen=True, eq=False)
class _Particles:
    """Particles: coordinates `x`, (n, d); logs of prior, likelihood, and reference over prior density, (n,) each."""

    x: FloatArray
    log_prior: FloatArray
    log_likelihood: FloatArray
    log_reference: FloatArray

    def select_rows(self, rows: IntArray) -> _Particles:
        return _Particles(self.x[rows], self.log_prior[rows], self.log_likelihood[rows], self.log_reference[rows])

    def with_rows_replaced(self, rows: IntArray, other: _Particles) -> _Particles:
        out = self.select_rows(np.arange(len(self.x)))
        out.x[rows], out.log_prior[rows] = other.x, other.log_prior
        out.log_likelihood[rows], out.log_reference[rows] = other.log_likelihood, other.log_reference
        return out

    def joined_cloud_by_cloud(self, other: _Particles, n_clouds: int) -> _Particles:
        """Append to each cloud of particles the cloud of the same number in `other`."""
        both = np.arange(len(self.x) + len(other.x))
        mine, others = np.split(both, [len(self.x)])
        rows = np.concatenate([mine.reshape(n_clouds, -1), others.reshape(n_clouds, -1)], axis=1).ravel()
        pairs = ((self.x, other.x), (self.log_prior, other.log_prior))
        logs = ((self.log_likelihood, other.log_likelihood), (self.log_reference, other.log_reference))
        return _Particles(*(np.concatenate(pair)[rows] for pair in (*pairs, *logs)))

    @property
    def log_target_over_reference(self) -> FloatArray:
        """Log of prior times likelihood over the reference density, (n,)."""
        return self.log_likelihood - self.log_reference

    def log_tempered_density(self, beta: float) -> FloatArray:
        """Log density at temperature `beta`, from the reference at 0 to the posterior at 1, up to a constant, (n,)."""
        return np.asarray(self.log_prior + beta * self.log_likelihood + (1.0 - beta) * self.log_reference)


def run_smc(
    problem: SensorProblem,
    reference: ReferenceDensity,
    rest: FloatArray,
    *,
    log_z_below: FloatArray,
    error_below: float,
    n_calls_below: int = 0,
    rng: np.random.Generator,
    space: Coordinates | None = None,
    n_steps: int = _N_STEPS,
    n_more: int = _N_MORE,
    least_effective: float = _KEPT,
    at_once_from: int | None = None,
    progress: Callable[[TemperatureSummary], None] | None = None,
) -> SMCResult:
    """Move particles from a reference density to the posterior of N Gaussians.

    Parameters
    ----------
    problem
        The problem of N Gaussians.
    reference
        Density of N Gaussians from which the particles are drawn.
    rest
        Samples of the posterior of N - 1, sorted by mass, (n, 6 N - 4), cloud after cloud; (n, 0) for a reference that
        needs none. n is the number of particles.
    log_z_below
        Natural log of the evidence of N - 1 from each cloud, (n_clouds,); n_clouds divides n. 0 without samples.
    error_below
        Standard error of `log_z_below` that all clouds share.
    n_calls_below
        Likelihood evaluations so far.
    rng
        Source of randomness.
    space
        Coordinates of the particles, with the prior density that they are held to; default: those of the prior.
    n_steps
        Moves of each particle at each temperature.
    n_more
        Moves of each particle at the posterior, times the number of temperatures; samples are kept from their last
        half.
    least_effective
        Least share of the particles that a change of temperature leaves effective.
    at_once_from
        Number of temperatures, 0 included, after which the next one is 1; where a `FaintGaussianLikelihoodRatio` gives
        the evidence.
    progress
        Called after every temperature.

    Returns
    -------
    SMCResult
        It has `warnings` if the posterior was not reached, or its evidence is doubtful.
    """
    space = reference.prior.coordinates if space is None else space
    n_calls = n_calls_below

    def evaluate_particles(x: FloatArray, beta: float = 0.0) -> _Particles:
        nonlocal n_calls
        theta, log_prior = space.leave(x)
        # What is impossible weighs nothing, but was drawn.
        log_likelihood, log_reference = np.full(len(x), -np.inf), np.zeros(len(x))
        possible = np.flatnonzero(np.isfinite(log_prior))
        if possible.size:
            n_calls += possible.size
            log_likelihood[possible] = problem.log_likelihood(theta[possible])
            if beta < 1.0:
                n_calls += possible.size
                log_reference[possible] = reference.log_density_over_prior(theta[possible])
        return _Particles(x, log_prior, log_likelihood, log_reference)

    n_clouds = len(log_z_below)
    n = len(rest) // n_clouds
    log_z = np.array(log_z_below)

    def draw_particles() -> _Particles:
        with np.errstate(invalid="ignore"):
            return evaluate_particles(space.enter(reference.draw(np.repeat(rest, _DRAWS, axis=0), rng=rng)))

    now = draw_particles()
    while n_effective(now.log_target_over_reference) < least_effective * len(rest) and len(now.x) < _MOST_DRAWS * len(
        rest
    ):
        now = now.joined_cloud_by_cloud(draw_particles(), n_clouds)
    temperatures, accepted, overlap = [0.0], 0.0, 1.0
    while temperatures[-1] < 1.0 and len(temperatures) <= _MOST_TEMPERATURES:
        rise = now.log_target_over_reference
        beta = (
            1.0
            if len(temperatures) == at_once_from
            else _next_temperature(rise, temperatures[-1], least_effective, len(rest))
        )
        width = beta - temperatures[-1]
        log_weight = (width * rise).reshape(n_clouds, -1)
        if not np.isfinite(log_weight.max(axis=1)).all():
            log_z[:] = -np.inf
            break
        here = log_weight.shape[1]
        # Cut off (truncated importance sampling, Ionides 2008): a single particle must not take over its cloud.
        mean = logsumexp(log_weight, axis=1, keepdims=True) - math.log(here)
        weight = np.exp(np.minimum(log_weight - mean, 0.5 * math.log(here)))
        now = now.select_rows(np.concatenate([k * here + resampled_rows(own, n, rng) for k, own in enumerate(weight)]))
        temperatures.append(beta)
        shares = []
        for _ in range(n_steps):
            now, share = _moved_by_differential_evolution(now, partial(evaluate_particles, beta=beta), beta, rng)
            shares.append(share)
        now = _moved_by_independent_proposals(now, partial(evaluate_particles, beta=beta), reference, space, beta, rng)
        accepted = float(np.mean(shares))
        if beta == 1.0:
            now = evaluate_particles(now.x)
        log_ratio, share = _log_evidence_ratio_and_overlap(
            log_weight, (width * now.log_target_over_reference).reshape(n_clouds, n)
        )
        log_z += log_ratio
        overlap = min(overlap, share)
        if progress is not None:
            progress(TemperatureSummary(beta, float(logsumexp(log_z)) - math.log(n_clouds), n_calls))
    kept = [now]
    if temperatures[-1] == 1.0:
        # A reference that is far from the posterior is forgotten late.
        kept = _snapshots_of_posterior(
            now, partial(evaluate_particles, beta=1.0), reference, space, n_more * (len(temperatures) - 1), rng
        )
    x = np.stack([cloud.x.reshape(n_clouds, n, -1) for cloud in kept], axis=1)
    theta, _ = space.leave(x.reshape(-1, x.shape[-1]))
    log_likelihood = np.stack([cloud.log_likelihood.reshape(n_clouds, n) for cloud in kept], axis=1)
    return SMCResult(
        names=reference.prior.names,
        theta=theta,
        log_likelihood=log_likelihood.ravel(),
        log_weight=np.full(len(theta), -math.log(len(theta))),
        log_z_of_clouds=log_z,
        start_error=error_below,
        temperatures=np.array(temperatures),
        accepted=accepted,
        n_calls=n_calls,
        doubts=()
        if overlap >= _LEAST_OVERLAP
        else (f"two temperatures have {overlap:.1%} of the particles in common",),
    )


def _snapshots_of_posterior(
    now: _Particles,
    evaluate_particles: Callable[[FloatArray], _Particles],
    reference: ReferenceDensity,
    space: Coordinates,
    n_more: int,
    rng: np.random.Generator,
) -> list[_Particles]:
    """Move particles of the posterior `n_more` times; return up to `N_SNAPSHOTS` of their states from the last half."""
    keep = {round(n_more * (0.5 + 0.5 * k / (N_SNAPSHOTS - 1))) for k in range(N_SNAPSHOTS)}
    kept = []
    for k in range(1, n_more + 1):
        now, _ = _moved_by_differential_evolution(now, evaluate_particles, 1.0, rng)
        if k % _AFRESH == 0:
            now = _moved_by_independent_proposals(now, evaluate_particles, reference, space, 1.0, rng)
        if k in keep:
            kept.append(now)
    return kept


def _log_evidence_ratio_and_overlap(before: FloatArray, after: FloatArray) -> tuple[FloatArray, float]:
    """Estimate by a bridge (Bennett 1976) the log ratio of two temperatures' evidences in each cloud, (n_clouds,).

    `before` and `after` are the log weights of particles at either temperature, (n_clouds, n) each. Also return the
    lesser effective share of the two sets of particles.
    """
    size = math.log(before.shape[1]) - math.log(after.shape[1])
    log_ratio = logsumexp(before, axis=1) - math.log(before.shape[1])
    for _ in range(_BRIDGE_STEPS):
        level = (log_ratio + size)[:, None]
        down, up = expit(before - level), expit(level - after)
        with np.errstate(divide="ignore"):
            log_ratio = level[:, 0] + np.log(down.mean(axis=1)) - np.log(up.mean(axis=1))
    shares = [part.sum() ** 2 / max((part**2).sum(), 1e-300) / part.size for part in (down, up)]
    return np.asarray(log_ratio), float(min(shares))


def _next_temperature(rise: FloatArray, beta: float, share: float, n_particles: int) -> float:
    """Find the temperature after `beta`, 1 at most, whose weights leave a share `share` of the particles effective."""
    # What is impossible is lost at any temperature.
    least = share * float(min(n_particles, np.isfinite(rise).sum()))
    if n_effective((1.0 - beta) * rise) >= least:
        return 1.0
    return power_bracket(lambda power: (power - beta) * rise, beta, 1.0, wanted=least, n_steps=_BISECTIONS)[1]


def _moved_by_differential_evolution(
    now: _Particles, evaluate_particles: Callable[[FloatArray], _Particles], beta: float, rng: np.random.Generator
) -> tuple[_Particles, float]:
    """Move each particle once, one half after the other; return the cloud and the share of moves accepted.

    A particle moves along the difference of two particles of the other half (differential evolution, ter Braak 2006).
    """
    n, d = now.x.shape
    n_gaussians = (d - 2) // 6
    block_of = np.minimum(np.arange(d) // 6, n_gaussians)
    jitter = _JITTER * now.x.std(axis=0)
    order = rng.permutation(n)
    n_accepted = 0
    for half in (0, 1):
        own, other = order[half::2], order[1 - half :: 2]
        m = len(own)
        old = now.select_rows(own)
        in_block = block_of == rng.integers(n_gaussians + 1, size=m)[:, None]
        by_block = rng.random(m) < _BY_BLOCK
        scale = 2.38 / math.sqrt(2 * d) * np.exp(0.4 * rng.standard_normal(m))
        scale *= np.where(by_block, math.sqrt(d / 6), 1.0)
        scale[rng.random(m) < _WHOLE_JUMP] = 1.0
        one, two = rng.choice(other, (2, m))
        step = scale[:, None] * (now.x[one] - now.x[two]) + jitter * rng.standard_normal((m, d))
        new = evaluate_particles(old.x + np.where(by_block[:, None] & ~in_block, 0.0, step))
        better = np.log(rng.random(m)) < new.log_tempered_density(beta) - old.log_tempered_density(beta)
        n_accepted += int(better.sum())
        now = now.with_rows_replaced(own[better], new.select_rows(np.flatnonzero(better)))
    return now, n_accepted / n


def _moved_by_independent_proposals(
    now: _Particles,
    evaluate_particles: Callable[[FloatArray], _Particles],
    reference: ReferenceDensity,
    space: Coordinates,
    beta: float,
    rng: np.random.Generator,
) -> _Particles:
    """Propose a draw from the reference to each particle, accepted by the ratio of target over reference density."""
    there, log_drawn = reference.propose_moves(space.leave(now.x)[0], rng=rng)
    with np.errstate(invalid="ignore"):
        new = evaluate_particles(space.enter(there))
        log_accept = (
            new.log_tempered_density(beta) - now.log_tempered_density(beta) + log_drawn + now.log_prior - new.log_prior
        )
        better = np.flatnonzero(np.log(rng.random(len(there))) < log_accept)
    return now.with_rows_replaced(better, new.select_rows(better))
