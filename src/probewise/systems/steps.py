"""The steps by which a law is integrated over a table, in all runs together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.systems.rosenbrock import RODAS
from probewise.systems.rows_in_runs import RowsInRuns
from probewise.systems.runge_kutta import StepSchedule
from probewise.systems.table import RunTable


@dataclass(frozen=True, eq=False)
class Steps:
    """Integration steps over a table, each taken in all runs together; position k is the k-th row of every run.

    No step is longer than `max_step`, in the unit of time, at fourth order. The method is linearly implicit if `stiff`,
    else explicit.
    """

    places: RowsInRuns
    max_step: float
    stiff: bool = False

    @cached_property
    def schedule(self) -> StepSchedule:
        """Number of steps from each row of a run to the next, the same in all runs, and the method."""
        longest = self.places.gaps.max(axis=1, initial=0.0)
        n_steps = np.asarray(np.maximum(np.ceil(longest / self.max_step - 1e-9), 1), dtype=np.int64)
        return StepSchedule(n_steps, RODAS) if self.stiff else StepSchedule.from_fourth_order_steps(n_steps)

    @property
    def n_steps_by_gap(self) -> IntArray:
        """Number of steps from each row of a run to the next, (n_places - 1,); the same in all runs."""
        return self.schedule.n_steps

    @cached_property
    def gap_of_step(self) -> IntArray:
        """Number of the gap in which each step lies, (n_steps,); gap k is between rows k and k + 1 of every run."""
        return np.repeat(np.arange(len(self.n_steps_by_gap)), self.n_steps_by_gap)

    @cached_property
    def n_steps_before_position(self) -> IntArray:
        """Number of steps from the first row of a run to its row at each position, (n_places,)."""
        return np.concatenate([[0], np.cumsum(self.n_steps_by_gap)])

    @property
    def n_runs(self) -> int:
        """Number of runs."""
        return int(self.places.row_by_position_and_run.shape[1])

    @cached_property
    def begin_share_of_gap(self) -> FloatArray:
        """Share of its gap between rows at which each step begins, (n_steps * n_runs,), ordered by step, then run."""
        gap = self.gap_of_step
        share = (np.arange(len(gap)) - self.n_steps_before_position[gap]) / self.n_steps_by_gap[gap]
        return np.repeat(share, self.n_runs)

    @cached_property
    def length_share_of_gap(self) -> FloatArray:
        """Share of its gap between rows that each step takes, (n_steps * n_runs,), ordered by step, then run."""
        return np.repeat(1.0 / self.n_steps_by_gap[self.gap_of_step], self.n_runs)

    def states_at_rows(self, states: FloatArray) -> FloatArray:
        """Select states (n_states, n_samples, n_steps + 1, n_runs) at every row: (n_states, n_samples, n_points)."""
        place, run = self.places.position_and_run_by_row
        return np.asarray(states[:, :, self.n_steps_before_position[place], run])


@lru_cache(maxsize=16)
def steps_for_table(table: RunTable, max_step: float, *, stiff: bool = False) -> Steps:
    """Return the `Steps` of an integration over a table."""
    return Steps(RowsInRuns(table), max_step, stiff)
