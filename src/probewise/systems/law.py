"""A law with what effects add to it, its readings, and its parameters and columns between the rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray, IntArray, floats
from probewise.errors import ShapeError
from probewise.systems.calls import call_on_read_only, read_only_views
from probewise.systems.simulator import Columns, Law, Values
from probewise.systems.step import Steps
from probewise.systems.table import RunTable

_ROUNDING = 16  # last digits of a time by which two times may differ by rounding alone

Term = Callable[[Values, Values, Values], Any]
"""A term of a state's rate: function of states, parameters and columns; returns (n_samples, n_runs)."""


@dataclass(frozen=True, eq=False)
class Limit:
    """A bound of a state: `level` (n_samples, 1), an upper bound if `upper`, else a lower bound.

    The rate beyond the bound is lost, except for shares that other states take up: `spilt`, by state, (n_samples, 1).
    """

    state: str
    level: FloatArray
    upper: bool = True
    spilt: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Jump:
    """A jump of a parameter by `size` after the time `at`, as printed, (n_samples, 1) each."""

    parameter: str
    size: FloatArray
    at: FloatArray


@dataclass(frozen=True, eq=False)
class LawWithEffects:
    """A law with the contributions of effects: additional terms of rates, dry friction, bounds, inputs between rows.

    `friction` is, by state, the size of the force against its motion, (n_samples, 1): a state at rest sticks until the
    other terms of its rate exceed it. Between the rows columns act after `dead_times`, parameters have `drifts`, slopes
    in time as printed, by name, (n_samples, 1) each, and `jumps`; the law's `hold` alone determines the rest.
    """

    law: Law
    terms: tuple[tuple[str, Term], ...] = ()
    friction: Mapping[str, FloatArray] = field(default_factory=dict)
    limits: tuple[Limit, ...] = ()
    dead_times: Mapping[str, FloatArray] = field(default_factory=dict)
    drifts: Mapping[str, FloatArray] = field(default_factory=dict)
    jumps: tuple[Jump, ...] = ()

    def plus(self, **more: Any) -> LawWithEffects:
        """Return the law with more `terms`, `limits` or `jumps`, or values by name, of which two of one name add up."""

        def with_more(known: Any, new: Any) -> Any:
            if isinstance(new, tuple):
                return (*known, *new)
            return {**known, **{name: known[name] + value if name in known else value for name, value in new.items()}}

        return replace(self, **{name: with_more(getattr(self, name), new) for name, new in more.items()})

    def directions_of_motion(self, s: Values, p: Values, u: Values) -> dict[str, Any]:
        """Return, by state with friction, the direction of motion in the next step: 1, -1, or 0 if it sticks."""
        if not self.friction:
            return {}
        if all((s[state] != 0).all() for state in self.friction):
            return {state: np.sign(s[state]) for state in self.friction}
        free = self.rates(s, p, u, {})
        return {
            state: np.where(
                s[state] != 0, np.sign(s[state]), np.where(np.abs(free[state]) > size, np.sign(free[state]), 0.0)
            )
            for state, size in self.friction.items()
        }

    def rates(self, s: Values, p: Values, u: Values, ways: Values) -> Values:
        """Return the rates by state, from states, parameters and columns, with bounds, and friction against `ways`.

        `p` and `u` are read-only, as an interpolator of `LawInputs` returns them; so are the states `s` afterwards.
        """
        for values in s.values():
            values.setflags(False)  # of writing; a keyword would double the time
        given: Values = call_on_read_only(self.law.rates, s, p, u)
        if not (self.terms or self.friction or self.limits):
            return given
        out = {state: given[state] for state in self.law.states}
        for state, term in self.terms:
            out[state] = out[state] + term(s, p, u)
        for state, way in ways.items():
            out[state] = np.where(way == 0, 0.0, out[state] - self.friction[state] * way)
        for limit in self.limits:
            rate, at = out[limit.state], s[limit.state]
            stopped = (at >= limit.level) & (rate > 0) if limit.upper else (at <= limit.level) & (rate < 0)
            out[limit.state] = np.where(stopped, 0.0, rate)
            for other, share in limit.spilt.items():
                out[other] = out[other] + share * np.where(stopped, rate, 0.0)
        return out

    def clip_and_stop_states(self, ways: Values, after: dict[str, Any]) -> dict[str, Any]:
        """Return the states after a step: clipped to their bounds, and 0 where they reversed against friction."""
        for state, way in ways.items():
            after[state] = np.where(way * after[state] < 0, 0.0, after[state])
        for limit in self.limits:
            bound, before = np.minimum if limit.upper else np.maximum, after[limit.state]
            after[limit.state] = bound(before, limit.level)
            for other, share in limit.spilt.items():
                after[other] = after[other] + share * (before - after[limit.state])
        return after


