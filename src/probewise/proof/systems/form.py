"""The form of an effect on a system: its formula, bound to a target; and the modulations of which many are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.kind import SystemKind, SystemTable

Side: TypeAlias = Literal["input", "parameter", "rate", "reading"]

Numbers: TypeAlias = Mapping[str, float]
"""A form's parameters by name."""

OfAmplitude: TypeAlias = Callable[[float, dict[str, float]], dict[str, float]]
Draw: TypeAlias = Callable[[np.random.Generator], dict[str, float]]


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
        return cls(rows.t, rows.time_since_start, rows.columns, rows.run, np.arange(float(len(rows))))


@dataclass(frozen=True, eq=False)
class Form:
    """The formula of an effect, in the vocabulary or outside, bound to a target.

    It is called `name` or `name:target`, and changes a `side`: `act`, of an input, is a function of columns, rows and
    parameters that returns columns; of a parameter, of now and parameters, that returns a term to add; of the rate of a
    state, of states, now and parameters, that returns a term to add; of the reading, of readings, rows and parameters,
    that returns readings. `first` and `limit` are the first amplitude tried and the largest, `covariates` those along
    which its residual is visible. `draw` draws all parameters except the amplitude and its sign (negative ones too if
    `signed`), and `of_amplitude` returns all by name. `target` is the parameter or state on which it acts; forms of
    readings act in ascending `order`; `uses` are the columns that it uses; `breaks` is a function of the parameters
    that returns the time of a discontinuity; `late` is the column that it delays. `sticks` and `stops`: it is dry
    friction, or an upper bound, of the target; `outside`: of the vocabulary of a diagnosis.
    """

    name: str
    side: Side
    act: Callable[..., Any]
    first: float
    limit: float
    covariates: tuple[str, ...]
    of_amplitude: OfAmplitude = lambda a, drawn: {"a": a, **drawn}
    draw: Draw = lambda rng: {}
    signed: bool = True
    target: str = ""
    order: int = 0
    uses: tuple[str, ...] = ()
    breaks: Callable[[Numbers], float] | None = None
    late: str = ""
    sticks: bool = False
    stops: bool = False
    outside: bool = False

    @property
    def vocabulary_name(self) -> str:
        """Name in the vocabulary: that of "saturation (floor)" is "saturation"."""
        return self.name.removesuffix(" (floor)")


FormWithParameters: TypeAlias = tuple[Form, Numbers]
"""A form with its parameters."""


@dataclass(frozen=True, eq=False)
class TrueSystem:
    """A system at its true parameters.

    `kind`, `table`: the system, and the table of the rows that are not held out; `parameters`: true parameters by name,
    numbers or (n_points,); `readings`, `states`: noise-free and without any effect, (n_points,); the states by name.
    """

    kind: SystemKind
    table: SystemTable
    parameters: Mapping[str, Any]
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

    @property
    def names_runs(self) -> bool:
        """Whether the table names its runs, of which there are several."""
        return self.kind.run is not None and len(self.table.rows_by_run) > 1

    def deviation(self, column: str) -> tuple[float, float]:
        """Return mean and sd of a column over the rows that are not held out."""
        values = self.table.columns[column]
        return float(values.mean()), float(values.std())

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


def modulation(value_at: Callable[[Instants, Numbers], Any], *covariates: str, reach: float = 1.0, **more: Any) -> Form:
    """Return a variation in proportion to an amplitude, of which forms are made by `modulated`.

    `value_at` is a function of instants and parameters, `reach` its typical magnitude at amplitude 1; `more` as of
    `Form`.
    """
    return Form("", "parameter", value_at, 1 / reach, math.inf, covariates, **more)


def modulated(how: Form, name: str, side: Side, size: float, *, limit: float, **more: Any) -> Form:
    """Return the form that varies so, by default a term added; `size` of its first amplitude, `limit` in that."""
    first = size * how.first
    return replace(how, name=name, side=side, first=first, limit=limit * first, **more)


def linear_drift(true: TrueSystem) -> Form:
    """Return the modulation a t, t the recorded time."""
    names = dict.fromkeys(("time", true.table.time or "time"))
    return modulation(lambda now, v: v["a"] * now.t, *names, reach=float(np.abs(true.table.t).max()))


def proportional_to_column(true: TrueSystem, column: str) -> Form:
    """Return the modulation a (column - its mean over the recording)."""
    middle, sd = true.deviation(column)
    return modulation(lambda now, v: v["a"] * (now.u[column] - middle), column, reach=sd, uses=(column,))


def step_at_change_point(true: TrueSystem) -> Form:
    """Return the modulation 0, then a after a time "at_s", or after a row "at_row" if the table has no time."""
    timed = true.table.time is not None
    at = "at_s" if timed else "at_row"
    return modulation(
        lambda now, v: v["a"] * ((now.t if timed else now.row) > v[at]),
        *(("time", str(true.table.time)) if timed else ("row",)),
        draw=lambda rng: {at: true.random_time(rng)},
        breaks=(lambda v: v[at]) if timed else None,
    )


def value_per_run(true: TrueSystem) -> Form:
    """Return a modulation with one normal random value per run, held-out runs included, times the amplitude."""
    names = [f"values[{k}]" for k in range(true.table.n_runs)]
    return modulation(
        lambda now, v: np.array([v[name] for name in names])[now.run],
        "run",
        of_amplitude=lambda a, drawn: {name: a * drawn[name] for name in names},
        draw=lambda rng: dict(zip(names, rng.standard_normal(len(names)).tolist(), strict=True)),
    )


def sinusoid_in_time(true: TrueSystem) -> Form:
    """Return a sinusoid in time, its period from four rows to two thirds of the recording."""
    rows = true.table
    return modulation(
        lambda now, v: v["a"] * np.sin(2 * np.pi * v["hz"] * now.t + v["phase"]),
        "time",
        str(rows.time),
        draw=lambda rng: {
            "hz": draw_log_uniform(rng, 1.5 / rows.duration, 0.25 / rows.median_gap),
            "phase": float(rng.uniform(0, 2 * np.pi)),
        },
        signed=False,
    )


def settling(true: TrueSystem) -> Form:
    """Return the modulation a exp(-t / tau_s), t the time since the start of the run."""
    longest = float(true.table.time_since_start.max())
    return modulation(
        lambda now, v: v["a"] * np.exp(-now.since / v["tau_s"]),
        *("time", "run", str(true.table.time)),
        draw=lambda rng: {"tau_s": draw_log_uniform(rng, 3 * true.table.median_gap, 0.4 * longest)},
    )
