"""The posterior of a run: a mixture of kinds of hypotheses, each with its own samples, evidence and error.

The probability of a kind is proportional to its prior times its evidence. Improbable kinds are kept with fewer samples,
so that later readings can revive them. Sequential evidences accumulate errors; if these could change the probabilities
of the kinds, the evidence is re-estimated from all readings: by bridge sampling or, if the samples could not follow the
readings, by nested sampling of that kind.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.special import expit, logsumexp

from probewise._arrays import FloatArray
from probewise.errors import DoubtfulResultWarning, NotConvergedError
from probewise.experiment.evidence import BridgedEvidence, bridged_evidence, posterior_sampled_about_points
from probewise.experiment.kinds import HypothesisKind
from probewise.experiment.particles import (
    BRIEF,
    STEADY,
    THOROUGH,
    Particles,
    UpdateSettings,
    particles_from_posterior,
    prior_particles,
    resample_and_move,
    update,
)
from probewise.experiment.refitted import fit_kind, sampled_about_fits
from probewise.experiment.rivals import declared_noise
from probewise.inference.problem import SensorProblem
from probewise.nested.importance import Weighted
from probewise.nested.result import NestedResult
from probewise.recordings.plan import Recording


class FromScratch(Protocol):
    """Solves a kind's whole problem by nested sampling; with fewer live points if `quick`."""

    def __call__(self, problem: SensorProblem, *, quick: bool = False) -> NestedResult:
        """Return the result; raise NotConvergedError if no hypothesis could have given the readings."""
        ...


_IMPROBABLE = 1e-3  # probability below which a kind is carried by fewer samples
_FEWER = 3  # times
_SUSPECTED = ((0.2, 2), (0.02, 4), (0.0, 6))  # probability from which on a rival has which fraction of the samples
_MOST_OFF = 0.02  # by which a kind's probability may be wrong
_DOUBTED_OFF = 0.06  # the same in a run that doubts its sensor, where no decision hangs on less
_OFF_AT_THE_END = 0.5  # the same where samples have just been taken anew
_HAS_A_SAY = 0.02  # probability of a kind in doubt that is solved from scratch; before a run ends, of every kind
_CARRIED = 0.25  # nats by which a carried evidence may be wrong that genealogies do not tell
_STRAINED = 6.0  # nats, where samples could not follow
_TOLD_APART = 1.5  # nats between an evidence carried and one taken anew, from which on the samples are in doubt
_HOPELESS = 60.0  # nats behind the best kind, from which on no evidence is taken anew
_DRAWS = 1000
_MOST_DRAWS = 1500
_NESTED = 6.0  # nats by which a rival may be less likely than the plain model, which is a case of it
_BEHIND = 9.0  # nats behind the best kind, from which on a rival is not sampled anew
_FEWEST = 4.0  # effective draws below which a sample replaces none
_LEAST_FOUND = 15.0  # effective draws from which on a sample replaces another of about the same evidence
_WELL_FOUND = 100.0  # effective draws from which on samples need not be taken anew until a reading strains them
_RULED_OUT = 10.0  # nats by which fits and a kind's own samples may miss its evidence, where both are behind
_REPRODUCED = 5  # of the starts, which must lead to fits as good as the best: otherwise better ones may be missed
_SEARCHED_PER_READING = 1  # kinds that are searched from scratch after a reading; before a run ends, all that need it
_LOST = 0.01  # probability of a kind that must not be missed

