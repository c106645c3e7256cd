"""Forms on the inputs: errors of a column, and of the clock."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, distinct_values, rounding_error
from probewise.effects.effect import PHASE, Act, WaveEffect, acting, in_words, sine_and_cosine_entries
from probewise.priors import LogUniform
from probewise.sensor import Stage
from probewise.systems.forms.modulations import (
    max_n_trial_frequencies,
    origin_in_words,
    origin_of_column,
    trial_frequencies,
)
from probewise.systems.forms.readings import delayed_values, values_at_earlier_times
from probewise.systems.forms.reference import (
    AMPLITUDE,
    POSITIVE,
    ActInTime,
    Form,
    ReferenceFit,
    clipping_between,
)
from probewise.systems.law import rounding_of_times
from probewise.systems.table import RunTable, covariate_of_column

_NUDGE = 1e-4  # of a column's spread: the step that tests whether it drives the readings
_MOST_FREQUENCIES = 600
_MOST_FREQUENCIES_CALLED = 96  # where each is two calls of a person's function
_ROWS_OF_A_WAVE = 4  # least distinct values per period on average: with fewer, some wave fits any readings
_LEAST_WAVES = 1.5  # in a column's range: half a period is seen again; any bend is a part of a slower wave
_NEAR_ZERO = 0.1  # of a column's range: largest dead zone
_FORTH_AND_BACK = 0.02  # least share of rows that move in each direction


def driving_columns(about: ReferenceFit) -> list[str]:
    """Return the names of the columns, except time, that the simulated readings depend on."""
    out = []
    for name, values in about.varying_columns.items():
        nudges = (_with_offset, _NUDGE * float(np.nanstd(values))), (_with_gain, _NUDGE)
        acts = ((_column_changer(name, change), np.array([[size]])) for change, size in nudges)
        if max(float(about.rms_change_in_sds(Stage.INPUT, *each)[0]) for each in acts) > 0:
            out.append(name)
    return out


def forms_on_inputs(about: ReferenceFit) -> Iterator[Form]:
    """Yield a form for each possible error of the columns that drive the simulator, and of the clock."""
    for name in driving_columns(about):
        yield from _forms_on_column(about, name)
    time = about.table.time
    if time is not None:
        origin = origin_of_column(about.table.time_s)
        act = _column_changer(time, acting(lambda c, rows, a: origin + (c - origin) * (1 + a)))
        says = in_words("the true time is the recorded time times (1 + a), a = {0}")
        own = ("clock_drift", Stage.INPUT, {"a": (AMPLITUDE, "1")}, ("time",), act, says)
        yield from about.form(*own, guess=1e-5, counted_from=origin_in_words(time, origin, about.time_unit))


def _forms_on_column(about: ReferenceFit, name: str) -> Iterator[Form]:
    values, unit, column = about.table.covariates[name], about.time_unit, covariate_of_column(name)
    spread, span = float(np.nanstd(values)), float(np.nanmax(values)) - float(np.nanmin(values))
    true, late = f"the true {name} is the recorded {name}", ("previous", column)

    def amplitude(kind: str, change: Act, guess: float, unit: str, says: str) -> Iterator[Form]:
        own = (f"{kind}:{name}", Stage.INPUT, {"a": (AMPLITUDE, unit)}, (column,), _column_changer(name, change))
        return about.form(*own, in_words(says), guess=guess)

    def size(
        kind: str, act: Act, own: tuple[str, str], along: tuple[str, ...], says: str, **more: Any
    ) -> Iterator[Form]:
        tried = (about.duration if kind == "input_delay" else span) * np.geomspace(1e-7, 0.5, 40)
        return about.sized(f"{kind}:{name}", Stage.INPUT, own, along, act, in_words(says), tried, **more)

    yield from amplitude("input_offset", _with_offset, 1e-4 * spread, name, f"{true} plus {{0}}")
    yield from amplitude("input_gain", _with_gain, 1e-4, "1", f"{true} times (1 + a), a = {{0}}")
    ends = clipping_between(values)
    if ends is not None:
        act = _column_changer(name, ends.act)
        if np.nanmax(about.rms_change_in_sds(Stage.INPUT, act, ends.tried[:, None]), initial=0.0) > 0.05:
            own = (f"input_saturation:{name}", Stage.INPUT, ends, name, (column,), act, ends.says(name))
            yield from about.clipped(*own)
    if float(np.nanmin(np.abs(values))) <= _NEAR_ZERO * span:  # if larger, it is an offset
        zone = acting(lambda c, rows, width: np.sign(c) * np.maximum(np.abs(c) - width, 0.0))
        within = f"{name} has no effect within {{0}} of 0"
        yield from size("dead_zone", _column_changer(name, zone), ("width", name), (column,), within)
    if _moves_both_ways(values, about.table):
        play = _column_changer(name, column_with_play)
        yield from size("backlash", play, ("width", name), late, f"{name} has {{0}} of play")
    yield from _periodic_error_form(about, name)
    if about.table.has_varying_time:
        delay, says = _column_delayer(about, name), f"{name} acts with a delay of {{0}} {unit}"
        yield from size("input_delay", delay, ("tau_s", unit), late, says, needs_rising_time=True)


_with_offset = acting(lambda c, rows, a: c + a)
_with_gain = acting(lambda c, rows, a: c * (1 + a))


def _column_changer(name: str, change: Act) -> Act:
    """Return the act on the inputs that applies `change` to the column `name`, (n_points,) or (n_samples, n_points)."""
    return lambda value, theta, table: {**value, name: np.asarray(change(value[name], theta, table))}


def _column_delayer(about: ReferenceFit, name: str) -> Act:
    """Return the function that delays the column `name`: of a law at the rows as well as between them."""
    held = about.is_held_between_rows(name)
    if about.system.simulator.law is None:
        return _column_changer(name, mean_of_delayed_held_column if held else delayed_values)
    at_rows = _column_changer(name, delayed_held_column if held else delayed_values)
    return ActInTime(at_rows, lambda motion, theta: motion.plus(dead_times={name: theta[:, :1]}))


def _periodic_error_form(about: ReferenceFit, name: str) -> Iterator[Form]:
    column = about.table.covariates[name]
    values = column[np.isfinite(column) & about.has_reading]  # others resolve no wave: it would fit any readings
    if len(distinct_values(values)) < 3 * _ROWS_OF_A_WAVE:
        return
    origin = origin_of_column(column[np.isfinite(column)])
    wave = acting(lambda c, rows, a, period, phase: c + a * np.sin(2 * np.pi * (c - origin) / period + phase))
    most = _MOST_FREQUENCIES if about.system.predicts_in_bulk else _MOST_FREQUENCIES_CALLED
    if about.system.caller is None:
        most = max_n_trial_frequencies(len(about.table))
    frequencies = trial_frequencies(np.sort(values), [np.arange(len(values))], most, _ROWS_OF_A_WAVE, _LEAST_WAVES)
    longest, shortest = (float(1 / frequencies[k]) for k in (0, -1))
    yield from about.form(
        f"periodic_error:{name}",
        Stage.INPUT,
        {"a": (POSITIVE, name), "period": (LogUniform(shortest * 0.98, longest / 0.9), name), "phase": (PHASE, "rad")},
        (covariate_of_column(name),),
        _column_changer(name, wave),
        in_words(
            f"{name} has a periodic error with an amplitude of {{0}} and a period of {{1}}, both in units of {name}"
        ),
        sine_and_cosine_entries(1.0, 1 / frequencies),
        guess=1e-4 * float(np.std(values)),
        kind=WaveEffect,
        counted_from=origin_in_words(name, origin),
    )


def delayed_held_column(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return the value that a held column had one dead time before each row, (n_samples, n_points)."""
    values = np.atleast_2d(c)
    out = np.empty((max(len(values), len(theta)), values.shape[1]))
    for rows in table.rows_by_scan():
        time = table.time_s[rows]
        earlier = time - theta[:, :1] + rounding_of_times(time)
        before = np.clip(np.searchsorted(time, earlier, side="right") - 1, 0, None)
        before = np.where(theta[:, :1] == 0, np.arange(len(rows)), before)  # also of rows with the same time
        own = np.broadcast_to(values[:, rows], (len(out), len(rows)))
        out[:, rows] = np.take_along_axis(own, np.broadcast_to(before, own.shape), axis=1)
    return out


