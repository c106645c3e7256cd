"""Evidence from dead points: shrinkage, weights, the error with correlated chains, and reasons to doubt a run.

Every new point is the end of a chain that begins at a surviving live point, its parent. If chains forget their start,
the sizes of lineages (all descendants of one point) differ by chance alone. If not, lineages that start at high
likelihood grow: sizes differ by more, a handful of lineages then represent the remaining volume, and log Z has a larger
variance. Such variance estimates from a single run are known from particle filters (Chan & Lai 2013; Lee & Whiteley
2018; Olsson & Douc 2019), of which nested sampling in rounds is one (Salomone, South, Johansen, Drovandi & Kroese
2018).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import kolmogorov

from probewise._arrays import FloatArray, IntArray, logsumexp
from probewise.nested.weights import weighted_quantiles

DOUBTFUL_P_VALUE = 1e-4
"""p value of the insertion ranks below which a result is doubtful: one false alarm in 10,000 runs."""

_N_SIMULATIONS = 200
_SIMULATED_AT_A_TIME = 100_000
_MOST_WINDOWS, _LEAST_LAG = 32, 4  # of lineages
MOST_MEMORY = 10.0  # lineage variance above which a run descends from too few lineages to estimate its error
_FAR = 4.0  # posterior sds: what lies farther has next to no weight
_FEWEST_STEPS = 30.0  # between floating-point numbers, from quartile to quartile


@dataclass(frozen=True, eq=False)
class Evidence:
    """log Z, the information (nats) and normalised log weights, (n_dead,).

    `spread`: sd of log Z from the random shrinkage alone; correlated chains multiply its variance, see
    `relative_lineage_variance`.
    """

    log_z: float
    spread: float
    information: float
    log_weight: FloatArray


def log_volumes(n_at_death: IntArray, log_start: float = 0.0) -> FloatArray:
    """Return `log_start` plus the expected log shrinkage up to each death, (n_dead,): -1/n per death of n alive."""
    return np.asarray(log_start - np.cumsum(1.0 / n_at_death))


def integrate(
    log_likelihood: FloatArray, n_at_death: IntArray, *, rng: np.random.Generator, log_start: float = 0.0
) -> Evidence:
    """Estimate the evidence: sum the likelihood over the shells of prior volume between successive deaths.

    `log_likelihood` of the dead points in order of death, the last live points included; `n_at_death`: number of points
    alive when each died, itself included, (n_dead,) both. `rng` draws 200 times the shrinkages t = Beta(n, 1), for the
    `spread` of log Z. `log_start`: log of the prior's share with a likelihood above zero.
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
    return Evidence(best + log_z, spread, information, log_weight)


def _log_shell_volumes(log_edges: FloatArray) -> FloatArray:
    before, after = log_edges[..., :-1], log_edges[..., 1:].copy()
    after[..., -1] = -np.inf
    with np.errstate(divide="ignore"):
        return np.asarray(before + np.log(-np.expm1(after - before)))


def birth_rows(
    log_likelihood: FloatArray, label: FloatArray, log_birth: FloatArray, birth_label: FloatArray
) -> IntArray:
    """Find the row of the last death at or below the level of each birth, (n_dead,); -1 where there is none.

    `log_likelihood` and `label` of the deaths are in order, ties of likelihood by label; all (n_dead,).
    """
    n = len(log_likelihood)
    born = np.repeat([0, 1], n)  # a death comes before the births at its own level
    levels, labels = np.concatenate([log_likelihood, log_birth]), np.concatenate([label, birth_label])
    order = np.lexsort((born, labels, levels))
    n_dead = np.empty(2 * n, dtype=np.int64)
    n_dead[order] = np.cumsum(born[order] == 0)
    return n_dead[n:] - 1


def insertion_ranks(ident: IntArray, n_live: int, n_replaced: int) -> tuple[IntArray, IntArray]:
    """Return how many of the points alive at the insertion of each new point were worse than it, and their number.

    Both are (n_inserted,), in order of birth. `ident`, (n_dead,), is each point's number in order of birth, rows in
    order of death; every round replaced the `n_replaced` worst of `n_live` points.
    """
    born_in, rows = np.maximum(ident - n_live, -n_replaced) // n_replaced + 1, np.argsort(ident)
    rank, n_alive = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for number in range(1, int(born_in.max()) + 1):
        n_gone = number * n_replaced
        new = rows[n_live + n_gone - n_replaced : n_live + n_gone]
        old = n_gone + np.flatnonzero(born_in[n_gone:] < number)
        rank.append(np.searchsorted(old, new) + np.tril(new < new[:, None], -1).sum(axis=1))
        n_alive.append(len(old) + np.arange(n_replaced))
    return np.concatenate(rank), np.concatenate(n_alive)