WARY = 12.0
"""Factor on the odds that the sensor model is incomplete, wherever something is concluded: choice of readings, stopping
rule, reported shape and its error, credible set. By the plain odds a fault that a dozen readings can hardly show would
be right one time in ten, and whatever is concluded of a run that has it would miss."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Samples of every kind, in the order of the kinds."""

    kinds: tuple[HypothesisKind, ...]
    particles: tuple[Particles, ...]

    @property
    def log_odds(self) -> FloatArray:
        """Log of prior times evidence of each kind, (n_kinds,)."""
        return np.array([k.log_prior + p.log_z for k, p in zip(self.kinds, self.particles, strict=True)])

    @property
    def probability(self) -> FloatArray:
        """Probability of each kind, (n_kinds,), summing to one."""
        return _probabilities_of_log_odds(self.log_odds)

    @property
    def log_z(self) -> float:
        """Natural log of the evidence of the mixture."""
        return float(logsumexp(self.log_odds))

    @property
    def left_out(self) -> dict[str, float]:
        """Probability of each effect that the sensor may leave out, marginalised over shapes; "" is none."""
        shares: dict[str, float] = {}
        for kind, p in zip(self.kinds, self.probability.tolist(), strict=True):
            shares[kind.left_out] = shares.get(kind.left_out, 0.0) + p
        return shares

    @property
    def leader(self) -> int:
        """Index of the most probable kind."""
        return int(self.log_odds.argmax())

    def with_fault_odds_times(self, times: float) -> Posterior:
        """Return the posterior with the odds of an incomplete sensor model multiplied by `times`."""
        log_prior = np.array([k.log_prior + (math.log(times) if k.left_out else 0.0) for k in self.kinds])
        log_prior -= logsumexp(log_prior)
        kinds = tuple(replace(k, log_prior=p) for k, p in zip(self.kinds, log_prior.tolist(), strict=True))
        return replace(self, kinds=kinds)

    @property
    def with_warier_odds(self) -> Posterior:
        """The posterior with the odds of an incomplete model multiplied by `WARY`; itself if no kind has an effect."""
        return self.with_fault_odds_times(WARY) if any(kind.left_out for kind in self.kinds) else self

    def joined(self, *, rng: np.random.Generator) -> Weighted:
        """Combine the samples of all kinds to one weighted posterior."""
        if len(self.kinds) == 1:
            return self.particles[0].weighted
        probability = self.probability
        some = [k for k, p in enumerate(probability) if p > 0]
        own = [self.particles[k].weighted for k in some]
        leader = self.particles[self.leader].weighted
        theta = np.concatenate([self.kinds[k].to_whole_theta(w.theta, rng) for k, w in zip(some, own, strict=True)])
        log_weight = np.concatenate([w.log_weight + math.log(probability[k]) for k, w in zip(some, own, strict=True)])
        weight = np.exp(log_weight)
        errors = np.array([self.particles[k].log_z_error for k in some])
        return Weighted(
            self.kinds[0].whole_names,
            theta,
            np.concatenate([w.log_likelihood for w in own]),
            log_weight,
            self.log_z,
            float(np.sqrt(probability[some] ** 2 @ errors**2)),
            float(weight.sum() ** 2 / (weight @ weight)),
            sum(p.weighted.n_calls for p in self.particles),
            max(w.pareto_k for w in own),
            leader.run,
        )


def prior_posterior(kinds: Sequence[HypothesisKind], n_particles: int, *, rng: np.random.Generator) -> Posterior:
    """Return the posterior without readings: samples of every kind's prior, fewer for improbable kinds and rivals."""
    shares = [math.exp(kind.log_prior) for kind in kinds]
    sizes = [_n_samples_of_kind(kind, p, n_particles) for kind, p in zip(kinds, shares, strict=True)]
    drawn = (prior_particles(kind.prior, n, rng=rng) for kind, n in zip(kinds, sizes, strict=True))
    return Posterior(tuple(kinds), tuple(drawn))


def updated(
    previous: Posterior,
    recording: Recording,
    n_particles: int,
    *,
    rng: np.random.Generator,
    from_scratch: FromScratch,
) -> Posterior:
    """Update the posterior with the last reading of a recording.

    Parameters
    ----------
    previous
        Posterior given the earlier readings.
    recording
        All readings.
    n_particles
        Samples of a probable kind.
    rng
        Source of randomness.
    from_scratch
        Solves a kind's whole problem by nested sampling.

    Raises
    ------
    NotConvergedError
        If no hypothesis of any kind could have given the readings.
    """
    problems = [kind.problem(recording) for kind in previous.kinds]
    if len(problems) == 1:
        (only,), (problem,) = previous.particles, problems
        found = update(only, problem, rng=rng, fall_back=lambda: from_scratch(problem))
        return replace(previous, particles=(found,))
    doubted = any(kind.left_out for kind in previous.kinds)
    particles = _update_every_kind(previous, problems, STEADY if doubted else THOROUGH, rng)
    now = replace(previous, particles=tuple(particles))
    if doubted:
        particles = _sample_rivals_again(now, problems, n_particles, rng, from_scratch)
        now = replace(previous, particles=tuple(particles))
        particles = [
            _with_bridged_evidence(p, problem, rng) if p.hurried and odds > now.log_odds.max() - _HOPELESS else p
            for p, problem, odds in zip(particles, problems, now.log_odds, strict=True)
        ]
        now = replace(previous, particles=tuple(particles))
    n = min(n_particles, _MOST_DRAWS) if doubted else n_particles
    now = _reestimated_where_doubtful(
        now, problems, n, from_scratch, rng, most_off=_DOUBTED_OFF if doubted else _MOST_OFF
    )
    particles = list(now.particles)
    if not np.isfinite(now.log_odds).any():
        raise NotConvergedError("no hypothesis of any kind could have given these readings")
    for k, p in enumerate(now.probability):
        had, n = len(particles[k].ancestor), _n_samples_of_kind(now.kinds[k], p, n_particles)
        if n > had or p < _IMPROBABLE:
            particles[k] = resample_and_move(
                particles[k], n, problems[k], rng=rng, effort=BRIEF if now.kinds[k].left_out else None
            )
    return replace(now, particles=tuple(particles))


