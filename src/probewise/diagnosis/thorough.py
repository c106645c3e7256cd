"""Weigh the leading hypotheses again by nested sampling, and let it win where Laplace's approximation fails.

The same joint model, priors and law of the noise as `probewise.diagnosis.evidence`; what differs is the integral
over the parameters: here the whole prior is searched, there the posterior is taken for one Gaussian peak.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from probewise import nested
from probewise._arrays import FloatArray
from probewise.diagnosis.coordinates import FARTHEST
from probewise.diagnosis.evidence import NoiseEvidence
from probewise.diagnosis.fit import Model
from probewise.diagnosis.noise import NoiseLaw
from probewise.diagnosis.weighed import Candidate, Search, weighed
from probewise.diagnosis.weighing import Weighing
from probewise.effects import NUISANCES
from probewise.recordings.plan import Recording

__all__ = ["JointProblem", "StandardNormal", "weigh_thoroughly"]

N_LIVE = 200

_MOST = 3  # hypotheses that are weighed again, the null apart
_LEAST_PROBABILITY = 0.01
_HELD = 0.999  # of the evidence by the nodes of the noise that are kept; the rest is made up for

Names = tuple[str, ...]
Progress = Callable[[str, nested.State], None]


@dataclass(frozen=True)
class StandardNormal:
    """The prior of a model's coordinates: independent, standard normal, and chains step in them as they are."""

    n_params: int

    @property
    def names(self) -> tuple[str, ...]:
        """z_1, z_2, ..."""
        return tuple(f"z_{k + 1}" for k in range(self.n_params))

    @property
    def coordinates(self) -> StandardNormal:
        """Its own."""
        return self

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map the unit cube to normal scores, (n_samples, n_params) both ways."""
        return np.asarray(ndtri(u))

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map normal scores to the unit cube."""
        return np.asarray(ndtr(theta))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Log density, (n_samples,)."""
        return np.asarray(-0.5 * np.sum(theta**2 + math.log(2 * math.pi), axis=1))

    def enter(self, theta: FloatArray) -> FloatArray:
        """Leave parameters as they are."""
        return theta

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Leave coordinates as they are, and give their log density."""
        return x, self.log_prob(x)


