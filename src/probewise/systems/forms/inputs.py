"""Forms on the inputs: errors of a column, and of the clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.waves import PHASE, sine_and_cosine_entries, starting_point_of_wave
from probewise.priors import LogUniform
from probewise.sensor import Stage
from probewise.systems.forms.about import About
from probewise.systems.forms.clipping import clipping_levels
from probewise.systems.forms.form import Act, Form, Say, with_unit
from probewise.systems.forms.modulations import most_waves_of_a_law, wave_numbers
from probewise.systems.forms.readings import delayed, earlier
from probewise.systems.table import RunTable

_N_SIZES = 9
_NUDGE = 1e-4  # of a column's spread: the step that tests whether it drives the readings
_MOST_WAVES = 600
_MOST_WAVES_CALLED = 96  # where each is two calls of a person's function
_ROWS_OF_A_WAVE = 4  # least distinct values per period on average: with fewer, some wave fits any readings
_NEAR_ZERO = 0.1  # of a column's range: largest dead zone
_FORTH_AND_BACK = 0.02  # least share of rows that move in each direction

Change = Callable[[FloatArray, FloatArray, RunTable], FloatArray]
"""Function of a column (n_points,) or (n_samples, n_points), parameters and the table; returns the true column."""


def driving_columns(about: About) -> list[str]:
    """Return the columns, except time, that the simulated readings depend on."""
    own, table = about.system.simulator, about.table
    out = []
    for name, values in table.covariates.items():
        spread = float(np.nanstd(values))
        if name == own.reading or name == own.noise.sd or spread == 0:
            continue
        rms = about.rms(Stage.INPUT, _on_column(name, _with_offset), np.array([[_NUDGE * spread]]))
        wave = about.rms(Stage.INPUT, _on_column(name, _scaled_column), np.array([[_NUDGE]]))
        if max(float(rms[0]), float(wave[0])) > 0:
            out.append(name)
    return out


def forms_on_inputs(about: About) -> Iterator[Form]:
    """Yield the possible errors of each column that drives the simulator, and of the clock."""
    table, time = about.table, about.table.time
    for name in driving_columns(about):
        values = table.covariates[name]
        spread, low, high = float(np.nanstd(values)), float(np.nanmin(values)), float(np.nanmax(values))
        says = partial(_sentence_of, f"the true {name} is the recorded {name} plus {{}}")
        yield from _linear_forms(
            about, f"input_offset:{name}", _on_column(name, _with_offset), 1e-4 * spread, name, says, name
        )
        says = partial(_sentence_of, f"the true {name} is the recorded {name} times (1 + a), a = {{}}")
        yield from _linear_forms(about, f"input_gain:{name}", _on_column(name, _scaled_column), 1e-4, "1", says, name)
        yield from _cut_off_forms(about, name, low, high)
        says = partial(_sentence_of, f"{name} has no effect within {{}} of 0")
        if float(np.nanmin(np.abs(values))) <= _NEAR_ZERO * (high - low):  # if larger, it is an offset
            yield from _form_with_sizes(
                about, f"dead_zone:{name}", "width", _on_column(name, _dead_zone), high - low, name, says, name
            )
        if _turns_back(values, table):
            says = partial(_sentence_of, f"{name} has {{}} of play")
            yield from _form_with_sizes(
                about, f"backlash:{name}", "width", _on_column(name, play), high - low, name, says, "previous", name
            )
        yield from _wave_forms(about, name)
        if table.has_time:
            says = partial(_sentence_of, f"{name} acts with a delay of {{}} {about.time_unit}")
            yield from _form_with_sizes(
                about,
                f"input_delay:{name}",
                "tau_s",
                _on_column(name, delayed_while_held if about.holds(name) else delayed),
                about.duration,
                about.time_unit,
                says,
                "previous",
                name,
            )
    if time is not None:
        says = partial(_sentence_of, "the true time is the recorded time times (1 + a), a = {}")
        yield from _linear_forms(about, "clock_drift", _on_column(time, _scaled_column), 1e-5, "1", says, "time")


def _sentence_of(sentence: str, mean: FloatArray, sd: FloatArray) -> str:
    return sentence.format(with_unit(mean[0], sd[0], ""))


def _with_offset(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    return np.asarray(c + theta[:, :1])


def _scaled_column(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    return np.asarray(c * (1 + theta[:, :1]))


def _on_column(name: str, change: Change) -> Act:
    return lambda value, theta, table: {**value, name: np.asarray(change(value[name], theta, table))}


def _linear_forms(
    about: About, name: str, act: Act, guess: float, unit: str, says: Say, *covariates: str
) -> Iterator[Form]:
    typical = about.typical(Stage.INPUT, act, np.full((1, 1, 1), guess), guess)
    if typical is not None:
        yield Form(
            name,
            Stage.INPUT,
            {"a": about.amplitude(typical)},
            (unit,),
            covariates,
            act,
            np.full((1, 1, 1), typical),
            (0,),
            says,
        )


def _form_with_sizes(
    about: About, name: str, parameter: str, act: Act, most: float, unit: str, says: Say, *covariates: str
) -> Iterator[Form]:
    prior = about.log_uniform(Stage.INPUT, act, most * np.geomspace(1e-7, 0.5, 40))
    if prior is not None:
        entries = np.geomspace(prior.low * 1.2, prior.high / 1.2, _N_SIZES)[:, None, None]
        yield Form(name, Stage.INPUT, {parameter: prior}, (unit,), covariates, act, entries, (), says, absent={0: 0.0})


def _cut_off_forms(about: About, name: str, low: float, high: float) -> Iterator[Form]:
    ends = clipping_levels(low, high)
    if ends is None:
        return

    def change(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        level = theta[:, :1]
        return np.asarray(np.where(level > ends.middle, np.minimum(c, level), np.maximum(c, level)))

    act = _on_column(name, change)
    if np.nanmax(about.rms(Stage.INPUT, act, ends.levels[:, None]), initial=0.0) > 0.05:
        yield Form(
            f"input_saturation:{name}",
            Stage.INPUT,
            {"level": ends.prior},
            (name,),
            (name,),
            act,
            ends.levels[:, None, None],
            (),
            lambda m, s: (
                f"{name} {'rises' if m[0] > ends.middle else 'falls'} no further than {with_unit(m[0], s[0], '')}"
            ),
            absent={0: ends.out_of_reach},
        )


def _most_waves(about: About) -> int:
    if about.system.caller is None:
        return most_waves_of_a_law(len(about.table))
    return _MOST_WAVES if about.system.in_bulk else _MOST_WAVES_CALLED


def _wave_forms(about: About, name: str) -> Iterator[Form]:
    values = about.table.covariates[name]
    if len(np.unique(values)) < 3 * _ROWS_OF_A_WAVE:
        return

    def change(c: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        return np.asarray(c + theta[:, :1] * np.sin(2 * np.pi * c / theta[:, 1:2] + theta[:, 2:3]))

    act = _on_column(name, change)
    waves = wave_numbers(np.sort(values), [np.arange(len(values))], _most_waves(about), _ROWS_OF_A_WAVE)
    guess = 1e-4 * float(np.nanstd(values))
    typical = about.typical(Stage.INPUT, act, sine_and_cosine_entries(guess, 1 / waves), guess)
    if typical is None:
        return
    marginals = {
        "a": about.amplitude(typical, positive=True),
        "period": LogUniform(float(1 / waves[-1]) * 0.98, float(2 / waves[0])),
        "phase": PHASE,
    }
    yield Form(
        f"periodic_error:{name}",
        Stage.INPUT,
        marginals,
        (name, name, "rad"),
        (name,),
        act,
        sine_and_cosine_entries(typical, 1 / waves),
        (0,),
        lambda m, s: (
            f"{name} has a periodic error with an amplitude of {with_unit(m[0], s[0], '')} "
            f"and a period of {with_unit(m[1], s[1], '')}, both in units of {name}"
        ),
        joined=starting_point_of_wave,
    )


def _dead_zone(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    return np.asarray(np.sign(c) * np.maximum(np.abs(c) - theta[:, :1], 0.0))


def delayed_while_held(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return the mean over each gap of a column that is held between rows and delayed by a dead time.

    The column at any time has the held value of one dead time earlier.
    """
    values = np.atleast_2d(c)
    out = np.array(np.broadcast_to(values, (max(len(values), len(theta)), values.shape[1])))
    by = theta[:, 0]
    for rows in table.rows_by_scan():
        time, own = table.time_s[rows], values[:, rows]
        gaps = np.diff(time)
        there = gaps > 0
        total = np.concatenate([np.zeros((len(own), 1)), np.cumsum(own[:, :-1] * gaps, axis=1)], axis=1)
        since = earlier(time, total, by) + own[:, :1] * np.minimum(time - by[:, None] - time[0], 0.0)
        out[:, rows[:-1][there]] = np.diff(since, axis=1)[:, there] / gaps[there]
    return out


