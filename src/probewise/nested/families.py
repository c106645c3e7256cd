"""Ask a run's families how much its chains remember, and what that adds to the error of log Z.

Every new point is the end of a chain that begins at a survivor, its parent. Where chains forget their start, every
family has the same prospects and sizes differ by chance alone. Where they do not, a family that lives in the right
place prospers: sizes differ by more, and log Z scatters by as much more, since a handful of families then stand for
the volume that leads on. Errors from the genealogy of one run are known from particle filters (Chan & Lai 2013; Lee &
Whiteley 2018; Olsson & Douc 2019), of which nested sampling with rounds is one (Salomone, South, Johansen, Drovandi &
Kroese 2018).
"""

from __future__ import annotations

import numpy as np

from probewise._arrays import IntArray

__all__ = ["chain_memory"]

_MOST_WINDOWS = 64
_LEAST_LAG = 4


def chain_memory(parent: IntArray, birth_row: IntArray, n_at_death: IntArray) -> float:
    """Estimate the variance of log Z over that of a run whose new points were independent draws, 1 or more.

    Between two times every point alive at the second descends from one alive at the first. Let D be the number of
    descendants of each of the n alive at the first. Families are independent, so that the volume lost in between has
    the relative variance var(D) / n in units of the mean of D. For chains without memory it is the sum of 2 / n^2 over
    births, of which the sum of 1 / n^2 over deaths is the volume's own (all of it where half of the points are
    replaced at a time) and the rest the choice of parents. What exceeds it is memory. A window cuts off what began
    before it, the more the shorter it is: the excess of windows of half a run and of their halves is carried on to the
    whole run, as if a constant were cut off from each.

    Parameters
    ----------
    parent
        Row of each point's parent; -1 where it was drawn from the whole prior, (n_dead,). Rows are in order of death.
    birth_row
        Row of the death above whose level each point was drawn; -1 at the start, (n_dead,).
    n_at_death
        Points alive when each died, itself included, (n_dead,).
    """
    families = _Families(parent, birth_row, n_at_death)
    times = np.unique(birth_row)  # ends of rounds
    lag = (len(times) - 1) // 4
    if lag < _LEAST_LAG:
        return 1.0
    starts = np.unique(np.linspace(0, len(times) - 1 - 2 * lag, _MOST_WINDOWS).astype(int))
    long, early, late = (
        np.array([families.excess(times[i + start], times[i + end]) for i in starts]).sum(axis=0)
        for start, end in ((0, 2 * lag), (0, lag), (lag, 2 * lag))
    )
    short = early + late
    of_half, of_quarter = long[0] / long[1], short[0] / short[1]
    return max(1.0, 1.0 + float(1.5 * of_half - 0.5 * of_quarter))


class _Families:
    """The points of a run by birth and death, to count descendants between any two ends of rounds."""

    def __init__(self, parent: IntArray, birth_row: IntArray, n_at_death: IntArray) -> None:
        self._parent, self._birth_row, self._n_at_death = parent, birth_row, n_at_death
        self._births = np.sort(birth_row)
        # Just after a round all of its points are alive: as many as when the next one dies.
        n_alive = n_at_death[np.minimum(self._births + 1, len(n_at_death) - 1)]
        self._by_births = np.concatenate([[0.0], np.cumsum(2.0 / n_alive**2)])
        self._by_deaths = np.concatenate([[0.0], np.cumsum(1.0 / n_at_death**2)])

    def excess(self, first: int, last: int) -> tuple[float, float]:
        """Relative variance of the volume lost in excess of chains without memory, and the volume's own variance."""
        alive = np.flatnonzero((self._birth_row <= last) & (np.arange(len(self._parent)) > last))
        ancestor = alive.copy()
        while (young := self._birth_row[ancestor] > first).any():
            ancestor[young] = self._parent[ancestor[young]]
        share = np.bincount(ancestor) / len(alive)
        spread = float(share @ share) - 1.0 / int(self._n_at_death[first + 1])
        born = np.searchsorted(self._births, [first, last], side="right")
        chance = float(self._by_births[born[1]] - self._by_births[born[0]])
        return spread - chance, float(self._by_deaths[last + 1] - self._by_deaths[first + 1])