def insertion_p_value(rank: IntArray, n_below_or_above: IntArray, *, rng: np.random.Generator) -> float:
    """Test that new points were inserted uniformly among the live ones (Fowlie, Handley & Su 2020); return p.

    `rank`: number of live points worse than each new one, `n_below_or_above`: of those alive at its insertion, m,
    (n_inserted,) each. The ranks of a correct sampler are independent and uniform on 0..m. A Kolmogorov-Smirnov test is
    made of the whole run and of its tenths (a fault may be temporary), with Bonferroni's correction. `rng` jitters the
    discrete ranks. For fewer than 20 points p is 1.
    """
    if len(rank) < 20:
        return 1.0
    position = (rank + rng.random(len(rank))) / (n_below_or_above + 1.0)
    whole = _uniform_p_value(position)
    if len(position) < 1000:
        return whole
    return min(1.0, 2.0 * min(whole, 10 * min(map(_uniform_p_value, np.array_split(position, 10)))))


def _uniform_p_value(position: FloatArray) -> float:
    """Return the Kolmogorov-Smirnov p value of positions, (n,), against the uniform distribution on 0 to 1."""
    n = len(position)
    place, steps = np.sort(position), np.arange(n + 1) / n
    distance = max(float((steps[1:] - place).max()), float((place - steps[:-1]).max()))
    # Stephens' (1970) correction for finite n: `scipy.stats` has the exact distribution, but takes a second to import.
    root = math.sqrt(n)
    return float(kolmogorov((root + 0.12 + 0.11 / root) * distance))


