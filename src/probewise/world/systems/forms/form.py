"""Forms of effects on a system, bound to a target."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.world.systems.table import SystemTable

Side: TypeAlias = Literal["input", "parameter", "rate", "reading"]

Numbers: TypeAlias = Mapping[str, Any]
"""A form's parameters by name: (n_samples, 1), or floats."""

Bank: TypeAlias = Sequence[Sequence[dict[str, float]]]
"""Template bank of a form: groups of settings that may be combined linearly."""


@dataclass(frozen=True, eq=False)
class Instants:
    """Instants of runs, at rows or between them; arrays broadcast.

    `t` is the recorded time, `since` the time since the start of the run, `u` the columns, `run` the number of the run,
    `row` the number of the row.
    """

    t: FloatArray
    since: FloatArray
    u: Mapping[str, Any]
    run: IntArray
    row: FloatArray

    @classmethod
    def at_rows(cls, rows: SystemTable) -> Self:
        """Return the instants of all rows."""
        return cls(rows.t[None, :], rows.time_since_start[None, :], rows.columns, rows.run, np.arange(float(len(rows))))


@dataclass(frozen=True, eq=False)
class Form:
    """A form, in the vocabulary or outside, bound to its target.

    Parameters
    ----------
    name
        `name` or `name:target`.
    side
        Side of the system on which it acts.
    act
        Its function, by side: input (columns, rows, parameters) to columns; parameter (now, parameters) to a term to
        add; rate (states, now, parameters) to a term to add; reading (readings, rows, parameters) to readings.
    of_amplitude
        Converts the amplitude and the drawn values to the form's parameters.
    draw
        Draws all parameters except the amplitude and its sign.
    bank
        Its template bank.
    start_values
        Converts a group of the bank and the amounts of its members to starting values of a fit.
    steps
        Step of each parameter for derivatives.
    first, limit
        First amplitude tried, and the largest.
    signed
        Whether the amplitude may be negative.
    target
        Parameter or state on which it acts, if any.
    order
        Order among the forms of the readings.
    uses
        Columns that it uses.
    covariates
        Covariates along which its residual is visible.
    breaks
        Function of the parameters that returns times of discontinuities.
    late
        Column that it delays.
    sticks, stops
        Whether it is dry friction, or a bound, of the target.
    shape
        Its formula in words, if it is outside the vocabulary.
    also_in_truth
        Constants of its formula, by name, which the truth lists beside the parameters.
    """

    name: str
    side: Side
    act: Callable[..., Any]
    of_amplitude: Callable[[float, dict[str, float]], dict[str, float]]
    draw: Callable[[np.random.Generator], dict[str, float]]
    bank: Bank
    start_values: Callable[[Sequence[dict[str, float]], FloatArray], dict[str, float]]
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
    also_in_truth: Mapping[str, Any] = field(default_factory=dict)


FormWithParameters: TypeAlias = tuple[Form, Numbers]
"""A form with its parameters."""


def parameter_arrays(settings: Sequence[Mapping[str, float]]) -> dict[str, FloatArray]:
    """Stack settings to parameter arrays, (n_settings, 1) each."""
    return {name: np.array([[each[name]] for each in settings]) for name in settings[0]}
