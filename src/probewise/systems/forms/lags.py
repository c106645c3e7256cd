"""Readings that come late: a lag of first order, and a dead time.

What a reading does between its rows is not recorded. Where rows are not dense beside the lag that makes a difference of
up to half a gap, as large as the lag itself. So each form has two variants: the reading changes at the rows (a lag) or
on straight lines between them (a dead time), or it is smooth, a cubic spline.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._words import value_with_sd
from probewise.effects.decaying_sum import decaying_sum
from probewise.priors import LogUniform
from probewise.sensor import Stage
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import Act, Form, flag_with_prior
from probewise.systems.forms.splines import Spline
from probewise.systems.table import RunTable

_N_SIZES = 9
_SMOOTH = "smooth"  # name of the parameter that is 0 for the first variant, and 1 for the smooth one
_ODDS_OF_SMOOTH = 0.05  # prior: the rows of most tables are dense beside what matters
_APART = 1.0  # lambda between the two at some trial size, below which they are the same


def late_forms(about: ReferenceFit) -> Iterator[Form]:
    """Yield the forms of a reading that comes late: `lag` and `delay`."""
    reading, unit = about.system.simulator.reading, about.time_unit
    for name, act, tried, says in (
        ("lag", lagged_readings, np.geomspace(0.02, 200.0, 33), f"{reading} lags with a time constant of"),
        ("delay", delayed_readings, np.geomspace(1e-3, 100.0, 41), f"{reading} is delayed by"),
    ):
        prior = about.log_uniform_size_prior(Stage.LAG, _at_rows_alone(act), about.median_gap * tried)
        if prior is not None:
            yield _with_smooth_variant(about, name, act, prior, says, unit)


def _at_rows_alone(act: Act) -> Act:
    return lambda value, theta, table: act(value, np.append(theta, np.zeros_like(theta), axis=1), table)


def _with_smooth_variant(
    about: ReferenceFit, name: str, act: Act, prior: LogUniform, says: str, time_unit: str
) -> Form:
    sizes = np.geomspace(prior.low * 1.2, prior.high / 1.2, _N_SIZES)

    def variant(smooth: bool) -> Form:
        flag, prior_of_flag = flag_with_prior(smooth)
        return Form(
            name,
            Stage.LAG,
            marginals={"tau_s": prior, _SMOOTH: prior_of_flag},
            units=(time_unit, "1"),
            covariates=("previous",),
            act=act,
            entries=np.stack([sizes, np.full(_N_SIZES, flag)], axis=1)[:, None, :],
            amplitudes=(),
            says=lambda mean, sd: f"{says} {value_with_sd(mean[0], sd[0], time_unit)}",
            absent={0: 0.0},
            needs_rising_time=True,
            fixed=(_SMOOTH,),
            relative_odds=_ODDS_OF_SMOOTH if smooth else 1.0,
        )

    at_rows, smooth = variant(False), variant(True)
    value = about.predicted[None, :]
    apart = act(value, at_rows.entries[:, 0], about.table) - act(value, smooth.entries[:, 0], about.table)
    size = np.sqrt(np.nansum(apart[:, about.has_reading] ** 2, axis=1)) / about.sd
    return replace(at_rows, alternatives=(smooth,)) if size.max() > _APART else at_rows


def lagged_readings(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return readings that lag by first order, (n_samples, n_points); each run begins without a lag.

    `theta` (n_samples, 2) is the time constant, and above 0.5 for readings that are smooth between the rows.
    """
    out = np.array(np.broadcast_to(value, (max(len(value), len(theta)), value.shape[1])))
    tau, smooth = theta[:, :1], theta[:, 1:2] > 0.5
    for rows in table.rows_by_scan():
        if len(rows) < 2:
            continue
        time, x = table.time_s[rows], out[:, rows]
        gaps = np.diff(time)
        with np.errstate(divide="ignore"):
            carry = np.where(tau > 0, np.exp(-gaps / np.where(tau > 0, tau, 1.0)), 0.0)
        gain = (1 - carry) * x[:, 1:]
        if smooth.any():
            gain = np.where(smooth & (gaps > 0), _gain_of_smooth_readings(Spline(time, x), tau, carry), gain)
        added, kept = np.insert(gain, 0, x[:, 0], axis=1), np.insert(carry, 0, 0.0, axis=1)
        out[:, rows] = decaying_sum(added, kept, longest=len(rows))
    return out


