"""A kind of system: its owner's file, its law again in the world's own words, and how it is recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from scipy.special import ndtri

from probewise._arrays import FloatArray

__all__ = ["Columns", "Formula", "Kind", "Law", "Logged", "Prior", "Values"]

Values: TypeAlias = Mapping[str, Any]
"""Parameters, states or columns by name: arrays that broadcast."""

Columns: TypeAlias = dict[str, FloatArray]

Formula: TypeAlias = Callable[[Values, Values], Any]
"""Parameters and columns to the reading, row by row."""


@dataclass(frozen=True)
class Law:
    """A law in continuous time.

    Parameters
    ----------
    start
        State to the parameter, or the number, at which each run starts.
    rates
        States, parameters and columns to the rate of each state.
    read
        States, parameters and columns to the reading.
    linear
        Whether what drives it moves on straight lines between rows; else it stays as in the row before.
    """

    start: Mapping[str, str | float]
    rates: Callable[[Values, Values, Values], dict[str, Any]]
    read: Callable[[Values, Values, Values], Any]
    linear: bool = False


@dataclass(frozen=True)
class Prior:
    """What the owner's file says of a parameter: "uniform" or "log" (low, high), or "normal" (mean, sd)."""

    shape: str
    a: float
    b: float

    @property
    def width(self) -> float:
        """Unit of its coordinate: the range or the sd; of a logarithm 1."""
        return {"uniform": self.b - self.a, "normal": self.b}.get(self.shape, 1.0)

    def coordinate(self, value: FloatArray) -> FloatArray:
        """Return the coordinate of a value."""
        return np.log(value) if self.shape == "log" else np.asarray(value / self.width)

    def value(self, coordinate: FloatArray) -> FloatArray:
        """Return the value at a coordinate."""
        return np.exp(np.clip(coordinate, -60.0, 60.0)) if self.shape == "log" else np.asarray(coordinate * self.width)

    def spread(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw n values, one from each of n parts of equal mass, in random order."""
        u = (rng.permutation(n) + rng.random(n)) / n
        if self.shape == "normal":
            return np.asarray(self.a + self.b * ndtri(u))
        if self.shape == "log":
            return np.exp(math.log(self.a) + u * math.log(self.b / self.a))
        return self.a + u * (self.b - self.a)


@dataclass(frozen=True)
class Logged:
    """A column that was logged because it could be: it wanders about a middle and jitters, printed to some decimals.

    `beyond` is how far its middle moves in a new regime.
    """

    name: str
    middle: float
    wander: float
    jitter: float
    decimals: int
    beyond: float = 0.0


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of system.

    Parameters
    ----------
    name
        What it is called in a truth.
    reading, unit
        The column that is predicted.
    text
        The owner's file; `{noise}` stands for what it says of the noise.
    priors
        As in the file.
    draw
        Draws the true parameters that all runs share.
    draw_run
        Draws a run's own.
    lay
        Lays a run out: (rng, n_rows, regime) to times from 0 and columns; the regime is 1, or larger beyond the others.
    decimals
        Decimals of the columns laid out, the time's too.
    drives
        Columns that the law asks for.
    sd
        Sd of a reading.
    formula, law
        One of them: the nominal model.
    time, time_unit, run
        Names of the columns; None where there is none.
    time_anew
        Whether time begins anew in each run.
    logged
        Columns that do nothing.
    n_runs, per_run
        Number of runs that are not kept back, and the parameters with a value in each.
    reading_decimals
        Decimals of a reading.
    tells_states
        Whether the owner's file gives a law's states and rates, or has a loop of its own.
    """

    name: str
    reading: str
    unit: str
    text: str
    priors: Mapping[str, Prior]
    draw: Callable[[np.random.Generator], dict[str, float]]
    lay: Callable[[np.random.Generator, int, float], tuple[FloatArray, Columns]]
    decimals: Mapping[str, int]
    drives: tuple[str, ...]
    sd: float
    formula: Formula | None = None
    law: Law | None = None
    draw_run: Callable[[np.random.Generator], dict[str, float]] = field(default=lambda rng: {})
    time: str | None = "t_s"
    time_unit: str = "s"
    run: str | None = "run"
    time_anew: bool = False
    logged: tuple[Logged, ...] = ()
    n_runs: int = 5
    per_run: tuple[str, ...] = ()
    reading_decimals: int = 4
    tells_states: bool = True

    @property
    def shared(self) -> tuple[str, ...]:
        """Parameters that all runs share."""
        return tuple(name for name in self.priors if name not in self.per_run)
