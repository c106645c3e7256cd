"""The system at its true parameters, over the rows that are not held out: effects are scaled by it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.kind import SystemKind
from probewise.proof.systems.table import SystemTable


@dataclass(frozen=True, eq=False)
class TrueSystem:
    """A system at its true parameters.

    Parameters
    ----------
    kind, table
        The system, and the table of the rows that are not held out.
    parameters
        True parameters by name, (1, 1) or (1, n_points).
    readings, states
        Noise-free and without any effect, (n_points,); the states by name.
    """

    kind: SystemKind
    table: SystemTable
    parameters: Mapping[str, FloatArray]
    readings: FloatArray
    states: Mapping[str, FloatArray]

    @property
    def noise_sd(self) -> float:
        """Sd of a reading's white noise."""
        return self.kind.sd

    @property
    def varying_columns(self) -> tuple[str, ...]:
        """Names of the columns that vary, except time."""
        return tuple(name for name, v in self.table.columns.items() if name != self.table.time and np.ptp(v) > 0)

    def mean_of(self, column: str) -> float:
        """Return the mean of a column over the rows that are not held out."""
        return float(self.table.columns[column].mean())

    def sd_of(self, column: str) -> float:
        """Return the sd of a column over the rows that are not held out."""
        return float(self.table.columns[column].std())

    def rms_rate(self, state: str) -> float:
        """Return the root-mean-square rate of a state, from differences between successive rows of a run."""
        found = []
        for own in self.table.rows_by_run:
            gaps = np.diff(self.table.t[own])
            found.append(np.diff(self.states[state][own])[gaps > 0] / gaps[gaps > 0])
        return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))

    def random_time(self, rng: np.random.Generator) -> float:
        """Draw a time (or a row plus 0.5, if there is no time) from the middle 60 % of the rows."""
        at = float(np.quantile(self.table.t, rng.uniform(0.2, 0.8)))
        return math.floor(at) + 0.5 if self.table.time is None else at


def draw_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number between `low` and `high` whose logarithm is uniform; NotConvergedError if the range is empty."""
    if not 0 < low < high:
        raise NotConvergedError(f"nothing lies between {low:g} and {high:g}: too few rows")
    return math.exp(rng.uniform(math.log(low), math.log(high)))
