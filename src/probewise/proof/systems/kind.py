"""A kind of system: its simulator file, which the world reads too, and its experimental design."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias, cast

import numpy as np

from probewise._arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class SystemTable:
    """Rows in order of time; every array is (n_points,).

    `columns`: numeric columns by name, including time; `run`: number, from 0, of each row's run among all runs of a
    case including held-out ones; `time`: name of the time column; None if none was recorded; `n_runs`: number of runs
    of the case, including held-out ones.
    """

    columns: Mapping[str, FloatArray]
    run: IntArray
    time: str | None
    n_runs: int

    def __len__(self) -> int:
        return len(self.run)

    @cached_property
    def t(self) -> FloatArray:
        """Recorded time in the table's unit, or the index of the row if there is none."""
        return np.arange(float(len(self))) if self.time is None else self.columns[self.time]

    @cached_property
    def rows_by_run(self) -> Sequence[IntArray]:
        """Row indices of each run that has rows here, by run number."""
        found = (np.flatnonzero(self.run == k) for k in range(self.n_runs))
        return [rows for rows in found if rows.size]

    @cached_property
    def time_since_start(self) -> FloatArray:
        """Time since the first row of the run, (n_points,)."""
        out = np.empty(len(self))
        for rows in self.rows_by_run:
            out[rows] = self.t[rows] - self.t[rows[0]]
        return out

    @cached_property
    def median_gap(self) -> float:
        """Median time from a row to the next of its run, over all runs."""
        return float(np.median(np.concatenate([np.diff(self.t[rows]) for rows in self.rows_by_run])))

    @property
    def duration(self) -> float:
        """Largest minus smallest recorded time."""
        return float(np.ptp(self.t))

    def select_rows(self, kept: FloatArray | IntArray) -> SystemTable:
        """Return the table of the rows `kept` (indices); runs keep their numbers."""
        return replace(self, columns={name: values[kept] for name, values in self.columns.items()}, run=self.run[kept])


Values: TypeAlias = Mapping[str, Any]
"""Parameters, states or columns by name: arrays that broadcast."""

Columns: TypeAlias = dict[str, FloatArray]

Formula: TypeAlias = Callable[[Values, Values], Any]
"""Function of parameters and columns; returns the reading, row by row."""


@dataclass(frozen=True)
class Law:
    """A law in continuous time.

    `start`: initial value of each state: the name of a parameter, or a number; `rates`: function of states, parameters
    and columns; returns the rate of each state; `read`: function of states, parameters and columns; returns the
    reading; `linear`: whether inputs are interpolated linearly between rows; otherwise they are held.
    """

    start: Mapping[str, str | float]
    rates: Callable[[Values, Values, Values], dict[str, Any]]
    read: Callable[[Values, Values, Values], Any]
    linear: bool = False


Range: TypeAlias = tuple[float, float] | tuple[str, float, float]
"""Ends of a uniform distribution, or "normal" with mean and sd."""


def draw_values(ranges: Mapping[str, Range], rng: np.random.Generator) -> dict[str, float]:
    """Draw a value from each of these distributions, by name."""
    return {name: float(rng.normal(*of[1:]) if of[0] == "normal" else rng.uniform(*of)) for name, of in ranges.items()}


@dataclass(frozen=True, eq=False)
class SystemKind:
    """A kind of system.

    What the simulator file states (parameters, reading, time, runs, and its formula or law) is taken from its `text`,
    which is as a user would provide it; `{noise}` stands for its line on noise. True parameters are drawn from the
    ranges `shared` and, in each run, `of_run`. `design` draws the times of a run, from 0, and its columns, from (rng,
    n_rows, regime): the regime is 1, or larger for a run with inputs beyond the others' range. `decimals` are those of
    designed columns and time, `drives` the columns that the law uses, `sd` that of a reading's white noise. Irrelevant
    columns are `logged`: a random walk about a middle, scaled, plus noise of an sd in each row; then come the decimals,
    and what shifts the middle in the last held-out run, if anything does. `stated_law` is the law of a file that
    integrates by itself; `n_runs` are not held out.
    """

    name: str
    text: str
    shared: Mapping[str, Range]
    design: Callable[[np.random.Generator, int, float], tuple[FloatArray, Columns]]
    decimals: Mapping[str, int]
    drives: tuple[str, ...]
    sd: float
    of_run: Mapping[str, Range] = field(default_factory=dict)
    stated_law: Law | None = None
    restarts_time: bool = False
    logged: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    n_runs: int = 5
    reading_decimals: int = 4

    @cached_property
    def _file(self) -> dict[str, Any]:
        names: dict[str, Any] = {}
        exec(self.text.replace("{noise}\n", ""), names)
        return names

    @property
    def reading(self) -> str:
        """Name of the predicted column."""
        return str(self._file["reading"])

    @property
    def time(self) -> str | None:
        """Name of the time column, if any."""
        return self._file.get("time")

    @property
    def run(self) -> str | None:
        """Name of the column of runs, if any."""
        return self._file.get("run")

    @property
    def per_run(self) -> tuple[str, ...]:
        """Names of the parameters with a value in each run."""
        return tuple(self._file.get("per_run", ()))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self._file["parameters"])

    @property
    def column_decimals(self) -> dict[str, int]:
        """Decimals of each column of the table, and of the reading."""
        logged = {name: int(about[3]) for name, about in self.logged.items()}
        return {**self.decimals, **logged, self.reading: self.reading_decimals}

    @property
    def defines_states(self) -> bool:
        """Whether the simulator file defines states and rates; False: a formula, or it integrates by itself."""
        return "rates" in self._file

    @cached_property
    def law(self) -> Law | None:
        """The law in continuous time, if the system has one."""
        if not self.defines_states:
            return self.stated_law
        start = self._file["states"]
        first = next(iter(start))
        read = self._file.get("observe", lambda s, p, u: s[first])
        return Law(start, self._file["rates"], read, linear=self._file.get("hold") == "linear")

    @property
    def formula(self) -> Formula:
        """The formula of a system without a law."""
        return cast(Formula, self._file["simulate"])


