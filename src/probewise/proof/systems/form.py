"""The form of an effect on a system: its formula, bound to a target; and the modulations of which many are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.kind import SystemKind, SystemTable

Side: TypeAlias = Literal["input", "parameter", "rate", "reading"]

Numbers: TypeAlias = Mapping[str, Any]
"""A form's parameters by name: (n_samples, 1), or floats."""

OfAmplitude: TypeAlias = Callable[[float, dict[str, float]], dict[str, float]]
Draw: TypeAlias = Callable[[np.random.Generator], dict[str, float]]
StartValues: TypeAlias = Callable[[Sequence[dict[str, float]], FloatArray], dict[str, float]]

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


def scaled_start_values(group: Sequence[dict[str, float]], amounts: FloatArray) -> dict[str, float]:
    """Return the first setting of a group; an amplitude "a" in it is multiplied by the first fitted coefficient."""
    first = group[0]
    return {**first, "a": first["a"] * float(amounts[0])} if "a" in first else dict(first)


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
    bank: Bank
    steps: Mapping[str, float]
    first: float
    limit: float
    covariates: tuple[str, ...]
    of_amplitude: OfAmplitude = lambda a, drawn: {"a": a, **drawn}
    draw: Draw = lambda rng: {}
    start_values: StartValues = scaled_start_values
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


@dataclass(frozen=True, eq=False)
class TrueSystem:
    """A system at its true parameters.

    `kind`, `table`: the system, and the table of the rows that are not held out; `parameters`: true parameters by name,
    (1, 1) or (1, n_points); `readings`, `states`: noise-free and without any effect, (n_points,); the states by name.
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


@dataclass(frozen=True, eq=False)
class Modulation:
    """A variation in proportion to an amplitude; attributes as of `Form`, `bank` and `steps` functions of amplitude.

    `value_at` is a function of instants and parameters, `reach` its typical magnitude at amplitude 1.
    """

    value_at: Callable[[Instants, Numbers], Any]
    bank: Callable[[float], Bank]
    steps: Callable[[float], Mapping[str, float]]
    covariates: tuple[str, ...]
    reach: float
    of_amplitude: OfAmplitude = lambda a, drawn: {"a": a, **drawn}
    draw: Draw = lambda rng: {}
    start_values: StartValues = scaled_start_values
    uses: tuple[str, ...] = ()
    breaks: Callable[[Numbers], FloatArray] | None = None
    signed: bool = True

    def form(
        self,
        name: str,
        side: Side,
        first: float,
        *,
        limit: float,
        bank: float = 1.0,
        act: Callable[..., Any] | None = None,
        **more: Any,
    ) -> Form:
        """Return the form that varies so, by default a term added; `limit` and `bank` are in the first amplitude."""
        return Form(
            name,
            side,
            act=act or self.value_at,
            of_amplitude=self.of_amplitude,
            draw=self.draw,
            bank=self.bank(bank * first),
            start_values=self.start_values,
            steps=self.steps(first),
            first=first,
            limit=limit * first,
            covariates=self.covariates,
            signed=self.signed,
            uses=self.uses,
            breaks=self.breaks,
            **more,
        )


def _amplitude_only_modulation(
    value_at: Callable[[Instants, Numbers], Any], covariates: tuple[str, ...], reach: float, uses: tuple[str, ...] = ()
) -> Modulation:
    return Modulation(
        value_at,
        bank=lambda a: [[{"a": a}]],
        steps=lambda a: {"a": a},
        covariates=covariates,
        reach=reach,
        uses=uses,
    )


def linear_drift(true: TrueSystem) -> Modulation:
    """Return the modulation a t, t the recorded time."""
    names = ("time",) if true.table.time in (None, "time") else ("time", str(true.table.time))
    return _amplitude_only_modulation(lambda now, v: v["a"] * now.t, names, float(np.abs(true.table.t).max()))


def proportional_to_column(true: TrueSystem, column: str) -> Modulation:
    """Return the modulation a (column - its mean over the recording)."""
    middle = true.mean_of(column)
    return _amplitude_only_modulation(
        lambda now, v: v["a"] * (now.u[column] - middle), (column,), true.sd_of(column), (column,)
    )


def step_at_change_point(true: TrueSystem) -> Modulation:
    """Return the modulation 0, then a after a time "at_s", or after a row "at_row" if the table has no time."""
    at, timed = ("at_s", True) if true.table.time is not None else ("at_row", False)
    moments = np.quantile(np.unique(true.table.t), np.linspace(0.02, 0.98, 40))

    def value_at(now: Instants, v: Numbers) -> Any:
        return v["a"] * ((now.t if timed else now.row) > v[at])

    return Modulation(
        value_at,
        draw=lambda rng: {at: true.random_time(rng)},
        bank=lambda a: [[{"a": a, at: float(moment)}] for moment in moments],
        steps=lambda a: {"a": a, at: 0.0},
        covariates=("time", str(true.table.time)) if timed else ("row",),
        reach=1.0,
        breaks=(lambda v: np.asarray(v[at])) if timed else None,
    )


def value_per_run(true: TrueSystem) -> Modulation:
    """Return a modulation with one normal random value per run, held-out runs included, times the amplitude."""
    n = true.table.n_runs
    names = [f"values[{k}]" for k in range(n)]
    present = [int(true.table.run[own[0]]) for own in true.table.rows_by_run]

    def value_at(now: Instants, v: Numbers) -> Any:
        values = np.concatenate(np.broadcast_arrays(*(np.atleast_2d(v[name]) for name in names)), axis=1)
        return values[:, now.run]

    def start_values(group: Sequence[dict[str, float]], amounts: FloatArray) -> dict[str, float]:
        return {name: float(sum(m * each[name] for m, each in zip(amounts, group, strict=True))) for name in names}

    return Modulation(
        value_at,
        of_amplitude=lambda a, drawn: {name: a * drawn[name] for name in names},
        draw=lambda rng: dict(zip(names, rng.standard_normal(n).tolist(), strict=True)),
        bank=lambda a: [[{name: a * (name == names[k]) for name in names} for k in present]],
        start_values=start_values,
        steps=lambda a: {name: (a if k in present else 0.0) for k, name in enumerate(names)},
        covariates=("run",),
        reach=1.0,
    )


def wave_bank(a: float, rates: FloatArray, name: str) -> Bank:
    """Return the template bank of a wave: a group of sine and cosine of amplitude `a` for each rate (key `name`)."""
    return [[{"a": a, name: float(r), "phase": 0.0}, {"a": a, name: float(r), "phase": 0.5 * np.pi}] for r in rates]


def start_values_of_wave(group: Sequence[dict[str, float]], amounts: FloatArray) -> dict[str, float]:
    """Return amplitude and phase of the wave that is the sum of a group's sine and cosine times their coefficients."""
    sine, cosine = amounts * group[0]["a"]
    return {**group[0], "a": float(np.hypot(sine, cosine)), "phase": float(np.arctan2(cosine, sine))}


