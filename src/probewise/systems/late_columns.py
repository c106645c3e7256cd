"""A column that acts after a dead time: where it jumps or bends between the rows, and what it is there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray, IntArray
from probewise.systems.rows_in_runs import RowsInRuns

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