def readings_of_states(law: Law, states: Values, parameters: Values, columns: Values) -> FloatArray:
    """Return a law's readings, (n_samples, n_points), from its states at every row, each of that shape."""
    first: FloatArray = next(iter(states.values()))
    if law.observe is None:
        return first
    with np.errstate(all="ignore"):
        given = map(read_only_views, (states, parameters, columns))
        out = floats(call_on_read_only(law.observe, *given), "what observe returns")
    try:
        return np.array(np.broadcast_to(out, first.shape))
    except ValueError:
        allowed = f"{first.shape} or one that broadcasts to it: a number for each sample and row"
        raise ShapeError(f"observe returns an array of shape {out.shape}; allowed: {allowed}") from None


Line = tuple[Any, Any]
"""A value at the beginning of a gap between rows, and its rise over the gap or its slope in time."""


def rounding_of_times(times: FloatArray) -> float:
    """Return the difference of two times that may be that of rounding alone."""
    return float(_ROUNDING * np.spacing(np.abs(times).max()))


class LateColumn:
    """A column, (n_points,) or (n_samples, n_points), that acts after a dead time, (n_samples, 1).

    Before a run, its first value holds. All rows are on one line of time, run after run, so that one search finds the
    rows of all runs: `shift` places the times of each run there, and `margin` beyond either end is of no other run.
    """

    def __init__(self, table: RunTable, column: FloatArray, dead_time: FloatArray, *, linear: bool) -> None:
        rows = np.concatenate(table.rows_by_scan())
        run, time = table.scan[rows], table.time_s[rows]
        is_first = np.append(True, run[1:] != run[:-1])
        self.begins = np.flatnonzero(is_first)
        self.first, self.last = time[self.begins], time[np.append(self.begins[1:], len(time)) - 1]
        width = float((self.last - self.first).max()) or 1.0
        self.margin, self.shift = 0.25 * width, 2 * width * np.arange(len(self.first)) - self.first
        self.at = time + self.shift[run]
        self.rounding = rounding_of_times(np.append(table.time_s, self.at[-1]))
        self.dead_time, self.linear = dead_time, linear
        self.values = np.atleast_2d(column)[:, rows]
        gap = np.append(np.diff(self.at), 1.0)
        ends = np.append(is_first[1:], True) | (gap <= 0)
        self.slopes = np.zeros((1, 1))
        if linear:
            with np.errstate(divide="ignore", invalid="ignore"):
                self.slopes = np.where(ends, 0.0, np.diff(self.values, axis=1, append=0.0) / gap)
        course = self.slopes if linear else self.values
        changes = np.any(np.diff(course, axis=1, prepend=course[:, :1]) != 0, axis=0)
        changes = changes | is_first | np.append(False, gap[:-1] <= 0) if linear else changes & ~is_first
        self.breaks = self.at[changes]
        """Places on the line at which the column jumps, or bends where it is linear."""

    def next_break(self, now: FloatArray, run: IntArray) -> FloatArray:
        """Return the time of the next break after `now`, (n_samples, n_columns); infinite if none is left."""
        first, last = self.first[run] - self.margin, self.last[run] + self.margin
        sought = np.clip(now - self.dead_time, first, last) + self.shift[run] + self.rounding
        at = np.append(self.breaks, np.inf)[np.searchsorted(self.breaks, sought, side="right")]
        return np.asarray(at - self.shift[run] + self.dead_time)

    def line_at(self, at: FloatArray, run: IntArray, start: FloatArray) -> Line:
        """Return its straight line around the times `at`, (n_samples, n_columns): value at `start`, slope in time."""
        earlier = at - self.dead_time
        before = earlier < self.first[run]
        inside = np.clip(earlier, self.first[run], self.last[run]) + self.shift[run]
        row = np.where(before, self.begins[run], np.searchsorted(self.at, inside, side="right") - 1)
        value = _of_rows(self.values, row)
        if not self.linear:
            return value, 0.0
        slope = np.where(before, 0.0, _of_rows(self.slopes, row))
        return value + slope * (start - self.dead_time - (self.at[row] - self.shift[run])), slope


