"""Cubic splines through the readings of a run: what a smooth reading does between its rows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_banded

from probewise._arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Spline:
    """Splines through values (n_samples, n) at rising times (n,), twice differentiable, a parabola in each end segment.

    Of rows at the same time the last counts.
    """

    time: FloatArray
    values: FloatArray

    @cached_property
    def gaps(self) -> FloatArray:
        """Time from each row to the next, (n - 1,)."""
        return np.diff(self.time)

    @cached_property
    def slopes(self) -> FloatArray:
        """First derivative at each row, (n_samples, n)."""
        last = np.append(self.gaps > 0, True)
        x = self.values[:, last]
        h = np.diff(self.time[last])
        if len(h) == 0:
            return np.zeros_like(self.values)
        secants = np.diff(x, axis=1) / h
        if len(h) == 1:
            slopes = np.repeat(secants, 2, axis=1)
        else:
            n = len(h) + 1
            bands, right = np.zeros((3, n)), np.empty_like(x)
            bands[1, [0, -1]] = bands[0, 1] = bands[2, -2] = 1.0
            bands[1, 1:-1] = 2 * (h[:-1] + h[1:])
            bands[0, 2:], bands[2, :-2] = h[:-1], h[1:]
            right[:, 0], right[:, -1] = 2 * secants[:, 0], 2 * secants[:, -1]
            right[:, 1:-1] = 3 * (h[1:] * secants[:, :-1] + h[:-1] * secants[:, 1:])
            slopes = np.asarray(solve_banded((1, 1), bands, right.T, check_finite=False)).T
        return np.asarray(slopes[:, np.cumsum(last) - last])

    @cached_property
    def derivatives(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Second derivative after and before each gap, and third derivative in it, (n_samples, n - 1) each."""
        h = np.where(self.gaps > 0, self.gaps, 1.0)
        before, after = self.slopes[:, :-1], self.slopes[:, 1:]
        secants = np.diff(self.values, axis=1) / h
        return (
            (6 * secants - 4 * before - 2 * after) / h,
            (2 * before + 4 * after - 6 * secants) / h,
            6 * (before + after - 2 * secants) / h**2,
        )

    def at(self, gap: IntArray, since: FloatArray) -> FloatArray:
        """Return the values in the gaps `gap` after the time `since` from their start, (n_samples, n_asked) each."""
        second, _, third = self.derivatives
        start, slope, bend, twist = (
            np.take_along_axis(np.broadcast_to(own, (len(gap), own.shape[1])), gap, axis=1)
            for own in (self.values[:, :-1], self.slopes[:, :-1], second, third)
        )
        return np.asarray(start + since * (slope + since * (bend / 2 + since * twist / 6)))
