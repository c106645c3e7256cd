"""Importance sampling: draws from a density fitted to posterior samples, weighted against prior and likelihood.

From such draws evidence and posterior are estimated independently of prior volumes, often with a hundredth of a run's
error for a few thousand evaluations (Cameron & Pettitt 2014; Lange 2023 with neural networks); the error of a run is
sqrt(H / n_live), with H the information in nats. The Pareto k of the weights' tail tells whether they are reliable
(Vehtari, Simpson, Gelman, Yao & Gabry 2024). `refine` does so for a run, `update` for one with new readings. From a
`repartitioned` prior near the samples another run is short.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeAlias

import numpy as np
from scipy.special import expit

from probewise._arrays import FloatArray, logsumexp, own_arithmetic
from probewise._kinds import checked_whole, require_callable, require_rng
from probewise.errors import require
from probewise.nested.clusters import Clusters, find_disconnected_clusters
from probewise.nested.problem import Evaluator, Samplable, Space, unbounded_space_of
from probewise.nested.result import NestedResult, Samples
from probewise.nested.weights import n_effective, resampled_rows, student_t_draws, student_t_log_norm
from probewise.priors import Prior

# Pareto k above which the mean of the weights converges too slowly for a reliable error (Vehtari et al. 2024).
MOST_K = 0.7
_FEW_EFFECTIVE = 100.0
MOST_LOST = 0.2  # of a posterior, from which on the error is not to be trusted
_BRIDGE_STEPS = 20
# Heavier tails than a Gaussian's keep the weights bounded where the fit is too narrow.
_DEGREES_OF_FREEDOM = 8.0
_MOST_KERNELS = 400
_FEW = 40
_SCALES = (1.0, 0.5, 0.2, 0.05, 0.01)
_BLOCK = 2048
# Of a prior near a posterior:
_DEGREES_NEAR, _WIDENING = 5.0, 1.4  # and times the samples' sds
_FLATTEST = 1e-12  # least variance along an axis, relative to the greatest
_LEAST_SAMPLES = 2  # distinct samples per parameter, to determine the axes


@dataclass(frozen=True, eq=False)
class Weighted(Samples):
    """Weighted posterior samples and the evidence, from importance sampling; see also `Samples`.

    `theta` are the draws with nonzero likelihood, (n, n_params). `pareto_k` is the shape of the weights' tail; above
    0.7 the error is unreliable. `run` is the fallback run, made where the weights were, else None; `n_calls` includes
    its own. `warnings` are reasons not to trust the error, in words; empty if there are none.
    """

    pareto_k: float
    run: NestedResult | None = None
    warnings: tuple[str, ...] = ()

    @property
    def sound(self) -> bool:
        """Whether there are no `warnings` about the error."""
        return not self.warnings

    def summary(self) -> str:
        """Describe evidence and posterior in plain text."""
        lines = [
            f"log Z        {self.log_z:.3f} ± {self.log_z_error:.3f} (of the peaks found; a missed one would add)",
            f"samples      {len(self.theta)}, effective sample size {self.n_eff:.0f}",
            f"cost         {self.n_calls} likelihood evaluations",
            f"weights      Pareto k = {self.pareto_k:.2f}",
        ]
        lines += [
            f"{name:<9}  {mean:>11.5g} ± {sd:.3g}"
            for name, mean, sd in zip(self.names, self.mean(), self.sd(), strict=True)
        ]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.warnings)])


def _warnings_of_weights(k: float, n_eff: float, missed: float = 0.0) -> tuple[str, ...]:
    """Return warnings of a heavy tail, of few effective samples, and of a share `missed` of the posterior."""
    reasons = {
        f"Pareto k of the weights is {k:.2f}, not below {MOST_K}": k < MOST_K,
        f"only {n_eff:.0f} effective samples, not {_FEW_EFFECTIVE:.0f}": n_eff >= _FEW_EFFECTIVE,
        f"the draws miss {100 * missed:.0f} % of the posterior": missed < MOST_LOST,
    }
    return tuple(words for words, fine in reasons.items() if not fine)


def evenly_weighted(
    names: tuple[str, ...],
    theta: FloatArray,
    log_likelihood: FloatArray,
    *,
    log_z: float = 0.0,
    log_z_error: float = 0.0,
    n_calls: int = 0,
    run: NestedResult | None = None,
) -> Weighted:
    """Return equally weighted samples, theta (n, n_params) and log_likelihood (n,), and an evidence, by default one."""
    even, n = np.full(len(theta), -math.log(len(theta))), float(len(theta))
    return Weighted(names, theta, log_likelihood, even, log_z, log_z_error, n, n_calls, pareto_k=-math.inf, run=run)


def samples_of_run(run: NestedResult) -> Weighted:
    """Return the samples, the evidence and the warnings of a run, with the run."""
    same = {each.name: getattr(run, each.name) for each in fields(Samples)}
    return Weighted(**same, pareto_k=-math.inf, run=run, warnings=run.warnings)


def weighted_draws(
    names: tuple[str, ...], theta: FloatArray, log_likelihood: FloatArray, log_ratio: FloatArray, n_draws: int
) -> Weighted:
    """Return draws, (n, n_params), weighted by the log of target over proposal density, (n,), as plain samples.

    The evidence is the mean weight of the `n_draws` that were made, those left out as impossible included.
    """
    total, n_eff = float(logsumexp(log_ratio)), n_effective(log_ratio)
    error = math.sqrt(max(1.0 / max(n_eff, 1.0) - 1.0 / n_draws, 0.0))
    there, evidence = log_ratio[np.isfinite(log_ratio)], (total - math.log(n_draws), error, n_eff)
    k = pareto_k(there) if len(there) > 1 else math.inf
    told = _warnings_of_weights(k, n_eff)
    return Weighted(names, theta, log_likelihood, log_ratio - total, *evidence, n_draws, k, warnings=told)


@dataclass(frozen=True, eq=False)
class Proposal:
    """A mixture of Student-t kernels, of one shape within each cluster."""

    clusters: Clusters
    centres: tuple[FloatArray, ...]  # in each cluster's whitened frame, (n_kernels, n_params) each
    width: tuple[float, ...]  # of the kernels in that frame
    share: FloatArray  # of the draws for each cluster, (n_clusters,)

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, n_params)."""
        n_params = self.clusters.mean.shape[1]
        which = rng.choice(len(self.share), size=n, p=self.share)
        white = student_t_draws(n, n_params, _DEGREES_OF_FREEDOM, rng=rng)
        out = np.empty((n, n_params))
        for k, (centres, width) in enumerate(zip(self.centres, self.width, strict=True)):
            rows = np.flatnonzero(which == k)
            place = centres[rng.integers(len(centres), size=rows.size)] + width * white[rows]
            out[rows] = self.clusters.mean[k] + place @ self.clusters.root[k].T
        return out

    def log_density(self, x: FloatArray) -> FloatArray:
        """Natural log of the density, (n, n_params) -> (n,)."""
        blocks = np.array_split(x, max(1, -(-len(x) // _BLOCK)))
        return np.concatenate([self._log_density_of_block(block) for block in blocks])

    def _log_density_of_block(self, x: FloatArray) -> FloatArray:
        n_params, nu = x.shape[1], _DEGREES_OF_FREEDOM
        constant, parts = student_t_log_norm(n_params, nu), []
        for k, (centres, width) in enumerate(zip(self.centres, self.width, strict=True)):
            white = (x - self.clusters.mean[k]) @ self.clusters.inverse_root[k].T
            square = (white**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2.0 * white @ centres.T
            kernel = -0.5 * (nu + n_params) * np.log1p(np.maximum(square, 0.0) / (nu * width**2))
            norm = constant - self.clusters.log_det[k] - n_params * math.log(width) - math.log(len(centres))
            parts.append(logsumexp(kernel, axis=1) + norm + math.log(self.share[k]))
        return np.asarray(logsumexp(parts, axis=0))


def mixture_of_proposals(proposals: Sequence[Proposal], share: Sequence[float]) -> Proposal:
    """Combine proposals into one mixture with the shares `share`, which need not be normalised."""
    total = math.fsum(share)
    return Proposal(
        Clusters.join(*(p.clusters for p in proposals)),
        tuple(centres for p in proposals for centres in p.centres),
        tuple(width for p in proposals for width in p.width),
        np.concatenate([s / total * p.share for p, s in zip(proposals, share, strict=True)]),
    )


def fit_wide_and_narrow_proposals(x: FloatArray, *, rng: np.random.Generator) -> tuple[Proposal, ...]:
    """Fit two proposals to samples, (n_samples, n_params): the best wide form, then the best narrow form.

    Wide: one kernel per cluster, as wide as the cluster. Narrow: kernels at the samples, of Silverman's width or less.
    Of each form the variant, with or without clusters, with the greatest held-out likelihood is fitted to all samples.
    That favours a close fit, weights of draws a wide one. Fewer than 80 samples give one wide kernel only.
    """
    x = x[rng.permutation(len(x))]
    half = len(x) // 2
    if half < _FEW:
        return (_fit_kernels(x, False, None),)

    def held_out_score(form: tuple[bool, float | None]) -> float:
        return float(_fit_kernels(x[:half], *form).log_density(x[half:]).mean())

    wide: list[tuple[bool, float | None]] = [(False, None), (True, None)]
    narrow: list[tuple[bool, float | None]] = [(split, scale) for split in (False, True) for scale in _SCALES]
    return tuple(_fit_kernels(x, *max(forms, key=held_out_score)) for forms in (wide, narrow))


def _fit_kernels(x: FloatArray, split: bool, scale: float | None) -> Proposal:
    """Fit one form of proposal: by cluster if `split`; one kernel per cluster if `scale` is None, else at samples.

    `scale`: width of the kernels in units of Silverman's.
    """
    clusters = find_disconnected_clusters(x) if split else Clusters.from_groups([x])
    home = clusters.assign(x)
    n_params = x.shape[1]
    centres, width = [], []
    for k in range(len(clusters)):
        part = x[home == k]
        if scale is None or len(part) < 2:
            centres.append(np.zeros((1, n_params)))
            width.append(1.0)
        else:
            kept = part[:_MOST_KERNELS]
            centres.append((kept - clusters.mean[k]) @ clusters.inverse_root[k].T)
            width.append(scale * (4 / (n_params + 2) / len(kept)) ** (1 / (n_params + 4)))
    size = np.maximum(np.bincount(home, minlength=len(clusters)), 1)
    return Proposal(clusters, tuple(centres), tuple(width), size / size.sum())


HeldOut: TypeAlias = tuple[FloatArray, FloatArray, float]
"""Posterior samples held out from a fit: in unbounded coordinates (n, n_params), log target (n,), effective number."""


def draw_and_weigh(
    proposal: Proposal,
    held: HeldOut | None,
    space: Space,
    evaluate: Evaluator,
    *,
    n_draws: int,
    rng: np.random.Generator,
) -> Weighted:
    """Make `n_draws` from a proposal, evaluate, and weight them.

    `held`: posterior samples that correct the evidence by bridge sampling, or None. If no draw is possible, log Z is
    -inf.
    """
    x = proposal.draw(n_draws, rng=rng)
    theta, log_density = space.leave(x)
    possible = np.flatnonzero(np.isfinite(log_density))
    theta, log_density = theta[possible], log_density[possible]
    log_likelihood = evaluate.log_likelihood(theta) if possible.size else np.empty(0)
    log_ratio = log_density + log_likelihood - proposal.log_density(x[possible])
    alive, n_calls = np.isfinite(log_ratio), evaluate.n_calls
    if not alive.any():
        nothing, none = np.empty(0), (-math.inf, math.inf, 0.0, n_calls, math.inf)
        told = _warnings_of_weights(math.inf, 0.0)
        return Weighted(evaluate.names, theta[:0], nothing, nothing, *none, warnings=told)
    theta, log_likelihood, log_ratio = theta[alive], log_likelihood[alive], log_ratio[alive]
    k = pareto_k(log_ratio)
    held_ratio, n_held = np.empty(0), 0.0
    if held is not None and len(held[0]):
        held_ratio, n_held = held[1] - proposal.log_density(held[0]), held[2]
    log_z, error, missed, log_weight = _bridge_sampling_estimate(log_ratio, n_draws, held_ratio, n_held)
    # The mean of weights of infinite variance converges as n^(k - 1) instead of n^(-1/2) (Vehtari et al. 2024).
    error *= len(log_ratio) ** min(max(k - 0.5, 0.0), 1.0)
    n_eff = n_effective(log_weight)
    told = _warnings_of_weights(k, n_eff, missed)
    return Weighted(evaluate.names, theta, log_likelihood, log_weight, log_z, error, n_eff, n_calls, k, warnings=told)


def _bridge_sampling_estimate(
    log_ratio: FloatArray, n_draws: int, held_ratio: FloatArray, n_held: float
) -> tuple[float, float, float, FloatArray]:
    """Estimate the evidence from draws and posterior samples by bridge sampling (Meng & Wong 1996).

    `log_ratio`: log of target over proposal density at the draws with nonzero target, (n_alive,), of `n_draws` in all.
    `held_ratio`: the same log at held-out posterior samples, (n_samples,), of effective number `n_held`; empty for
    plain importance sampling. Return log Z, its error, the share of the posterior that the draws miss, and the draws'
    log weights, (n_alive,).
    """
    log_z = float(logsumexp(log_ratio)) - math.log(n_draws)
    missed, kept_error, cut = 0.0, 0.0, log_ratio
    if len(held_ratio):
        # The optimal bridge tapers weights above n_draws / n_held times their mean; the samples correct for it.
        for _ in range(_BRIDGE_STEPS):
            limit = log_z + math.log(n_draws / n_held)
            cut = log_ratio - np.logaddexp(0.0, log_ratio - limit)
            share = expit(limit - held_ratio)
            kept = max(float(share.mean()), 1e-9)
            log_z = float(logsumexp(cut)) - math.log(n_draws) - math.log(kept)
        missed = float((held_ratio > limit).mean())
        kept_error = float(share.std()) / math.sqrt(n_held) / kept
    # Draws with zero target count as weights of zero.
    spread = max(1.0 / n_effective(cut) - 1.0 / n_draws, 0.0)
    return log_z, math.sqrt(spread + kept_error**2), missed, cut - float(logsumexp(cut))


def pareto_k(log_weight: FloatArray) -> float:
    """Estimate the Pareto shape k of the tail of importance weights, from log weights of any scale, (n,).

    A generalised Pareto distribution is fitted to the largest weights, 3 sqrt(n) of them but at most a fifth, with the
    estimator of Zhang & Stephens (2009), as in Vehtari et al. (2024). Below 0.5 the weights have a finite variance;
    above 0.7 their mean converges too slowly to be used. k is infinite for fewer than 25 weights, and minus infinity
    where fewer than five of the tail exceed the rest.
    """
    n = len(log_weight)
    n_tail = int(min(0.2 * n, 3.0 * math.sqrt(n)))
    if n_tail < 5:
        return math.inf
    weight = np.sort(np.exp(log_weight - log_weight.max()))
    excess = weight[-n_tail:] - weight[-n_tail - 1]
    # The shape does not depend on the scale; below 1e-100 of the greatest, one over an excess would overflow.
    excess = excess[excess > 1e-100 * excess[-1]] / max(excess[-1], 1e-300)
    if excess.size < 5:
        return -math.inf
    n_grid = 30 + int(math.sqrt(excess.size))
    quartile = excess[int(excess.size / 4 + 0.5) - 1]
    b = 1.0 / excess[-1] + (1.0 - np.sqrt(n_grid / (np.arange(1, n_grid + 1) - 0.5))) / (3.0 * quartile)
    b[b == 0.0] = 1e-12 / quartile  # the exponential tail, k = 0, approximated by its neighbour
    k = np.log1p(-b[:, None] * excess).mean(axis=1)
    log_profile = excess.size * (np.log(-b / k) - k - 1.0)
    mean_b = float(np.exp(log_profile - logsumexp(log_profile)) @ b)
    shape = float(np.log1p(-mean_b * excess).mean())
    # Shrunk towards 0.5 by ten prior observations, to reduce the noise of short tails.
    return float((excess.size * shape + 10 * 0.5) / (excess.size + 10))


_MOST_FITTED = 2000
_SURPRISED = 0.01
_HELD_OUT = 1 / 3
_MOST_HELD = 1000
_N_UPDATED = 1000  # samples of the old posterior whose likelihood is evaluated again
_APART = 4.0  # errors between the log Z of draws and of the refined run, above which they disagree
_N_PILOTS = 2
_FIRST = 0.75  # share of the better form of density in the mixture

Posterior: TypeAlias = NestedResult | Weighted


@own_arithmetic
def refine(result: Posterior, problem: Samplable, *, rng: np.random.Generator, n_draws: int = 5000) -> Weighted:
    """Reduce the error of a run's evidence and posterior by importance sampling; see `Weighted.sound` before its use.

    Two forms of proposal density are fitted to two thirds of the run's posterior samples. In each pilot round a few
    draws of each are weighted; the form with the larger effective sample size gets the larger share of the mixture, and
    its weighted draws are added to the samples for the next fit. Finally `n_draws` points are drawn, 100 or more; only
    these count, so they are independent. Each of two pilot rounds takes a quarter of that, at least 100, in addition.

    The held-out third of the samples is combined with the draws by bridge sampling (Meng & Wong 1996), which estimates
    the share of the posterior that the proposal misses. The error includes that; what a heavy tail of the weights adds,
    which slows the convergence of their mean; and that the run may have lost a mode: with n_live points and information
    H (nats) it knows the shares of modes as n_live / H independent samples do, so that a mode of share s is lost with
    probability exp(-s n_live / H). The sum of s times that over the modes found is added. A mode that the run missed
    is in neither number: its error says nothing of it, and only another run, or more live points, can find it.

    `result` is a run of the same problem, or an earlier refinement. Raises ParameterError if an option is out of range,
    the run has other parameters, or the prior has neither `to_unit_cube` nor coordinates; NotConvergedError if the
    likelihood fails.
    """
    require_rng(rng)
    n_draws = checked_whole("n_draws", n_draws, least=100)
    evaluate, space = _evaluator_and_space(problem, result, "result")
    require(result.names, "result", "a run without parameters", "one with some; the evidence is exact without")
    n_lineages = effective_lineages(result)
    # Two to one at random: samples for fitting a density, by weight, and held-out ones.
    lot = rng.random(len(result.theta)) < _HELD_OUT
    chosen = np.flatnonzero(lot & (result.log_weight > -math.inf))
    rows = chosen[resampled_rows(np.exp(result.log_weight[chosen]), min(_MOST_HELD, chosen.size), rng)]
    x = space.enter(result.theta[rows])
    held = x, space.leave(x)[1] + result.log_likelihood[rows], _HELD_OUT * n_lineages
    known = [_resampled_for_fit(result.theta[~lot], result.log_weight[~lot], space, rng)]
    for _ in range(_N_PILOTS):
        proposals = fit_wide_and_narrow_proposals(np.concatenate(known), rng=rng)
        pilots = [draw_and_weigh(p, None, space, evaluate, n_draws=max(n_draws // 8, 50), rng=rng) for p in proposals]
        first = int(np.argmax([pilot.n_eff for pilot in pilots]))
        better = pilots[first]
        # The other form keeps a share: it may cover what the better one does not.
        others = (1.0 - _FIRST) / max(len(proposals) - 1, 1)
        best = mixture_of_proposals(proposals, [_FIRST if k == first else others for k in range(len(proposals))])
        if better.n_eff > 2 * len(evaluate.names):
            known.append(_resampled_for_fit(better.theta, better.log_weight, space, rng))
    found = draw_and_weigh(best, held, space, evaluate, n_draws=n_draws, rng=rng)
    found = with_error_of_lost_parts(found, n_lineages, space, rng)
    return replace(found, warnings=(*found.warnings, *_inherited_warnings(found, result)))


@own_arithmetic
def update(
    previous: Posterior,
    problem: Samplable,
    *,
    rng: np.random.Generator,
    fall_back: Callable[[], NestedResult],
    n_draws: int = 2000,
) -> Weighted:
    """Update a posterior with new readings by importance sampling.

    The previous samples are reweighted by the new readings' likelihood, and refined as those of a run are. The draws
    are weighted against the whole new problem, so the evidence is absolute and errors do not accumulate from reading to
    reading. Where the new readings are surprising (too few effective samples or too heavy a tail of the weights),
    `fall_back` starts from scratch.

    `previous` is the posterior of the same parameters given fewer readings; `problem` has the prior, and the likelihood
    of all readings; `fall_back` solves the new problem, as `lambda: run(problem, rng=rng)`: then its samples are
    returned, and its result as `run`. `n_draws`: number of draws, 100 or more; half as many are pilots, and each old
    sample, at most 1000, is evaluated once. Errors as of `refine`.
    """
    require_rng(rng)
    require_callable(
        "fall_back", fall_back, "a function that solves the problem, such as lambda: run(problem, rng=rng)"
    )
    n_draws = checked_whole("n_draws", n_draws, least=100)
    evaluate, _ = _evaluator_and_space(problem, previous, "previous")
    rows = np.unique(previous.draw_rows(_N_UPDATED, rng=rng))
    theta, before = previous.theta[rows], previous.log_weight[rows]
    log_likelihood = evaluate.log_likelihood(theta)
    # Rows of weight above 1 / 1000 were drawn several times and kept once: their weight makes up for it.
    log_weight = np.maximum(before, -math.log(_N_UPDATED)) + log_likelihood - previous.log_likelihood[rows]
    n_eff, k = n_effective(log_weight), math.inf
    # Without parameters there is no density to fit: the fallback evaluates the only hypothesis.
    if evaluate.names and n_eff >= max(_SURPRISED * len(rows), 3 * len(evaluate.names)):
        total = float(logsumexp(log_weight))
        now = previous.log_z + total, math.hypot(previous.log_z_error, n_eff**-0.5)
        n_own = effective_lineages(previous) * n_eff / len(rows)
        old = Weighted(evaluate.names, theta, log_likelihood, log_weight - total, *now, n_own, 0, pareto_k=-math.inf)
        found = refine(old, problem, rng=rng, n_draws=n_draws)
        if found.sound:
            return replace(found, n_calls=found.n_calls + evaluate.n_calls)
        k = found.pareto_k
    fallen = samples_of_run(fall_back())
    return replace(fallen, n_calls=evaluate.n_calls + fallen.n_calls, pareto_k=k)


def _evaluator_and_space(problem: Samplable, found: Posterior, name: str) -> tuple[Evaluator, Space]:
    """Return a problem's evaluator and unbounded coordinates; ParameterError if `found` has other parameters."""
    evaluate = Evaluator(problem)
    require(found.names == evaluate.names, f"{name}.names", found.names, f"the problem's names {evaluate.names}")
    return evaluate, unbounded_space_of(problem.prior)


def _inherited_warnings(found: Weighted, result: Posterior) -> tuple[str, ...]:
    """Return the warnings of `result`; of a run also where its log Z, or its check's, is four errors from `found`'s."""
    if isinstance(result, Weighted):
        return result.warnings
    routes = [("the run", result.log_z, result.log_z_error)]
    if result.check is not None:
        routes.append((result.check.route, result.check.log_z, result.check.log_z_error))
    apart = tuple(
        f"{name} gives log Z = {log_z:.2f} ± {error:.2f}, the draws {found.log_z:.2f} ± {found.log_z_error:.2f}"
        for name, log_z, error in routes
        if not abs(log_z - found.log_z) <= _APART * math.hypot(error, found.log_z_error)
    )
    return (*result.warnings, *apart)


def effective_lineages(found: Posterior) -> float:
    """Return the number of independent samples that would give the share of a mode as precisely as this posterior.

    Many samples of a run descend from one live point. The log evidence of a mode has the error sqrt(H memory / n_live),
    with H the information and `memory` the variance factor of correlated chains; a share estimated from n independent
    samples has the relative error 1 / sqrt(n). So n is n_live / (H memory); for `Weighted` without a run it is `n_eff`.
    """
    if isinstance(found, Weighted):
        return found.n_eff if found.run is None else effective_lineages(found.run)
    return found.n_live / max(found.information * found.memory, 1.0)


def _resampled_for_fit(theta: FloatArray, log_weight: FloatArray, space: Space, rng: np.random.Generator) -> FloatArray:
    """Resample for fitting a density; return distinct samples in coordinates of `space`, (n, n_params).

    A third as many are drawn by the square root of the weights: a proposal must have wider tails than the posterior.
    """
    weight = np.exp(log_weight - log_weight.max())
    n = int(min(max(n_effective(log_weight), 4 * theta.shape[1] + 4), _MOST_FITTED))
    rows = [resampled_rows(weight, n, rng), resampled_rows(np.sqrt(weight), n // 3, rng)]
    return space.enter(theta[np.unique(np.concatenate(rows))])


def with_error_of_lost_parts(found: Weighted, n_lineages: float, space: Space, rng: np.random.Generator) -> Weighted:
    """Add to the error, in quadrature, the share of the posterior that a run of `n_lineages` samples may have lost."""
    if not found.n_eff > 1:
        return found
    n = int(min(found.n_eff, 1000))
    parts = find_disconnected_clusters(space.enter(found.theta[np.unique(found.draw_rows(n, rng=rng))]))
    share = parts.size / parts.size.sum()
    lost = float(share @ np.exp(-n_lineages * share))
    doubt = f"{100 * lost:.0f} % of the posterior may be lost: too few live points for its parts"
    warnings = found.warnings if lost < MOST_LOST else (*found.warnings, doubt)
    return replace(found, warnings=warnings, log_z_error=math.hypot(found.log_z_error, lost))


@dataclass(frozen=True, eq=False)
class Repartitioned:
    """A problem with the same evidence and posterior, but a prior near that posterior: posterior repartitioning.

    Evidence and posterior depend only on the product of prior and likelihood, so any density may replace the prior if
    the likelihood compensates for it (Chen, Hobson, Das & Gelderblom 2019, Stat. Comput. 29, 835). From a density near
    the posterior there are few nats of compression, which lowers the cost and the error of a run. Live points climb to
    regions that the density undersamples; a distant part of the posterior without any sample stays unseen.

    `prior` has coordinates to draw in, and `log_prior_ratio`: the log of the original prior's density over its own.
    """

    problem: Samplable
    prior: Any

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood plus the log of the original over the new prior density, (n, n_params) -> (n,)."""
        # The ratio first: a likelihood may modify its argument.
        log_prior_ratio = self.prior.log_prior_ratio(theta)
        return np.asarray(self.problem.log_likelihood(theta) + log_prior_ratio)


class _PriorNearPosterior:
    """A prior near the posterior: a mixture of Student t products in unbounded coordinates x, those of `space`.

    There is a part for each of some groups of points. In it x = `center` (n_parts, n_params) + `root` (n_parts,
    n_params, n_params) e, where the coordinates e along its principal axes are independent Student t of 5 degrees of
    freedom. Chains move in the coordinates e of the first part. `original`: the problem's prior.
    """

    def __init__(self, original: Prior, groups: Sequence[FloatArray]) -> None:
        self.original, self.names, self.space = original, original.names, unbounded_space_of(original)
        x = [self.space.enter(each) for each in groups]
        self.share: FloatArray = np.array([len(group) for group in x]) / sum(map(len, x))
        self.center = np.stack([group.mean(axis=0) for group in x])
        self.root = np.stack([covariance_root_of_points(group, _WIDENING) for group in x])
        self.inverse_root: FloatArray = np.asarray(np.linalg.inv(self.root), dtype=np.float64)
        self._log_dets: FloatArray = np.asarray(np.linalg.slogdet(self.root)[1], dtype=np.float64)

    @property
    def coordinates(self) -> _PriorNearPosterior:
        return self

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self.original.from_unit_cube(u)  # of the original; samplers use `draw`

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` points of this prior in the coordinates of chains, (n, n_params)."""
        part = rng.choice(len(self.share), size=n, p=self.share)
        e = rng.standard_t(_DEGREES_NEAR, (n, len(self.names)))
        return self._to_axes(self.center[part] + np.einsum("nij,nj->ni", self.root[part], e), 0)

    def log_prior_ratio(self, theta: FloatArray) -> FloatArray:
        x = self.space.enter(theta)
        return np.asarray(self.space.leave(x)[1] - self._log_density(x))

    def enter(self, theta: FloatArray) -> FloatArray:
        return self._to_axes(self.space.enter(theta), 0)

    def leave(self, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = self.center[0] + e @ self.root[0].T
        theta, log_plain = self.space.leave(x)
        return theta, np.where(np.isfinite(log_plain), self._log_density(x) + self._log_dets[0], -np.inf)

    def _to_axes(self, x: FloatArray, part: int) -> FloatArray:
        # A matrix product would depend, in the last bit, on the batch, which an executor divides.
        return np.asarray(np.einsum("nj,ij->ni", x - self.center[part], self.inverse_root[part]))

    def _log_density(self, x: FloatArray) -> FloatArray:
        nu = _DEGREES_NEAR
        e = np.stack([self._to_axes(x, part) for part in range(len(self.share))])
        along = (student_t_log_norm(1, nu) - 0.5 * (nu + 1) * np.log1p(e**2 / nu)).sum(axis=2)
        return np.asarray(np.logaddexp.reduce(along + (np.log(self.share) - self._log_dets)[:, None], axis=0))


def repartitioned(problem: Samplable, theta: FloatArray, *, peaks: Sequence[FloatArray] = ()) -> Repartitioned:
    """Repartition a problem: a prior near its posterior, for a second run that is shorter and more precise.

    Its log Z is that of the original problem; its `log_likelihood` is not, so that `refine` takes its runs with this
    problem. Along each principal axis the prior is a Student t with five degrees of freedom, 1.4 times as wide as the
    samples `theta`, (n_samples, n_params), of the posterior. With `peaks`, further groups of points, it is a mixture
    with a part for each group, by its number of points. ParameterError if there are too few distinct samples to
    determine the axes.
    """
    n_different, least = len(np.unique(theta, axis=0)), _LEAST_SAMPLES * len(problem.prior.names)
    found, allowed = f"{n_different} different samples", f"{least} or more; run with more live points"
    require(n_different >= max(least, 1), "theta", found, allowed)
    return Repartitioned(problem, _PriorNearPosterior(problem.prior, (theta, *peaks)))


def covariance_root_of_points(x: FloatArray, scale: float = 1.0) -> FloatArray:
    """Return a root of the covariance of points (n, n_params), times `scale`; see `root_of_covariance`."""
    return root_of_covariance(np.atleast_2d(np.cov(x, rowvar=False)), scale)


def root_of_covariance(covariance: FloatArray, scale: float = 1.0) -> FloatArray:
    """Return a root of a covariance, (n_params, n_params): the principal axes as columns, times sd and `scale`.

    Axes without variance keep a millionth of the greatest sd, so that the root can be inverted.
    """
    variance, axes = np.linalg.eigh(covariance)
    sd = np.sqrt(np.maximum(variance, _FLATTEST * max(float(variance[-1]), 1e-300)))
    return np.asarray(scale * axes * sd)
