"""Variations of a quantity, and so of parameters, over the rows: drift, step, per run, wave, with a column."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from probewise._arrays import ROUNDING, TINY, FloatArray, distinct_values
from probewise._words import unit_of_name, value_with_sd
from probewise.effects.effect import (
    AMPLITUDE,
    MOST_FREQUENCIES,
    PHASE,
    POSITIVE,
    Binding,
    ChangePoints,
    Declared,
    Effect,
    Fixed,
    Say,
    StepEffect,
    WaveEffect,
    in_words,
    sine_and_cosine_entries,
    single_column_bank,
)
from probewise.effects.reference import is_far_from_zero
from probewise.priors import LogUniform, SharedScalePrior, Uniform
from probewise.sensor import Stage
from probewise.systems.forms.reference import UNSEEN, ReferenceFit, flag, period_with_sd
from probewise.systems.table import RunTable, covariate_of_column

_N_VALUES = 9
_IN_EACH_RUN = "in_each_run"  # name of the parameter that is 0 for the first variant of a drift, 1 for the other
_ALL = 17  # digits of a number in double precision
_ROWS_OF_WAVES = 250_000  # rows at which a law is solved for the trial frequencies of one form: a fifth of a second
_N_BANDS = 64  # of equal prior probability
_PEAKS_OF_A_BAND = 8  # so many, for the days and years between readings give each wave some of its height
_BINS_PER_WAVE = 8  # of the fastest wave: a bin is within a sixteenth of a turn of its rows
_MOST_BINS = 2**21
OUTLYING = 5.0  # medians of the residual's size
_MOST_OF_ONE_SCALE = 24  # values per run: with 36 a vector of typical length has 6 sds, a coordinate's bound, in one


def origin_of_column(values: FloatArray) -> float:
    """Return the origin from which an effect counts a column, (n_points,): 0, or the least value if that is far away.

    Far is more than ten times the column's range, as seconds of the epoch are: a drift from 0 would be a constant.
    """
    least = float(np.nanmin(values))
    return least if is_far_from_zero(values, float(np.nanmax(values)) - least) else 0.0


def origin_in_words(name: str | None, origin: float, unit: str = "") -> str:
    """Return a phrase on the origin from which an effect counts the column `name`; "" for 0."""
    unit = "" if unit == name else unit  # "year counts from 1912 year"
    return f"{name} counts from {origin:.12g} {unit}".rstrip() if origin else ""


def text_rounded_to_spread(value: float, spread: float, least: int = 4) -> str:
    """Return a number as text, to `least` digits, or to more if that would move it by a twentieth of the spread."""
    beyond = math.ceil(math.log10(abs(value) / spread)) if value and spread > 0 else 0
    return f"{value:.{min(max(least, 2 + beyond), _ALL)}g}"


def trial_frequencies(
    values: FloatArray,
    groups: list[Any],
    most: int = MOST_FREQUENCIES,
    rows_each: int = 2,
    least_waves: float = 1.0,
    most_waves: float = np.inf,
) -> FloatArray:
    """Return trial frequencies along a covariate, (n_trial,), rising evenly from `least_waves` / range.

    Nothing tells a slower wave from a bend. They go up to one wave in `rows_each` rows of a group or `most_waves` /
    range, in steps of about half the resolution, but there are 8 at least and `most` at most.
    """
    reach, highest = float(np.ptp(values)), _frequency_of_median_gap(values, groups, rows_each)
    highest = min(highest, len(distinct_values(values)) / (rows_each * reach), most_waves / reach)
    n = int(np.clip(np.ceil(2 * highest * reach), 8, most))
    return np.asarray(np.linspace(least_waves / reach, max(highest, 2 * least_waves / reach), n))


def trial_frequencies_in_time(
    about: ReferenceFit, most: int = MOST_FREQUENCIES, rows_each: int = 2, *, most_waves: float = np.inf
) -> FloatArray:
    """Return `trial_frequencies` along the times of the readings, (n_trial,); other rows resolve nothing."""
    times, groups = _times_of_readings(about)
    return trial_frequencies(times, groups, most, rows_each, most_waves=most_waves)


def max_n_trial_frequencies(n_points: int) -> int:
    """Return the affordable number of trial frequencies of a form of a law: 64 to 1,024, fewer for more rows."""
    return int(np.clip(_ROWS_OF_WAVES // (2 * n_points), 64, MOST_FREQUENCIES))


def frequency_prior(frequencies: FloatArray) -> LogUniform:
    """Return the log-uniform prior of a frequency: over the trial frequencies and a little beyond."""
    return LogUniform(float(0.9 * frequencies[0]), float(frequencies[-1] * 1.02))


def residual_peaks(about: ReferenceFit, tried: FloatArray) -> tuple[FloatArray, float]:
    """Find the frequencies in time at which the residuals of a fit have peaks, where those `tried` are too sparse.

    Clustered times tell waves apart up to one in two median gaps, far too many to try each. A fast Fourier transform
    finds the eight highest peaks in each of 64 bands, of one width in log frequency, so that slow noise hides no wave.
    Returns the frequencies, (n_peaks,), rising, and the highest one that was looked at.
    """
    times, groups = _times_of_readings(about)
    residuals, reach = _weighted_residuals(about), float(np.ptp(times))
    bin_width = max(1 / (_BINS_PER_WAVE * _frequency_of_median_gap(times, groups, 2)), reach / _MOST_BINS)
    highest = max(1 / (_BINS_PER_WAVE * bin_width), float(tried[-1]))
    is_sparse = float(np.diff(tried).max()) * reach > 0.6
    if len(residuals) < len(times) or (not is_sparse and highest <= 1.001 * tried[-1]):
        return np.zeros(0), float(tried[-1])
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
    return np.sort(frequencies[falling[rank < _PEAKS_OF_A_BAND]]), highest


def _times_of_readings(about: ReferenceFit) -> tuple[FloatArray, list[Any]]:
    read = np.flatnonzero(about.has_reading)
    if np.ptp(about.table.time_s[read]) == 0:
        return about.table.time_s, about.table.rows_by_scan()
    run = about.table.scan[read]
    return about.table.time_s[read], [np.flatnonzero(run == k) for k in np.unique(run)]


def _frequency_of_median_gap(values: FloatArray, groups: list[Any], rows_each: int) -> float:
    reach = float(np.ptp(values))
    gaps = np.concatenate([np.abs(np.diff(values[rows])) for rows in groups])
    gaps = gaps[gaps > ROUNDING * max(reach, TINY)]
    return 1 / (rows_each * float(np.median(gaps))) if gaps.size else 1.0 / reach


def _weighted_residuals(about: ReferenceFit) -> FloatArray:
    own, table, read = about.system.simulator, about.table, about.has_reading
    sd = table.covariates[own.noise.sd][read] if isinstance(own.noise.sd, str) else np.full(int(read.sum()), about.sd)
    sd = np.where(np.isfinite(sd) & (sd > 0), sd, about.sd)
    in_sds = (table.columns[own.reading] - about.predicted)[read] / sd
    in_sds = in_sds - np.average(in_sds / sd) / np.average(1 / sd)
    most = OUTLYING * float(np.median(np.abs(in_sds)))
    return np.asarray(np.clip(in_sds, -most, most) / sd)


@dataclass(frozen=True, eq=False)
class Quantity:
    """What may vary over the rows, in words, with its unit; `add` returns a stage's value with the variation added.

    `guess` is an amplitude so small that the readings change in proportion; `covariates` are those along which the
    residual shows whatever the variation.
    """

    what: str
    unit: str
    stage: Stage
    guess: float
    add: Callable[[Any, FloatArray], Any]
    covariates: tuple[str, ...] = ()

    def varying(
        self,
        about: ReferenceFit,
        name: str,
        at_rows: Callable[[FloatArray, RunTable], FloatArray],
        parameters: Declared,
        covariates: tuple[str, ...],
        says: Say,
        entries: FloatArray | None = None,
        **more: Any,
    ) -> Iterator[Effect]:
        """Yield the form by which it varies as `at_rows(theta, table)`, (n_samples, n_points), 0 at amplitude 0."""

        def act(value: Any, theta: FloatArray, rows: RunTable) -> Any:
            return self.add(value, at_rows(theta, rows))

        own = (name, self.stage, parameters, covariates + self.covariates, act, says, entries)
        return about.form(*own, guess=self.guess, **more)


def time_since_start_of_run(table: RunTable) -> FloatArray:
    """Return the time since the first row of each row's run, (n_points,)."""
    first = np.array([table.time_s[rows].min() for rows in table.rows_by_scan()])
    return np.asarray(table.time_s - first[table.scan])


