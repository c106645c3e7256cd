"""Forms on what a simulator takes: errors of a column and of the clock, and terms that the rates of its law lack."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from probewise._arrays import ROUNDING, FloatArray, distinct_values, rounding_error
from probewise._words import value_with_sd
from probewise.effects.effect import (
    AMPLITUDE,
    PHASE,
    POSITIVE,
    Act,
    Binding,
    Declared,
    Effect,
    Fixed,
    WaveEffect,
    acting,
    in_words,
    sine_and_cosine_entries,
    single_column_bank,
)
from probewise.priors import LogUniform, Uniform
from probewise.sensor import Stage
from probewise.systems.forms.modulations import (
    declared_wave,
    max_n_trial_frequencies,
    origin_in_words,
    origin_of_column,
    trial_frequencies,
    trial_frequencies_in_time,
)
from probewise.systems.forms.readings import delayed_values, earlier_values, within_runs
from probewise.systems.forms.reference import ReferenceFit, clipping_between, period_with_sd
from probewise.systems.law import LawWithEffects, Limit
from probewise.systems.table import covariate_of_column

_MOST_FREQUENCIES = 600
_MOST_FREQUENCIES_CALLED = 96  # where each is two calls of a person's function
_ROWS_OF_A_WAVE = 4  # least distinct values per period on average: with fewer, some wave fits any readings
_LEAST_WAVES = 1.5  # in a column's range: half a period is seen again; any bend is a part of a slower wave
_NEAR_ZERO = 0.1  # of a column's range: largest dead zone
_FORTH_AND_BACK = 0.02  # least share of rows that move in each direction


def sorting_column(about: ReferenceFit, *, in_runs: bool = False) -> str | None:
    """Return the name of a column that drives the simulator and rises or falls along all rows; None if none does.

    If `in_runs`, one that rises along the rows of every run, or falls along those of every run.

    Where a time was recorded, there is none: rows are in its order, whatever they are sorted by besides. A column that
    drives nothing, such as a number of the reading, may be that order itself.
    """
    table = about.table
    if table.has_varying_time:
        return None
    counted = np.diff(table.scan) == 0 if in_runs else np.full(len(table) - 1, True)
    changes = {name: np.diff(values)[counted] for name, values in table.covariates.items() if np.ptp(values) > 0}
    ordered = {name for name, change in changes.items() if np.all(change >= 0) or np.all(change <= 0)}
    return next((name for name in about.driving_columns if name in ordered), None) if ordered else None


def forms_on_inputs(about: ReferenceFit) -> Iterator[Effect]:
    """Yield a form for each possible error of the columns that drive the simulator, and of the clock."""
    for name in about.driving_columns:
        yield from _forms_on_column(about, name)
    time = about.table.time
    if time is not None:
        origin = origin_of_column(about.table.time_s)
        act = _column_changer(time, acting(lambda c, rows, a: origin + (c - origin) * (1 + a)))
        says = in_words("the true time is the recorded time times (1 + a), a = {0}")
        own = ("clock_drift", Stage.INPUT, {"a": (AMPLITUDE, "1")}, ("time",), act, says)
        yield from about.form(*own, guess=1e-5, binding=Binding(origin_in_words(time, origin, about.time_unit)))


def _forms_on_column(about: ReferenceFit, name: str) -> Iterator[Effect]:
    table, unit, column = about.table, about.time_unit, covariate_of_column(name)
    values = table.covariates[name]
    spread, span = float(np.nanstd(values)), float(np.nanmax(values)) - float(np.nanmin(values))
    true, late = f"the true {name} is the recorded {name}", ("previous", column)

    def amplitude(kind: str, change: Act, guess: float, unit: str, says: str) -> Iterator[Effect]:
        own = (f"{kind}:{name}", Stage.INPUT, {"a": (AMPLITUDE, unit)}, (column,), _column_changer(name, change))
        return about.form(*own, in_words(says), guess=guess)

    def size(
        kind: str, act: Act, own: tuple[str, str], along: tuple[str, ...], says: str, **more: Any
    ) -> Iterator[Effect]:
        tried = (about.duration if kind == "input_delay" else span) * np.geomspace(1e-7, 0.5, 40)
        return about.sized(f"{kind}:{name}", Stage.INPUT, own, along, act, in_words(says), tried, **more)

    yield from amplitude("input_offset", _with_offset, 1e-4 * spread, name, f"{true} plus {{0}}")
    yield from amplitude("input_gain", _with_gain, 1e-4, "1", f"{true} times (1 + a), a = {{0}}")
    ends = clipping_between(values)
    if ends is not None:
        act = _column_changer(name, ends.act)
        if np.nanmax(about.rms_change_in_sds(Stage.INPUT, act, ends.tried[:, None]), initial=0.0) > 0.05:
            own = ({"level": (ends.prior, name)}, (column,), act, ends.says(name), single_column_bank(ends.tried))
            yield from about.form(f"input_saturation:{name}", Stage.INPUT, *own, absent={0: ends.nowhere})
    if float(np.nanmin(np.abs(values))) <= _NEAR_ZERO * span:  # if larger, it is an offset
        zone = acting(lambda c, rows, width: np.sign(c) * np.maximum(np.abs(c) - width, 0.0))
        within = f"{name} has no effect within {{0}} of 0"
        yield from size("dead_zone", _column_changer(name, zone), ("width", name), (column,), within)
    moves, still = np.concatenate([np.diff(values[rows]) for rows in table.rows_by_scan()]), rounding_error(values)
    if moves.size and min((moves > still).mean(), (moves < -still).mean()) > _FORTH_AND_BACK:
        play = _column_changer(name, column_with_play)
        yield from size("backlash", play, ("width", name), late, f"{name} has {{0}} of play")
    yield from _periodic_error_form(about, name)
    if table.has_varying_time:
        late_values = mean_of_delayed_held_column if about.is_held_between_rows(name) else delayed_values
        delay, says = _column_changer(name, late_values), f"{name} acts with a delay of {{0}}"
        yield from size("input_delay", delay, ("tau_s", unit), late, f"{says} {unit}", needs_rising_time=True)


_with_offset = acting(lambda c, rows, a: c + a)
_with_gain = acting(lambda c, rows, a: c * (1 + a))


def _column_changer(name: str, change: Act) -> Act:
    """Return the act on the inputs that applies `change` to the column `name`, (n_points,) or (n_samples, n_points)."""
    return lambda value, theta, table: {**value, name: np.asarray(change(value[name], theta, table))}


def _periodic_error_form(about: ReferenceFit, name: str) -> Iterator[Effect]:
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
    period = LogUniform(shortest * 0.98, longest / 0.9)
    parameters: Declared = {"a": (POSITIVE, name), "period": (period, name), "phase": (PHASE, "rad")}
    both = "an amplitude of {0} and a period of {1}, both in units of"
    says, bank = f"{name} has a periodic error with {both} {name}", sine_and_cosine_entries(1.0, 1 / frequencies)
    own = (parameters, (covariate_of_column(name),), _column_changer(name, wave), in_words(says), bank)
    guess, binding = 1e-4 * float(np.std(values)), Binding(origin_in_words(name, origin))
    given = (f"periodic_error:{name}", Stage.INPUT, *own)
    yield from about.form(*given, guess=guess, kind=WaveEffect, binding=binding)


@within_runs
def mean_of_delayed_held_column(values: FloatArray, theta: FloatArray, time: FloatArray) -> FloatArray:
    """Return a held column delayed by a dead time, (n_samples, n_points): at each row its mean until the next row."""
    by, gaps = theta[:, 0], np.diff(time)
    there = gaps > rounding_error(time)
    total = np.concatenate([np.zeros((len(values), 1)), np.cumsum(values[:, :-1] * gaps, axis=1)], axis=1)
    since = earlier_values(time, total, by) + values[:, :1] * np.minimum(time - by[:, None] - time[0], 0.0)
    out = np.array(np.broadcast_to(values, since.shape))
    out[:, :-1][:, there] = np.diff(since, axis=1)[:, there] / gaps[there]
    return out


@within_runs
def column_with_play(values: FloatArray, theta: FloatArray, time: FloatArray) -> FloatArray:
    """Return a column with play (backlash), (n_samples, n_points): it rests until the play is taken up.

    A run starts as if it had arrived in the direction of its first motion; without any, in the middle of the play.
    """
    half, moves = 0.5 * theta[:, 0], np.diff(values[0])
    own, out = np.broadcast_to(values[:, 0], half.shape), np.empty((len(half), len(time)))
    first = np.flatnonzero(np.abs(moves) > rounding_error(values[0]))
    if first.size:
        own = own - half * np.sign(moves[first[0]])
    for k, column in enumerate(values.T):
        out[:, k] = own = np.clip(own, column - half, column + half)
    return out


def forms_on_rates(about: ReferenceFit) -> Iterator[Effect]:
    """Yield a form for each term that may be missing from the rate of a state, for friction and for bounds."""
    if not about.table.has_varying_time:  # nothing moves
        return
    for state in about.states:
        for kind in ("damping", "drag", "forcing"):
            yield from _rate_term_form(about, f"{kind}:{state}", state, state)
        yield from _friction_form(about, state)
        yield from _periodic_forcing_form(about, state)
        yield from _limit_form(about, state)
        for other in about.states:
            for kind in ("cubic", "quadratic", *(("coupling",) if other != state else ())):
                yield from _rate_term_form(about, f"{kind}:{state}:{other}", state, other)


_TERMS: dict[str, tuple[Callable[[Any], Any], int, str]] = {
    "damping": (lambda r: -r, 1, "a damping term -a {0}"),
    "drag": (lambda r: -np.abs(r) * r, 2, "a drag term -a |{0}| {0}"),
    "forcing": (lambda r: 1.0 + 0.0 * r, 0, "a constant term a"),
    "cubic": (lambda r: -(r * r * r), 3, "a term -a {0}^3"),  # other powers than the square take twenty times as long
    "quadratic": (lambda r: -(r**2), 2, "a term -a {0}^2"),
    "coupling": (lambda r: -r, 1, "a term -a {0}"),
}
"""The term of each kind, of unit amplitude, as a function of a state; its degree in the state; and its words."""


def _rate_term_form(about: ReferenceFit, name: str, state: str, other: str) -> Iterator[Effect]:
    kind = name.split(":")[0]
    (term, degree, what), in_time = _TERMS[kind], f"per {about.time_unit}"
    per = in_time if kind == "damping" else ""  # in a sentence; of another term it says more than it helps

    def says(mean: FloatArray, sd: FloatArray) -> str:
        said, minus, of = what.format(other).partition(" -a ")
        if minus and mean[0] < 0:  # a term that adds to the rate, without a double negative
            return f"the rate of {state} lacks a term +b {of}, b = -a = {value_with_sd(-mean[0], sd[0], per)}"
        return f"the rate of {state} lacks {said}{minus}{of}, a = {value_with_sd(mean[0], sd[0], per)}"

    act = acting(lambda motion, rows, a: motion.plus(terms=((state, lambda s, p, u: a * term(s[other])),)))
    size = {"a": (AMPLITUDE, _unit_of_term(state, other, degree, about.time_unit))}
    largest = float(np.nanmax(np.abs(about.states[other]))) or 1.0
    own = (name, Stage.RATE, size, (f"state:{other}", "time"), act, says)
    yield from about.form(*own, guess=trial_rate(about, state) / largest**degree)


def _unit_of_term(state: str, other: str, degree: int, time_unit: str) -> str:
    """Return the unit of a term's size: of a state per time, over the power of the state that it multiplies."""
    if degree == 0:
        return f"{state} per {time_unit}"
    power, above = (degree - 1, "1") if other == state else (degree, state)
    below = {0: time_unit, 1: f"({other} {time_unit})"}.get(power, f"({other}^{power} {time_unit})")
    return f"{above}/{below}"


