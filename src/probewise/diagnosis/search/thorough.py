"""The evidence of the leading hypotheses once more, by nested sampling, which replaces Laplace's where that fails.

Model, priors and noise are those of `probewise.diagnosis.evidence`; only the integral over the parameters differs: here
over the whole prior, there for one Gaussian mode.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from probewise import nested
from probewise._arrays import FloatArray, own_arithmetic
from probewise._kinds import require_rng
from probewise.diagnosis.evidence import covariance_root
from probewise.diagnosis.fit import FARTHEST
from probewise.diagnosis.posterior import HypothesisProblem
from probewise.diagnosis.search.hypotheses import Searched, WeighedFit, noise_effects_in_vocabulary
from probewise.diagnosis.words import Names, combination_label
from probewise.errors import DoubtfulResultWarning
from probewise.nested.importance import repartitioned
from probewise.progress import Progress, silent


@dataclass(frozen=True)
class Weighing:
    """Log evidence of one hypothesis by both methods, with the same model, priors and noise.

    `effects` on the mean and on the noise, sorted; `n_gaussians` of the SSF; `laplace` and `nested`: the log evidences
    in nats; `error`: standard error of `nested`; `doubts`: warnings of the nested runs.
    """

    effects: tuple[str, ...]
    n_gaussians: int
    laplace: float
    nested: float
    error: float
    doubts: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Effects joined by "+", or "clean"."""
        return combination_label(self.effects)

    @property
    def gap(self) -> float:
        """Log evidence by nested sampling minus that by Laplace, in nats."""
        return self.nested - self.laplace

    @property
    def agree(self) -> bool:
        """Whether the two log evidences differ by at most a nat plus one standard error of nested sampling."""
        return abs(self.gap) <= 1.0 + self.error


def sentence_with_agreement(reason: str, weighings: Sequence[Weighing]) -> str:
    """Extend a verdict's reason by whether nested sampling agrees, by how many nats not, and its first warning."""
    if not weighings:
        return reason
    signed = {w.label: f"{w.gap:+.1f} nats".replace("-", "−") for w in weighings if not w.agree}
    apart = ", ".join(f"{label} by {gap}" for label, gap in signed.items())
    doubt = next((f"{w.label}: {doubt}" for w in weighings for doubt in w.doubts), None)
    if not apart:
        said = "nested sampling agrees to within a nat plus its standard error"
    elif doubt is not None:
        said = f"nested sampling would move {apart}, and probabilities are left as they were"
    else:
        said = f"nested sampling moves {apart}, and the probabilities are by its evidence"
    return f"{reason.rstrip('.')}; {said}{'' if doubt is None else f', but its runs gave a warning ({doubt})'}."


N_LIVE = 100
_LEAST, _MOST = 2, 3  # hypotheses to recompute, apart from the null
_LEAST_PROBABILITY = 0.01
_MOST_RUNS = 4  # runs from priors near the posterior
_N_SAMPLES = 2000  # posterior samples that define such a prior
_APART = 3.3  # standard errors: one in a thousand

Run = Callable[..., nested.NestedResult]


@own_arithmetic
def weigh_thoroughly(
    searched: Searched, *, rng: np.random.Generator, n_live: int = N_LIVE, progress: Progress = silent
) -> tuple[Searched, tuple[Weighing, ...]]:
    """Compute the evidence of two or three leading hypotheses, and of the null, by nested sampling.

    If the two methods differ for any by more than a nat plus the standard error, and no run has warnings, nested
    sampling takes precedence: the evidences of these hypotheses, and of unknown effects beside them, are shifted, and
    all probabilities recomputed.
    Laplace's error for the null is assumed for every hypothesis that was not recomputed, so shifts are relative to the
    null. Hypotheses pruned by Laplace's evidence are not restored.

    Parameters
    ----------
    searched
        The search with Laplace evidences.
    rng
        Source of randomness.
    n_live
        Live points of each run, or more if there are many parameters. The first run, from the whole prior, locates the
        posterior; further runs, from priors near it (`probewise.nested.importance`), estimate the evidence until its
        error is small.
    progress
        Called after every round of every run, with the number and the name of the hypothesis.

    Returns
    -------
    The search with updated probabilities, and both evidences of each hypothesis, the most probable first.
    """
    require_rng(rng)
    weighings: dict[tuple[int, Names], Weighing] = {}
    leaders = _leading_hypotheses(searched)
    for k, ((candidate, noise), own) in enumerate(zip(leaders, rng.spawn(len(leaders)), strict=True)):
        show = partial(progress, "weighing hypotheses again", k, len(leaders))
        weighings[candidate.n_gaussians, candidate.names] = _weigh_by_nested_sampling(
            candidate, noise, searched, rng=own, n_live=n_live, show=show
        )
    told = tuple(weighings.values())
    if not all(w.agree for w in told) and not any(w.doubts for w in told):
        common = next((w.gap for (_, names), w in weighings.items() if not names), 0.0)
        gaps = {key: w.gap - common for key, w in weighings.items()}
        searched = searched.with_evidences(searched.evidences.with_log_evidence_shifted(gaps))
    return searched, told