def _update_every_kind(
    previous: Posterior, problems: list[SensorProblem], usual: UpdateSettings, rng: np.random.Generator
) -> list[Particles]:
    """Update every kind with the last reading, improbable rivals with less effort."""
    return [
        update(particles, problem, rng=rng, effort=BRIEF if kind.left_out and p < _SUSPECTED[1][0] else usual)
        for kind, particles, problem, p in zip(
            previous.kinds, previous.particles, problems, previous.probability, strict=True
        )
    ]


def with_rivals_sampled_again(
    posterior: Posterior,
    recording: Recording,
    n_particles: int,
    *,
    rng: np.random.Generator,
    from_scratch: FromScratch,
) -> Posterior:
    """Return the posterior with rivals sampled again and doubtful evidences re-estimated; called before a run ends.

    Left as they are: rivals that were sampled in this way before and have followed the readings since, and rivals that
    are hopelessly improbable.
    """
    problems = [kind.problem(recording) for kind in posterior.kinds]
    now = replace(
        posterior, particles=tuple(_sample_rivals_again(posterior, problems, n_particles, rng, from_scratch, each=True))
    )
    return _reestimated_where_doubtful(
        now, problems, min(n_particles, _MOST_DRAWS), from_scratch, rng, most_off=_OFF_AT_THE_END
    )


def _sample_rivals_again(
    now: Posterior,
    problems: list[SensorProblem],
    n_particles: int,
    rng: np.random.Generator,
    from_scratch: FromScratch,
    *,
    each: bool = False,
) -> list[Particles]:
    """Sample rivals anew, where their own samples may have lost the truth.

    Return the particles of every kind.

    That can happen after a reading that few of them predict. And a rival whose effect can be negligible cannot be much
    less likely than the plain model: if it seems to be, its samples are in the wrong place. With `each`, every rival is
    sampled anew, except those that do not matter and whose samples were found in this way and have followed the
    readings since. Fits that start at samples of other kinds come first. Where few of them lead to the best fit, others
    may be missed: the kind is searched from scratch, one kind after a reading in turn, and with `each` all of them and
    those that matter. A rival that came out far below the best kind is sampled again when the readings since could have
    made up the difference.
    """
    particles, log_odds = list(now.particles), now.log_odds
    probability = now.with_warier_odds.probability
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
        matters = each and probability[k] > _HAS_A_SAY
        wanted = matters or (each and not own.refitted) or beyond or own.strained or own.hurried
        if not wanted or (own.log_z_limit < hopeless and (own.limit_is_searched or not each)):
            continue
        best = max(alike, key=lambda j: log_odds[j])
        donors = [now.particles[j].weighted for j in {plain, best} if now.particles[j].log_z > -math.inf]
        donors += [own.weighted] if own.log_z > hopeless else []
        n = max(len(own.ancestor), _n_samples_of_kind(kind, 0.0, n_particles))
        anew = _sample_near_other_kinds(kind, problem, own.weighted, donors, n, hopeless, rng)
        few = _LEAST_FOUND if kind.effect is not None else _WELL_FOUND
        is_searched = n_searches > 0 and (matters or not anew.is_reproduced or (each and anew.n_eff < few))
        if is_searched:
            n_searches -= 1
            anew = _search_from_scratch(problem, own.weighted, n, hopeless, rng, from_scratch)
        found = anew.samples
        if anew.highest_log_z < hopeless:
            limit = max(anew.highest_log_z, own.log_z) + _RULED_OUT
            if anew.is_reproduced:
                particles[k] = replace(own, log_z_limit=limit, limit_is_searched=is_searched)
            continue
        if found is None or found.n_eff < _FEWEST:
            particles[k] = replace(own, strained=own.strained or own.hurried)
            continue
        if found.log_z < own.log_z + (_TOLD_APART if found.n_eff < _LEAST_FOUND else -_CARRIED):
            continue
        fresh = particles_from_posterior(found, n, problem, rng=rng, effort=BRIEF)
        fresh = _independent_start_with_evidence(
            fresh, bridged_evidence(fresh.weighted, problem, rng=rng, n_draws=min(2 * n, _DRAWS))
        )
        if is_searched and not own.strained and fresh.log_z < own.log_z - _CARRIED:
            continue
        particles[k] = replace(
            fresh,
            refitted=anew.is_reproduced and found.n_eff >= _WELL_FOUND,
            strained=found.n_eff < _LEAST_FOUND,
        )
    return particles