def play(c: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
    """Apply play (backlash) to a column: no motion until the play is taken up; a run starts in the middle of it."""
    values = np.atleast_2d(c)
    half = 0.5 * theta[:, 0]
    out = np.empty((max(len(values), len(theta)), values.shape[1]))
    for rows in table.rows_by_scan():
        own = np.broadcast_to(values[:, rows[0]], half.shape).copy()
        first = np.flatnonzero(np.diff(values[0, rows]))
        if first.size:  # assume the direction of arrival is that of the first motion
            own -= half * np.sign(values[0, rows[first[0] + 1]] - values[0, rows[first[0]]])
        for row in rows:
            own = np.clip(own, values[:, row] - half, values[:, row] + half)
            out[:, row] = own
    return out


def _turns_back(values: FloatArray, table: RunTable) -> bool:
    moves = np.concatenate([np.diff(values[rows]) for rows in table.rows_by_scan()])
    if not moves.size:
        return False
    return bool((moves > 0).mean() > _FORTH_AND_BACK and (moves < 0).mean() > _FORTH_AND_BACK)


WORDS = {
    "clock_drift": "a clock that runs fast or slow",
    "input_offset": "an offset of {0}",
    "input_gain": "a wrong scale of {0}",
    "input_delay": "a late effect of {0}",
    "input_saturation": "a limit of {0}",
    "dead_zone": "a dead zone of {0}",
    "periodic_error": "a periodic error of {0}",
    "backlash": "backlash (play) of {0}",
}
"""A noun phrase for each form here, with places for its targets, to follow "the model leaves out"."""
