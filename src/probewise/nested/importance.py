"""Importance sampling: weighted draws for `refine`, and `update` of a posterior with new readings.

Nested sampling locates the posterior; the error of its log evidence is sqrt(H / n_live), with H the information in
nats. Importance sampling from a density fitted to its samples estimates the same evidence and posterior independently,
often with a hundredth of the error for a few thousand more evaluations (Cameron & Pettitt 2014; Lange 2023 with neural
networks). The Pareto k of the weights' tail tells whether they are reliable (Vehtari, Simpson, Gelman, Yao & Gabry
2024).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from scipy.special import expit, logsumexp

from probewise._arrays import FloatArray, own_arithmetic, read_only_floats
from probewise._kinds import checked_number, checked_whole, require_callable, require_rng
from probewise.errors import ParameterError
from probewise.nested.evaluate import Evaluator, Samplable
from probewise.nested.proposal import Proposal, find_disconnected_clusters, fit_wide_and_narrow_proposals
from probewise.nested.result import NestedResult
from probewise.nested.space import Space, unbounded_space_of
from probewise.nested.weighted_samples import WeightedSamples
from probewise.nested.weights import n_effective, resampled_rows

# Pareto k above which the mean of the weights converges too slowly for a reliable error (Vehtari et al. 2024).
_MOST_K = 0.7
_FEW_EFFECTIVE = 100.0
_MOST_FITTED = 2000
_SURPRISED = 0.01
_MOST_LOST = 0.2
_HELD_OUT = 1 / 3
_MOST_HELD = 1000
_BRIDGE_STEPS = 20
# Draws whose log Z is this many errors from that of the refined run disagree with it.
_APART = 4.0


@dataclass(frozen=True, eq=False)
class Weighted(WeightedSamples):
    """Weighted posterior samples and the evidence, from importance sampling.

    Attributes
    ----------
    names
        Parameter names, one per column of theta.
    theta
        Draws with nonzero likelihood, (n, n_params).
    log_likelihood, log_weight
        Of each draw, (n,); the weights sum to one.
    log_z, log_z_error
        Natural log of the evidence and its standard error.
    n_eff
        Kish's effective sample size.
    n_calls
        Likelihood evaluations, including those of a fallback run.
    pareto_k
        Shape of the weights' tail; above 0.7 the error is unreliable.
    run
        The fallback run, made where the weights were unreliable; else None.
    missed
        Share of the posterior that the draws undersample, estimated from held-out samples; `log_z` includes it, the
        samples do not.
    lost
        Share of the posterior that the run may have lost undetected, see `refine`; the error includes it.
    inherited
        Doubts about the refined run, and about a disagreement with it, in words.
    """

    names: tuple[str, ...]
    theta: FloatArray
    log_likelihood: FloatArray
    log_weight: FloatArray
    log_z: float
    log_z_error: float
    n_eff: float
    n_calls: int
    pareto_k: float
    run: NestedResult | None = field(default=None)
    missed: float = 0.0
    lost: float = 0.0
    inherited: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("theta", "log_likelihood", "log_weight"):
            object.__setattr__(self, name, read_only_floats(getattr(self, name)))

    @property
    def sound(self) -> bool:
        """Whether there are no `doubts` about the error."""
        return not self.doubts

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons not to trust the error, in words, or the warnings of the fallback run; empty if there are none."""
        if self.run is not None:
            return self.run.warnings
        reasons = (
            (not self.pareto_k < _MOST_K, f"Pareto k of the weights is {self.pareto_k:.2f}, not below {_MOST_K}"),
            (not self.n_eff >= _FEW_EFFECTIVE, f"only {self.n_eff:.0f} effective samples, not {_FEW_EFFECTIVE:.0f}"),
            (not self.missed < _MOST_LOST, f"the draws miss {100 * self.missed:.0f} % of the posterior"),
            (
                not self.lost < _MOST_LOST,
                f"{100 * self.lost:.0f} % of the posterior may be lost: too few live points for its parts",
            ),
        )
        return (*(words for so, words in reasons if so), *self.inherited)

    @own_arithmetic
    def mean(self, f: Callable[[FloatArray], FloatArray] | None = None) -> FloatArray:
        """Posterior mean of the parameters, (n_params,), or of `f(theta)`, (n, ...), of the trailing shape."""
        values = self.theta if f is None else np.asarray(f(self.theta))
        return np.asarray(np.tensordot(self.weight, values, axes=(0, 0)))

    def summary(self) -> str:
        """Describe evidence and posterior in plain text."""
        lines = [
            f"log Z        {self.log_z:.3f} ± {self.log_z_error:.3f}",
            f"samples      {len(self.theta)}, effective sample size {self.n_eff:.0f}",
            f"cost         {self.n_calls} likelihood evaluations",
            f"weights      Pareto k = {self.pareto_k:.2f}, missed {self.missed:.2g}, possibly lost {self.lost:.2g}",
        ]
        lines += [
            f"{name:<9}  {mean:>11.5g} ± {sd:.3g}"
            for name, mean, sd in zip(self.names, self.mean(), self.sd(), strict=True)
        ]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.doubts)])