_PAUSE = 0.15  # pause between runs, as a share of the first run's length


def irregular_times(rng: np.random.Generator, n: int, gap: float) -> FloatArray:
    """Draw n times from 0, whose gaps lie between 0.6 and 1.4 times `gap`, (n,)."""
    return np.concatenate([[0.0], np.cumsum(gap * rng.uniform(0.6, 1.4, n - 1))])


def random_steps(rng: np.random.Generator, n: int, levels: FloatArray, length: int) -> FloatArray:
    """Return random levels, none twice in succession, each held for 0.5 to 2 times `length` rows, (n,)."""
    out: list[float] = []
    while len(out) < n:
        choices = [level for level in levels if not out or level != out[-1]]
        out += [float(rng.choice(choices))] * int(rng.integers(max(length // 2, 2), 2 * length))
    return np.array(out[:n])


def random_waves(rng: np.random.Generator, t: FloatArray, size: float, fastest: float) -> FloatArray:
    """Return a sum of four sinusoids at times `t`, frequencies 0.1 to 1 times `fastest`, rms `size`; shape of `t`."""
    hz = fastest * rng.uniform(0.1, 1.0, 4)
    waves = np.sin(2 * np.pi * hz[:, None] * t + rng.uniform(0, 2 * np.pi, 4)[:, None])
    return np.asarray(size * waves.sum(axis=0) / np.sqrt(2.0))


def sweep_there_and_back(rng: np.random.Generator, n: int, low: float, high: float) -> FloatArray:
    """Return a rising and then a falling sweep between `low` and `high` in random steps, (n,)."""
    up = n // 2
    first, second = np.sort(rng.uniform(0, 1, up)), np.sort(rng.uniform(0, 1, n - up))[::-1]
    return np.asarray(low + (high - low) * np.concatenate([first, second]))


def design_runs(kind: SystemKind, *, rng: np.random.Generator) -> SystemTable:
    """Return the table of all runs of a case; the last two are held out, the last one is in a new range of inputs."""
    n_runs = kind.n_runs + 2
    each = int(np.clip(rng.integers(150, 420) // kind.n_runs, 24, 120))
    columns: dict[str, list[FloatArray]] = {}
    run: list[FloatArray] = []
    clock = 0.0
    for k in range(n_runs):
        n = int(each * rng.uniform(0.8, 1.2))
        regime = 1.5 if k == n_runs - 1 else 1.0
        t, own = kind.design(rng, n, regime)
        if not kind.restarts_time:
            t = t + clock
            clock = float(t[-1]) + _PAUSE * float(t[-1] - t[0]) * rng.uniform(0.5, 1.5) + float(t[1] - t[0])
        whole = {**own, **_irrelevant_columns(kind, n, regime, rng)}
        if kind.time is not None:
            whole[kind.time] = t
        for name, values in whole.items():
            columns.setdefault(name, []).append(np.round(values, kind.column_decimals[name]))
        run.append(np.full(n, k))
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    return SystemTable(joined, np.concatenate(run).astype(np.int64), kind.time, n_runs)


def _irrelevant_columns(kind: SystemKind, n: int, regime: float, rng: np.random.Generator) -> Columns:
    out = {}
    for name, (middle, wander, jitter, _, *beyond) in kind.logged.items():
        walk = np.cumsum(rng.standard_normal(n)) / np.sqrt(n) + rng.standard_normal()
        shifted = middle + sum(beyond) * (regime > 1)
        out[name] = shifted + wander * walk + jitter * rng.standard_normal(n)
    return out