def drift_form(about: ReferenceFit, name: str, of: Quantity) -> Iterator[Effect]:
    """Yield a linear drift a t, with recorded time t from its origin: 0, or the first time if far from 0.

    Of runs one after the other, another variant counts the time from the start of each run.
    """
    table, per, origin = about.table, about.time_unit, origin_of_column(about.table.time_s)
    since = time_since_start_of_run(table)
    follow_each_other = float(np.ptp(table.time_s - since)) >= float(since.max()) > 0.0

    def says(mean: FloatArray, sd: FloatArray) -> str:
        anew = " in each run, from its start" if (mean[1:] > 0.5).any() else ""
        return f"{of.what} drifts by {value_with_sd(mean[0], sd[0], of.unit)} per {per}{anew}"

    def at_rows(theta: FloatArray, rows: RunTable) -> FloatArray:
        along = rows.time_s - origin
        if theta.shape[1] > 1:
            along = np.where(theta[:, 1:] > 0.5, time_since_start_of_run(rows), along)
        return np.asarray(theta[:, :1] * along)

    size: Declared = {"a": (AMPLITUDE, f"{of.unit or '1'}/{per}")}
    more: dict[str, Any] = {"binding": Binding(origin_in_words(table.time, origin, per))}
    variants = list[Effect]()
    if not follow_each_other:
        variants += of.varying(about, name, at_rows, size, ("time",), says, **more)
    for value, prior in map(flag, (False, True)) if follow_each_other else ():
        both, bank = {**size, _IN_EACH_RUN: (prior, "1")}, single_column_bank(1.0, value)
        variants += of.varying(about, name, at_rows, both, ("time",), says, bank, **more)
    if variants:
        yield replace(variants[0], alternatives=tuple(variants[1:]))