def _of_rows(values: FloatArray, row: IntArray) -> FloatArray:
    """Take values (1 or n_samples, n_points) at rows (1 or n_samples, n_columns)."""
    sample = np.arange(len(values))[:, None] if len(values) > 1 else 0
    return np.asarray(values[sample, row])


@dataclass(frozen=True, eq=False)
class StepInputs:
    """Parameters and columns, in that order, by name: `held` over a gap, read-only, or on straight `lines` over it.

    Over a table arrays are (1 or n_samples, n_places, n_runs), those of a constant (1 or n_samples, 1, 1 or n_runs);
    of some steps (1 or n_samples, n_columns), with a column for each step and run, the runs of a step in turn, or 1.
    `time` is the name of the time, which is always on such a line.
    """

    time: str
    held: tuple[Values, Values]
    lines: tuple[Mapping[str, Line], Mapping[str, Line]]

    @property
    def gap(self) -> Any:
        """Time of the gap by the time column, which an effect on the clock changes, (1 or n_samples, n_columns)."""
        return self.lines[1][self.time][1]

    def __call__(self, share: Any) -> tuple[Values, Values]:
        """Return parameters and columns, by name, at a share of the gap between rows: read-only arrays."""
        (p, u), (moving, sloping) = self.held, self.lines
        return _values_on_lines(p, moving, share), _values_on_lines(u, sloping, share)

    def mapped(self, chosen: Callable[[Any], Any]) -> StepInputs:
        """Return them with a function applied to every array."""
        p, u = ({name: chosen(values) for name, values in each.items()} for each in self.held)
        for values in (*p.values(), *u.values()):
            values.setflags(False)
        moving, sloping = ({name: (chosen(v), chosen(d)) for name, (v, d) in each.items()} for each in self.lines)
        return replace(self, held=(p, u), lines=(moving, sloping))

    def of_columns(self, columns: IntArray) -> StepInputs:
        """Return them in some of the columns."""
        return self.mapped(partial(of_columns, columns=columns))


def _values_on_lines(held: Values, lines: Mapping[str, Line], share: Any) -> Values:
    if not lines:
        return held
    out = dict(held)
    for name, (low, rise) in lines.items():
        out[name] = value = low + share * rise
        value.setflags(False)  # of writing; a keyword would double the time
    return out


StepPart = tuple[IntArray | None, StepInputs, Any, Any]
"""A part of some steps in which no input jumps or bends: columns, inputs, begin and length.

The first are indices of columns of the states' arrays, None: all; the last are shares of the gap between rows, numbers
or arrays with one value per column.
"""


