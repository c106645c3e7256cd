"""The rows of a table by their position in its runs, in which all runs are stepped together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.systems.table import RunTable


@dataclass(frozen=True, eq=False)
class RowsInRuns:
    """The rows of a table by position in its runs, for stepping all runs together; short runs repeat their last row.

    Raises
    ------
    ParameterError
        On first use, if time decreases within a run.
    """

    table: RunTable

    @cached_property
    def row_by_position_and_run(self) -> IntArray:
        """Row of the table at each position of each run, (n_places, n_runs); after its end, a run's last row."""
        self.table.require_rising_time()
        by_run = self.table.rows_by_scan()
        longest = max(len(rows) for rows in by_run)
        return np.stack([np.append(rows, np.full(longest - len(rows), rows[-1])) for rows in by_run], axis=1)

    @cached_property
    def gaps(self) -> FloatArray:
        """Time from each position to the next, (n_places - 1, n_runs), in the unit of time."""
        return np.diff(self.table.time_s[self.row_by_position_and_run], axis=0)

    @property
    def typical_gap(self) -> float:
        """Median time between two rows of a run that are not at the same time; 1 without any."""
        return float(np.median(self.gaps[self.gaps > 0])) if (self.gaps > 0).any() else 1.0

    @cached_property
    def position_and_run_by_row(self) -> tuple[IntArray, IntArray]:
        """Position in its run, and number of its run, of each row, (n_points,) each."""
        place = np.empty(len(self.table), dtype=np.int64)
        for rows in self.table.rows_by_scan():
            place[rows] = np.arange(len(rows))
        return place, self.table.scan
