"""The system at its true parameters, about which effects are built, over the rows not held out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.world.systems.kind import SystemKind
from probewise.world.systems.table import SystemTable


@dataclass(frozen=True, eq=False)
class TrueSystem:
    """A system at its true parameters.

    Parameters
    ----------
    kind, table
        The system, and the table of the rows given to the diagnosis.
    parameters
        True parameters, (1, 1) or (1, n_points).
    readings, states
        Noise-free and without any effect, (n_points,).
    """

    kind: SystemKind
    table: SystemTable
    parameters: Mapping[str, FloatArray]
    readings: FloatArray
    states: Mapping[str, FloatArray]

    @property
    def noise_sd(self) -> float:
        """Sd of a reading's noise."""
        return self.kind.sd

    @property
    def varying_columns(self) -> tuple[str, ...]:
        """Columns that vary, except time."""
        return tuple(name for name, v in self.table.columns.items() if name != self.table.time and np.ptp(v) > 0)

    def mean_of(self, column: str) -> float:
        """Return the mean of a column."""
        return float(self.table.columns[column].mean())

    def sd_of(self, column: str) -> float:
        """Return the sd of a column."""
        return float(self.table.columns[column].std())

    def rms_rate(self, state: str) -> float:
        """Return the root-mean-square rate of a state, from its values at the rows."""
        found = []
        for own in self.table.rows_by_run:
            gaps = np.diff(self.table.t[own])
            found.append(np.diff(self.states[state][own])[gaps > 0] / gaps[gaps > 0])
        return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))

    def random_time(self, rng: np.random.Generator) -> float:
        """Draw a time, or a row, well inside the recording."""
        at = float(np.quantile(self.table.t, rng.uniform(0.2, 0.8)))
        return math.floor(at) + 0.5 if self.table.time is None else at


def draw_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform; raise NotConvergedError if the range is empty."""
    if not 0 < low < high:
        raise NotConvergedError(f"nothing lies between {low:g} and {high:g}: too few rows")
    return math.exp(rng.uniform(math.log(low), math.log(high)))