def _gain_of_smooth_readings(spline: Spline, tau: FloatArray, carry: FloatArray) -> FloatArray:
    """Return what each gap adds to `carry` times the lagging reading before it, (n_samples, n - 1).

    Of a cubic x the lagging reading is x - tau x' + tau^2 x'' - tau^3 x''' once the start is forgotten.
    """
    second_after, second_before, third = spline.derivatives
    late = tau**2 * np.stack([second_after, second_before]) - tau**3 * third
    begin = spline.values[:, :-1] - tau * spline.slopes[:, :-1] + late[0]
    end = spline.values[:, 1:] - tau * spline.slopes[:, 1:] + late[1]
    return np.asarray(end - carry * begin)


def delayed_readings(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return readings after a dead time, (n_samples, n_points); before it is over, a run's first reading holds.

    `theta` (n_samples, 2) is the dead time, and above 0.5 for readings that are smooth between the rows.
    """
    out = delayed_values(value, theta, table)
    smooth = np.flatnonzero(theta[:, 1] > 0.5)
    if smooth.size:
        by, own = theta[smooth, 0], value[smooth] if len(value) > 1 else value
        for rows in table.rows_by_scan():
            out[np.ix_(smooth, rows)] = _smooth_values_at_earlier_times(table.time_s[rows], own[:, rows], by)
    return out


def delayed_values(values: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return readings or a column, (n_points,) or (n_samples, n_points), delayed within runs by theta[:, 0]."""
    values = np.atleast_2d(values)
    out = np.empty((max(len(values), len(theta)), values.shape[1]))
    for rows in table.rows_by_scan():
        out[:, rows] = values_at_earlier_times(table.time_s[rows], values[:, rows], theta[:, 0])
    return out


def values_at_earlier_times(time: FloatArray, values: FloatArray, by: FloatArray) -> FloatArray:
    """Interpolate values (1 or n_samples, n), given at times (n,), at times earlier by `by`: (n_samples, n).

    Before the first time, the first value holds.
    """
    if len(time) < 2:
        return np.broadcast_to(values, (len(by), len(time)))
    asked = time[None, :] - by[:, None]
    after = _index_of_next_row(time, asked)
    gap = time[after] - time[after - 1]
    share = np.clip((asked - time[after - 1]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
    values = np.broadcast_to(values, asked.shape)
    low, high = np.take_along_axis(values, after - 1, axis=1), np.take_along_axis(values, after, axis=1)
    # Where two rows have the same time, interpolation would take the last for the first.
    return np.where(by[:, None] == 0, values, low + share * (high - low))


def _index_of_next_row(time: FloatArray, asked: FloatArray) -> IntArray:
    """Return the index of the row after each time asked for, (n_samples, n), from 1 to that of the last row."""
    return np.clip(np.searchsorted(time, asked.ravel(), side="right").reshape(asked.shape), 1, len(time) - 1)


def _smooth_values_at_earlier_times(time: FloatArray, values: FloatArray, by: FloatArray) -> FloatArray:
    """Return what `values_at_earlier_times` does, by a spline."""
    if len(time) < 2:
        return np.broadcast_to(values, (len(by), len(time)))
    asked = np.maximum(time[None, :] - by[:, None], time[0])
    gap = _index_of_next_row(time, asked) - 1
    found = Spline(time, values).at(gap, asked - time[gap])
    return np.where(by[:, None] == 0, np.broadcast_to(values, asked.shape), found)