class LawInputs:
    """Parameters and columns of a law over the table of its steps, (n_points,) or (n_samples, n_points) each.

    Parameters that vary from row to row go on between the rows as columns do, since a column moves them; `motion` has
    their drifts and jumps, and the columns that are late.
    """

    def __init__(self, motion: LawWithEffects, steps: Steps, parameters: Values, columns: Columns) -> None:
        rows, table, linear = steps.row_by_position_and_run, steps.table, motion.law.hold == "linear"
        held: dict[str, Any] = {}
        moving: dict[str, Line] = {}
        for name, values in parameters.items():
            for jump in motion.jumps:
                if jump.parameter == name:  # it is added where it is, within a gap
                    values = values - jump.size * (table.time_s > jump.at)
            own = values_at_rows(values, rows)
            if own.shape[1] == 1 or not np.ptp(own, axis=1).any():
                held[name] = own[:, :1]
            elif linear:
                moving[name] = own, np.diff(own, axis=1)
            elif name in motion.drifts:
                moving[name] = own, motion.drifts[name][:, :, None] * steps.gaps
            else:
                held[name] = own
        still: dict[str, Any] = {}
        sloping: dict[str, Line] = {}
        for name, values in columns.items():
            own = values_at_rows(values, rows)
            if name == table.time or (linear and values.dtype == np.float64):
                sloping[name] = own, np.diff(own, axis=1)
            else:
                still[name] = own
        values_at_places = read_only_views(held), read_only_views(still)
        self.steps, self.jumps = steps, motion.jumps
        self.over_table = StepInputs(str(table.time), values_at_places, (moving, sloping))
        self.late = {
            name: LateColumn(table, columns[name], dead_time, linear=linear)
            for name, dead_time in motion.dead_times.items()
        }

    def of_gaps(self, gaps: IntArray | slice, n_gaps: int) -> StepInputs:
        """Return parameters and columns in some of the gaps between positions, of several steps one after the other."""

        def in_gaps(values: Any) -> Any:
            if values.shape[1] > 1:
                return values[:, gaps].reshape(len(values), -1)
            constant = values[:, 0]
            return np.tile(constant, (1, n_gaps)) if n_gaps > 1 and constant.shape[1] > 1 else constant

        return self.over_table.mapped(in_gaps)

    def parts_of_steps(
        self, inputs: StepInputs, gap: IntArray, begin: Any, length: Any, *, whole: bool
    ) -> Iterator[StepPart]:
        """Divide steps where inputs jump or bend, a late column or a parameter with a jump; yield the parts in turn.

        `gap` is that of each step, (n_steps,), with the shares of it at which the step begins, and that it takes:
        numbers, or one per step and run. Each part has all columns of the states if `whole`, so that runs are together;
        else those alone that have one.
        """
        if not (self.late or self.jumps):
            yield None, inputs, begin, length
            return
        rows, time = self.steps.row_by_position_and_run, self.steps.table.time_s
        run, rounding = np.tile(np.arange(rows.shape[1]), len(gap)), rounding_of_times(time)
        n_columns = len(run)
        start, gap_s = time[rows[gap]].ravel(), self.steps.gaps[gap].ravel()
        end = np.broadcast_to(begin + length, n_columns)
        share = np.broadcast_to(begin, (1, n_columns))
        columns = np.arange(n_columns)
        while True:
            now, last = start + share * gap_s, start + end * gap_s
            stop: Any = np.inf  # time of the next jump or bend, infinite if none is left
            for late in self.late.values():
                stop = np.minimum(stop, late.next_break(now, run))
            for jump in self.jumps:
                stop = np.minimum(stop, np.where(jump.at > now + rounding, jump.at, np.inf))
            over = ~(stop < last)
            part = self._with_breaks(inputs, 0.5 * (now + np.where(over, last, stop)), run, start, gap_s)
            with np.errstate(divide="ignore", invalid="ignore"):
                until = np.where(over, end, (stop - start) / gap_s)
            yield None if len(columns) == n_columns else columns, part, share, until - share
            going = ~over.all(axis=0)
            if not going.any():
                return
            share = until
            if not whole:
                some = np.flatnonzero(going)
                columns, run = columns[some], run[some]
                start, gap_s, end, share = start[some], gap_s[some], end[some], share[:, some]
                inputs = inputs.of_columns(some)

    def _with_breaks(
        self, inputs: StepInputs, at: FloatArray, run: IntArray, start: FloatArray, gap_s: FloatArray
    ) -> StepInputs:
        """Return inputs with the late columns and the parameters with jumps as they are around the times `at`."""
        (p, u), (moving, sloping) = map(dict, inputs.held), map(dict, inputs.lines)
        for name, late in self.late.items():
            value, slope = late.line_at(at, run, start)
            if late.linear:
                sloping[name] = value, slope * gap_s
            else:
                u[name] = value
        for jump in self.jumps:
            name, own = jump.parameter, jump.size * (at > jump.at)
            if name in moving:
                moving[name] = moving[name][0] + own, moving[name][1]
            else:
                p[name] = p[name] + own
        return replace(inputs, held=(read_only_views(p), read_only_views(u)), lines=(moving, sloping))


def of_columns(values: Any, columns: IntArray) -> Any:
    """Return some columns of values by column, (n_columns,) or (n, n_columns); a number is that of all columns."""
    return values[..., columns] if np.ndim(values) and values.shape[-1] > 1 else values


def values_at_rows(values: NDArray[Any], rows: IntArray) -> NDArray[Any]:
    """Index values (n_points,) or (n_samples, n_points) by rows (n_places, n_runs); (n, 1) becomes (n, 1, 1)."""
    if values.ndim == 1:
        return np.asarray(values[rows][None])
    return values[:, :, None] if values.shape[1] == 1 else np.asarray(values[:, rows])
