"""The error of log Z from correlated chains, estimated from the genealogy of a run's points.

Every new point is the end of a chain that begins at a surviving live point, its parent. If chains forget their start,
the sizes of lineages (all descendants of one point) differ by chance alone. If not, lineages that start at high
likelihood grow: sizes differ by more, a handful of lineages then represent the remaining volume, and log Z has a larger
variance. Such variance estimates from a single run are known from particle filters (Chan & Lai 2013; Lee & Whiteley
2018; Olsson & Douc 2019), of which nested sampling in rounds is one (Salomone, South, Johansen, Drovandi & Kroese
2018).
"""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import FloatArray, IntArray

_MOST_WINDOWS = 32
_LEAST_LAG = 4


def relative_lineage_variance(
    parent: IntArray, birth_row: IntArray, n_at_death: IntArray, log_weight: FloatArray
) -> float:
    """Estimate the variance of log Z relative to that of a run whose new points are independent draws.

    Every point that dies after a given time descends from one of the n points alive then. Let s be the shares of these
    n lineages in the evidence from there on. Two points drawn by weight belong to different lineages with probability 1
    - sum s^2, and minus its log estimates a variance of the log evidence. For independent draws it grows by 2 / n^2 per
    birth, of which 1 / n^2 per death is the shrinkage of the volume (all of it if half of the points are replaced at a
    time) and the rest the choice of parents; the excess is due to correlated chains.

    Few lineages survive a whole run, so an estimate over all of it would be noisy. Windows of half and of a quarter of
    the run are less noisy but miss the correlations that began before them. The two are extrapolated linearly in the
    inverse window length to the whole run.

    Parameters
    ----------
    parent
        Row of each point's parent; -1 for draws from the whole prior, (n_dead,). Rows are in order of death.
    birth_row
        Row of the dead point above whose level each point was drawn; -1 at the start, (n_dead,).
    n_at_death
        Number of points alive when each died, itself included, (n_dead,).
    log_weight
        Natural log of each point's share of the evidence, (n_dead,).

    Returns
    -------
    The ratio of variances, 1 or more; 1 for a run of fewer than 17 rounds, too short for an estimate.
    """
    genealogy = _Genealogy(parent, birth_row, n_at_death, log_weight)
    ends = np.unique(birth_row)  # of rounds
    n_rounds = len(ends) - 1
    if n_rounds // 4 < _LEAST_LAG:
        return 1.0
    half, quarter = (genealogy.relative_variance_from_windows(ends, n_rounds // part) for part in (2, 4))
    return max(1.0, 1.5 * half - 0.5 * quarter)


class _Genealogy:
    """Births, deaths and weights of a run's points, for tracing lineages between the ends of any two rounds."""

    def __init__(self, parent: IntArray, birth_row: IntArray, n_at_death: IntArray, log_weight: FloatArray) -> None:
        self._parent, self._birth_row, self._n_at_death = parent, birth_row, n_at_death
        self._weight = np.exp(log_weight)
        self._left = np.append(np.cumsum(self._weight[::-1])[::-1], 0.0)  # evidence from each row on
        self._own = np.concatenate([[0.0], np.cumsum((self._left[:-1] / n_at_death) ** 2)])
        self._births = np.sort(birth_row)
        # Just after a round as many points are alive as at the next death.
        n_alive = n_at_death[np.minimum(self._births + 1, len(n_at_death) - 1)]
        self._chance = np.concatenate([[0.0], np.cumsum(2.0 * (self._left[self._births + 1] / n_alive) ** 2)])

    def relative_variance_from_windows(self, ends: IntArray, lag: int) -> float:
        """Estimate the variance of log Z over that of independent draws from up to 32 windows of `lag` rounds each.

        `ends` are the last rows of all rounds, in order.
        """
        starts = np.unique(np.linspace(0, len(ends) - 1 - lag, _MOST_WINDOWS).astype(int))
        windows = [self._excess_and_shrinkage_variance(ends[i], ends[i + lag]) for i in starts]
        excess, own = np.array(windows).sum(axis=0)
        return 1.0 + float(excess / own)

    def _excess_and_shrinkage_variance(self, first: int, last: int) -> tuple[float, float]:
        """Return a window's excess variance of log Z over that of independent draws, and its variance from shrinkage.

        Lineages are traced back from row `last` to row `first`; the points alive at `last` share the evidence beyond
        it.
        """
        rows = np.arange(len(self._parent))
        row = np.flatnonzero((rows > first) & (self._birth_row <= last))
        ancestor = row.copy()
        while (young := self._birth_row[ancestor] > first).any():
            ancestor[young] = self._parent[ancestor[young]]
        alive = row > last
        part = np.where(alive, self._left[last + 1] / max(int(alive.sum()), 1), self._weight[row])
        whole = float(part.sum())
        share = np.bincount(ancestor, part) / whole
        alone = 1.0 / int(self._n_at_death[first + 1])  # two draws of the same point
        met = -math.log(max(1.0 - float(share @ share), 1e-12)) - alone
        born = np.searchsorted(self._births, [first, last], side="right")
        chance = float(self._chance[born[1]] - self._chance[born[0]])
        return met * whole**2 - chance, float(self._own[last + 1] - self._own[first + 1])
