"""Forms on the reading: offsets, gains, lag, delay, hysteresis, bend, saturation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.polynomial.chebyshev import chebfit, chebval

from probewise._arrays import ROUNDING, BoolArray, FloatArray, distinct_values, rounding_error
from probewise._words import value_with_sd
from probewise.effects.effect import (
    AMPLITUDE,
    LEAST_VISIBLE,
    ROWS_OF_A_SIDE,
    Act,
    Declared,
    Effect,
    Fixed,
    acting,
    in_words,
    single_column_bank,
    sizes_inside,
)
from probewise.effects.reading import decaying_sum
from probewise.effects.reference import sign_of_change
from probewise.priors import HeavyTailedPrior, LogUniform, Uniform
from probewise.sensor import Stage
from probewise.systems.forms.modulations import (
    OUTLYING,
    Quantity,
    form_along_column,
    forms_over_rows,
    time_since_start_of_run,
    wave_form,
)
from probewise.systems.forms.reference import N_SIZES, Clipping, ReferenceFit, flag, switch_points
from probewise.systems.table import RunTable, covariate_of_column

_SMOOTH = "smooth"  # name of the parameter that distinguishes the variants of a reading that comes late
# Prior odds: a reading takes over in the gap before its row, or (1) is smooth, though the rows of most tables are dense
# beside what matters, or (2) holds from its row on, as what was set there does.
_ODDS_OF_VARIANTS = 1.0, 0.05, 0.5
_APART = 1.0  # lambda from the first variant at some trial size, below which another one is the same
_BEND_DEGREE = 4
_NEAR_LOW = 0.05  # of the range: below it a power less than one may have any slope
_COEFFICIENTS = "a1", "a2", "a3", "a4", "a5"  # of a curve
_HARDLY = 1e-6  # of a size: more than rounding of none


def _cubics(time: FloatArray, values: FloatArray) -> FloatArray:
    """Return the cubic in the time since the row before of each gap, highest power first, (4, n_samples, n - 1).

    They are splines through values (n_samples, n); of rows at the same time the last counts. They are NaN where a
    sample has a value that is not finite.
    """
    from scipy.interpolate import CubicSpline  # a third of a second, which few diagnoses need

    out, passes = np.zeros((4, len(values), len(time) - 1)), np.diff(time) > 0
    out[3] = values[:, :-1]
    if passes.any():
        last, finite = np.append(passes, True), np.asarray(np.isfinite(values).all(axis=1))
        smooth = np.where(finite[:, None], values, 0.0)  # SciPy refuses other numbers, though of one sample alone
        out[:, :, passes] = CubicSpline(time[last], smooth[:, last], axis=1).c.transpose(0, 2, 1)
        out[:, ~finite] = np.nan
    return out


def _late_form(about: ReferenceFit, name: str, act: Act, tried: FloatArray, says: str, n: int) -> Iterator[Effect]:
    """Yield the form of a reading that comes late, with those of its `n` variants that rows tell from the first."""

    def at_rows(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        return np.asarray(act(value, np.append(theta, np.zeros_like(theta), axis=1), table))

    prior = about.log_uniform_size_prior(Stage.LAG, at_rows, about.table.median_gap * tried)
    if prior is None:
        return
    variants: list[Effect] = []
    for k, odds in enumerate(_ODDS_OF_VARIANTS[:n]):
        value, of_flag = flag(k, odds)
        own: Declared = {"tau_s": (prior, about.time_unit), _SMOOTH: (of_flag, "1")}
        words = in_words(f"{about.system.simulator.reading} {says}", about.time_unit)
        bank = single_column_bank(sizes_inside(prior, N_SIZES, 1.2), value)
        given = (name, Stage.LAG, own, ("previous",), act, words, bank)
        variants += about.form(*given, absent={0: 0.0}, needs_rising_time=True)
    first, *others = (act(about.predicted[None, :], each.entries[:, 0], about.table) for each in variants)
    told = (
        variant
        for variant, other in zip(variants[1:], others, strict=True)
        if np.sqrt(np.nansum((first - other)[:, about.has_reading] ** 2, axis=1).max()) / about.sd > _APART
    )
    yield replace(variants[0], alternatives=tuple(told))


def within_runs(change: Act) -> Act:
    """Return the act that changes values run by run: `change` gets values (1 or n_samples, n), theta and the times."""

    def act(values: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        values = np.atleast_2d(values)  # a column is (n_points,)
        out = np.empty((max(len(values), len(theta)), values.shape[1]))
        for rows in table.rows_by_scan():
            out[:, rows] = change(values[:, rows], theta, table.time_s[rows])
        return out

    return act


@within_runs
def lagged_readings(x: FloatArray, theta: FloatArray, time: FloatArray) -> FloatArray:
    """Return readings that lag by first order, (n_samples, n_points); each run begins without a lag.

    `theta` (n_samples, 2) is the time constant, and what readings do between the rows: those of a row hold in the gap
    before it (0), are smooth (1), or hold in the gap after it (2).
    """
    if len(time) < 2:
        return x
    tau, between, gaps = theta[:, :1], np.round(theta[:, 1:2]), np.diff(time)
    with np.errstate(divide="ignore"):
        carry = np.where(tau > 0, np.exp(-gaps / np.where(tau > 0, tau, 1.0)), 0.0)
    gain = (1 - carry) * np.where((between == 2) & (tau > 0), x[:, :-1], x[:, 1:])
    if (smooth := between == 1).any():
        gain = np.where(smooth & (gaps > 0), _gain_of_smooth_readings(time, x, tau, carry), gain)
    added, kept = np.insert(gain, 0, x[:, 0], axis=1), np.insert(carry, 0, 0.0, axis=1)
    return decaying_sum(added, kept, longest=len(time))


def _gain_of_smooth_readings(time: FloatArray, x: FloatArray, tau: FloatArray, carry: FloatArray) -> FloatArray:
    """Return what each gap adds to `carry` times the lagging reading before it, (n_samples, n - 1).

    Of a cubic x the lagging reading is x - tau x' + tau^2 x'' - tau^3 x''' once the start is forgotten.
    """
    (third, second, first, start), gap = _cubics(time, x), np.diff(time)
    twist = 6 * tau**3 * third
    begin = start - tau * first + 2 * tau**2 * second - twist
    slope, bend = first + gap * (2 * second + 3 * gap * third), 2 * second + 6 * gap * third
    return np.asarray(x[:, 1:] - tau * slope + tau**2 * bend - twist - carry * begin)


def delayed_readings(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return readings after a dead time, (n_samples, n_points); before it is over, a run's first reading holds.

    `theta` (n_samples, 2) is the dead time, and above 0.5 for readings that are smooth between the rows.
    """
    out: FloatArray = delayed_values(value, theta, table)
    smooth = np.flatnonzero(theta[:, 1] > 0.5)
    if smooth.size:
        by, own = theta[smooth, 0], value[smooth] if len(value) > 1 else value
        for rows in table.rows_by_scan():
            out[np.ix_(smooth, rows)] = earlier_values(table.time_s[rows], own[:, rows], by, smooth=True)
    return out


