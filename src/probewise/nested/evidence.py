"""Evidence from dead points: shrinkage, weights, errors and the insertion-rank test (Skilling 2006)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import kolmogorov, logsumexp

from probewise._arrays import FloatArray, IntArray

DOUBTFUL_P_VALUE = 1e-4
"""p value of the insertion ranks below which a result is doubtful: one false alarm in 10,000 runs."""

_N_SIMULATIONS = 200
_SIMULATED_AT_A_TIME = 100_000


@dataclass(frozen=True, eq=False)
class Evidence:
    """log Z, the information (nats), normalised log weights, (n_dead,), and Kish's effective sample size.

    `spread`: sd of log Z from the random shrinkage alone; `log_start_error`: standard error of the log of the share of
    the prior with a likelihood above zero.
    """

    log_z: float
    spread: float
    log_start_error: float
    information: float
    log_weight: FloatArray
    n_eff: float

    def log_z_error(self, memory: float) -> float:
        """Return the standard error of log Z.

        `memory`: factor by which correlated chains multiply the variance from shrinkage; see
        `probewise.nested.relative_lineage_variance`.
        """
        return math.hypot(math.sqrt(memory) * self.spread, self.log_start_error)


def log_volumes(n_at_death: IntArray, log_start: float = 0.0) -> FloatArray:
    """Return `log_start` plus the expected log shrinkage up to each death, (n_dead,): -1/n per death of n alive."""
    return np.asarray(log_start - np.cumsum(1.0 / n_at_death))


def integrate(
    log_likelihood: FloatArray,
    n_at_death: IntArray,
    *,
    rng: np.random.Generator,
    log_start: float = 0.0,
    log_start_error: float = 0.0,
) -> Evidence:
    """Estimate the evidence: sum the likelihood over the shells of prior volume between successive deaths.

    Parameters
    ----------
    log_likelihood
        Log likelihoods of the dead points in order of death, the last live points included, (n_dead,).
    n_at_death
        Number of points alive when each died, itself included, (n_dead,).
    rng
        Source of randomness for the `spread` of log Z: its sd over 200 draws of the shrinkages t = Beta(n, 1).
    log_start, log_start_error
        Log of the prior's share with a likelihood above zero, and its standard error.
    """
    log_x = log_volumes(n_at_death, log_start)
    log_shell = _log_shell_volumes(np.concatenate([[log_start], log_x]))
    # Relative to the best: volumes would vanish in the rounding of a log likelihood such as -1e100.
    best = float(log_likelihood.max())
    log_likelihood = log_likelihood - best
    log_mass = log_shell + log_likelihood
    log_z = float(logsumexp(log_mass))
    log_weight = log_mass - log_z
    weight = np.exp(log_weight)
    information = float(weight @ np.where(weight > 0, log_likelihood - log_z, 0.0))
    n_dead = len(n_at_death)
    simulated = np.empty(_N_SIMULATIONS)
    # In blocks, to bound the memory of long runs.
    size = max(1, _SIMULATED_AT_A_TIME // n_dead)
    for first in range(0, _N_SIMULATIONS, size):
        n = min(size, _N_SIMULATIONS - first)
        shrink = -rng.standard_exponential((n, n_dead)) / n_at_death
        edges = np.concatenate([np.full((n, 1), log_start), log_start + np.cumsum(shrink, axis=1)], axis=1)
        simulated[first : first + n] = logsumexp(_log_shell_volumes(edges) + log_likelihood, axis=1)
    spread = float(np.std(simulated, ddof=1))
    return Evidence(best + log_z, spread, log_start_error, information, log_weight, float(1.0 / (weight @ weight)))


def _log_shell_volumes(log_edges: FloatArray) -> FloatArray:
    """Return the log volume between successive edges along the last axis; the last shell ends at zero volume."""
    before, after = log_edges[..., :-1], log_edges[..., 1:].copy()
    after[..., -1] = -np.inf
    with np.errstate(divide="ignore"):
        return np.asarray(before + np.log(-np.expm1(after - before)))


def birth_rows(
    log_likelihood: FloatArray, label: FloatArray, log_birth: FloatArray, birth_label: FloatArray
) -> IntArray:
    """Find the row of the dead point above whose level each point was drawn, (n_dead,); -1 where there is none.

    It is the last death at or below the level of birth. `log_likelihood` and `label` of the deaths are in order, ties
    of likelihood by label; `log_birth` and `birth_label` are the levels above which each point was drawn, all
    (n_dead,).
    """
    n = len(log_likelihood)
    born = np.repeat([0, 1], n)  # a death comes before the births at its own level
    levels, labels = np.concatenate([log_likelihood, log_birth]), np.concatenate([label, birth_label])
    order = np.lexsort((born, labels, levels))
    n_dead = np.empty(2 * n, dtype=np.int64)
    n_dead[order] = np.cumsum(born[order] == 0)
    return n_dead[n:] - 1


def insertion_p_value(rank: IntArray, n_below_or_above: IntArray, *, rng: np.random.Generator) -> float:
    """Test that new points were inserted uniformly among the live ones (Fowlie, Handley & Su 2020); return p.

    `rank`: number of live points worse than each new one; `n_below_or_above`: number of points alive at its insertion,
    m, without itself; (n_inserted,) each. The ranks of a correct sampler are independent and uniform on 0..m. A
    Kolmogorov-Smirnov test is made of the whole run and of its tenths (a fault may be temporary), with Bonferroni's
    correction. `rng` jitters the discrete ranks. For fewer than 20 points p is 1.
    """
    if len(rank) < 20:
        return 1.0
    position = (rank + rng.random(len(rank))) / (n_below_or_above + 1.0)
    tenths = np.array_split(position, 10) if len(position) >= 1000 else []
    whole = _uniform_p_value(position)
    parts = min((_uniform_p_value(part) for part in tenths), default=1.0)
    return min(1.0, 2.0 * min(whole, len(tenths) * parts)) if tenths else whole


def _uniform_p_value(position: FloatArray) -> float:
    """Return the Kolmogorov-Smirnov p value of positions, (n,), against the uniform distribution on 0 to 1.

    It is the limiting distribution with Stephens' (1970) correction for finite n: `scipy.stats` has the exact one, but
    takes a second to import.
    """
    n = len(position)
    place, steps = np.sort(position), np.arange(n + 1) / n
    distance = max(float((steps[1:] - place).max()), float((place - steps[:-1]).max()))
    root = math.sqrt(n)
    return float(kolmogorov((root + 0.12 + 0.11 / root) * distance))