Posterior: TypeAlias = NestedResult | Weighted


def inherited_doubts(found: Weighted, result: Posterior) -> tuple[str, ...]:
    """Return the doubts about `result`, which `found` refines, in words.

    For a run also where its log Z, or that of its check, is more than four errors from that of `found`.
    """
    if isinstance(result, Weighted):
        return result.doubts
    routes = [("the run", result.log_z, result.log_z_error)]
    if result.check is not None:
        routes.append((result.check.route, result.check.log_z, result.check.log_z_error))
    apart = tuple(
        f"{name} gives log Z = {log_z:.2f} ± {error:.2f}, the draws {found.log_z:.2f} ± {found.log_z_error:.2f}"
        for name, log_z, error in routes
        if not abs(log_z - found.log_z) <= _APART * math.hypot(error, found.log_z_error)
    )
    return (*result.warnings, *apart)


@own_arithmetic
def update(
    previous: Posterior,
    problem: Samplable,
    *,
    rng: np.random.Generator,
    fall_back: Callable[[], NestedResult],
    n_draws: int = 2000,
    prior_share: float = 0.1,
) -> Weighted:
    """Update a posterior with new readings by importance sampling.

    The previous samples are reweighted by the new readings' likelihood, and a proposal is fitted to the samples. Draws
    from a mixture of the proposal and the prior are weighted against the whole new problem, so the evidence is absolute
    and errors do not accumulate from reading to reading. Where the new readings are surprising (too few effective
    samples or too heavy a tail of the weights), `fall_back` starts from scratch.

    Parameters
    ----------
    previous
        Posterior of the same parameters given fewer readings.
    problem
        Prior, and likelihood of all readings.
    rng
        Source of randomness.
    fall_back
        Function that solves the new problem, for instance `lambda: run(problem, rng=rng)`.
    n_draws
        Number of draws; the cost is this many evaluations plus one per old sample, at most 1000.
    prior_share
        Share of the draws that come from the prior, 0 to below 1: they cover regions without samples of the old
        posterior, and bound the weights.

    Returns
    -------
    Weighted
        With the samples and `run` of the fallback where it was used.

    Raises
    ------
    ParameterError
        If `previous` has other parameters, an option is out of range, or the prior has neither `to_unit_cube` nor
        coordinates.
    NotConvergedError
        If the likelihood fails.
    """
    require_rng(rng)
    require_callable(
        "fall_back", fall_back, "a function that solves the problem, such as lambda: run(problem, rng=rng)"
    )
    n_draws = checked_whole("n_draws", n_draws)
    if not 0 <= checked_number("prior_share", prior_share) < 1:
        raise ParameterError("prior_share", prior_share, "0 or more, below 1")
    evaluate = Evaluator(problem)
    if previous.names != evaluate.names:
        raise ParameterError("previous.names", previous.names, f"the problem's names {evaluate.names}")
    space = unbounded_space_of(problem.prior)
    rows = np.unique(previous.draw_rows(1000, rng=rng))
    theta = previous.theta[rows]
    log_likelihood = evaluate.log_likelihood(theta)
    log_weight = previous.log_weight[rows] + log_likelihood - previous.log_likelihood[rows]
    # Rows of weight above 1 / 1000 were drawn several times and kept once: their weight makes up for it.
    log_weight = log_weight + np.maximum(-math.log(1000) - previous.log_weight[rows], 0.0)
    n_eff, k = n_effective(log_weight), math.inf
    # Without parameters there is no density to fit: the fallback evaluates the only hypothesis.
    if evaluate.names and n_eff >= max(_SURPRISED * len(rows), 3 * len(evaluate.names)):
        proposal = fit_wide_and_narrow_proposals(
            resampled_for_fit(theta, log_weight - float(logsumexp(log_weight)), space, rng), rng=rng
        )[-1]
        found = draw_and_weigh(proposal, prior_share, HeldOutSamples.empty(), space, evaluate, n_draws=n_draws, rng=rng)
        found = with_error_of_lost_parts(found, effective_lineages(previous) * n_eff / len(rows), space, rng)
        if found.sound:
            return found
        k = found.pareto_k
    fallen = fall_back()
    return Weighted(
        fallen.names,
        fallen.theta,
        log_likelihood=fallen.log_likelihood,
        log_weight=fallen.log_weight,
        log_z=fallen.log_z,
        log_z_error=fallen.log_z_error,
        n_eff=fallen.n_eff,
        n_calls=evaluate.n_calls + fallen.n_calls,
        pareto_k=k,
        run=fallen,
    )