def _friction_form(about: ReferenceFit, state: str) -> Iterator[Effect]:
    # A drive and the friction against it may each be far larger than what is left of the two, which moves the state.
    tried = _rms_rate(about, state) * np.geomspace(1e-6, 30.0, 31)
    act = acting(lambda motion, rows, a: motion.plus(friction={state: a}))
    says = in_words(f"dry friction slows {state} by {{0}} per {about.time_unit}, and holds it at rest")
    size = ("a", f"{state} per {about.time_unit}")
    return about.sized(f"friction:{state}", Stage.RATE, size, (f"state:{state}", "level"), act, says, tried)


def _periodic_forcing_form(about: ReferenceFit, state: str) -> Iterator[Effect]:
    time, origin, per = str(about.table.time), origin_of_column(about.table.time_s), about.time_unit
    frequencies = trial_frequencies_in_time(about, max_n_trial_frequencies(len(about.table)))

    @acting
    def act(motion: LawWithEffects, rows: Any, a: FloatArray, hz: FloatArray, phase: FloatArray) -> LawWithEffects:
        return motion.plus(terms=((state, lambda s, p, u: a * np.sin(2 * np.pi * hz * (u[time] - origin) + phase)),))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        size, period = value_with_sd(mean[0], sd[0]), period_with_sd(mean[1], sd[1], per)
        of = f"an amplitude of {size} per {per} and a period of {period}"
        return f"the rate of {state} lacks a sinusoidal term with {of}"

    own = declared_wave(about, frequencies, f"{state} per {per}")
    name = f"periodic_forcing:{state}"
    yield from about.form(name, Stage.RATE, act=act, says=says, guess=trial_rate(about, state), **own)


