"""A law with what effects add to it, its readings, and its parameters and columns between the rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray, IntArray, floats
from probewise.errors import ShapeError
from probewise.systems.calls import call_on_read_only, call_on_views, read_only_views
from probewise.systems.simulator import Columns, Law, Values
from probewise.systems.step import Steps
from probewise.systems.table import RunTable

_ROUNDING = 16  # last digits of a time by which two times may differ by rounding alone

_NO_WAYS: Mapping[int, Any] = MappingProxyType({})

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
        own: dict[str, Any] = {}
        for what, new in more.items():
            known = getattr(self, what)
            if isinstance(new, tuple):
                own[what] = (*known, *new)
            else:
                own[what] = {**known, **{name: known[name] + v if name in known else v for name, v in new.items()}}
        return replace(self, **own)

    @property
    def may_halt(self) -> bool:
        """Whether a state may come to a halt within a step."""
        return bool(self.limits or self.friction)

    @cached_property
    def friction_of(self) -> dict[int, FloatArray]:
        """The size of the friction by the number of the state."""
        return {[*self.law.states].index(state): size for state, size in self.friction.items()}

    def directions_of_motion(self, s: FloatArray, given: tuple[Values, Values]) -> dict[int, Any]:
        """Return, by number of the state with friction, the direction of its next motion: 1, -1, or 0 if it sticks."""
        ways: dict[int, Any] = {state: np.sign(s[state]) for state in self.friction_of}
        if any((way == 0).any() for way in ways.values()):
            free = self.rates(s, given)
            for state, size in self.friction_of.items():
                breaks_loose = np.where(np.abs(free[state]) > size, np.sign(free[state]), 0.0)
                ways[state] = np.where(s[state] != 0, ways[state], breaks_loose)
        return ways

    def rates(self, s: FloatArray, given: tuple[Values, Values], ways: Mapping[int, Any] = _NO_WAYS) -> FloatArray:
        """Return the rates of states, (n_states, n_samples, n_columns), with bounds, and friction against `ways`.

        `given` are parameters and columns, read-only, as `StepInputs` returns them.
        """
        at: Any = s.view()
        at.setflags(False)  # of writing; a keyword would double the time
        out = np.empty(s.shape)
        by_name, rate = dict(zip(self.law.states, at, strict=True)), dict(zip(self.law.states, out, strict=True))
        found = call_on_read_only(self.law.rates, by_name, *given)
        for state in rate:
            rate[state][:] = found[state]
        for state, term in self.terms:
            rate[state] += term(by_name, *given)
        for number, way in ways.items():
            out[number] = np.where(way == 0, 0.0, out[number] - self.friction_of[number] * way)
        for limit in self.limits:
            own, here = rate[limit.state], by_name[limit.state]
            stopped = (here >= limit.level) & (own > 0) if limit.upper else (here <= limit.level) & (own < 0)
            lost = np.where(stopped, own, 0.0)
            own[stopped] = 0.0
            for other, share in limit.spilt.items():
                rate[other] += share * lost
        return out

    def clip_and_stop_states(self, ways: Mapping[int, Any], after: FloatArray) -> FloatArray:
        """Clip states after a step to their bounds, and set those to 0 that reversed against friction, in place."""
        for number, way in ways.items():
            after[number] = np.where(way * after[number] < 0, 0.0, after[number])
        state = dict(zip(self.law.states, after, strict=True))
        for limit in self.limits:
            bound, before = np.minimum if limit.upper else np.maximum, state[limit.state].copy()
            state[limit.state][:] = bound(before, limit.level)
            for other, share in limit.spilt.items():
                state[other] += share * (before - state[limit.state])
        return after


def readings_of_states(law: Law, states: Values, parameters: Values, columns: Values) -> FloatArray:
    """Return a law's readings, (n_samples, n_points), from its states at every row, each of that shape."""
    first: FloatArray = next(iter(states.values()))
    if law.observe is None:
        return first
    with np.errstate(all="ignore"):
        out = floats(call_on_views(law.observe, states, parameters, columns), "what observe returns")
    try:
        return np.array(np.broadcast_to(out, first.shape))
    except ValueError:
        allowed = f"{first.shape} or one that broadcasts to it: a number for each sample and row"
        raise ShapeError(f"observe returns an array of shape {out.shape}; allowed: {allowed}") from None


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

    def line_at(self, at: FloatArray, run: IntArray, start: FloatArray) -> tuple[Any, Any]:
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
    """Parameters and columns by name, in that order, read-only: at the start of a gap, and their rise over it if any.

    Over a table arrays are (1 or n_samples, n_places, n_runs), those of a constant (1 or n_samples, 1, 1 or n_runs);
    of some steps (1 or n_samples, n_columns), with a column for each step and run, the runs of a step in turn, or 1.
    `time` is the name of the time, which always rises.
    """

    time: str
    start: tuple[Values, Values]
    rise: tuple[Values, Values]

    @property
    def gap(self) -> Any:
        """Time of the gap by the time column, which an effect on the clock changes, (1 or n_samples, n_columns)."""
        return self.rise[1][self.time]

    def __call__(self, share: Any) -> tuple[Values, Values]:
        """Return parameters and columns, by name, at a share of the gap between rows: read-only arrays."""
        return _at_share(self.start[0], self.rise[0], share), _at_share(self.start[1], self.rise[1], share)

    def mapped(self, chosen: Callable[[Any], Any]) -> StepInputs:
        """Return them with a function applied to every array."""
        p, u, dp, du = ({name: chosen(v) for name, v in each.items()} for each in (*self.start, *self.rise))
        for values in (*p.values(), *u.values()):
            values.setflags(False)
        return StepInputs(self.time, (p, u), (dp, du))

    def of_columns(self, columns: IntArray) -> StepInputs:
        """Return them in some of the columns."""
        return self.mapped(partial(of_columns, columns=columns))


