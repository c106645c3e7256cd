"""Trial frequencies of waves: evenly spaced ones, and those at which the residuals of a fit have peaks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, distinct_values
from probewise.priors import LogUniform
from probewise.systems.forms.about import ReferenceFit

_MOST_FREQUENCIES = 1024
_ROWS_OF_WAVES = 250_000  # rows at which a law is solved for the trial frequencies of one form: a fifth of a second
_N_BANDS = 64  # of equal prior probability
_PEAKS_OF_A_BAND = 8  # so many, for the days and years between readings give each wave some of its height
_BINS_PER_WAVE = 8  # of the fastest wave: a bin is within a sixteenth of a turn of its rows
_MOST_BINS = 2**21
_OUTLYING = 5.0  # medians of the residual's size


def trial_frequencies(
    values: FloatArray,
    groups: list[Any],
    most: int = _MOST_FREQUENCIES,
    rows_each: int = 2,
    least_waves: float = 1.0,
    most_waves: float = np.inf,
) -> FloatArray:
    """Return trial frequencies along a covariate, (n_trial,), rising evenly from `least_waves` / range.

    A wave slower than one in the range is never seen as a whole: nothing tells it from a drift or a bend. They go up to
    one wave in `rows_each` rows or `most_waves` / range, and to 2 `least_waves` / range at least, in steps of about
    half the resolution; where that gives fewer than 8 or more than `most`, there are 8 or `most`. `groups` are the rows
    of each run.
    """
    reach = float(np.ptp(values))
    highest = _frequency_of_median_gap(values, groups, rows_each)
    highest = min(highest, len(distinct_values(values)) / (rows_each * reach), most_waves / reach)
    n = int(np.clip(np.ceil(2 * highest * reach), 8, most))
    return np.asarray(np.linspace(least_waves / reach, max(highest, 2 * least_waves / reach), n))


def trial_frequencies_in_time(
    about: ReferenceFit, most: int = _MOST_FREQUENCIES, rows_each: int = 2, *, most_waves: float = np.inf
) -> FloatArray:
    """Return `trial_frequencies` along the times of the readings, (n_trial,); other rows resolve nothing."""
    times, groups = _times_of_readings(about)
    return trial_frequencies(times, groups, most, rows_each, most_waves=most_waves)


def max_n_trial_frequencies(n_points: int) -> int:
    """Return the affordable number of trial frequencies of a form of a law: 64 to 1,024, fewer for more rows."""
    return int(np.clip(_ROWS_OF_WAVES // (2 * n_points), 64, _MOST_FREQUENCIES))


def frequency_prior(frequencies: FloatArray) -> LogUniform:
    """Return the log-uniform prior of a frequency: over the trial frequencies and a little beyond."""
    return LogUniform(float(0.9 * frequencies[0]), float(frequencies[-1] * 1.02))


@dataclass(frozen=True, eq=False)
class Peaks:
    """Frequencies `at` (n_peaks,) where residuals have peaks, rising; `highest` is the end of the range looked at."""

    at: FloatArray
    highest: float


def residual_peaks(about: ReferenceFit, tried: FloatArray) -> Peaks:
    """Find the frequencies in time at which the residuals of a fit have peaks, where those `tried` are too sparse.

    Times that come in clusters, as of readings in bursts or with a long pause, tell waves apart that are much faster
    than their average spacing: up to one wave in two median gaps. Of such frequencies there may be 100,000, too many to
    try each. A fast Fourier transform of the residuals finds the eight highest peaks in each of 64 bands, of one width
    in log frequency, so that slow noise hides no fast wave. There are none where `tried`, (n_trial,), has gaps of about
    half the resolution at most and reaches as high.
    """
    times, groups = _times_of_readings(about)
    residuals, reach = _weighted_residuals(about), float(np.ptp(times))
    bin_width = max(1 / (_BINS_PER_WAVE * _frequency_of_median_gap(times, groups, 2)), reach / _MOST_BINS)
    highest = max(1 / (_BINS_PER_WAVE * bin_width), float(tried[-1]))
    is_sparse = float(np.diff(tried).max()) * reach > 0.6
    if len(residuals) < len(times) or (not is_sparse and highest <= 1.001 * tried[-1]):
        return Peaks(np.zeros(0), float(tried[-1]))
    bins = np.rint((times - times.min()) / bin_width).astype(np.int64)
    n_bins = 1 << int(2 * (bins.max() + 1) - 1).bit_length()  # twice the range: steps of half the resolution
    power = np.abs(np.fft.rfft(np.bincount(bins, residuals, n_bins))) ** 2
    frequencies = np.arange(len(power)) / (n_bins * bin_width)
    band = np.searchsorted(np.geomspace(tried[0], highest, _N_BANDS + 1), frequencies)
    is_peak = np.zeros(len(power), dtype=bool)
    is_peak[1:-1] = (power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])
    is_peak &= (band > 0) & (band <= _N_BANDS) & (is_sparse | (frequencies > tried[-1]))
    falling = np.flatnonzero(is_peak)
    falling = falling[np.lexsort((-power[falling], band[falling]))]
    rank = np.arange(len(falling)) - np.searchsorted(band[falling], band[falling])
    return Peaks(np.sort(frequencies[falling[rank < _PEAKS_OF_A_BAND]]), highest)


def _times_of_readings(about: ReferenceFit) -> tuple[FloatArray, list[Any]]:
    """Return the times of the rows with a reading, (n_read,), and the numbers of those of each run."""
    read = np.flatnonzero(about.has_reading)
    if np.ptp(about.table.time_s[read]) == 0:
        return about.table.time_s, about.table.rows_by_scan()
    run = about.table.scan[read]
    return about.table.time_s[read], [np.flatnonzero(run == k) for k in np.unique(run)]


def _frequency_of_median_gap(values: FloatArray, groups: list[Any], rows_each: int) -> float:
    """Return the frequency of one wave in `rows_each` median gaps between rows of a group, or else one in the range."""
    reach = float(np.ptp(values))
    gaps = np.concatenate([np.abs(np.diff(values[rows])) for rows in groups])
    gaps = gaps[gaps > 1e-9 * max(reach, 1e-300)]
    return 1 / (rows_each * float(np.median(gaps))) if gaps.size else 1.0 / reach


def _weighted_residuals(about: ReferenceFit) -> FloatArray:
    """Return the residuals of the readings in noise variances, (n_read,), outlying ones clipped, about their mean."""
    own, table, read = about.system.simulator, about.table, about.has_reading
    sd = table.covariates[own.noise.sd][read] if isinstance(own.noise.sd, str) else np.full(int(read.sum()), about.sd)
    sd = np.where(np.isfinite(sd) & (sd > 0), sd, about.sd)
    in_sds = (table.columns[own.reading] - about.predicted)[read] / sd
    in_sds = in_sds - np.average(in_sds / sd) / np.average(1 / sd)
    most = _OUTLYING * float(np.median(np.abs(in_sds)))
    return np.asarray(np.clip(in_sds, -most, most) / sd)