def form_along_column(about: ReferenceFit, name: str, of: Quantity, column: str) -> Iterator[Effect]:
    """Yield a variation in proportion to a column, about its mean over the recording: a (C - mean C)."""
    middle, per = float(np.nanmean(about.table.covariates[column])), unit_of_name(column) or "unit"
    return of.varying(
        about,
        name,
        lambda theta, rows: theta[:, :1] * (rows.covariates[column] - middle),
        {"a": (AMPLITUDE, f"{of.unit or '1'} per {column}")},
        (covariate_of_column(column),),
        lambda mean, sd: f"{of.what} changes by {value_with_sd(mean[0], sd[0], of.unit)} per {per} of {column}",
    )


def step_form(about: ReferenceFit, name: str, of: Quantity, *, may_end: bool = False) -> Iterator[Effect]:
    """Yield a step at a change point: a 1(t > t0), in time if recorded, else in row number; it may go back."""
    table, by_row = about.table, not about.table.has_varying_time
    along = np.arange(float(len(table))) if by_row else table.time_s
    ends = sorted((along[rows].max(), along[rows].min()) for rows in table.rows_by_scan())
    points = ChangePoints.of(along, by_row=by_row)
    if len(ends) == 2 and ends[0][0] < ends[1][1] and len(points.at) > 5:
        points = replace(points, border=float(ends[0][0]))
    first, last = points.at[0], points.at[-1]
    place, unit = ("row", "row") if by_row else ("s", about.time_unit)

    def at_in_words(mean: float, sd: float) -> str:  # of rows, a point between two, counted from 0
        row = f"row {int(mean) + 3} of the table (the header is row 1)"
        return row if by_row else value_with_sd(mean, sd, about.time_unit)

    def says(mean: FloatArray, sd: FloatArray) -> str:
        goes_back = may_end and mean[1] > mean[2]
        then = f"goes back at {at_in_words(mean[1], sd[1])}" if goes_back else "stays there"
        size = value_with_sd(mean[0], sd[0], of.unit)
        return f"{of.what} jumps by {size} at {at_in_words(mean[-1], sd[-1])} and {then}"

    def at_rows(theta: FloatArray, rows: RunTable) -> FloatArray:
        at, begin, end = points.variable_at_rows(rows), theta[:, -1:], theta[:, 1:2]
        return np.asarray(theta[:, :1] * ((at > begin) & ((at <= end) | (end <= begin))))

    never = Fixed(first - 2.0, first - 1.0) if may_end else None
    until: Declared = {} if never is None else {f"until_{place}": (never, unit)}
    parameters: Declared = {"a": (AMPLITUDE, of.unit), **until, f"at_{place}": (Uniform(first, last), unit)}
    bank = single_column_bank(1.0, *([first - 1.5] if may_end else []), 0.5 * (first + last))
    more: dict[str, Any] = {"kind": StepEffect, "change_points": points, "never": never}
    yield from of.varying(about, name, at_rows, parameters, ("row",) if by_row else ("time",), says, bank, **more)


