"""Parameters and columns of a law between the rows: held, on straight lines, late, or with a jump."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray, IntArray
from probewise.systems.calls import read_only_views
from probewise.systems.simulator import Law
from probewise.systems.step import RowsInRuns

_ROUNDING = 16  # last digits of a time by which two times may differ by rounding alone


Line = tuple[Any, Any]
"""A value at the beginning of a gap between rows, and its rise over the gap or its slope in time."""


def rounding_of_times(times: FloatArray) -> float:
    """Return the difference of two times that may be that of rounding alone."""
    return float(_ROUNDING * np.spacing(np.abs(times).max()))


@dataclass(frozen=True, eq=False)
class Timeline:
    """All rows of a table on one line of time, run after run, so that one search finds the rows of all runs."""

    places: RowsInRuns

    @cached_property
    def rows(self) -> IntArray:
        """The rows, run by run."""
        return np.concatenate(self.places.table.rows_by_scan())

    @cached_property
    def is_first(self) -> NDArray[np.bool_]:
        """Mask of the first row of each run, in the order of `rows`."""
        run = self.places.table.scan[self.rows]
        return np.append(True, run[1:] != run[:-1])

    @cached_property
    def first_and_last(self) -> tuple[FloatArray, FloatArray]:
        """Times, as printed, at which each run begins and ends, (n_runs,) each."""
        time = self.places.table.time_s[self.rows]
        at = np.flatnonzero(self.is_first)
        return time[at], time[np.append(at[1:], len(time)) - 1]

    @cached_property
    def width(self) -> float:
        """Time of the longest run; 1 if none has any."""
        first, last = self.first_and_last
        return float((last - first).max()) or 1.0

    @cached_property
    def shift(self) -> FloatArray:
        """What is added to a time of each run to place it on the line, (n_runs,)."""
        first, _ = self.first_and_last
        return np.asarray(2 * self.width * np.arange(len(first)) - first)

    @cached_property
    def at(self) -> FloatArray:
        """Place of each of `rows` on the line."""
        return np.asarray(self.places.table.time_s[self.rows] + self.shift[self.places.table.scan[self.rows]])

    @cached_property
    def rounding(self) -> float:
        """Difference of two places that may be that of rounding alone."""
        return rounding_of_times(np.append(self.places.table.time_s, self.at[-1]))

    def places_of(self, times: FloatArray, run: IntArray) -> FloatArray:
        """Place times as printed, (n_samples, n_columns), of runs `run` (n_columns,), on the line."""
        first, last = self.first_and_last
        margin = 0.25 * self.width
        return np.asarray(np.clip(times, first[run] - margin, last[run] + margin) + self.shift[run])


@dataclass(frozen=True, eq=False)
class LateColumn:
    """A column that acts after a dead time, (n_samples, 1); before a run, its first value holds.

    `values` and `slopes` are those of the rows on the timeline, (1 or n_samples, n_points); `breaks` are the places on
    it at which the column itself jumps, or bends where it is `linear`.
    """

    timeline: Timeline
    values: FloatArray
    slopes: FloatArray
    breaks: FloatArray
    dead_time: FloatArray
    linear: bool

    @classmethod
    def of(cls, timeline: Timeline, column: FloatArray, dead_time: FloatArray, *, linear: bool) -> LateColumn:
        """Find where a column, (n_points,) or (n_samples, n_points), jumps or bends."""
        values = np.atleast_2d(column)[:, timeline.rows]
        gap = np.append(np.diff(timeline.at), 1.0)
        ends = np.append(timeline.is_first[1:], True) | (gap <= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = np.where(ends, 0.0, np.diff(values, axis=1, append=0.0) / gap) if linear else np.zeros((1, 1))
        course = slopes if linear else values
        changes = np.any(np.diff(course, axis=1, prepend=course[:, :1]) != 0, axis=0)
        if linear:
            changes |= timeline.is_first | np.append(False, gap[:-1] <= 0)
        else:
            changes &= ~timeline.is_first
        return cls(timeline, values, slopes, timeline.at[changes], dead_time, linear)

    def next_break(self, now: FloatArray, run: IntArray) -> FloatArray:
        """Return the time of the next break after `now`, (n_samples, n_columns); infinite if none is left."""
        sought = self.timeline.places_of(now - self.dead_time, run) + self.timeline.rounding
        at = np.append(self.breaks, np.inf)[np.searchsorted(self.breaks, sought, side="right")]
        return np.asarray(at - self.timeline.shift[run] + self.dead_time)

    def line_at(self, at: FloatArray, run: IntArray, start: FloatArray) -> Line:
        """Return its straight line around the times `at`, (n_samples, n_columns): value at `start`, slope in time."""
        line, earlier = self.timeline, at - self.dead_time
        first, last = line.first_and_last
        before = earlier < first[run]
        inside = np.clip(earlier, first[run], last[run]) + line.shift[run]
        row = np.searchsorted(line.at, inside, side="right") - 1
        row = np.where(before, np.flatnonzero(line.is_first)[run], row)
        value = _of_rows(self.values, row)
        if not self.linear:
            return value, 0.0
        slope = np.where(before, 0.0, _of_rows(self.slopes, row))
        return value + slope * (start - self.dead_time - (line.at[row] - line.shift[run])), slope


def _of_rows(values: FloatArray, row: IntArray) -> FloatArray:
    """Take values (1 or n_samples, n_points) at rows (1 or n_samples, n_columns)."""
    sample = np.arange(len(values))[:, None] if len(values) > 1 else 0
    return np.asarray(values[sample, row])


Pair = tuple[Mapping[str, Any], Mapping[str, Any]]
"""Parameters and columns by name."""


@dataclass(frozen=True, eq=False)
class Jump:
    """A jump of a parameter by `size` after the time `at`, as printed, (n_samples, 1) each."""

    parameter: str
    size: FloatArray
    at: FloatArray


@dataclass(frozen=True, eq=False)
class BetweenRows:
    """What effects do between the rows; the law's `hold` alone determines the rest.

    Parameters
    ----------
    dead_times
        By column, the time after which it acts, (n_samples, 1).
    drifts
        By parameter, its slope in time as printed, (n_samples, 1).
    jumps
        Jumps of parameters.
    """

    dead_times: Mapping[str, FloatArray] = field(default_factory=dict)
    drifts: Mapping[str, FloatArray] = field(default_factory=dict)
    jumps: tuple[Jump, ...] = ()

    def with_dead_time(self, column: str, dead_time: FloatArray) -> BetweenRows:
        """Return it with a column that acts after a dead time, (n_samples, 1); two of one column add up."""
        before = self.dead_times.get(column, 0.0)
        return replace(self, dead_times={**self.dead_times, column: np.asarray(before + dead_time)})

    def with_drift(self, parameter: str, slope: FloatArray) -> BetweenRows:
        """Return it with a drift of a parameter, a slope in time, (n_samples, 1); two of one parameter add up."""
        before = self.drifts.get(parameter, 0.0)
        return replace(self, drifts={**self.drifts, parameter: np.asarray(before + slope)})

    def with_jump(self, jump: Jump) -> BetweenRows:
        """Return it with a jump of a parameter."""
        return replace(self, jumps=(*self.jumps, jump))


@dataclass(frozen=True, eq=False)
class StepInputs:
    """Parameters and columns within some steps; the last axis of the arrays is that of the steps and runs, or 1.

    `constant` and `held` do not change within a step, and are read-only; `moving` and `sloping` are on straight lines.
    The first of each pair are parameters, the second columns.
    """

    constant: Mapping[str, Any]
    moving: Mapping[str, Line]
    held: Mapping[str, Any]
    sloping: Mapping[str, Line]

    def __call__(self, share: Any) -> Pair:
        """Return parameters and columns, by name, at a share of the gap between rows: read-only arrays."""
        if not (self.moving or self.sloping):
            return self.constant, self.held
        p, u = dict(self.constant), dict(self.held)
        for at, lines in ((p, self.moving), (u, self.sloping)):
            for name, (low, rise) in lines.items():
                at[name] = value = low + share * rise
                value.setflags(False)  # of writing; a keyword would double the time
        return p, u

    def of_some(self, columns: IntArray) -> StepInputs:
        """Return the inputs of some of the columns of the arrays."""

        def chosen_lines(lines: Mapping[str, Line]) -> dict[str, Line]:
            return {name: (of_columns(low, columns), of_columns(rise, columns)) for name, (low, rise) in lines.items()}

        return StepInputs(
            read_only_views({name: of_columns(values, columns) for name, values in self.constant.items()}),
            chosen_lines(self.moving),
            read_only_views({name: of_columns(values, columns) for name, values in self.held.items()}),
            chosen_lines(self.sloping),
        )


@dataclass(frozen=True, eq=False)
class StepPart:
    """A part of some steps in which no input jumps or bends.

    `columns` are the indices of its columns of the states' arrays, None: all; `begin` and `length` are shares of the
    gap between rows, numbers or arrays with one value per column.
    """

    columns: IntArray | None
    inputs: StepInputs
    begin: Any
    length: Any


@dataclass(frozen=True, eq=False)
class LawInputs:
    """Parameters and columns of a law at the positions in runs: some held over a gap, some interpolated linearly.

    `constant`, `kept` and `moving` are parameters, `held` and `sloping` are columns: (1 or n_samples, n_places,
    n_runs); a constant parameter has no axis of places. With what is moving or sloping is its rise over each gap,
    (1 or n_samples, n_places - 1, n_runs). `late` are the columns with a dead time.
    """

    places: RowsInRuns
    constant: Mapping[str, Any]
    kept: Mapping[str, FloatArray]
    moving: Mapping[str, Line]
    held: Mapping[str, NDArray[Any]]
    sloping: Mapping[str, Line]
    late: Mapping[str, LateColumn] = field(default_factory=dict)
    jumps: tuple[Jump, ...] = ()

    @classmethod
    def arranged_by_runs(
        cls,
        law: Law,
        places: RowsInRuns,
        parameters: Mapping[str, FloatArray],
        columns: Mapping[str, NDArray[Any]],
        between: BetweenRows | None = None,
    ) -> LawInputs:
        """Arrange parameters and columns, (n_points,) or (n_samples, n_points) each, by positions in the runs.

        Parameters that vary from row to row go on between the rows as columns do, since a column moves them; `between`
        has their drifts and jumps, and the columns that are late.
        """
        rows, time = places.row_by_position_and_run, places.table.time
        between = BetweenRows() if between is None else between
        constant: dict[str, Any] = {}
        kept: dict[str, FloatArray] = {}
        moving: dict[str, Line] = {}
        for name, values in parameters.items():
            for jump in between.jumps:
                if jump.parameter == name:  # it is added where it is, within a gap
                    values = values - jump.size * (places.table.time_s > jump.at)
            own = values_at_rows(values, rows)
            own.setflags(write=False)
            if own.shape[1] == 1 or not np.ptp(own, axis=1).any():
                constant[name] = own[:, 0]
            elif law.hold == "linear":
                moving[name] = own, np.diff(own, axis=1)
            elif name in between.drifts:
                moving[name] = own, between.drifts[name][:, :, None] * places.gaps
            else:
                kept[name] = own
        sloping: dict[str, Line] = {}
        held: dict[str, NDArray[Any]] = {}
        for name, values in columns.items():
            own = values_at_rows(values, rows)
            if name == time or (law.hold == "linear" and values.dtype == np.float64):
                sloping[name] = own, np.diff(own, axis=1)
            else:
                held[name] = own
        timeline = Timeline(places)
        late = {
            name: LateColumn.of(timeline, columns[name], dead_time, linear=law.hold == "linear")
            for name, dead_time in between.dead_times.items()
        }
        return cls(places, constant, kept, moving, read_only_views(held), sloping, late, between.jumps)

    @property
    def has_breaks(self) -> bool:
        """Whether inputs may jump or bend within a gap between rows."""
        return bool(self.late or self.jumps)

    def of_gap(self, k: int) -> StepInputs:
        """Return parameters and columns in the gap between positions k and k + 1, with a column for each run."""
        return StepInputs(
            {**self.constant, **{name: v[:, k] for name, v in self.kept.items()}},
            {name: (v[:, k], rise[:, k]) for name, (v, rise) in self.moving.items()},
            {name: v[:, k] for name, v in self.held.items()},
            {name: (v[:, k], rise[:, k]) for name, (v, rise) in self.sloping.items()},
        )

    def of_steps(self, gap: IntArray) -> StepInputs:
        """Return those of `of_gap` for many steps at once, in the gaps `gap`, (n_steps,).

        Their arrays have a column for each step and run, the runs of a step in turn.
        """

        def in_gaps(values: Any) -> Any:
            return values[:, gap].reshape(len(values), -1)

        def lines_in_gaps(lines: Mapping[str, Line]) -> dict[str, Line]:
            return {name: (in_gaps(values), in_gaps(rise)) for name, (values, rise) in lines.items()}

        constant = {name: np.tile(v, (1, len(gap))) if v.shape[1] > 1 else v for name, v in self.constant.items()}
        return StepInputs(
            read_only_views({**constant, **{name: in_gaps(v) for name, v in self.kept.items()}}),
            lines_in_gaps(self.moving),
            read_only_views({name: in_gaps(v) for name, v in self.held.items()}),
            lines_in_gaps(self.sloping),
        )

    def parts_of_steps(
        self, inputs: StepInputs, gap: IntArray, begin: Any, length: Any, *, whole: bool
    ) -> Iterator[StepPart]:
        """Divide steps where inputs jump or bend, a late column or a parameter with a jump; yield the parts in turn.

        Parameters
        ----------
        inputs
            Parameters and columns of these steps.
        gap, begin, length
            The gap of each step, (n_steps,), and the shares of it at which the step begins, and that it takes: numbers,
            or one per step and run.
        whole
            Whether each part has all columns of the states, so that runs are together; else those alone that have one.
        """
        if not self.has_breaks:
            yield StepPart(None, inputs, begin, length)
            return
        run = np.tile(np.arange(self.places.row_by_position_and_run.shape[1]), len(gap))
        n_columns = len(run)
        start, gap_s = self._begins[gap].ravel(), self.places.gaps[gap].ravel()
        end = np.broadcast_to(begin + length, n_columns)
        share = np.broadcast_to(begin, (1, n_columns))
        columns = np.arange(n_columns)
        while True:
            now, last = start + share * gap_s, start + end * gap_s
            stop = self._next_break(now, run)
            over = ~(stop < last)
            part = self._with_breaks(inputs, 0.5 * (now + np.where(over, last, stop)), run, start, gap_s)
            with np.errstate(divide="ignore", invalid="ignore"):
                until = np.where(over, end, (stop - start) / gap_s)
            yield StepPart(None if len(columns) == n_columns else columns, part, share, until - share)
            going = ~over.all(axis=0)
            if not going.any():
                return
            share = until
            if not whole:
                some = np.flatnonzero(going)
                columns, run = columns[some], run[some]
                start, gap_s, end, share = start[some], gap_s[some], end[some], share[:, some]
                inputs = inputs.of_some(some)

    @cached_property
    def _begins(self) -> FloatArray:
        """Time at which each gap begins, as printed, (n_places - 1, n_runs)."""
        return np.asarray(self.places.table.time_s[self.places.row_by_position_and_run[:-1]])

    def _next_break(self, now: FloatArray, run: IntArray) -> FloatArray:
        """Return the time of the next jump or bend of an input after `now`, of that shape; infinite if none is left."""
        rounding = rounding_of_times(self.places.table.time_s)
        out: Any = np.inf
        for late in self.late.values():
            out = np.minimum(out, late.next_break(now, run))
        for jump in self.jumps:
            out = np.minimum(out, np.where(jump.at > now + rounding, jump.at, np.inf))
        return np.asarray(out)

    def _with_breaks(
        self, inputs: StepInputs, at: FloatArray, run: IntArray, start: FloatArray, gap_s: FloatArray
    ) -> StepInputs:
        """Return inputs with the late columns and the parameters with jumps as they are around the times `at`."""
        constant, moving = dict(inputs.constant), dict(inputs.moving)
        held, sloping = dict(inputs.held), dict(inputs.sloping)
        for name, late in self.late.items():
            value, slope = late.line_at(at, run, start)
            if late.linear:
                sloping[name] = value, slope * gap_s
            else:
                held[name] = value
        for jump in self.jumps:
            name, own = jump.parameter, jump.size * (at > jump.at)
            if name in moving:
                moving[name] = moving[name][0] + own, moving[name][1]
            else:
                constant[name] = constant[name] + own
        return StepInputs(read_only_views(constant), moving, read_only_views(held), sloping)


def of_columns(values: Any, columns: IntArray) -> Any:
    """Return some columns of values by column, (n_columns,) or (n, n_columns); a number is that of all columns."""
    return values[..., columns] if np.ndim(values) and values.shape[-1] > 1 else values


def values_at_rows(values: NDArray[Any], rows: IntArray) -> NDArray[Any]:
    """Index values (n_points,) or (n_samples, n_points) by rows (n_places, n_runs); (n, 1) becomes (n, 1, 1)."""
    if values.ndim == 1:
        return np.asarray(values[rows][None])
    return values[:, :, None] if values.shape[1] == 1 else np.asarray(values[:, rows])