def _leading_hypotheses(searched: Searched) -> list[tuple[WeighedFit, Names]]:
    """List two or three leading refitted hypotheses on the mean, and the null, each with its most probable noise."""
    merged, noise_of = searched.posterior.marginal_over_noise, dict[Names, Names]()
    for mean, noise in searched.posterior.probabilities:  # the most probable first
        noise_of.setdefault(mean, noise)
    out: list[tuple[WeighedFit, Names]] = []
    for mean in sorted(merged, key=lambda names: -merged[names]):
        if len(out) == _MOST or (len(out) >= _LEAST and merged[mean] < _LEAST_PROBABILITY):
            break
        candidate = searched.best_refit_of(mean, noise_of[mean])
        if candidate is not None:
            out.append((candidate, noise_of[mean]))
    if all(candidate.names for candidate, _ in out):
        order = out[0][0].n_gaussians if out else searched.likeliest_order
        out.append((searched.evidences.fits[order, ()], noise_of[()]))
    return out


def _weigh_by_nested_sampling(
    candidate: WeighedFit,
    noise: Names,
    searched: Searched,
    *,
    rng: np.random.Generator,
    n_live: int,
    show: Callable[[str], None],
) -> Weighing:
    evidence = candidate.evidence[noise]
    effects = tuple(sorted((*candidate.names, *noise_effects_in_vocabulary(noise))))
    weighing = Weighing(effects, candidate.n_gaussians, evidence.log_z, math.nan, math.nan)
    once = HypothesisProblem(candidate.found.model, searched.prepared.recording, evidence, candidate.found.z)
    # Laplace's method integrates over one peak, to be counted `n_peaks` times. The whole prior holds them all.
    log_factor = candidate.log_share + candidate.log_detectable
    log_factor -= sum(math.log(e.n_peaks) for e in candidate.found.model.effects)
    n_live = max(n_live, nested.LIVE_PER_PARAM * once.model.n_params)
    run = partial(
        nested.run,
        rng=rng,
        n_live=n_live,
        progress=lambda _: show(weighing.label),
        max_cost=1.0,  # each run here is checked against the next
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # warnings of the last run are reported
        explored = run(once)

        def weighing_from_samples(theta: FloatArray) -> Weighing:
            log_z, error, doubts = _evidence_near_posterior(theta, once, run, rng)
            return replace(weighing, nested=log_z + log_factor, error=error, doubts=doubts)

        told = weighing_from_samples(explored.samples(_N_SAMPLES, rng=rng))
        if told.gap < 0 and not told.agree:  # the run may have lost the mode that the fit has found
            found, law = candidate.found, candidate.law
            root = covariance_root(law(found.slopes), found.sd**2 / law.fisher_information)
            draws = found.z + rng.standard_normal((_N_SAMPLES, len(found.z))) @ root.T
            again = weighing_from_samples(np.clip(draws, -FARTHEST, FARTHEST))
            told = max(told, again, key=lambda own: own.nested)
    more = explored.log_z + log_factor - told.nested
    apart = more / math.hypot(explored.log_z_error, told.error)
    if apart < _APART:
        return told
    doubt = f"the whole prior holds more evidence than was found near the posterior, by {apart:.1f} standard errors"
    return replace(told, doubts=(*told.doubts, doubt))


def _evidence_near_posterior(
    theta: FloatArray, problem: nested.Samplable, run: Run, rng: np.random.Generator
) -> tuple[float, float, tuple[str, ...]]:
    """Return log evidence, its error, and warnings, by up to four runs from priors near the posterior, to 0.3 nats.

    The first is near the samples `theta`, each further one near the samples of the last; the result is their weighted
    mean, or that of a run whose refinement has a smaller error.
    """
    runs: list[nested.NestedResult] = []
    while True:
        nearer = repartitioned(problem, theta)
        found = run(nearer)
        runs.append(found)
        sharper = nested.refine(found, nearer, rng=rng)
        if sharper.sound and sharper.log_z_error < found.log_z_error:
            return sharper.log_z, sharper.log_z_error, ()
        weights = np.array([1.0 / own.log_z_error**2 for own in runs])
        error = float(weights.sum() ** -0.5)
        if error <= 0.3 or len(runs) == _MOST_RUNS:  # nats: with more, a difference of one is not resolved
            log_z = float(np.average([own.log_z for own in runs], weights=weights))
            return log_z, error, tuple(doubt for own in runs for doubt in own.warnings)
        theta = found.samples(_N_SAMPLES, rng=rng)