@within_runs
def delayed_values(values: FloatArray, theta: FloatArray, time: FloatArray) -> FloatArray:
    """Return readings or a column, (n_points,) or (n_samples, n_points), delayed within runs by theta[:, 0]."""
    return earlier_values(time, values, theta[:, 0])


def earlier_values(time: FloatArray, values: FloatArray, by: FloatArray, *, smooth: bool = False) -> FloatArray:
    """Interpolate values (1 or n_samples, n), given at times (n,), at times earlier by `by`: (n_samples, n).

    Before the first time, the first value holds. Values lie on straight lines, or on a spline if they are `smooth`.
    """
    if len(time) < 2:
        return np.broadcast_to(values, (len(by), len(time)))
    asked = np.maximum(time - by[:, None], time[0])
    before = np.clip(np.searchsorted(time, asked.ravel(), side="right").reshape(asked.shape), 1, len(time) - 1) - 1
    every = np.broadcast_to(values, asked.shape)
    if smooth:
        since, found = asked - time[before], np.zeros(asked.shape)
        for power in _cubics(time, values):
            gaps = np.broadcast_to(power, (len(by), len(time) - 1))
            found = found * since + np.take_along_axis(gaps, before, axis=1)
    else:
        gap = time[before + 1] - time[before]
        share = np.clip((asked - time[before]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
        low, high = (np.take_along_axis(every, row, axis=1) for row in (before, before + 1))
        found = low + share * (high - low)
    # Where two rows have the same time, interpolation would take the last for the first.
    return np.where(by[:, None] == 0, every, found)


def forms_on_readings(about: ReferenceFit) -> Iterator[Effect]:
    """Yield every form of the reading that could be detectable in this table."""
    own, zero = about.system.simulator, about.system.simulator.noise.zero
    span = float(np.ptp(about.predicted)) or about.sd
    reading = Quantity(own.reading, own.unit, Stage.OFFSET, about.sd, lambda y, change: y + change)
    called, scaled = f"the gain of {own.reading}", lambda y, change: zero + (y - zero) * (1 + change)
    gain = Quantity(called, "1", Stage.GAIN, about.sd / span, scaled, ("level",))
    for kind, form in forms_over_rows(about).items():
        yield from form(about, f"offset_{kind}", reading)
        ends = {"may_end": True} if kind == "step" else {}  # rows may be in another unit for a while
        yield from form(about, f"gain_{kind}", gain, **ends)
    if about.table.has_varying_time:
        yield from wave_form(about, "interference", reading)
        yield from _settling_form(about)
        lags, dead = np.geomspace(0.02, 200.0, 33), np.geomspace(1e-3, 100.0, 41)
        yield from _late_form(about, "lag", lagged_readings, lags, "lags with a time constant of {0}", 3)
        yield from _late_form(about, "delay", delayed_readings, dead, "is delayed by {0}", 2)
    for name in about.varying_columns:
        yield from form_along_column(about, f"sensitivity:{name}", reading, name)
        yield from _curve_form(about, name)
        if name not in about.states:
            yield from _friction_form(about, name)
    yield from _hysteresis_form(about)
    yield from _nonlinearity_form(about)
    yield from _saturation_form(about)


def _curve_form(about: ReferenceFit, name: str) -> Iterator[Effect]:
    """Yield a polynomial in a column scaled to [-1, 1]; its order, less than the number of values, is a variant."""
    column, reading, unit = about.table.covariates[name], about.system.simulator.reading, about.reading_unit
    low, high, n = float(np.nanmin(column)), float(np.nanmax(column)), len(_COEFFICIENTS)
    last = min(len(distinct_values(column[about.has_reading])) - 1, n)
    if last < 2:
        return

    def act(value: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        z = (2 * rows.covariates[name] - low - high) / (high - low)
        return np.asarray(value + theta @ z ** np.arange(1, n + 1)[:, None])

    def says(mean: FloatArray, sd: FloatArray) -> str:
        sizes = [value_with_sd(mean[k], sd[k], unit) for k in range(n) if sd[k] > _HARDLY * sd.max()]
        said = " + ".join(f"({size}) z^{k}" if k > 1 else f"({size}) z" for k, size in enumerate(sizes, 1))
        return f"{reading} follows a curve of {name}: {said}, z from -1 at {name} = {low:.4g} to 1 at {high:.4g}"

    own = (dict.fromkeys(_COEFFICIENTS, (AMPLITUDE, unit)), (covariate_of_column(name),), act, says)
    for whole in about.form(f"curve:{name}", Stage.OFFSET, *own):
        first, *others = (_up_to_order(whole, order, int(about.has_reading.sum())) for order in range(2, last + 1))
        yield replace(first, alternatives=tuple(others))


def _up_to_order(curve: Effect, order: int, n_read: int) -> Effect:
    """Return the variant of a curve whose higher coefficients are 0, and whose highest one can be seen.

    Otherwise it would be the curve of the order below, or a straight line, which has a name.
    """
    none = Fixed(-ROUNDING * curve.entries.max(), ROUNDING * curve.entries.max())
    highest = cast(HeavyTailedPrior, curve.marginals[_COEFFICIENTS[order - 1]])
    seen = replace(highest, smallest=max(highest.smallest, min(LEAST_VISIBLE / np.sqrt(n_read), 1.0)))
    priors = {**curve.marginals, _COEFFICIENTS[order - 1]: seen, **dict.fromkeys(_COEFFICIENTS[order:], none)}
    return replace(curve, parameters=priors, entries=curve.entries[:, :order])


def _friction_form(about: ReferenceFit, name: str) -> Iterator[Effect]:
    """Yield the friction of a column that moves both ways: a sign or, another variant, a smooth one."""
    column, unit = about.table.covariates[name][about.has_reading], about.reading_unit
    points, speeds = switch_points(column), np.sort(np.abs(column[column != 0]))
    if not points.size or not points[0] < 0 < points[-1]:
        return
    low, high = float(speeds[ROWS_OF_A_SIDE - 1]), 0.5 * float(np.nanmax(speeds))

    @acting
    def act(value: FloatArray, rows: RunTable, a: FloatArray, width: FloatArray) -> FloatArray:
        return value + a * np.tanh(rows.covariates[name] / np.maximum(width, 0.1 * ROUNDING * low))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        by = f"tanh({name} / width), width {value_with_sd(mean[1], sd[1])}" if mean[1] > ROUNDING * low else "its sign"
        size = value_with_sd(mean[0], sd[0], unit)
        return f"{about.system.simulator.reading} has dry friction of {name}: {size} times {by}"

    parameters: Declared = {"a": (AMPLITUDE, unit), "width": (Fixed(0.0, ROUNDING * low), name)}
    own = (parameters, (covariate_of_column(name),), act, says, single_column_bank(1.0, 0.5 * ROUNDING * low))
    for sign in about.form(f"friction:{name}", Stage.OFFSET, *own):
        if low < high:
            widths = single_column_bank(sign.entries[0, 0, 0], np.geomspace(low, high, N_SIZES))
            smooth = replace(sign, parameters={**sign.marginals, "width": LogUniform(low, high)}, entries=widths)
            sign = replace(sign, alternatives=(smooth,))
        yield sign


def settling_time_prior(about: ReferenceFit) -> LogUniform:
    """Return the prior of a settling time: from half a gap, or a hundredth of the longest run, to twice that run."""
    longest = float(time_since_start_of_run(about.table).max()) or 1.0
    return LogUniform(min(0.5 * about.table.median_gap, 0.01 * longest), 2 * longest)


def _settling_form(about: ReferenceFit) -> Iterator[Effect]:
    prior, units = settling_time_prior(about), (about.reading_unit, about.time_unit)
    act = acting(lambda value, rows, a, tau_s: value + a * np.exp(-time_since_start_of_run(rows) / tau_s))
    start = "the start" + " of each run" * (len(about.table.scan_names) > 1)
    says = f"is off by {{0}} at {start}, and settles with a time constant of {{1}}"
    words, taus = f"{about.system.simulator.reading} {says}", np.geomspace(prior.low * 1.5, 0.5 * prior.high, N_SIZES)
    parameters: Declared = {"a": (AMPLITUDE, units[0]), "tau_s": (prior, units[1])}
    own = (parameters, ("time", "run"), act, in_words(words, *units), single_column_bank(1.0, taus))
    yield from about.form("settling", Stage.OFFSET, *own, guess=1.0)


def _hysteresis_form(about: ReferenceFit) -> Iterator[Effect]:
    def side(values: FloatArray, rows: RunTable) -> FloatArray:
        return sign_of_change(values, rows.rows_by_scan(), still=rounding_error(values, axis=1))

    if np.ptp(side(about.predicted[None, :], about.table)) == 0:
        return
    own, way = about.system.simulator, "{more/less} while it rises than while it falls"
    says = in_words(f"{own.reading} reads {{|0|}} {way}", own.unit, factors=(2,))
    act = acting(lambda value, rows, a: value + a * side(value, rows))
    size: Declared = {"a": (AMPLITUDE, own.unit)}
    yield from about.form("hysteresis", Stage.HYSTERESIS, size, ("previous",), act, says, typical=about.sd)


def _expected_readings_and_inliers(about: ReferenceFit) -> tuple[FloatArray, BoolArray]:
    """Return the readings to be expected, (n_points,), and the mask of the readings that are no outliers from these.

    They are the predicted ones, bent by a polynomial in these, fitted to the residuals: without it a law that lacks a
    bend misses the ends of the range by many noise sds.
    """
    predicted, readings = about.predicted, about.table.columns[about.system.simulator.reading]
    low, high = float(predicted.min()), float(predicted.max())
    there = np.isfinite(readings)
    degree = min(_BEND_DEGREE, distinct_values(predicted[there]).size - 1)
    if not low < high or degree < 1:
        return predicted, there
    level, residual = 2 * (predicted - low) / (high - low) - 1, readings - predicted
    bend = np.zeros(1)
    for _ in range(3):  # the last two without outlying residuals
        bend = chebfit(level[there], residual[there], degree)
        off = np.abs(residual - chebval(level, bend))
        there = np.isfinite(readings) & (off <= OUTLYING * max(np.nanmedian(off), about.sd))
    return predicted + chebval(level, bend), there


def _nonlinearity_form(about: ReferenceFit) -> Iterator[Effect]:
    expected = _expected_readings_and_inliers(about)[0]
    low, high = float(expected.min()), float(expected.max())
    if not low < high:
        return

    @acting
    def act(value: FloatArray, rows: RunTable, a: FloatArray, power: FloatArray) -> FloatArray:
        share = (value - low) / (high - low)
        # Limited so that the response rises from near the low end on: what falls again is no bend of a meter.
        ends = power * np.array([_NEAR_LOW, 1.0]) ** (power - 1) - 1
        with np.errstate(divide="ignore"):
            limits = -1 / ends
        most = np.min(np.where(ends < 0, limits, np.inf), axis=1, keepdims=True)
        a = np.clip(a, np.max(np.where(ends > 0, limits, -np.inf), axis=1, keepdims=True), most)
        return value + a * (high - low) * (np.sign(share) * np.abs(share) ** power - share)

    z = f"z from 0 at {low:.4g} to 1 at {high:.4g} {about.reading_unit}"
    bend = f"y + a (hi - lo) (z^power - z) with {z}, a = {{0}}, power = {{1}}"
    says = in_words(f"{about.system.simulator.reading} has a bent response, {bend}")
    parameters: Declared = {"a": (AMPLITUDE, "1"), "power": (LogUniform(0.4, 5.0), "1")}
    own = (parameters, ("level",), act, says, single_column_bank(1.0, np.array([0.5, 1.5, 2.0, 3.0, 4.0])))
    yield from about.form("nonlinearity", Stage.BEND, *own, guess=about.sd / (high - low))


def _saturation_form(about: ReferenceFit) -> Iterator[Effect]:
    low, high = float(about.predicted.min()), float(about.predicted.max())
    if not low < high:
        return
    # One wild reading would move the middle of the range, which tells a ceiling from a floor.
    readings = about.table.columns[about.system.simulator.reading][_expected_readings_and_inliers(about)[1]]
    lowest, highest = about.system.simulator.noise.ends
    within = (readings >= lowest) & (readings <= highest)
    # Outside the declared range are no readings of the quantity, such as 9999 for an error.
    least, most = (float(end(readings[within] if within.any() else readings)) for end in (np.min, np.max))

    # Clipped readings end at the limit: in the upper half of their range it is a ceiling, in the lower half a floor.
    middle, top, bottom = 0.5 * (least + most), max(high, most), min(low, least)
    span, depths = top - bottom, np.geomspace(0.005, 0.9, 16)
    ceilings, floors = top - span * depths, bottom + span * depths
    levels = np.concatenate([ceilings[ceilings > middle], floors[floors < middle]])
    if levels.size:
        prior = Uniform(bottom - 0.02 * span, top + 0.02 * span)
        ends = Clipping(prior, middle, levels, float(top + 1e3 * span))
        unit, says = about.reading_unit, ends.says(about.system.simulator.reading, about.reading_unit)
        own = ({"level": (prior, unit)}, ("level",), ends.act, says, single_column_bank(levels))
        yield from about.form("saturation", Stage.SATURATION, *own, absent={0: ends.nowhere})
