"""Ask a run's families how much its chains remember, and what that adds to the error of log Z.

Every new point is the end of a chain that begins at a survivor, its parent. Where chains forget their start, every
family has the same prospects and sizes differ by chance alone. Where they do not, a family that lives in the right
place prospers: sizes differ by more, and log Z scatters by as much more, since a handful of families then stand for
the volume that leads on. Errors from the genealogy of one run are known from particle filters (Chan & Lai 2013; Lee &
Whiteley 2018; Olsson & Douc 2019), of which nested sampling with rounds is one (Salomone, South, Johansen, Drovandi &
Kroese 2018).
"""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import FloatArray, IntArray

__all__ = ["chain_memory"]

_MOST_WINDOWS = 32
_LEAST_LAG = 4


def chain_memory(parent: IntArray, birth_row: IntArray, n_at_death: IntArray, log_weight: FloatArray) -> float:
    """Estimate the variance of log Z over that of a run whose new points were independent draws, 1 or more.

    Every point that dies after a time descends from one of the n alive then, and so belongs to a family. Let s be the
    families' shares of the evidence from there on. Minus the log of the chance that two lineages drawn by their weights
    never meet, 1 - sum s^2, is a variance of the log evidence: for chains without memory it grows by 2 / n^2 a birth,
    of which 1 / n^2 a death is the volume's own (all of it where half of the points are replaced at a time) and the
    rest the choice of parents. What exceeds it is memory. What has no part in the evidence, as families that part
    beyond the posterior's bulk, has none in this.

    Few families are left at the end of a run, so that the whole of it would tell little. Windows of half of it and of a
    quarter tell more and cut off what began before them, the more the shorter they are: what they say is carried on to
    the whole run, as if a constant were cut off from each.

    Parameters
    ----------
    parent
        Row of each point's parent; -1 where it was drawn from the whole prior, (n_dead,). Rows are in order of death.
    birth_row
        Row of the death above whose level each point was drawn; -1 at the start, (n_dead,).
    n_at_death
        Points alive when each died, itself included, (n_dead,).
    log_weight
        Each point's share of the evidence, natural log, (n_dead,).
    """
    families = _Families(parent, birth_row, n_at_death, log_weight)
    ends = np.unique(birth_row)  # of rounds
    n_rounds = len(ends) - 1
    if n_rounds // 4 < _LEAST_LAG:
        return 1.0
    half, quarter = (families.memory(ends, n_rounds // part) for part in (2, 4))
    return max(1.0, 1.5 * half - 0.5 * quarter)


class _Families:
    """The points of a run by birth and death, to tell families between any two ends of rounds."""

    def __init__(self, parent: IntArray, birth_row: IntArray, n_at_death: IntArray, log_weight: FloatArray) -> None:
        self._parent, self._birth_row, self._n_at_death = parent, birth_row, n_at_death
        self._weight = np.exp(log_weight)
        self._left = np.append(np.cumsum(self._weight[::-1])[::-1], 0.0)  # evidence from each row on
        self._own = np.concatenate([[0.0], np.cumsum((self._left[:-1] / n_at_death) ** 2)])
        self._births = np.sort(birth_row)
        # Just after a round all of its points are alive: as many as when the next one dies.
        n_alive = n_at_death[np.minimum(self._births + 1, len(n_at_death) - 1)]
        self._chance = np.concatenate([[0.0], np.cumsum(2.0 * (self._left[self._births + 1] / n_alive) ** 2)])

    def memory(self, ends: IntArray, lag: int) -> float:
        """Give the memory as windows of `lag` rounds show it."""
        starts = np.unique(np.linspace(0, len(ends) - 1 - lag, _MOST_WINDOWS).astype(int))
        excess, own = np.array([self._excess(ends[i], ends[i + lag]) for i in starts]).sum(axis=0)
        return 1.0 + float(excess / own)

    def _excess(self, first: int, last: int) -> tuple[float, float]:
        """Variance of log Z from lineages that meet after `first`, less that of chance, and the volume's own variance.

        Who is alive at `last` stands for all of the evidence from there on.
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
        alone = 1.0 / int(self._n_at_death[first + 1])  # two draws of one and the same point
        met = -math.log(max(1.0 - float(share @ share), 1e-12)) - alone
        born = np.searchsorted(self._births, [first, last], side="right")
        chance = float(self._chance[born[1]] - self._chance[born[0]])
        return met * whole**2 - chance, float(self._own[last + 1] - self._own[first + 1])
