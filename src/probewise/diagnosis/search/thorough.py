"""Weigh the leading hypotheses again by nested sampling, and let it win where Laplace's approximation fails.

The same joint model, priors and law of the noise as `probewise.diagnosis.evidence.laplace`; what differs is the
integral over the parameters: here the whole prior is searched, there the posterior is taken for one Gaussian peak.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from probewise import nested
from probewise.diagnosis.evidence.folded import folded
from probewise.diagnosis.evidence.joint import JointProblem
from probewise.diagnosis.search.weighed import Candidate, Search, in_vocabulary, weighed
from probewise.diagnosis.search.weighing import Weighing

__all__ = ["weigh_thoroughly"]

N_LIVE = 100

_LEAST, _MOST = 2, 3  # hypotheses that are weighed again, the null apart
_LEAST_PROBABILITY = 0.01
_SHARP = 0.3  # nats: an error that leaves it open whether two evidences are a nat apart is too large
_APART = 3.3  # standard errors: one in a thousand
# Times as many live points: about what was found, until that is sharp; in the whole prior, where the two differ.
_MORE_ABOUT = (1, 2, 4)
_MORE_EXPLORING = (1, 4)

Names = tuple[str, ...]
Progress = Callable[[str, nested.State], None]
Run = Callable[..., nested.NestedResult]


def weigh_thoroughly(
    search: Search, *, rng: np.random.Generator, n_live: int = N_LIVE, progress: Progress | None = None
) -> tuple[Search, tuple[Weighing, ...]]:
    """Weigh two or three leading hypotheses, and the null, by nested sampling.

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
        Live points. A run of the whole prior says where the posterior is, one from a prior near that
        (`probewise.nested.repartitioned`) what the evidence is. There are more where that is not sharp yet, or the
        two differ.
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
    merged = search.by_mean
    out: list[tuple[Candidate, Names]] = []
    for mean in sorted(merged, key=lambda names: -merged[names]):
        if len(out) == _MOST or (len(out) >= _LEAST and merged[mean] < _LEAST_PROBABILITY):
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
    effects = tuple(sorted((*candidate.names, *in_vocabulary(noise))))
    weighing = Weighing(effects, candidate.n_gaussians, evidence.log_z, math.nan, math.nan)
    problem = JointProblem(candidate.found.model, search.recording, evidence, search.sd_floor)
    once = folded(problem, candidate.found.z)
    run = partial(
        nested.run,
        rng=rng,
        progress=None if progress is None else lambda state: progress(weighing.label, state),
        return_interrupted=False,
    )
    for more in _MORE_EXPLORING:
        explored = run(once, n_live=more * n_live)
        about = _about(explored, once, run, n_live, rng)
        apart = abs(explored.log_z - about.log_z) / math.hypot(explored.log_z_error, about.log_z_error)
        if apart < _APART:
            break
    doubts = about.warnings
    if apart >= _APART:
        doubts = (*doubts, f"the prior as a whole and what was found in it differ by {apart:.1f} standard errors")
    log_z = about.log_z + candidate.log_factor
    return replace(weighing, nested=log_z, error=about.log_z_error, doubts=doubts)


def _about(
    found: nested.NestedResult, problem: nested.Samplable, run: Run, n_live: int, rng: np.random.Generator
) -> _Evidence:
    """Sharpen what a run of the whole prior has found by runs from priors near its posterior."""
    for more in _MORE_ABOUT:
        nearer = nested.repartitioned(problem, found, rng=rng)
        found = run(nearer, n_live=more * n_live)
        sharper = nested.refine(found, nearer, rng=rng)
        if sharper.sound and sharper.log_z_error < found.log_z_error:
            return _Evidence(sharper.log_z, sharper.log_z_error)
        if found.log_z_error <= _SHARP:
            break
    return _Evidence(found.log_z, found.log_z_error, found.warnings)


@dataclass(frozen=True)
class _Evidence:
    """Log evidence, its standard error, and what speaks against it."""

    log_z: float
    log_z_error: float
    warnings: tuple[str, ...] = ()


def _moved(search: Search, gaps: dict[tuple[int, Names], float]) -> Search:
    """Move the evidence of candidates, and of what is unknown beside them, under every noise model alike."""
    candidates = dict(search.candidates)
    for key, gap in gaps.items():
        candidates[key] = candidates[key].moved(gap)
    unknown = {(n, mean, noise): v + gaps.get((n, mean), 0.0) for (n, mean, noise), v in search.unknown.items()}
    return weighed(replace(search, candidates=candidates, unknown=unknown))
