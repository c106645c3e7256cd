"""The form of an effect on a system: its formula, bound to a target."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.proof.systems.table import SystemTable

Side: TypeAlias = Literal["input", "parameter", "rate", "reading"]

Numbers: TypeAlias = Mapping[str, Any]
"""A form's parameters by name: (n_samples, 1), or floats."""

Bank: TypeAlias = Sequence[Sequence[dict[str, float]]]
"""Template bank of a form: groups of settings that may be combined linearly."""


@dataclass(frozen=True, eq=False)
class Instants:
    """Instants of runs, at rows or between them; arrays broadcast.

    `t` is the recorded time, `since` the time since the start of the run, `u` the columns by name, `run` the number of
    the run, `row` the index of the row.
    """

    t: FloatArray
    since: FloatArray
    u: Mapping[str, Any]
    run: IntArray
    row: FloatArray

    @classmethod
    def at_rows(cls, rows: SystemTable) -> Self:
        """Return the instants of all rows of a table."""
        return cls(rows.t[None, :], rows.time_since_start[None, :], rows.columns, rows.run, np.arange(float(len(rows))))


@dataclass(frozen=True, eq=False)
class Form:
    """The formula of an effect, in the vocabulary or outside, bound to a target.

    Parameters
    ----------
    name
        `name` or `name:target`.
    side
        What it changes: "input", "parameter", "rate" (of a state) or "reading".
    act
        Its function, by side: input (columns, rows, parameters) to columns; parameter (now, parameters) to a term to
        add; rate (states, now, parameters) to a term to add; reading (readings, rows, parameters) to readings.
    of_amplitude
        Function of the amplitude and the values from `draw`; returns all parameters by name.
    draw
        Draws all parameters except the amplitude and its sign.
    bank
        Template bank: groups of parameter settings; templates within a group may be combined linearly.
    start_values
        Function of a group of the bank and the fitted coefficient of each setting; returns start values of a fit.
    steps
        Scale of a change of each parameter, for derivatives; 0: not fitted.
    first, limit
        First amplitude tried, and the largest.
    signed
        Whether the amplitude may be negative.
    target
        Parameter or state on which it acts, if any.
    order
        Forms of side "reading" act in ascending order.
    uses
        Columns that it uses.
    covariates
        Covariates along which its residual is visible.
    breaks
        Function of the parameters that returns times of discontinuities.
    late
        Column that it delays.
    sticks, stops
        Whether it is dry friction, or an upper bound, of the target.
    shape
        Its formula in words, if it is outside the vocabulary, else "".
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
    """Stack parameter settings into one array per parameter, (n_settings, 1)."""
    return {name: np.array([[each[name]] for each in settings]) for name in settings[0]}