@dataclass(frozen=True, eq=False)
class JointProblem:
    """A model in its coordinates against a recording, the noise's sd and the nodes of its law summed out.

    Parameters
    ----------
    model, recording
        What predicts and what was read.
    noise
        The evidence of a fit under the noise model: its nodes, of which those that matter are kept.
    sd_floor
        Least believable sd of a reading's noise.
    """

    model: Model
    recording: Recording
    noise: NoiseEvidence
    sd_floor: float

    @cached_property
    def prior(self) -> StandardNormal:
        """The prior of the model's coordinates."""
        return StandardNormal(self.model.n_params)

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Predict all readings and weigh the usable ones under each law kept: (n_samples, n_params) -> (n_samples,)."""
        usable = self.recording.usable
        predicted = self.model.predict(np.clip(theta, -FARTHEST, FARTHEST))[:, usable]
        residuals = (self.recording.readings[usable] - predicted).T
        laid_out, log_share = self.noise.laid_out, -math.log(float(self.noise.weights[self._kept].sum()))
        terms = [
            laid_out.log_weights[node] + _log_likelihood(laid_out.laws[node], residuals, self.sd_floor)
            for node in self._kept
        ]
        out = np.asarray(logsumexp(terms, axis=0)) + log_share
        return np.where(np.isfinite(out), out, -np.inf)

    @cached_property
    def _kept(self) -> list[int]:
        """The fewest nodes of the noise that hold what matters."""
        order = np.argsort(-self.noise.weights)
        n_kept = int(np.searchsorted(np.cumsum(self.noise.weights[order]), _HELD)) + 1
        kept: list[int] = order[:n_kept].tolist()
        return kept


def _log_likelihood(law: NoiseLaw, residuals: FloatArray, sd_floor: float) -> FloatArray:
    """Log likelihood of residuals (n_points, n_samples) under one law, log sd integrated out: (n_samples,)."""
    n_points = law.n_points
    whitened = law(residuals)
    sigma = law.scale(whitened, floor=sd_floor)
    curvature = law.tail.scale_curvature(whitened, sigma, n_points) if law.share else 2.0 * n_points
    peak = -law.misfit(whitened, sigma, floor=sd_floor) - 0.5 * n_points * math.log(2 * math.pi)
    return np.asarray(peak + 0.5 * np.log(2 * math.pi / curvature) - law.log_det() + law.log_extra)


def weigh_thoroughly(
    search: Search, *, rng: np.random.Generator, n_live: int = N_LIVE, progress: Progress | None = None
) -> tuple[Search, tuple[Weighing, ...]]:
    """Weigh the null and up to three leading hypotheses by nested sampling.

    Where the two disagree by more than a nat, and no run has doubts, nested sampling wins: the evidence of what
    was weighed is moved, and what is unknown beside it, and all probabilities are made anew. What Laplace misses
    of the null it misses of every hypothesis that was not weighed again, so the null is what others are moved
    against.

    Parameters
    ----------
    search
        What Laplace's approximation has weighed.
    rng
        Source of randomness.
    n_live
        Live points of each run.
    progress
        Called after every round with the label of what is being weighed, and the state.

    Returns
    -------
    The search, with other probabilities where nested sampling wins, and each hypothesis as weighed twice,
    the most probable first.
    """
    weighings: dict[tuple[int, Names], Weighing] = {}
    for (candidate, noise), own in zip(leaders := _leaders(search), rng.spawn(len(leaders)), strict=True):
        key = candidate.n_gaussians, candidate.names
        weighings[key] = _weigh(candidate, noise, search, rng=own, n_live=n_live, progress=progress)
    told = tuple(weighings.values())
    if all(w.agree for w in told) or any(w.doubts for w in told):
        return search, told
    common = next((w.gap for (_, names), w in weighings.items() if not names), 0.0)
    return _moved(search, {key: w.gap - common for key, w in weighings.items()}), told


def _leaders(search: Search) -> list[tuple[Candidate, Names]]:
    """List the leading refitted hypotheses about the mean, each under its best noise, then the null if not among them.

    All under the SSF order that has the most evidence for each, the null under that of the first.
    """
    merged: dict[Names, float] = {}
    for (mean, _), p in search.probabilities.items():
        merged[mean] = merged.get(mean, 0.0) + p
    out: list[tuple[Candidate, Names]] = []
    for mean in sorted(merged, key=lambda names: -merged[names]):
        if len(out) == _MOST or (out and merged[mean] < _LEAST_PROBABILITY):
            break
        noise = _noise_of(search, mean)
        candidate = search.best(mean, noise)
        if candidate is not None:
            out.append((candidate, noise))
    null = search.candidates[out[0][0].n_gaussians if out else search.order, ()]
    if all(candidate.names for candidate, _ in out):
        out.append((null, _noise_of(search, ())))
    return out


def _noise_of(search: Search, mean: Names) -> Names:
    """Find the noise model under which a hypothesis about the mean is most probable."""
    own = {noise: p for (names, noise), p in search.probabilities.items() if names == mean}
    return max(own, key=lambda noise: own[noise])


def _weigh(
    candidate: Candidate,
    noise: Names,
    search: Search,
    *,
    rng: np.random.Generator,
    n_live: int,
    progress: Progress | None,
) -> Weighing:
    evidence = candidate.evidence[noise]
    effects = tuple(sorted((*candidate.names, *(name for name in noise if name not in NUISANCES))))
    weighing = Weighing(effects, candidate.n_gaussians, evidence.log_z, math.nan, math.nan)
    problem = JointProblem(candidate.found.model, search.recording, evidence, search.sd_floor)
    show = None if progress is None else lambda state: progress(weighing.label, state)
    result = nested.run(problem, rng=rng, n_live=n_live, progress=show, return_interrupted=False)
    sharper = nested.refine(result, problem, rng=rng)
    best = sharper if sharper.sound else result
    return replace(
        weighing,
        nested=best.log_z + candidate.log_share,
        error=best.log_z_error,
        doubts=() if sharper.sound else tuple(result.warnings),
    )


def _moved(search: Search, gaps: dict[tuple[int, Names], float]) -> Search:
    """Move the evidence of candidates, and of what is unknown beside them, under every noise model alike."""
    candidates = dict(search.candidates)
    for key, gap in gaps.items():
        evidence = {k: replace(e, log_z=e.log_z + gap) for k, e in candidates[key].evidence.items()}
        candidates[key] = replace(candidates[key], evidence=evidence)
    unknown = {(n, mean, noise): v + gaps.get((n, mean), 0.0) for (n, mean, noise), v in search.unknown.items()}
    return weighed(replace(search, candidates=candidates, unknown=unknown))
