"""The table of a recording of a system: columns, time and runs, as recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class SystemTable:
    """Rows in order of time; every array is (n_points,).

    Parameters
    ----------
    columns
        Numeric columns by name, including time.
    run
        Number, from 0, of each row's run among all runs of a case including held-out ones.
    time
        Name of the time column; None if none was recorded.
    n_runs
        Number of runs of the case, including held-out ones.
    """

    columns: Mapping[str, FloatArray]
    run: IntArray
    time: str | None
    n_runs: int

    def __len__(self) -> int:
        return len(self.run)

    @cached_property
    def t(self) -> FloatArray:
        """Recorded time in the table's unit, or the index of the row if there is none."""
        return np.arange(float(len(self))) if self.time is None else self.columns[self.time]

    @cached_property
    def rows_by_run(self) -> Sequence[IntArray]:
        """Row indices of each run that has rows here, by run number."""
        found = (np.flatnonzero(self.run == k) for k in range(self.n_runs))
        return [rows for rows in found if rows.size]

    @cached_property
    def time_since_start(self) -> FloatArray:
        """Time since the first row of the run, (n_points,)."""
        out = np.empty(len(self))
        for rows in self.rows_by_run:
            out[rows] = self.t[rows] - self.t[rows[0]]
        return out

    @cached_property
    def median_gap(self) -> float:
        """Median time from a row to the next of its run, over all runs."""
        return float(np.median(np.concatenate([np.diff(self.t[rows]) for rows in self.rows_by_run])))

    @property
    def duration(self) -> float:
        """Largest minus smallest recorded time."""
        return float(np.ptp(self.t))

    def select_rows(self, kept: FloatArray | IntArray) -> SystemTable:
        """Return the table of the rows `kept` (indices); runs keep their numbers."""
        return replace(self, columns={name: values[kept] for name, values in self.columns.items()}, run=self.run[kept])
