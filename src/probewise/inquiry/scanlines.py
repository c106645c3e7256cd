"""Scanline intervals: places of a grid inside shapes, and near their edges, row by row for many shapes at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.grid import Grid

ROWS = 3
"""Rows of a grid per batch, to fit the cache."""

Interval = tuple[FloatArray, FloatArray]
"""Ends of intervals along a row, mm, one array each; empty if the first exceeds the second."""


@dataclass(frozen=True, eq=False)
class PlacesNearEdges:
    """Pairs of an interval and a place near the edge, (n_pairs,) each: indices of interval, column, and place."""

    interval: IntArray
    column: IntArray
    place: IntArray


@dataclass(frozen=True, eq=False)
class ScanlineIntervals:
    """Intersections of shapes with some rows of a grid, (n_intervals,) each: row, shape (`hypothesis`), and columns.

    `row` is counted from the first of these rows. Columns from `first` to `last` are in the shape or near its edge,
    those from `inner_first` to `inner_last` deep inside; if there are none, these are `last` + 1 and `last`.
    """

    grid: Grid
    n_rows: int
    row: IntArray
    hypothesis: IntArray
    first: IntArray
    last: IntArray
    inner_first: IntArray
    inner_last: IntArray

    @classmethod
    def from_interval_ends(
        cls, grid: Grid, n_rows: int, row: IntArray, hypothesis: IntArray, outer: Interval, inner: Interval
    ) -> Self:
        """Build from ends of intervals along rows: `outer`, in the shape or near its edge, and `inner`, deep inside.

        `row`, `hypothesis`: row and shape of each, (n_intervals,); `n_rows`: number of the grid's rows used. Ends are
        in mm, in single precision, which resolves a ten-thousandth of a millimetre.
        """
        per_mm = np.float32((grid.n_x - 1) / grid.width_mm)

        def columns_in(interval: Interval) -> tuple[IntArray, IntArray]:
            first = to_int32(np.ceil(np.clip(interval[0] * per_mm, 0.0, grid.n_x)))
            last = to_int32(np.floor(np.clip(interval[1] * per_mm, -1.0, grid.n_x - 1.0)))
            return np.minimum(first, last + 1), last

        first, last = columns_in(outer)
        inner_first, inner_last = columns_in(inner)
        none = np.flatnonzero(inner_first > inner_last)
        inner_first[none], inner_last[none] = last[none] + 1, last[none]
        return cls(
            grid,
            n_rows,
            row=row,
            hypothesis=hypothesis,
            first=first,
            last=last,
            inner_first=inner_first,
            inner_last=inner_last,
        )

    def places_near_edges(self) -> PlacesNearEdges:
        """Pair intervals with their places in the ring about the edge: left of the interior, then right of it."""
        n = len(self.row)
        count = np.concatenate([self.inner_first - self.first, self.last - self.inner_last])
        begin = np.concatenate([self.first, self.inner_last + 1])
        # Repeating is the slow step: it is done once, and everything else is indexed.
        interval = np.repeat(np.arange(2 * n), count)
        column = to_int32(begin - np.cumsum(count) + count)[interval]
        column += to_int32(np.arange(len(interval)))
        interval[int(count[:n].sum()) :] -= n
        return PlacesNearEdges(interval, column, column + to_int32(self.row * self.grid.n_x)[interval])

    def level_histogram(
        self, weight: FloatArray, ring: PlacesNearEdges, level: IntArray, ends: tuple[int, int], n_levels: int
    ) -> FloatArray:
        """Return the weighted histogram of levels at every place of the rows, (n_rows * n_x, n_levels).

        `weight`: of each shape, (n_shapes,); each row of the result has the same sum. `ring`, `level`: pairs near the
        edges, and the index of the level there, (n_pairs,). `ends`: indices of the constant levels outside and inside.
        """
        n_places = self.n_rows * self.grid.n_x
        near = np.bincount(ring.place * n_levels + level, weight[self.hypothesis][ring.interval], n_places * n_levels)
        mass = near.reshape(n_places, n_levels).astype(np.float64, copy=False)  # integers if there are no pairs
        inside = self._weight_deep_inside(weight)
        outside = weight.sum() - inside - mass.sum(axis=1)
        mass[:, ends[1]] += inside
        mass[:, ends[0]] += outside
        return mass

    def _weight_deep_inside(self, weight: FloatArray) -> FloatArray:
        """Return the weight of the shapes that contain each place deep inside, (n_rows * n_x,)."""
        width = self.grid.n_x + 1
        own, size = weight[self.hypothesis], self.n_rows * width
        begins = np.bincount(self.row * width + self.inner_first, own, minlength=size)
        ends = np.bincount(self.row * width + self.inner_last + 1, own, minlength=size)
        return np.cumsum((begins - ends).reshape(self.n_rows, width), axis=1)[:, :-1].ravel()


def to_single_precision(values: NDArray[Any]) -> FloatArray:
    """Round to single precision, which the type checker does not distinguish from double."""
    return cast(FloatArray, np.asarray(values, dtype=np.float32))


def to_int32(values: NDArray[Any]) -> IntArray:
    """Truncate to 32-bit integers, which the type checker does not distinguish from 64-bit ones."""
    return cast(IntArray, values.astype(np.int32))
