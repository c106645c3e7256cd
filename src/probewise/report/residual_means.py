"""Binned means of residuals along a covariate, with the 95 % band of chance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray, distinct_values

_STEPS = 24
_MOST_STEPS = 60
_LEAST_ROWS = 4
_FEW_STEPS = 6
_NEVER_LESS = 0.05  # of the variance of a mean: the least width of the band, however much the fit absorbs
_NEGLIGIBLE = 0.01  # correlation


@dataclass(frozen=True, eq=False)
class ResidualMeans:
    """Mean residuals per bin; all arrays have shape (n_bins,).

    `at` is the covariate's mean in the bin, or 0, 1, 2 ... for a categorical covariate. `before` and `after` are the
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
        return float(np.max(np.abs(self.before) / np.maximum(self.chance / 1.96, 1e-300), initial=0.0))


def mean_residuals(
    covariate: FloatArray,
    before: FloatArray,
    after: FloatArray | None,
    *,
    sd: FloatArray | float,
    rho: float = 0.0,
    scan: IntArray | None = None,
    names: Mapping[float, str] | None = None,
    window: tuple[float, float] | None = None,
    absorbed: FloatArray | None = None,
) -> ResidualMeans:
    """Average residuals in bins of a covariate, with the 95 % band of chance.

    All have the shape (n_points,): the covariate, the residuals of both models, NaN where there is no reading, the
    noise `sd` of one reading, and `scan` numbers, within which successive noise has the correlation `rho`. `names` are
    those of a categorical covariate's values: each is a bin. No bin straddles the ends of `window`. `absorbed`,
    (n_samples, n_points), are posterior samples of the predictions, whose variance the fit absorbs from the noise: it
    narrows the band.
    """
    ok = np.flatnonzero(np.isfinite(covariate) & np.isfinite(before))
    values = covariate[ok]
    few = [np.flatnonzero(values == value) for value in np.unique(values)] if names else rows_by_value(values)
    groups = _groups_in_steps(values, window) if few is None else few
    rows = [ok[group] for group in groups]
    at = np.arange(len(groups), dtype=np.float64) if names else np.array([values[g].mean() for g in groups])
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


def _groups_in_steps(values: FloatArray, window: tuple[float, float] | None) -> list[IntArray]:
    """List row numbers by equal steps of the covariate; groups of few rows are joined, not across the window's ends."""
    if values.size == 0:
        return []
    low, high = window or (-np.inf, np.inf)
    inside = (values >= low) & (values <= high)
    least = int(np.clip(inside.sum(), 1, _LEAST_ROWS)) if window else _LEAST_ROWS
    parts = [np.flatnonzero(part) for part in (values < low, inside, values > high)]
    return [group for part in parts if part.size for group in _groups_of_rows(values, part, least)]


def _groups_of_rows(values: FloatArray, rows: IntArray, least: int) -> list[IntArray]:
    """Split `rows` by equal steps of the covariate; into equal numbers where most of them share a few values."""
    there = values[rows]
    span = float(np.ptp(there))
    n = int(np.clip(round(_STEPS * (span / max(float(np.ptp(values)), 1e-300))), 1, _MOST_STEPS))
    step = np.minimum((n * (there - there.min()) / max(span, 1e-300)).astype(int), n - 1)
    groups = _merged_groups([rows[step == k] for k in range(n)], least)
    if len(groups) >= min(_FEW_STEPS, n) or rows.size < _FEW_STEPS * least:
        return groups
    # Where most readings share a few values, groups of equal size show more than bins of equal width.
    return [rows[group] for group in groups_of_neighbours(there, min(n, rows.size // least))]


def _merged_groups(parts: Sequence[IntArray], least: int) -> list[IntArray]:
    """Join successive groups until each has `least` rows; what remains joins the last."""
    groups: list[IntArray] = []
    waiting = np.empty(0, dtype=np.int64)
    for part in parts:
        waiting = np.concatenate([waiting, part])
        if waiting.size >= least:
            groups.append(waiting)
            waiting = waiting[:0]
    return groups if not waiting.size else [*groups[:-1], np.concatenate([*groups[-1:], waiting])]


def _variance_of_mean(rows: IntArray, sd: FloatArray, scan: IntArray, rho: float) -> float:
    """Return the variance of the mean noise over `rows`; the noise is AR(1) within scans."""
    noise = np.zeros(len(scan))
    noise[rows] = sd[rows]
    variance = float(noise @ noise)
    longest = math.ceil(math.log(_NEGLIGIBLE) / math.log(abs(rho))) if _NEGLIGIBLE < abs(rho) < 1 else 0
    for lag in range(1, min(longest, len(scan) - 1) + 1):
        variance += 2 * rho**lag * float(np.sum(noise[lag:] * noise[:-lag] * (scan[lag:] == scan[:-lag])))
    return max(variance, 0.0) / max(rows.size, 1) ** 2