@dataclass(frozen=True, eq=False)
class HeldOutSamples:
    """Posterior samples held out from the fit.

    `x` (n, n_params) in unbounded coordinates; the prior's log density there and the log likelihood, (n,);
    `n_independent`: their effective number.
    """

    x: FloatArray
    log_density: FloatArray
    log_likelihood: FloatArray
    n_independent: float

    @classmethod
    def empty(cls) -> HeldOutSamples:
        """Return an empty set, for plain importance sampling."""
        return cls(np.empty((0, 0)), np.empty(0), np.empty(0), 0.0)


def effective_lineages(found: Posterior) -> float:
    """Return the number of independent samples that would give the share of a mode as precisely as this posterior.

    Many samples of a run descend from one live point. The log evidence of a mode has the error sqrt(H memory / n_live),
    with H the information and `memory` the variance factor of correlated chains; a share estimated from n independent
    samples has the relative error 1 / sqrt(n). So n is n_live / (H memory); for `Weighted` without a run it is `n_eff`.
    """
    if isinstance(found, Weighted):
        return found.n_eff if found.run is None else effective_lineages(found.run)
    return found.n_live / max(found.information * found.memory, 1.0)


def split_off_held_out(
    found: Posterior, n_lineages: float, space: Space, rng: np.random.Generator
) -> tuple[FloatArray, HeldOutSamples]:
    """Split samples at random, two to one, into those for fitting a density and held-out ones.

    The first are (n, n_params), in coordinates of `space`, resampled by weight. `n_lineages`: effective number of all.
    """
    lot = rng.random(len(found.theta)) < _HELD_OUT
    chosen = np.flatnonzero(lot & (found.log_weight > -math.inf))
    weight = np.exp(found.log_weight[chosen])
    rows = chosen[resampled_rows(weight, min(_MOST_HELD, chosen.size), rng)]
    x = space.enter(found.theta[rows])
    held = HeldOutSamples(x, space.leave(x)[1], found.log_likelihood[rows], _HELD_OUT * n_lineages)
    return resampled_for_fit(found.theta[~lot], found.log_weight[~lot], space, rng), held