def n_independent(theta: FloatArray, weight: FloatArray, parent: IntArray) -> float:
    """Return how many independent draws would tell the posterior means as precisely: the least of the parameters.

    A chain that starts at its parent remembers it. If a parameter's correlation with the parent is rho, the weighted
    mean is a sum of independent parts, one a point, each with the point's weight and rho times that of its children's
    parts. `theta`: (n_dead, n_params); `weight`, summing to one, and `parent`, -1 for draws from the prior: (n_dead,).
    """
    started = np.flatnonzero(parent >= 0)
    apart = theta - weight @ theta
    sd = np.sqrt(weight @ apart**2)
    apart = np.clip(np.divide(apart, sd, out=np.zeros_like(apart), where=sd > 0), -_FAR, _FAR)
    now, before, share = apart[started], apart[parent[started]], weight[started, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        now, before = (x - (share * x).sum(0) / share.sum() for x in (now, before))
        rho = (share * now * before).sum(0) / np.sqrt((share * now**2).sum(0) * (share * before**2).sum(0))
    rho = np.clip(np.nan_to_num(rho), 0.0, 1.0)
    generation, ancestor = np.zeros(len(parent), dtype=np.int64), parent
    while (later := ancestor >= 0).any():
        generation[later] += 1
        ancestor = np.where(later, parent[ancestor], -1)
    part = np.repeat(weight[:, None], theta.shape[1], axis=1)
    for k in range(int(generation.max()), 0, -1):
        rows = np.flatnonzero(generation == k)
        np.add.at(part, parent[rows], rho * part[rows])
    drawn = np.where(parent[:, None] < 0, 1.0, 1.0 - rho**2)
    return float(1.0 / (drawn * part**2).sum(axis=0).max(initial=float(weight @ weight)))


def relative_lineage_variance(parent: IntArray, birth_row: IntArray, n_at_death: IntArray, weight: FloatArray) -> float:
    """Estimate the variance of log Z relative to that of a run whose new points are independent draws.

    Every point that dies after a given time descends from one of the n points alive then. Let s be the shares of these
    n lineages in the evidence from there on. Two points drawn by weight belong to different lineages with probability 1
    - sum s^2, and minus its log estimates a variance of the log evidence. For independent draws it grows by 2 / n^2 per
    birth, of which 1 / n^2 per death is the shrinkage of the volume (all of it if half of the points are replaced at a
    time) and the rest the choice of parents; the excess is due to correlated chains. Few lineages survive a whole run,
    so windows of half and of a quarter of it, which miss the correlations that began before, are extrapolated linearly
    in the inverse length.

    `parent`: row of each point's parent, -1 for draws from the whole prior; rows are in order of death. `birth_row`:
    row of the dead point above whose level each was drawn, -1 at the start. `n_at_death`: number of points alive when
    each died, itself included. `weight`: each point's share of the evidence. All (n_dead,). Return the ratio of
    variances, 1 or more; 1 for a run of fewer than 17 rounds, too short for an estimate.
    """
    left = np.append(np.cumsum(weight[::-1])[::-1], 0.0)  # evidence from each row on
    from_shrinkage = np.concatenate([[0.0], np.cumsum((left[:-1] / n_at_death) ** 2)])
    births = np.sort(birth_row)
    # Just after a round as many points are alive as at the next death.
    n_alive = n_at_death[np.minimum(births + 1, len(n_at_death) - 1)]
    by_chance = np.concatenate([[0.0], np.cumsum(2.0 * (left[births + 1] / n_alive) ** 2)])
    rows = np.arange(len(parent))

    def excess_and_shrinkage_variance(first: int, last: int) -> tuple[float, float]:
        """Trace the lineages of the points alive at row `last`, which share the evidence beyond it, to row `first`."""
        row = np.flatnonzero((rows > first) & (birth_row <= last))
        ancestor = row.copy()
        while (young := birth_row[ancestor] > first).any():
            ancestor[young] = parent[ancestor[young]]
        alive = row > last
        part = np.where(alive, left[last + 1] / max(int(alive.sum()), 1), weight[row])
        whole = float(part.sum())
        share = np.bincount(ancestor, part) / whole
        alone = 1.0 / int(n_at_death[first + 1])  # two draws of the same point
        met = -math.log(max(1.0 - float(share @ share), 1e-12)) - alone
        born = np.searchsorted(births, [first, last], side="right")
        chance = float(by_chance[born[1]] - by_chance[born[0]])
        return met * whole**2 - chance, float(from_shrinkage[last + 1] - from_shrinkage[first + 1])

    def from_windows(lag: int) -> float:
        starts = np.unique(np.linspace(0, n_rounds - lag, _MOST_WINDOWS).astype(int))
        windows = [excess_and_shrinkage_variance(ends[i], ends[i + lag]) for i in starts]
        excess, own = np.array(windows).sum(axis=0)
        return 1.0 + float(excess / own)

    ends = np.unique(birth_row)  # of rounds
    n_rounds = len(ends) - 1
    if n_rounds // 4 < _LEAST_LAG:
        return 1.0
    return max(1.0, 1.5 * from_windows(n_rounds // 2) - 0.5 * from_windows(n_rounds // 4))


def warning_of_few_possible_draws(log_start: float, log_start_error: float, n_live: int) -> str | None:
    """Return a warning if fewer possible hypotheses than live points were drawn from the prior, else None.

    A share s of the prior, estimated from m possible hypotheses, has the relative error sqrt((1 - s) / m).
    """
    if log_start_error <= 0:
        return None
    share = math.exp(log_start)
    found = round((1.0 - share) / log_start_error**2)
    if found >= n_live:
        return None
    return f"only {found} of {round(found / share)} hypotheses drawn from the prior are possible"


def warning_of_coarse_coordinates(names: Sequence[str], u: FloatArray, weight: FloatArray) -> str | None:
    """Return a warning if the posterior is too narrow in the sampling coordinates for floating-point numbers, or None.

    Just below 1 numbers are 1e-16 apart, so this is the case about 8 sds above the mean of a normal prior, not below.
    `u`: points, (n, n_params); `weight`, (n,): of the posterior, sum 1.
    """
    low, high = weighted_quantiles(u, weight, [0.25, 0.75])
    steps = (high - low) / np.spacing(np.abs(low))
    narrowest = int(np.argmin(steps))
    if steps[narrowest] >= _FEWEST_STEPS:
        return None
    return (
        f"half of the posterior of {names[narrowest]} lies within {steps[narrowest]:.0f} steps between floating-point "
        "numbers, where its prior is mapped to 0 to 1: log Z and samples may be far off; take a prior with more "
        "probability there"
    )


def warning_of_few_lineages(memory: float) -> str | None:
    """Return a warning if the lineage variance exceeds 10, so that the error from it is uncertain; else None."""
    if memory <= MOST_MEMORY:
        return None
    return (
        f"memory is {memory:.0f}: so few lineages lead to the posterior that the error is itself uncertain; "
        "use move=nested.SliceMove(steps_per_param=4) or more n_live"
    )
