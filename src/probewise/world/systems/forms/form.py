"""What may be left out of a system: a form, bound to a target, and a form with its numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.world.systems.rows import SystemRows

__all__ = ["Bank", "Form", "Now", "Numbers", "Placed", "Side", "as_numbers"]

Side: TypeAlias = Literal["input", "parameter", "rate", "reading"]

Numbers: TypeAlias = Mapping[str, Any]
"""A form's parameters by name: (n_samples, 1), or floats."""

Bank: TypeAlias = Sequence[Sequence[dict[str, float]]]
"""Settings to look for a form with: groups of those that may add up."""


@dataclass(frozen=True, eq=False)
class Now:
    """Moments of runs, all of one shape or one that broadcasts: at rows, or between them.

    `t` is the time as printed, `since` the time since the start of the run, `u` the columns, `run` the number of the
    run, `row` the number of the row, which is counted at rows alone.
    """

    t: FloatArray
    since: FloatArray
    u: Mapping[str, Any]
    run: IntArray
    row: FloatArray

    @classmethod
    def at_rows(cls, rows: SystemRows) -> Self:
        """Give the moments of all rows."""
        return cls(rows.t[None, :], rows.since_start[None, :], rows.columns, rows.run, np.arange(float(len(rows))))


@dataclass(frozen=True, eq=False)
class Form:
    """A form of the vocabulary, or a stranger to it, bound to its target.

    Parameters
    ----------
    name
        `name` or `name:target`.
    side
        Where it acts.
    act
        What it does, by side: input (columns, rows, numbers) to columns; parameter (now, numbers) to what is added;
        rate (states, now, numbers) to what is added; reading (readings, rows, numbers) to readings.
    sized
        Amplitude and what was drawn to the form's numbers.
    draw
        Draws all but the amplitude and its sign.
    bank
        Where to look for it.
    join
        Turns a group of the bank and the amounts of its members into numbers to start a fit from.
    steps
        By how much to change each number for a derivative.
    first, limit
        Amplitude to begin with, and the largest.
    signed
        Whether the amplitude may be negative.
    target
        Parameter or state, where it acts on one.
    order
        Among the forms of the readings.
    uses
        Columns that it asks for.
    covariates
        Along which it shows.
    breaks
        Numbers to moments at which something jumps.
    late
        The column that it delays.
    sticks, stops
        Whether it is dry friction, or a bound, of the target.
    shape
        A formula in words, where it is no form of the vocabulary.
    """

    name: str
    side: Side
    act: Callable[..., Any]
    sized: Callable[[float, dict[str, float]], dict[str, float]]
    draw: Callable[[np.random.Generator], dict[str, float]]
    bank: Bank
    join: Callable[[Sequence[dict[str, float]], FloatArray], dict[str, float]]
    steps: Mapping[str, float]
    first: float
    limit: float
    covariates: tuple[str, ...]
    signed: bool = True
    target: str = ""
    order: int = 0
    uses: tuple[str, ...] = ()
    breaks: Callable[[Numbers], FloatArray] | None = None
    late: str = ""
    sticks: bool = False
    stops: bool = False
    shape: str = ""
    beside: Mapping[str, Any] = field(default_factory=dict)


Placed: TypeAlias = tuple[Form, Numbers]
"""A form with its numbers."""


def as_numbers(settings: Sequence[Mapping[str, float]]) -> dict[str, FloatArray]:
    """Stack settings into numbers, (n_settings, 1) each."""
    return {name: np.array([[each[name]] for each in settings]) for name in settings[0]}
