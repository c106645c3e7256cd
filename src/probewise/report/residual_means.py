"""Binned means of residuals along a covariate, with the 95 % band of chance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray, distinct_values

_STEPS = 24
_LEAST_ROWS = 4
_NEVER_LESS = 0.05  # of the variance of a mean: the least width of the band, however much the fit absorbs
_NEGLIGIBLE = 0.01  # correlation


@dataclass(frozen=True, eq=False)
class ResidualMeans:
    """Mean residuals per bin; all arrays have shape (n_bins,).

    `at` is the covariate's mean in the bin. `before` and `after` are the
    mean residuals of the calibrated and of the repaired model (`after` None: nothing was repaired), `chance` half the
    width of the 95 % band of chance, `size` the number of readings. `by_value`: each bin is one value of a covariate
    that has few.
    """

    at: FloatArray
    before: FloatArray
    after: FloatArray | None
    chance: FloatArray
    size: IntArray
    by_value: bool = False

    @property
    def largest_mean_in_sds(self) -> float:
        """Largest absolute mean of `before`, in sds of that mean by chance; 0 without bins."""
        return float(self._in_sds.max(initial=0.0))

    def is_largest_within(self, window: tuple[float, float]) -> bool:
        """Return whether the largest absolute mean, in sds of chance, lies in an interval of the covariate."""
        within = (self.at >= window[0]) & (self.at <= window[1])
        return bool(self._in_sds[within].max(initial=0.0) >= self._in_sds.max(initial=0.0))

    @property
    def _in_sds(self) -> FloatArray:
        return np.abs(self.before) / np.maximum(self.chance / 1.96, 1e-300)


def mean_residuals(
    covariate: FloatArray,
    before: FloatArray,
    after: FloatArray | None,
    *,
    sd: FloatArray | float,
    rho: float = 0.0,
    scan: IntArray | None = None,
    window: tuple[float, float] | None = None,
    absorbed: FloatArray | None = None,
) -> ResidualMeans:
    """Average residuals in bins of a covariate, with the 95 % band of chance.

    All have the shape (n_points,): the covariate, the residuals of both models, NaN where there is no reading, the
    noise `sd` of one reading, and `scan` numbers, within which successive noise has the correlation `rho`. No bin
    straddles the ends of `window`. `absorbed`, (n_samples, n_points), are posterior samples of the predictions, whose
    variance the fit absorbs from the noise: it narrows the band.
    """
    ok = np.flatnonzero(np.isfinite(covariate) & np.isfinite(before))
    values = covariate[ok]
    few = rows_by_value(values)
    groups = _groups_beside_window(values, window) if few is None else few
    rows = [ok[group] for group in groups]
    at = np.array([values[g].mean() for g in groups])
    sd_of_row = np.broadcast_to(np.asarray(sd, dtype=np.float64), before.shape)
    scan = np.zeros(len(before), dtype=np.int64) if scan is None else scan
    variance = np.array([_variance_of_mean(r, sd_of_row, scan, rho) for r in rows])
    if absorbed is not None:
        taken = np.array([np.var(absorbed[:, r].mean(axis=1)) for r in rows])
        variance = np.maximum(variance - taken, _NEVER_LESS * variance)
    return ResidualMeans(
        at,
        np.array([before[r].mean() for r in rows]),
        None if after is None else np.array([after[r].mean() for r in rows]),
        1.96 * np.sqrt(variance),
        np.array([r.size for r in rows], dtype=np.int64),
        few is not None,
    )


def rows_by_value(values: FloatArray) -> list[IntArray] | None:
    """List the rows of each value, ascending, of up to 24 that have four rows or more on average; else None."""
    distinct = distinct_values(values)
    if distinct.size > _STEPS or values.size < _LEAST_ROWS * distinct.size:
        return None
    which = np.searchsorted(distinct, values, side="right") - 1
    return [np.flatnonzero(which == k) for k in range(distinct.size)]


def groups_of_neighbours(values: FloatArray, n: int) -> list[IntArray]:
    """Split rows by ascending value into `n` groups of equal size, or fewer, as rows of one value stay together."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    starts = np.cumsum([part.size for part in np.array_split(order, n)])[:-1]
    cuts = np.unique(np.searchsorted(ordered, ordered[np.minimum(starts, values.size - 1)]))
    return [rows for rows in np.split(order, cuts) if rows.size]


def _groups_beside_window(values: FloatArray, window: tuple[float, float] | None) -> list[IntArray]:
    """List row numbers by equal steps of the covariate, none across an end of the window; groups of few are joined."""
    low, high = window or (-np.inf, np.inf)
    part = (values >= low).astype(np.int64) + (values > high)
    span = max(float(np.ptp(values)) if values.size else 0.0, 1e-300)
    step = np.minimum(_STEPS * (values - values.min(initial=np.inf)) / span, _STEPS - 1).astype(np.int64)
    place = part * _STEPS + step
    groups: list[IntArray] = []
    for at in np.unique(place):
        rows = np.flatnonzero(place == at)
        if groups and groups[-1].size < _LEAST_ROWS and part[groups[-1][0]] == part[rows[0]]:
            rows = np.concatenate([groups.pop(), rows])
        groups.append(rows)
    return groups


def _variance_of_mean(rows: IntArray, sd: FloatArray, scan: IntArray, rho: float) -> float:
    """Return the variance of the mean noise over `rows`; the noise is AR(1) within scans."""
    noise = np.zeros(len(scan))
    noise[rows] = sd[rows]
    variance = float(noise @ noise)
    longest = math.ceil(math.log(_NEGLIGIBLE) / math.log(abs(rho))) if _NEGLIGIBLE < abs(rho) < 1 else 0
    for lag in range(1, min(longest, len(scan) - 1) + 1):
        variance += 2 * rho**lag * float(np.sum(noise[lag:] * noise[:-lag] * (scan[lag:] == scan[:-lag])))
    return max(variance, 0.0) / max(rows.size, 1) ** 2