def form_per_run(about: ReferenceFit, name: str, of: Quantity) -> Iterator[Effect]:
    """Yield a variation by one value per run: a_run; 0 for runs outside the recording that are like none of it.

    The values have one scale in common, unless they are so many that a single one could not differ much more than the
    others within the bounds of a coordinate.
    """
    names = about.table.scan_names
    known = {name: k for k, name in enumerate(names)}

    def at_rows(theta: FloatArray, rows: RunTable) -> FloatArray:
        at = np.array([known.get(rows.like.get(name, name), len(names)) for name in rows.scan_names])
        values = np.concatenate([theta, np.zeros((len(theta), 1))], axis=1)
        return np.asarray(values[:, at[rows.scan]])

    def says(mean: FloatArray, sd: FloatArray) -> str:
        far = int(np.argmax(np.abs(mean)))
        by = value_with_sd(mean[far], sd[far], of.unit)
        return f"{of.what} differs from run to run, most in run {names[far]}: by {by} from their median"

    parameters: Declared = {f"values[{name}]": (AMPLITUDE, of.unit) for name in names}
    for form in of.varying(about, name, at_rows, parameters, ("run",), says):
        if len(names) > _MOST_OF_ONE_SCALE:
            yield form
        else:  # all runs may differ about as much, or one of them alone by far more than the others
            together = SharedScalePrior(form.prior.names, cast(Any, next(iter(form.marginals.values()))))
            yield replace(form, parameters=together, alternatives=(form,))


def forms_over_rows(about: ReferenceFit) -> dict[str, Callable[..., Iterator[Effect]]]:
    """Return a drift where time passes, a step, and a value per run where there are several, by what each is called.

    Each is a function of the fit, the form's name and a quantity.
    """
    drift = {"drift": drift_form} if about.table.has_varying_time else {}
    per_run = {"per_run": form_per_run} if about.can_fit_value_per_run else {}
    return {**drift, "step": step_form, **per_run}


