"""Whether the rows of a table are in the order of recording, or sorted by the readings themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from probewise._arrays import IntArray, distinct_values
from probewise.systems.simulator import Simulator
from probewise.systems.table import RunTable

_BY_CHANCE = 1e-4  # probability below which sorted readings are no chance


def chance_of_sorted_readings(simulator: Simulator, table: RunTable) -> float:
    """Return the probability that readings in equal rows are in order by chance; 1 if they are not in order.

    Rows are equal where all columns but the reading and its sd are. Readings must rise in all groups of equal rows, or
    fall in all: by chance once in the product of the numbers of their arrangements. It is 1 where a time was recorded,
    where equal rows are apart, and for readings that rise or fall along the whole table, as those of a drift do.
    """
    own, readings = simulator, table.columns.get(simulator.reading)
    if table.has_varying_time or readings is None or readings.dtype != np.float64:
        return 1.0
    inputs = [values for name, values in table.columns.items() if name not in (own.reading, own.noise.sd)]
    codes = [_codes_of_equal_cells(values) for values in inputs]
    group = np.unique(np.stack([*codes, np.zeros(len(table), dtype=np.int64)]), axis=1, return_inverse=True)[1].ravel()
    there = np.flatnonzero(np.isfinite(readings))
    if (
        np.count_nonzero(np.diff(group[there])) >= np.unique(group[there]).size
    ):  # equal rows apart: by a jump or a drift
        return 1.0
    sizes = np.bincount(group[there])
    ties = np.unique(np.stack([group[there], readings[there]]), axis=1, return_counts=True)[1]
    log_chance = np.log(2.0) - np.sum(gammaln(sizes + 1)) + np.sum(gammaln(ties + 1))
    whole = np.diff(readings[there])
    along = whole[np.diff(group[there]) == 0]  # equal rows are beside each other
    for sign in (1.0, -1.0):
        if np.all(sign * along >= 0) and not np.all(sign * whole >= 0):
            return float(min(np.exp(log_chance), 1.0))
    return 1.0


def _codes_of_equal_cells(values: NDArray[Any]) -> IntArray:
    """Return a number for each cell of a column, (n_points,), the same for cells that are equal but for rounding."""
    if values.dtype != np.float64:
        return np.unique(values, return_inverse=True)[1]
    return np.where(np.isfinite(values), np.searchsorted(distinct_values(values), values, side="right"), 0)


def rows_are_in_order(simulator: Simulator, table: RunTable) -> bool:
    """Return whether the order of rows may be that of recording: readings in equal rows are not sorted."""
    return chance_of_sorted_readings(simulator, table) > _BY_CHANCE


def note_on_row_order(simulator: Simulator, table: RunTable) -> tuple[str, ...]:
    """Return a note where rows are in no order of recording; else ()."""
    chance = chance_of_sorted_readings(simulator, table)
    if chance > _BY_CHANCE:
        return ()
    once_in = 1 / max(chance, 1e-300)
    return (
        f"rows are in no order of recording: wherever the other columns are equal, {simulator.reading} is sorted, by "
        f"chance once in {once_in:.0e} tables; nothing is asked that needs their order, such as a jump at a row, "
        "hysteresis or correlated noise",
    )