def _limit_form(about: ReferenceFit, state: str) -> Iterator[Effect]:
    """Yield a bound of a state: the rate beyond it is lost, or a state that it drives takes up a share (overflow)."""
    ends = clipping_between(about.states[state])
    if ends is None:
        return
    others = [other for other in about.states if other != state]
    says_where = ends.says(state)

    def act(value: LawWithEffects, theta: FloatArray, table: Any) -> LawWithEffects:
        level = theta[:, :1]
        above = level > ends.least_ceiling
        spilt = {other: theta[:, k : k + 1] for k, other in enumerate(others, 1) if theta[:, k].any()}
        ceiling = Limit(state, np.where(above, level, np.inf), spilt=spilt)
        floor = Limit(state, np.where(above, -np.inf, level), upper=False, spilt=spilt)
        return value.plus(limits=(ceiling, floor))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        shares = {other: value_with_sd(mean[k], sd[k]) for k, other in enumerate(others, 1) if mean[k] > ROUNDING}
        taken = (f"; {other} takes up {share} of the rest" for other, share in shares.items())
        return says_where(mean, sd) + "".join(taken)

    def variant(taking: str | None) -> Effect:
        shares = {other: Uniform(0.0, 1.0) if other == taking else Fixed(0.0, ROUNDING) for other in others}
        own: Declared = {"level": (ends.prior, state)} | {f"share[{name}]": (p, "1") for name, p in shares.items()}
        bank = single_column_bank(ends.tried, *(0.5 * (other == taking) for other in others))
        given = (f"limit:{state}", Stage.RATE, own, (f"state:{state}", "level"), act, says, bank)
        return next(about.form(*given, absent={0: ends.nowhere}))

    alone = variant(None)
    if np.nanmax(about.rms_change_in_sds(Stage.RATE, act, alone.entries[:, 0]), initial=0.0) > 0.05:
        # Downstream only: states that drive each other, as an angle and its rate, are no vessels.
        drives = about.state_drives_rate
        into = [other for other in others if drives(state, other) and not drives(other, state)]
        yield replace(alone, alternatives=tuple(variant(other) for other in into))


def trial_rate(about: ReferenceFit, state: str) -> float:
    """Return a rate of a state that is too small to change the course of a law."""
    return 1e-5 * _rms_rate(about, state)


def _rms_rate(about: ReferenceFit, state: str) -> float:
    """Return the rms rate of a state, by differences from row to row; 1 if that is 0."""
    by_run = about.table.rows_by_scan()
    moves, gaps = (np.concatenate([np.diff(v[r]) for r in by_run]) for v in (about.states[state], about.table.time_s))
    there = gaps > rounding_error(about.table.time_s)
    return float(np.sqrt(np.mean((moves[there] / gaps[there]) ** 2))) or 1.0