def declared_wave(about: ReferenceFit, frequencies: FloatArray, unit: str, highest: float = 0.0) -> dict[str, Any]:
    """Return what `ReferenceFit.form` takes of a wave of these trial frequencies, (n_trial,), or up to `highest`."""
    table, time_unit = about.table, about.time_unit
    prior = frequency_prior(np.append(frequencies, max(highest, float(frequencies[-1]))))
    return {
        "parameters": {"a": (POSITIVE, unit), "hz": (prior, f"1/{time_unit}"), "phase": (PHASE, "rad")},
        "covariates": ("time",),
        "entries": sine_and_cosine_entries(1.0, frequencies),
        "kind": WaveEffect,
        "binding": Binding(origin_in_words(table.time, origin_of_column(table.time_s), time_unit)),
    }


def wave_form(about: ReferenceFit, name: str, of: Quantity) -> Iterator[Effect]:
    """Yield a wave in time, of a frequency that the residuals of the fit may suggest."""
    frequencies, origin = trial_frequencies_in_time(about), origin_of_column(about.table.time_s)
    suggested, highest = residual_peaks(about, frequencies)

    def at_rows(theta: FloatArray, rows: RunTable) -> FloatArray:
        return np.asarray(theta[:, :1] * np.sin(2 * np.pi * theta[:, 1:2] * (rows.time_s - origin) + theta[:, 2:3]))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        size, period = value_with_sd(mean[0], sd[0], of.unit), period_with_sd(mean[1], sd[1], about.time_unit)
        return f"{of.what} oscillates with an amplitude of {size} and a period of {period}"

    for form in of.varying(about, name, at_rows, says=says, **declared_wave(about, frequencies, of.unit, highest)):
        more = sine_and_cosine_entries(form.entries[0, 0, 0], suggested)
        entries = np.concatenate([form.entries, more])
        yield replace(cast(WaveEffect, form), entries=entries, n_suggested=len(suggested))


_KINDS = {"drift": "drifts", "step": "steps", "per_run": "differs"}
_QUARTILES = np.array([0.25, 0.75])


def forms_on_parameters(about: ReferenceFit) -> Iterator[Effect]:
    """Yield a form for each way in which a parameter may vary: drift, step, one value per run, with a column."""
    simulator, table = about.system.simulator, about.table
    values = about.system.parameters(about.theta, table)
    for name, prior in simulator.parameters.items():
        guess = 1e-4 * (float(np.abs(values[name]).max()) or float(np.ptp(prior.from_unit(_QUARTILES))))

        def add(value: Any, change: FloatArray, name: str = name) -> Any:
            return {**value, name: value[name] + change}

        of = Quantity(name, unit_of_name(name), Stage.PARAMETER, guess, add)
        for kind, form in forms_over_rows(about).items():
            if kind != "per_run" or name not in simulator.per_run:
                slow = replace(of, guess=guess / about.duration) if kind == "drift" else of
                yield from form(about, f"{_KINDS[kind]}:{name}", slow)
        for column in about.varying_columns:
            of_column = replace(of, guess=guess / float(np.nanstd(table.covariates[column])))
            yield from form_along_column(about, f"depends:{name}:{column}", of_column, column)


def forms_of_extras(about: ReferenceFit) -> Iterator[Effect]:
    """Yield a form for each extra effect of a file that changes the readings somewhere in its prior."""
    for name, extra in about.system.simulator.extra.items():
        values = np.asarray(extra.prior.from_unit((np.arange(_N_VALUES) + 0.5) / _N_VALUES))
        values = values[values != extra.null]

        def act(value: Any, theta: FloatArray, table: RunTable, name: str = name) -> dict[str, FloatArray]:
            return {**value, name: theta[:, :1]}

        rms = about.rms_change_in_sds(Stage.PARAMETER, act, values[:, None])
        seen = np.isfinite(rms) & (rms > UNSEEN)
        if seen.any():
            says, along = in_words(extra.says.replace("{value}", "{0}")), ("level", "time", "row")
            own = (name, Stage.PARAMETER, {"value": (extra.prior, "")}, along, act, says, values[seen][:, None, None])
            yield from about.form(*own, absent={0: extra.null})