def _at_share(start: Values, rise: Values, share: Any) -> Values:
    if not rise:
        return start
    out = dict(start)
    for name, by in rise.items():
        out[name] = value = out[name] + share * by
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
        rows, table, linear = steps.rows, steps.table, motion.law.hold == "linear"
        p, u, dp, du = ({} for _ in range(4))
        for name, values in parameters.items():
            for jump in motion.jumps:
                if jump.parameter == name:  # it is added where it is, within a gap
                    values = values - jump.size * (table.time_s > jump.at)
            p[name] = own = values_at_rows(values, rows)
            if own.shape[1] == 1 or not np.ptp(own, axis=1).any():
                p[name] = own[:, :1]
            elif linear:
                dp[name] = np.diff(own, axis=1)
            elif name in motion.drifts:
                dp[name] = motion.drifts[name][:, :, None] * steps.gaps
        for name, values in columns.items():
            u[name] = own = values_at_rows(values, rows)
            if name == table.time or (linear and values.dtype == np.float64):
                du[name] = np.diff(own, axis=1)
        self.steps, self.jumps = steps, motion.jumps
        self.over_table = StepInputs(str(table.time), (p, u), (dp, du))
        late = motion.dead_times.items()
        self.late = {name: LateColumn(table, columns[name], by, linear=linear) for name, by in late}

    def of_gaps(self, gaps: IntArray | slice, n_gaps: int) -> StepInputs:
        """Return parameters and columns in some of the gaps between positions, of several steps one after the other."""

        def in_gaps(values: Any) -> Any:
            if values.shape[1] > 1:
                return values[:, gaps].reshape(len(values), -1)
            constant = values[:, 0]
            return np.tile(constant, (1, n_gaps)) if n_gaps > 1 and constant.shape[1] > 1 else constant

        return self.over_table.mapped(in_gaps)

    def parts_of_steps(self, inputs: StepInputs, gap: IntArray, begin: Any, length: Any) -> Iterator[StepPart]:
        """Divide steps where inputs jump or bend, a late column or a parameter with a jump; yield the parts in turn.

        `gap` is that of each step, (n_steps,), with the shares of it at which the step begins, and that it takes:
        numbers, or one per step and run.
        """
        if not (self.late or self.jumps):
            yield None, inputs, begin, length
            return
        rows, time = self.steps.rows, self.steps.table.time_s
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
            some = np.flatnonzero(going)
            columns, run, inputs = columns[some], run[some], inputs.of_columns(some)
            start, gap_s, end, share = start[some], gap_s[some], end[some], until[:, some]

    def _with_breaks(
        self, inputs: StepInputs, at: FloatArray, run: IntArray, start: FloatArray, gap_s: FloatArray
    ) -> StepInputs:
        """Return inputs with the late columns and the parameters with jumps as they are around the times `at`."""
        (p, u), (dp, du) = map(dict, inputs.start), map(dict, inputs.rise)
        for name, late in self.late.items():
            u[name], slope = late.line_at(at, run, start)
            if late.linear:
                du[name] = slope * gap_s
        for jump in self.jumps:
            p[jump.parameter] = p[jump.parameter] + jump.size * (at > jump.at)
        return replace(inputs, start=(read_only_views(p), read_only_views(u)), rise=(dp, du))


def of_columns(values: Any, columns: IntArray) -> Any:
    """Return some columns of values by column, (n_columns,) or (n, n_columns); a number is that of all columns."""
    return values[..., columns] if np.ndim(values) and values.shape[-1] > 1 else values


def values_at_rows(values: NDArray[Any], rows: IntArray) -> NDArray[Any]:
    """Index values (n_points,) or (n_samples, n_points) by rows (n_places, n_runs); (n, 1) becomes (n, 1, 1)."""
    if values.ndim == 1:
        return np.asarray(values[rows][None])
    return values[:, :, None] if values.shape[1] == 1 else np.asarray(values[:, rows])
