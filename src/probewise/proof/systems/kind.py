"""A kind of system: its simulator file, an independent implementation of its law, and its experimental design."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from scipy.special import ndtri

from probewise._arrays import FloatArray

Values: TypeAlias = Mapping[str, Any]
"""Parameters, states or columns by name: arrays that broadcast."""

Columns: TypeAlias = dict[str, FloatArray]

Formula: TypeAlias = Callable[[Values, Values], Any]
"""Function of parameters and columns; returns the reading, row by row."""


@dataclass(frozen=True)
class Law:
    """A law in continuous time.

    Parameters
    ----------
    start
        Initial value of each state: the name of a parameter, or a number.
    rates
        Function of states, parameters and columns; returns the rate of each state.
    read
        Function of states, parameters and columns; returns the reading.
    linear
        Whether inputs are interpolated linearly between rows; otherwise they are held.
    """

    start: Mapping[str, str | float]
    rates: Callable[[Values, Values, Values], dict[str, Any]]
    read: Callable[[Values, Values, Values], Any]
    linear: bool = False


@dataclass(frozen=True)
class Prior:
    """Prior of a parameter in the simulator file: `shape` "uniform" or "log" (low, high), or "normal" (mean, sd)."""

    shape: str
    a: float
    b: float

    @property
    def coordinate_unit(self) -> float:
        """Unit of the coordinate: the range of "uniform", the sd of "normal", 1 of "log" (a logarithm)."""
        return {"uniform": self.b - self.a, "normal": self.b}.get(self.shape, 1.0)

    def coordinate(self, value: FloatArray) -> FloatArray:
        """Return the coordinate of a value: its logarithm for "log", else the value in units of `coordinate_unit`."""
        return np.log(value) if self.shape == "log" else np.asarray(value / self.coordinate_unit)

    def value(self, coordinate: FloatArray) -> FloatArray:
        """Return the value at a coordinate."""
        return (
            np.exp(np.clip(coordinate, -60.0, 60.0))
            if self.shape == "log"
            else np.asarray(coordinate * self.coordinate_unit)
        )

    def stratified_draws(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw n values, one from each of n intervals of equal probability, in random order."""
        u = (rng.permutation(n) + rng.random(n)) / n
        if self.shape == "normal":
            return np.asarray(self.a + self.b * ndtri(u))
        if self.shape == "log":
            return np.exp(math.log(self.a) + u * math.log(self.b / self.a))
        return self.a + u * (self.b - self.a)


@dataclass(frozen=True)
class IrrelevantColumn:
    """A logged column without influence: a random walk (scale `wander`) about `middle`, plus `jitter` of sd per row.

    `beyond` shifts `middle` in the last held-out run.
    """

    name: str
    middle: float
    wander: float
    jitter: float
    decimals: int
    beyond: float = 0.0


@dataclass(frozen=True, eq=False)
class SystemKind:
    """A kind of system.

    Parameters
    ----------
    name
        Its name in a truth.
    reading, unit
        The predicted column, and its unit.
    text
        The simulator file as a user would provide it; `{noise}` stands for its line on noise.
    priors
        Priors as in the file, by parameter.
    draw
        Draws the true shared parameters.
    draw_run
        Draws the true parameters of a run.
    design
        Designs a run: draws its times from 0 and its columns, from (rng, n_rows, regime). The regime is 1, or larger
        for a run with inputs beyond the others' range.
    decimals
        Decimals of the designed columns and of time.
    drives
        Columns that the law uses.
    sd
        Sd of a reading's white noise.
    formula, law
        The nominal model, one of the two; the other is None.
    time, time_unit, run
        Name of the time column, its unit, name of the run column; names are None if absent.
    restarts_time
        Whether time restarts in each run.
    logged
        Irrelevant columns.
    n_runs, per_run
        Number of runs not held out, and the parameters with a value in each.
    reading_decimals
        Decimals of a reading.
    defines_states
        Whether the simulator file defines states and rates; False: it integrates by itself.
    """

    name: str
    reading: str
    unit: str
    text: str
    priors: Mapping[str, Prior]
    draw: Callable[[np.random.Generator], dict[str, float]]
    design: Callable[[np.random.Generator, int, float], tuple[FloatArray, Columns]]
    decimals: Mapping[str, int]
    drives: tuple[str, ...]
    sd: float
    formula: Formula | None = None
    law: Law | None = None
    draw_run: Callable[[np.random.Generator], dict[str, float]] = field(default=lambda rng: {})
    time: str | None = "t_s"
    time_unit: str = "s"
    run: str | None = "run"
    restarts_time: bool = False
    logged: tuple[IrrelevantColumn, ...] = ()
    n_runs: int = 5
    per_run: tuple[str, ...] = ()
    reading_decimals: int = 4
    defines_states: bool = True

    @property
    def shared_parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters that all runs share."""
        return tuple(name for name in self.priors if name not in self.per_run)
