"""Runs that could be recorded next: a run repeated, reversed, slower, or with its controls moved otherwise."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.scheduling import MOST_READINGS
from probewise.recordings.plan import Plan
from probewise.systems import RunTable
from probewise.systems.table import append_tables, unused_name

_LEAST_ROWS = 4
_MOST_RUNS = 4  # recorded runs to start from
_SPELT = {
    1 / 60_000: "ms millisecond milliseconds",
    1 / 60: "s sec second seconds",
    1.0: "min minute minutes",
    60.0: "h hr hour hours",
    1440.0: "d day days",
    10_080.0: "week weeks",
    43_830.0: "month months",
    525_960.0: "a yr year years",
}
_MINUTES = {unit: minutes for minutes, units in _SPELT.items() for unit in units.split()}
_A_READING = 1 / 60  # minutes, where no time tells how long one takes
_BREAK = 0.5  # minutes, before a run
_RUN = "run"


@dataclass(frozen=True, eq=False)
class RunCommand:
    """One run that could be recorded: kind, description, rows without readings (`table`), and duration in minutes."""

    kind: str
    description: str
    table: RunTable
    minutes: float

    @property
    def plan(self) -> Plan:
        """The rows, as a plan."""
        return cast(Plan, self.table)


def possible_run_commands(table: RunTable, reading: str, controls: Sequence[str], time_unit: str) -> list[RunCommand]:
    """List the runs that could be recorded: recorded runs again, reversed, slower, or with a control moved otherwise.

    At most four recorded runs are taken, those that differ in their controls.

    Parameters
    ----------
    table
        The recorded rows.
    reading
        The predicted column, which is empty in rows yet to be taken.
    controls
        Columns that can be set; without any, runs can only be repeated.
    time_unit
        Unit of the table's time.
    """
    out: list[RunCommand] = []
    settable = [name for name in controls if name in table.covariates]
    ends = {name: _least_and_greatest(table.covariates[name]) for name in settable}
    for rows in _rows_of_distinct_runs(table, settable):
        name = table.scan_names[int(table.scan[rows[0]])]
        kept = rows[:: -(-len(rows) // MOST_READINGS)]
        of = f"run {name}" if table.run is not None else "the rows"
        for kind, words, columns, slower in _variations_of_run(table, kept, ends, of):
            called = unused_name(f"{name} {kind}", table.scan_names)
            made = _planned_run(table, kept, columns=columns, reading=reading, name=called, like=name, slower=slower)
            out.append(RunCommand(kind, words, made, _minutes_of_runs(made, time_unit)))
    return out


Change = tuple[str, str, Mapping[str, FloatArray], float]
"""Kind, words, the columns that are set, and how many times as long the run takes."""


def _variations_of_run(
    table: RunTable, rows: IntArray, ends: Mapping[str, tuple[float, float]], of: str
) -> Iterator[Change]:
    own = {name: table.covariates[name][rows] for name in ends}
    yield "again", f"take {of} again", {}, 1.0
    if not ends:
        return
    if any(np.ptp(values) > 0 for values in own.values()):
        yield (
            "reversed",
            f"take {of} with {_list_in_words(ends)} in reverse order",
            {k: v[::-1] for k, v in own.items()},
            1.0,
        )
    if table.has_varying_time:
        yield "slow", f"take {of} again, twice as slowly", {}, 2.0
    n = len(rows)
    share = np.linspace(0.0, 1.0, n)
    shapes: dict[str, tuple[str, Callable[[float, float], FloatArray]]] = {
        "up": ("swept from {low} to {high}", lambda low, high: low + (high - low) * share),
        "down": ("swept from {high} to {low}", lambda low, high: high + (low - high) * share),
        "up and down": (
            "swept from {low} to {high} and back", lambda low, high: low + (high - low) * (1 - np.abs(2 * share - 1)),
        ),
        "steps": ("switched between {low} and {high}, twice", lambda low, high: np.where(4 * share % 2 < 1, low, high)),
        "low": ("held at {low}", lambda low, high: np.full(n, low)),
        "middle": ("held at {middle}", lambda low, high: np.full(n, 0.5 * (low + high))),
        "high": ("held at {high}", lambda low, high: np.full(n, high)),
    }  # fmt: skip
    for name, (low, high) in ends.items():
        for kind, (said, shape) in shapes.items():
            text = said.format(low=f"{low:.4g}", high=f"{high:.4g}", middle=f"{0.5 * (low + high):.4g}")
            yield (
                f"{name} {kind}",
                f"take {of} with {name} {text}",
                {name: _rounded_to_range(shape(low, high), low, high)},
                1.0,
            )


def _rounded_to_range(values: FloatArray, low: float, high: float) -> FloatArray:
    """Round values to a thousandth of a range or finer, so that they can be set; those at its ends stay."""
    if not low < high:
        return values
    decimals = int(np.ceil(3 - np.log10(high - low)))
    return np.where((values == low) | (values == high), values, np.round(values, decimals))


def _planned_run(
    table: RunTable,
    rows: IntArray,
    columns: Mapping[str, FloatArray],
    reading: str,
    name: str,
    like: str,
    slower: float,
) -> RunTable:
    """Return rows of a table as a new run after it, called `name`: without readings, with `columns` set.

    The run takes `slower` times as long as the rows did; parameters per run are taken as in the run `like`.
    """
    taken = table.take(rows)
    changed: dict[str, Any] = {**columns}
    if reading in table.columns:
        changed[reading] = np.full(len(rows), np.nan)
    if table.time is not None:
        time = table.time_s[rows]
        begin = time[0] if table.time_begins_anew else _next_start_time(table)
        changed[table.time] = begin + slower * (time - time[0])
    run = table.run or unused_name(_RUN, table.columns)
    changed[run] = np.full(len(rows), name)
    return replace(
        taken,
        columns={**taken.columns, **changed},
        run=run,
        like={name: table.like.get(like, like)},
        first_row=len(table),
    )


def _next_start_time(table: RunTable) -> float:
    """Return the time at which a run after a table starts: the median pause between runs later, or ten rows."""
    by_run = [table.time_s[rows] for rows in table.rows_by_scan()]
    between = [later[0] - earlier[-1] for earlier, later in itertools.pairwise(by_run)]
    gaps = np.concatenate([np.diff(time) for time in by_run])
    gap = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0
    apart = [pause for pause in between if pause > 0]
    return float(table.time_s.max()) + (float(np.median(apart)) if apart else 10 * gap)


def plan_of_alternatives(commands: Sequence[RunCommand], after: Plan) -> Plan:
    """Concatenate alternative runs, each timed as if it came next, to predict all of them at once."""
    first, *more = (command.table for command in commands)
    return cast(Plan, append_tables(first, more))


def plan_of_sequence(commands: Sequence[RunCommand], after: Plan) -> Plan:
    """Concatenate runs to be recorded in sequence: each begins after the one before, unless time restarts with each."""
    recorded = cast(RunTable, after)
    out: list[RunTable] = []
    for command in commands:
        table = command.table
        if table.time is not None and not recorded.time_begins_anew and out:
            later = float(out[-1].time_s[-1]) + _next_start_time(recorded) - float(recorded.time_s.max())
            table = table.with_columns({table.time: table.time_s - table.time_s[0] + later})
        out.append(table)
    return cast(Plan, append_tables(out[0], out[1:]))


def _rows_of_distinct_runs(table: RunTable, controls: Sequence[str]) -> list[IntArray]:
    """Return the row numbers of the first four runs, of four rows or more, that differ in their controls."""
    seen: dict[tuple[object, ...], IntArray] = {}
    size = {name: float(np.nanmax(np.abs(table.covariates[name]))) or 1.0 for name in controls}
    for rows in table.rows_by_scan():
        if len(rows) >= _LEAST_ROWS:
            own = tuple(np.round(table.covariates[name][rows] / size[name], 9).tobytes() for name in controls)
            seen.setdefault(own or (int(table.scan[rows[0]]),), rows)
    return list(seen.values())[:_MOST_RUNS]


def _least_and_greatest(values: FloatArray) -> tuple[float, float]:
    return float(np.nanmin(values)), float(np.nanmax(values))


def is_known_duration(table: RunTable, time_unit: str) -> bool:
    """Return whether a table tells how long its rows take: it has a time, in a unit that is known."""
    return _minutes_of_time_unit(table, time_unit) is not None


def _minutes_of_runs(table: RunTable, time_unit: str) -> float:
    minutes = _minutes_of_time_unit(table, time_unit)
    if minutes is None:
        return _BREAK + len(table) * _A_READING
    return _BREAK + float(np.ptp(table.time_s)) * minutes


def _minutes_of_time_unit(table: RunTable, time_unit: str) -> float | None:
    """Return how many minutes a unit of a table's time has; None without a time, or in an unknown unit."""
    return None if table.time is None else _MINUTES.get(time_unit.strip().rstrip(".").lower())


def _list_in_words(names: Mapping[str, object]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last