@dataclass(frozen=True, eq=False)
class _SamplesAnew:
    """Samples of a kind taken anew.

    Attributes
    ----------
    samples
        None if none was found.
    highest_log_z
        The largest log evidence by fits or by a search from scratch; infinite without either.
    is_reproduced
        Whether several starts led to the best fit, or a search from scratch to the samples.
    """

    samples: Weighted | None
    highest_log_z: float = math.inf
    is_reproduced: bool = True

    @property
    def n_eff(self) -> float:
        """Effective number of the samples; 0 without any."""
        return 0.0 if self.samples is None else self.samples.n_eff


def _sample_near_other_kinds(
    kind: HypothesisKind,
    problem: SensorProblem,
    own: Weighted,
    donors: list[Weighted],
    n: int,
    hopeless: float,
    rng: np.random.Generator,
) -> _SamplesAnew:
    """Sample a kind's posterior from samples of other kinds: by refits or, for a noise model, from these directly.

    No samples are drawn if the largest log evidence by fits is below `hopeless`.
    """
    noise = declared_noise(kind.likelihood)
    if kind.effect is not None:
        if noise is None:
            return _SamplesAnew(None)
        sd = math.hypot(noise[0], noise[1] / math.sqrt(12.0))
        found = fit_kind(kind, problem, donors, noise_sd=sd, rng=rng)
        is_reproduced = found.n_as_good_as_best >= _REPRODUCED
        if found.highest_log_z < hopeless:
            return _SamplesAnew(None, found.highest_log_z, is_reproduced)
        with_own = own.log_z > hopeless
        return _SamplesAnew(
            sampled_about_fits(found, kind, problem, own, n_draws=2 * n, with_own=with_own, rng=rng),
            found.highest_log_z,
            is_reproduced,
        )
    n_own = len(kind.prior.names)
    points = [donor.samples(n // 2, rng=rng)[:, :n_own] for donor in donors]
    if own.log_z > hopeless:
        points.append(own.samples(n // 2, rng=rng))
    return _SamplesAnew(_importance_sampled_if_possible(np.concatenate(points), problem, n, rng))


def _search_from_scratch(
    problem: SensorProblem,
    own: Weighted,
    n: int,
    hopeless: float,
    rng: np.random.Generator,
    from_scratch: FromScratch,
) -> _SamplesAnew:
    """Sample a kind's posterior by a quick run of nested sampling."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DoubtfulResultWarning)  # its samples are only where draws are made
            run = from_scratch(problem, quick=True)
    except NotConvergedError:
        return _SamplesAnew(None, -math.inf)
    return _SamplesAnew(_samples_from_run(run, own, problem, n, rng, with_own=own.log_z > hopeless), run.log_z)


def _samples_from_run(
    run: NestedResult, own: Weighted, problem: SensorProblem, n: int, rng: np.random.Generator, *, with_own: bool
) -> Weighted:
    """Return samples of a kind from a run of nested sampling, and from the kind's own samples if `with_own`.

    Importance sampling about both weighs them. Where modes are too many or too bent for it, few draws would hold all of
    the weight: then the run's samples are returned as they are, with its evidence.
    """
    points = run.samples(n, rng=rng)
    about = np.concatenate([points, own.samples(n // 2, rng=rng)]) if with_own else points
    drawn = _importance_sampled_if_possible(about, problem, 2 * n, rng)
    if drawn is None or drawn.n_eff < _WELL_FOUND:
        even = np.full(n, -math.log(n))
        likelihood = problem.log_likelihood(points)
        drawn = Weighted(
            problem.prior.names, points, likelihood, even, run.log_z, run.log_z_error, float(n), n, -math.inf
        )
    return replace(drawn, n_calls=own.n_calls + run.n_calls + drawn.n_calls)


def _importance_sampled_if_possible(
    points: FloatArray, problem: SensorProblem, n_draws: int, rng: np.random.Generator
) -> Weighted | None:
    """Sample by importance sampling about points; None if no draw could have given the readings."""
    try:
        return posterior_sampled_about_points(points, problem, rng=rng, n_draws=n_draws)
    except NotConvergedError:
        return None


def _n_samples_of_kind(kind: HypothesisKind, probability: float, n_particles: int) -> int:
    """Return the number of samples of a kind: fewer the less probable it is, and for rivals at most half."""
    if kind.left_out:
        return max(n_particles // next(part for least, part in _SUSPECTED if probability >= least), 100)
    return n_particles if probability >= _IMPROBABLE else n_particles // _FEWER


def _probabilities_of_log_odds(log_odds: FloatArray) -> FloatArray:
    """Return probabilities in the ratios of exp(log_odds), summing to one."""
    share = np.exp(log_odds - log_odds.max())
    return np.asarray(share / share.sum())


def _reestimated_where_doubtful(
    now: Posterior,
    problems: list[SensorProblem],
    n: int,
    from_scratch: FromScratch,
    rng: np.random.Generator,
    *,
    most_off: float,
) -> Posterior:
    """Re-estimate kinds until none has an evidence whose error could change its probability by more than `most_off`."""
    particles, settled = list(now.particles), set[int]()
    while (k := _kind_with_most_doubtful_evidence(now, settled, most_off)) is not None:
        settled.add(k)
        particles[k] = _reestimate_kind(particles[k], problems[k], n, from_scratch, rng)
        now = replace(now, particles=tuple(particles))
    return now


def _kind_with_most_doubtful_evidence(now: Posterior, settled: set[int], most_off: float) -> int | None:
    """Return the index of the kind whose probability its evidence's error affects most; None if none by `most_off`.

    In a run that doubts its sensor, a kind whose samples are in doubt counts where it has a say in the shape.
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
        doubt = 2 * particles.log_z_error + (_CARRIED if particles.n_resampled else 0.0)
        p, low, high = (float(expit(odds + by)) for by in (0.0, -doubt, doubt))
        off[k] = max(p - low, high - p)
        least, most = (float(expit(odds + by)) for by in (-_STRAINED, _STRAINED))
        may_be_right = most > _LOST and least < 1 - _LOST
        if particles.strained and (p > _HAS_A_SAY if doubted else may_be_right):
            off[k] = 1.0
    return int(off.argmax()) if off.max() > most_off else None


def _reestimate_kind(
    particles: Particles, problem: SensorProblem, n: int, from_scratch: FromScratch, rng: np.random.Generator
) -> Particles:
    """Re-estimate a kind's evidence from all readings, and its samples too if they may be incomplete."""
    had = particles.weighted
    if not particles.strained:
        found = bridged_evidence(had, problem, rng=rng, n_draws=n)
        if abs(found.log_z - had.log_z) < _TOLD_APART:
            return _independent_start_with_evidence(particles, found)
    try:
        run = from_scratch(problem)
    except NotConvergedError:  # no hypothesis of this kind could have given the readings
        return replace(particles, weighted=replace(had, log_z=-math.inf, log_z_error=math.inf), strained=False)
    drawn = _samples_from_run(run, had, problem, n, rng, with_own=particles.log_z > -math.inf)
    fresh = particles_from_posterior(drawn, n, problem, rng=rng)
    fresh = _independent_start_with_evidence(fresh, bridged_evidence(fresh.weighted, problem, rng=rng, n_draws=n))
    return replace(fresh, weighted=replace(fresh.weighted, run=run), refitted=True)


def _with_bridged_evidence(particles: Particles, problem: SensorProblem, rng: np.random.Generator) -> Particles:
    """Re-estimate the evidence of hurried samples by bridge sampling; the moved samples themselves are valid."""
    found = bridged_evidence(particles.weighted, problem, rng=rng, n_draws=min(2 * len(particles.ancestor), _DRAWS))
    return (
        replace(_independent_start_with_evidence(particles, found), strained=particles.strained)
        if math.isfinite(found.log_z)
        else particles
    )


def _independent_start_with_evidence(particles: Particles, found: BridgedEvidence) -> Particles:
    """Give the samples a new evidence, and make them an independent start: each is its own ancestor."""
    had = particles.weighted
    weighted = replace(had, log_z=found.log_z, log_z_error=found.error, n_calls=had.n_calls + found.n_calls)
    start = Particles(weighted, np.arange(len(had.theta)), found.error**2)
    return replace(
        start,
        refitted=particles.refitted,
        log_z_limit=particles.log_z_limit,
        limit_is_searched=particles.limit_is_searched,
    )