def sinusoid_in_time(true: TrueSystem, n: int) -> Modulation:
    """Return a sinusoid in time, its period from four rows to two thirds of the recording; its bank has n rates."""
    rows = true.table
    slowest, fastest = 1.5 / rows.duration, 0.25 / rows.median_gap
    return Modulation(
        lambda now, v: v["a"] * np.sin(2 * np.pi * v["hz"] * now.t + v["phase"]),
        draw=lambda rng: {"hz": draw_log_uniform(rng, slowest, fastest), "phase": float(rng.uniform(0, 2 * np.pi))},
        bank=lambda a: wave_bank(a, np.linspace(0.4 / rows.duration, 0.5 / rows.median_gap, n), "hz"),
        start_values=start_values_of_wave,
        steps=lambda a: {"a": a, "hz": 0.02 / rows.duration, "phase": 0.1},
        covariates=("time", str(rows.time)),
        reach=1.0,
        signed=False,
    )


def settling(true: TrueSystem) -> Modulation:
    """Return the modulation a exp(-t / tau_s), t the time since the start of the run."""
    longest = float(true.table.time_since_start.max())
    taus = np.geomspace(true.table.median_gap, longest, 12)
    return Modulation(
        lambda now, v: v["a"] * np.exp(-now.since / np.maximum(v["tau_s"], 1e-12)),
        draw=lambda rng: {"tau_s": draw_log_uniform(rng, 3 * true.table.median_gap, 0.4 * longest)},
        bank=lambda a: [[{"a": a, "tau_s": float(tau)}] for tau in taus],
        steps=lambda a: {"a": a, "tau_s": 0.05 * longest},
        covariates=("time", "run", str(true.table.time)),
        reach=1.0,
    )
