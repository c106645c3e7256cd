"""Sharpen a run by importance sampling from a density fitted to it; carry a posterior on to new readings.

Nested sampling finds where the posterior is; its evidence is as uncertain as sqrt(H / n_live). A
density fitted to its samples, drawn from and weighed, gives the same evidence and posterior by a
route of its own, often a hundred times as sharp for a few thousand evaluations more (Cameron &
Pettitt 2014; Lange 2023 does it with neural networks). How far its weights can be trusted is
measured: Pareto's k of their tail (Vehtari, Simpson, Gelman, Yao & Gabry 2024).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray, frozen
from probewise.errors import ParameterError
from probewise.nested.evaluate import Evaluator, Samplable
from probewise.nested.proposal import Proposal, fit_proposals, joined
from probewise.nested.result import NestedResult
from probewise.nested.space import Space, unbounded

__all__ = ["Weighted", "pareto_k", "refine", "update"]

# Above it the mean of the weights converges too slowly for their sd to be its error (Vehtari et al. 2024).
_MOST_K = 0.7
_FEW_EFFECTIVE = 100.0
_MOST_FITTED = 2000
_SURPRISED = 0.01
_FIRST = 0.75


@dataclass(frozen=True, eq=False)
class Weighted:
    """Hold weighted samples of a posterior and its evidence, by importance sampling.

    Attributes
    ----------
    names
        Parameters, one a column of theta.
    theta
        Draws with a likelihood above zero, (n, n_params).
    log_likelihood, log_weight
        Of each, (n,); the weights sum to one.
    log_z, log_z_error
        Natural log of the evidence and its standard error.
    n_eff
        Kish's effective number of samples.
    n_calls
        Likelihood evaluations, those of the fallback included.
    pareto_k
        Shape of the weights' tail; above 0.7 the error is not to be trusted.
    run
        The run that took over because the weights could not be trusted, or None.
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

    def __post_init__(self) -> None:
        for name in ("theta", "log_likelihood", "log_weight"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def sound(self) -> bool:
        """Whether the weights' tail and number allow the error to be trusted."""
        return self.run is not None or (self.pareto_k < _MOST_K and self.n_eff >= _FEW_EFFECTIVE)

    @property
    def weight(self) -> FloatArray:
        """Posterior weights, summing to one, (n,)."""
        return np.asarray(np.exp(self.log_weight))

    def rows(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Rows of `n` equally weighted samples by systematic resampling, (n,), in random order."""
        if n < 1:
            raise ParameterError("n", n, "1 or more")
        ladder = np.cumsum(self.weight)
        rows = np.searchsorted(ladder / ladder[-1], (np.arange(n) + rng.random()) / n, side="right")
        return rng.permutation(np.minimum(rows, len(ladder) - 1))

    def samples(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` equally weighted posterior samples, (n, n_params), in random order."""
        return np.asarray(self.theta[self.rows(n, rng=rng)])

    def mean(self, f: Callable[[FloatArray], FloatArray] | None = None) -> FloatArray:
        """Posterior mean of the parameters, (n_params,), or of `f(theta)` (n, ...), of the trailing shape."""
        values = self.theta if f is None else np.asarray(f(self.theta))
        return np.asarray(np.tensordot(self.weight, values, axes=(0, 0)))

    def sd(self) -> FloatArray:
        """Posterior standard deviation of the parameters, (n_params,)."""
        return np.asarray(np.sqrt(self.weight @ (self.theta - self.mean()) ** 2))

    def summary(self) -> str:
        """Describe evidence and posterior in plain text."""
        lines = [
            f"log Z        {self.log_z:.3f} ± {self.log_z_error:.3f}",
            f"samples      {len(self.theta)}, worth {self.n_eff:.0f} independent ones",
            f"cost         {self.n_calls} likelihood evaluations",
            f"weights      Pareto k = {self.pareto_k:.2f}"
            + ("" if self.sound else f": doubtful, it should be below {_MOST_K} with {_FEW_EFFECTIVE:.0f} effective"),
        ]
        lines += [
            f"{name:<9}  {mean:>11.5g} ± {sd:.3g}"
            for name, mean, sd in zip(self.names, self.mean(), self.sd(), strict=True)
        ]
        return "\n".join(lines)


Posterior: TypeAlias = NestedResult | Weighted


def refine(
    result: Posterior, problem: Samplable, *, rng: np.random.Generator, n_draws: int = 5000, n_pilots: int = 2
) -> Weighted:
    """Sharpen the evidence and the posterior of a run by importance sampling.

    A density is fitted to the run's posterior samples in two forms; a few draws of each are
    weighed, the form with the more even weights gets the greater share, and its weighted draws join
    the samples that the next densities are fitted to. At last `n_draws` points are drawn.
    Only they count, so they are independent of each other and the error is that of a mean. A mode
    that the run never saw is not found by this; what the run saw is weighed afresh.

    Parameters
    ----------
    result
        A run of the same problem.
    problem
        Prior and likelihood.
    rng
        Source of randomness.
    n_draws
        Draws that count; every pilot round takes a quarter of that besides.
    n_pilots
        Pilot rounds, 1 or more.

    Returns
    -------
    Weighted
        Ask `sound` before using it in place of the run's own evidence.

    Raises
    ------
    ParameterError
        If an option is out of range or the run is of other parameters.
    """
    evaluate = Evaluator(problem)
    if result.names != evaluate.names:
        raise ParameterError("result.names", result.names, f"the problem's names {evaluate.names}")
    if n_draws < 100:
        raise ParameterError("n_draws", n_draws, "100 or more")
    if n_pilots < 1:
        raise ParameterError("n_pilots", n_pilots, "1 or more")
    space = unbounded(problem.prior)
    known = [_unbounded_samples(result, space, rng)]
    for _ in range(n_pilots):
        proposals = fit_proposals(np.concatenate(known), rng=rng)
        pilots = [_weigh(p, 0.0, space, evaluate, max(n_draws // 8, 50), rng) for p in proposals]
        first = int(np.argmax([pilot.n_eff for pilot in pilots]))
        told = pilots[first]
        # The other form keeps a share: one may reach where the other does not.
        others = (1.0 - _FIRST) / max(len(proposals) - 1, 1)
        best = joined(proposals, [_FIRST if k == first else others for k in range(len(proposals))])
        if told.n_eff > 2 * len(evaluate.names):
            known.append(_unbounded_samples(told, space, rng))
    return _weigh(best, 0.0, space, evaluate, n_draws, rng)


def update(
    previous: Posterior,
    problem: Samplable,
    *,
    rng: np.random.Generator,
    fall_back: Callable[[], NestedResult],
    n_draws: int = 2000,
    prior_share: float = 0.1,
) -> Weighted:
    """Infer again after new readings, from the posterior before them.

    The samples of the previous posterior are weighed by what the new readings add; a density is
    fitted to them, mixed with draws from the prior, and weighed against the whole new problem, so
    that the evidence is absolute and errors do not add up from reading to reading. Where the new
    reading surprises (few of the old samples, or too heavy a tail of the weights, carry the new
    posterior), `fall_back` runs from scratch.

    Parameters
    ----------
    previous
        Posterior of the same parameters given fewer readings.
    problem
        Prior, and likelihood of all readings.
    rng
        Source of randomness.
    fall_back
        Runs the whole problem, for instance `lambda: run(problem, rng=rng)`.
    n_draws
        Draws; the cost is this many evaluations and one for each old sample, at most 1000.
    prior_share
        Share of the draws that come from the prior: they find what the old posterior had no samples
        of, and bound the weights.

    Returns
    -------
    Weighted
        With the fallback's samples and `run` where it took over.
    """
    if not 0 <= prior_share < 1:
        raise ParameterError("prior_share", prior_share, "0 or more, below 1")
    evaluate = Evaluator(problem)
    if previous.names != evaluate.names:
        raise ParameterError("previous.names", previous.names, f"the problem's names {evaluate.names}")
    space = unbounded(problem.prior)
    rows = np.unique(previous.rows(1000, rng=rng))
    theta = previous.theta[rows]
    log_likelihood = evaluate.log_likelihood(theta)
    log_weight = previous.log_weight[rows] + log_likelihood - previous.log_likelihood[rows]
    # Rows of weight above 1 / 1000 were kept once: their weight stands for them.
    log_weight = log_weight + np.maximum(-math.log(1000) - previous.log_weight[rows], 0.0)
    found = Weighted(evaluate.names, theta, log_likelihood, *_normalised(log_weight), n_calls=0, pareto_k=0.0)
    if found.n_eff >= max(_SURPRISED * len(rows), 3 * len(evaluate.names)):
        proposal = fit_proposals(_unbounded_samples(found, space, rng), rng=rng)[-1]
        found = _weigh(proposal, prior_share, space, evaluate, n_draws, rng)
        if found.sound:
            return found
    fallen = fall_back()
    return Weighted(
        fallen.names,
        fallen.theta,
        fallen.log_likelihood,
        fallen.log_weight,
        fallen.log_z,
        fallen.log_z_error,
        fallen.n_eff,
        evaluate.n_calls + fallen.n_calls,
        found.pareto_k,
        fallen,
    )


def _unbounded_samples(found: Posterior, space: Space, rng: np.random.Generator) -> FloatArray:
    """Choose samples to fit a density to: about as many as the posterior is worth, so that few occur twice.

    A third more come from the posterior of the root of the likelihood's weight: a density that is
    to be weighed by must reach further than the posterior does.
    """
    n = int(min(max(found.n_eff, 4 * len(found.names) + 4), _MOST_FITTED))
    rows = found.rows(n, rng=rng)
    tempered = np.exp(0.5 * (found.log_weight - found.log_weight.max()))
    wide = rng.choice(len(tempered), size=n // 3, p=tempered / tempered.sum())
    return space.enter(found.theta[np.unique(np.concatenate([rows, wide]))])


def _weigh(
    proposal: Proposal, prior_share: float, space: Space, evaluate: Evaluator, n_draws: int, rng: np.random.Generator
) -> Weighted:
    """Draw, evaluate and weigh."""
    n_prior = round(prior_share * n_draws)
    x = np.concatenate([proposal.draw(n_draws - n_prior, rng=rng), space.draw(n_prior, rng=rng)])
    theta, log_density = space.leave(x)
    possible = np.flatnonzero(np.isfinite(log_density))
    theta, log_density = theta[possible], log_density[possible]
    log_likelihood = evaluate.log_likelihood(theta) if possible.size else np.empty(0)
    log_proposal = proposal.log_density(x[possible])
    if n_prior:
        share = n_prior / n_draws
        log_proposal = np.logaddexp(log_proposal + math.log1p(-share), log_density + math.log(share))
    log_ratio = log_density + log_likelihood - log_proposal
    alive = np.isfinite(log_ratio)
    if not alive.any():
        nothing = np.empty(0)
        return Weighted(
            evaluate.names, theta[:0], nothing, nothing, -math.inf, math.inf, 0.0, evaluate.n_calls, math.inf
        )
    log_weight, _, _, n_eff = _normalised(log_ratio[alive])
    log_z = float(logsumexp(log_ratio[alive])) - math.log(n_draws)
    # Draws that led nowhere count as weights of zero.
    error = math.sqrt(max(1.0 / n_eff - 1.0 / n_draws, 0.0))
    k = pareto_k(log_ratio[alive])
    return Weighted(
        evaluate.names, theta[alive], log_likelihood[alive], log_weight, log_z, error, n_eff, evaluate.n_calls, k
    )


def _normalised(log_weight: FloatArray) -> tuple[FloatArray, float, float, float]:
    """Normalise log weights; also log of their sum, no error, and Kish's sample size."""
    total = float(logsumexp(log_weight))
    normalised = log_weight - total
    return normalised, total, 0.0, float(np.exp(-logsumexp(2.0 * normalised)))


def pareto_k(log_weight: FloatArray) -> float:
    """Estimate the shape of the tail of importance weights, (n,) log weights of any scale.

    The greatest weights, 3 sqrt(n) of them but at most a fifth, are fitted by a generalised Pareto
    distribution with the estimator of Zhang & Stephens (2009), as Vehtari et al. (2024) do: below
    0.5 the weights have a variance, above 0.7 their mean converges too slowly to be used.
    """
    n = len(log_weight)
    n_tail = int(min(0.2 * n, 3.0 * math.sqrt(n)))
    if n_tail < 5:
        return math.inf
    weight = np.sort(np.exp(log_weight - log_weight.max()))
    excess = weight[-n_tail:] - weight[-n_tail - 1]
    excess = excess[excess > 0]
    if excess.size < 5:
        return -math.inf
    n_grid = 30 + int(math.sqrt(excess.size))
    quartile = excess[int(excess.size / 4 + 0.5) - 1]
    b = 1.0 / excess[-1] + (1.0 - np.sqrt(n_grid / (np.arange(1, n_grid + 1) - 0.5))) / (3.0 * quartile)
    k = np.log1p(-b[:, None] * excess).mean(axis=1)
    log_profile = excess.size * (np.log(-b / k) - k - 1.0)
    mean_b = float(np.exp(log_profile - logsumexp(log_profile)) @ b)
    shape = float(np.log1p(-mean_b * excess).mean())
    # Shrunk towards 0.5 by ten prior observations, against the noise of short tails.
    return float((excess.size * shape + 10 * 0.5) / (excess.size + 10))
