"""Samples of one kind of hypotheses taken anew from all readings: near other kinds' samples, or by nested sampling."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import DoubtfulResultWarning, NotConvergedError
from probewise.experiment.declared_noise import DeclaredNoise
from probewise.experiment.evidence import BridgedEvidence, posterior_sampled_about_points
from probewise.experiment.kinds import HypothesisKind
from probewise.experiment.particles import Particles
from probewise.experiment.refitted import fit_kind, sampled_about_fits
from probewise.inference.problem import SensorProblem
from probewise.nested import NestedResult, Weighted

_REPRODUCED = 5  # of the starts, which must lead to fits as good as the best: otherwise better ones may be missed
WELL_FOUND = 100.0  # effective draws from which on samples need not be taken anew until a reading strains them


class SolverFromScratch(Protocol):
    """Function that solves a kind's whole problem by nested sampling; with fewer live points if `quick`."""

    def __call__(self, problem: SensorProblem, *, quick: bool = False) -> NestedResult:
        """Return the result; raise NotConvergedError if no hypothesis could have given the readings."""
        ...


@dataclass(frozen=True, eq=False)
class SamplesAnew:
    """Samples of a kind taken anew.

    Attributes
    ----------
    samples
        The weighted samples; None if none were found.
    highest_log_z
        The largest log evidence by fits or by a search from scratch; infinite if neither was made.
    is_reproduced
        Whether five starts or more led to fits as good as the best; True without fits.
    is_searched
        Whether the samples come from a search from scratch.
    """

    samples: Weighted | None
    highest_log_z: float = math.inf
    is_reproduced: bool = True
    is_searched: bool = False

    @property
    def n_eff(self) -> float:
        """Effective number of the samples; 0 if `samples` is None."""
        return 0.0 if self.samples is None else self.samples.n_eff


def sample_near_other_kinds(
    kind: HypothesisKind,
    problem: SensorProblem,
    own: Weighted,
    donors: list[Weighted],
    n: int,
    hopeless: float,
    rng: np.random.Generator,
) -> SamplesAnew:
    """Sample a kind's posterior starting from `donors`, samples of other kinds.

    A kind with an effect is fitted from these; a noise model is sampled by importance sampling about them. No samples
    are drawn if the largest log evidence by fits is below `hopeless`.
    """
    noise = DeclaredNoise.from_likelihood(kind.likelihood)
    if kind.effect is not None:
        if noise is None:
            return SamplesAnew(None)
        sd = math.hypot(noise.sd, noise.step / math.sqrt(12.0))
        found = fit_kind(kind, problem, donors, noise_sd=sd, rng=rng)
        is_reproduced = found.n_as_good_as_best >= _REPRODUCED
        if found.highest_log_z < hopeless:
            return SamplesAnew(None, found.highest_log_z, is_reproduced)
        with_own = own.log_z > hopeless
        return SamplesAnew(
            sampled_about_fits(found, kind, problem, own, n_draws=2 * n, with_own=with_own, rng=rng),
            found.highest_log_z,
            is_reproduced,
        )
    n_own = len(kind.prior.names)
    points = [donor.samples(n // 2, rng=rng)[:, :n_own] for donor in donors]
    if own.log_z > hopeless:
        points.append(own.samples(n // 2, rng=rng))
    return SamplesAnew(_importance_sampled_if_possible(np.concatenate(points), problem, n, rng))


def sample_from_scratch(
    problem: SensorProblem,
    own: Weighted,
    n: int,
    hopeless: float,
    rng: np.random.Generator,
    from_scratch: SolverFromScratch,
) -> SamplesAnew:
    """Sample a kind's posterior by a quick run of nested sampling, and near `own` unless its evidence is `hopeless`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DoubtfulResultWarning)  # its samples are only where draws are made
            run = from_scratch(problem, quick=True)
    except NotConvergedError:
        return SamplesAnew(None, -math.inf, is_searched=True)
    samples = samples_from_run(run, own, problem, n, rng, with_own=own.log_z > hopeless)
    return SamplesAnew(samples, run.log_z, is_searched=True)


def samples_from_run(
    run: NestedResult, own: Weighted, problem: SensorProblem, n: int, rng: np.random.Generator, *, with_own: bool
) -> Weighted:
    """Return a kind's samples by importance sampling about those of a nested sampling run (and its own if `with_own`).

    If fewer than 100 effective draws result (modes too many or too bent), return the run's samples and evidence.
    """
    points = run.samples(n, rng=rng)
    about = np.concatenate([points, own.samples(n // 2, rng=rng)]) if with_own else points
    drawn = _importance_sampled_if_possible(about, problem, 2 * n, rng)
    if drawn is None or drawn.n_eff < WELL_FOUND:
        even = np.full(n, -math.log(n))
        likelihood = problem.log_likelihood(points)
        drawn = Weighted(
            problem.prior.names,
            points,
            log_likelihood=likelihood,
            log_weight=even,
            log_z=run.log_z,
            log_z_error=run.log_z_error,
            n_eff=float(n),
            n_calls=n,
            pareto_k=-math.inf,
        )
    return replace(drawn, n_calls=own.n_calls + run.n_calls + drawn.n_calls)


def _importance_sampled_if_possible(
    points: FloatArray, problem: SensorProblem, n_draws: int, rng: np.random.Generator
) -> Weighted | None:
    """Return `posterior_sampled_about_points`, or None if no draw could have given the readings."""
    try:
        return posterior_sampled_about_points(points, problem, rng=rng, n_draws=n_draws)
    except NotConvergedError:
        return None


def with_new_evidence_and_lineages(particles: Particles, found: BridgedEvidence) -> Particles:
    """Return the samples with a new evidence and as an independent start: each sample is its own ancestor."""
    had = particles.weighted
    weighted = replace(had, log_z=found.log_z, log_z_error=found.error, n_calls=had.n_calls + found.n_calls)
    return replace(
        particles,
        weighted=weighted,
        ancestor=np.arange(len(had.theta)),
        start_variance=found.error**2,
        n_resampled=0,
        strained=False,
        hurried=False,
    )