def mean_of_delayed_held_column(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return a held column delayed by a dead time, (n_samples, n_points): at each row its mean until the next row."""
    values = np.atleast_2d(c)
    out = np.array(np.broadcast_to(values, (max(len(values), len(theta)), values.shape[1])))
    by = theta[:, 0]
    for rows in table.rows_by_scan():
        time, own = table.time_s[rows], values[:, rows]
        gaps = np.diff(time)
        there = gaps > rounding_error(table.time_s)
        total = np.concatenate([np.zeros((len(own), 1)), np.cumsum(own[:, :-1] * gaps, axis=1)], axis=1)
        since = values_at_earlier_times(time, total, by) + own[:, :1] * np.minimum(time - by[:, None] - time[0], 0.0)
        out[:, rows[:-1][there]] = np.diff(since, axis=1)[:, there] / gaps[there]
    return out


def column_with_play(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return a column with play (backlash), (n_samples, n_points): it rests until the play is taken up.

    A run starts as if it had arrived in the direction of its first motion; without any, in the middle of the play.
    """
    values = np.atleast_2d(c)
    half = 0.5 * theta[:, 0]
    out = np.empty((max(len(values), len(theta)), values.shape[1]))
    for rows in table.rows_by_scan():
        own = np.broadcast_to(values[:, rows[0]], half.shape).copy()
        first = np.flatnonzero(np.abs(np.diff(values[0, rows])) > rounding_error(values[0]))
        if first.size:  # assume the direction of arrival is that of the first motion
            own -= half * np.sign(values[0, rows[first[0] + 1]] - values[0, rows[first[0]]])
        for row in rows:
            own = np.clip(own, values[:, row] - half, values[:, row] + half)
            out[:, row] = own
    return out


def _moves_both_ways(values: FloatArray, table: RunTable) -> bool:
    """Return whether a column both rises and falls, each at more than 2 % of the steps from row to row."""
    moves = np.concatenate([np.diff(values[rows]) for rows in table.rows_by_scan()])
    if not moves.size:
        return False
    still = rounding_error(values)
    return bool((moves > still).mean() > _FORTH_AND_BACK and (moves < -still).mean() > _FORTH_AND_BACK)