def resampled_for_fit(theta: FloatArray, log_weight: FloatArray, space: Space, rng: np.random.Generator) -> FloatArray:
    """Resample for fitting a density; return distinct samples in coordinates of `space`, (n, n_params).

    As many are drawn by weight as the effective sample size, at most 2000, and a third as many by the square root of
    the weights: a proposal must have wider tails than the posterior.
    """
    weight = np.exp(log_weight - log_weight.max())
    n = int(min(max(n_effective(log_weight), 4 * theta.shape[1] + 4), _MOST_FITTED))
    rows = [resampled_rows(weight, n, rng), resampled_rows(np.sqrt(weight), n // 3, rng)]
    return space.enter(theta[np.unique(np.concatenate(rows))])


def with_error_of_lost_parts(found: Weighted, n_lineages: float, space: Space, rng: np.random.Generator) -> Weighted:
    """Set `lost`, the share of the posterior that a run of `n_lineages` effective samples may have lost.

    It is added to `log_z_error` in quadrature.
    """
    if not found.n_eff > 1:
        return found
    n = int(min(found.n_eff, 1000))
    parts = find_disconnected_clusters(space.enter(found.theta[np.unique(found.draw_rows(n, rng=rng))]))
    share = parts.size / parts.size.sum()
    lost = float(share @ np.exp(-n_lineages * share))
    return replace(found, lost=lost, log_z_error=math.hypot(found.log_z_error, lost))


def draw_and_weigh(
    proposal: Proposal,
    prior_share: float,
    held: HeldOutSamples,
    space: Space,
    evaluate: Evaluator,
    *,
    n_draws: int,
    rng: np.random.Generator,
    tail: float = 3.0,
) -> Weighted:
    """Draw from a mixture of a proposal and the prior, evaluate, and weight the draws.

    `prior_share`: share of the `n_draws` from the prior. `held`: posterior samples that correct the evidence by bridge
    sampling. `tail` as for `pareto_k`. If no draw is possible, log Z is -inf.
    """
    # At least one draw is the proposal's: a share below 1, such as 0.9999 of 2000, may round to all of them.
    n_prior = min(round(prior_share * n_draws), n_draws - 1)

    def log_proposal(x: FloatArray, log_density: FloatArray) -> FloatArray:
        """Return the log density of the mixture from which the draws come; `log_density` is the prior's."""
        log_fitted = proposal.log_density(x)
        if not n_prior:
            return log_fitted
        share = n_prior / n_draws
        return np.asarray(np.logaddexp(log_fitted + math.log1p(-share), log_density + math.log(share)))

    x = np.concatenate([proposal.draw(n_draws - n_prior, rng=rng), space.draw(n_prior, rng=rng)])
    theta, log_density = space.leave(x)
    possible = np.flatnonzero(np.isfinite(log_density))
    theta, log_density = theta[possible], log_density[possible]
    log_likelihood = evaluate.log_likelihood(theta) if possible.size else np.empty(0)
    log_ratio = log_density + log_likelihood - log_proposal(x[possible], log_density)
    alive = np.isfinite(log_ratio)
    if not alive.any():
        nothing = np.empty(0)
        return Weighted(
            evaluate.names,
            theta[:0],
            log_likelihood=nothing,
            log_weight=nothing,
            log_z=-math.inf,
            log_z_error=math.inf,
            n_eff=0.0,
            n_calls=evaluate.n_calls,
            pareto_k=math.inf,
        )
    theta, log_likelihood, log_ratio = theta[alive], log_likelihood[alive], log_ratio[alive]
    k = pareto_k(log_ratio, tail)
    held_ratio = np.empty(0)
    if len(held.x):
        held_ratio = held.log_density + held.log_likelihood - log_proposal(held.x, held.log_density)
    log_z, error, missed, log_weight = _bridge_sampling_estimate(log_ratio, n_draws, held_ratio, held.n_independent)
    # The mean of weights of infinite variance converges as n^(k - 1) instead of n^(-1/2) (Vehtari et al. 2024).
    error *= len(log_ratio) ** min(max(k - 0.5, 0.0), 1.0)
    n_eff = n_effective(log_weight)
    return Weighted(
        evaluate.names,
        theta,
        log_likelihood=log_likelihood,
        log_weight=log_weight,
        log_z=log_z,
        log_z_error=error,
        n_eff=n_eff,
        n_calls=evaluate.n_calls,
        pareto_k=k,
        missed=missed,
    )


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


def pareto_k(log_weight: FloatArray, tail: float = 3.0) -> float:
    """Estimate the Pareto shape k of the tail of importance weights, from log weights of any scale, (n,).

    A generalised Pareto distribution is fitted to the largest weights, `tail` sqrt(n) of them but at most a fifth, with
    the estimator of Zhang & Stephens (2009), as in Vehtari et al. (2024). Below 0.5 the weights have a finite variance;
    above 0.7 their mean converges too slowly to be used. k is infinite for fewer than 25 weights, and minus infinity
    where fewer than five of the tail exceed the rest.
    """
    n = len(log_weight)
    n_tail = int(min(0.2 * n, tail * math.sqrt(n)))
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
