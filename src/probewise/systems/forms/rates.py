"""Forms on the rates of a law: damping, drag, friction, forces, couplings, bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, rounding_error
from probewise._words import value_with_sd
from probewise.effects.effect import (
    Declared,
    Fixed,
    acting,
    in_words,
    single_column_bank,
)
from probewise.priors import Uniform
from probewise.sensor import Stage
from probewise.systems.forms.modulations import (
    declared_wave,
    max_n_trial_frequencies,
    origin_of_column,
    trial_frequencies_in_time,
)
from probewise.systems.forms.reference import (
    AMPLITUDE,
    Form,
    ReferenceFit,
    clipping_between,
    period_with_sd,
)
from probewise.systems.law import LawWithEffects, Limit

_NO_SHARE = 1e-9  # of what a bound stops: none


def forms_on_rates(about: ReferenceFit) -> Iterator[Form]:
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


def _rate_term_form(about: ReferenceFit, name: str, state: str, other: str) -> Iterator[Form]:
    kind = name.split(":")[0]
    term, degree, what = _TERMS[kind]
    per = (
        f"per {about.time_unit}" if kind == "damping" else ""
    )  # in a sentence; of another term it says more than it helps

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


def _friction_form(about: ReferenceFit, state: str) -> Iterator[Form]:
    # A drive and the friction against it may each be far larger than what is left of the two, which moves the state.
    tried = _rms_rate(about, state) * np.geomspace(1e-6, 30.0, 31)
    act = acting(lambda motion, rows, a: motion.plus(friction={state: a}))
    says = in_words(f"dry friction slows {state} by {{0}} per {about.time_unit}, and holds it at rest")
    size = ("a", f"{state} per {about.time_unit}")
    return about.sized(f"friction:{state}", Stage.RATE, size, (f"state:{state}", "level"), act, says, tried)


def _periodic_forcing_form(about: ReferenceFit, state: str) -> Iterator[Form]:
    time, origin, per = str(about.table.time), origin_of_column(about.table.time_s), about.time_unit
    frequencies = trial_frequencies_in_time(about, max_n_trial_frequencies(len(about.table)))

    @acting
    def act(motion: LawWithEffects, rows: Any, a: FloatArray, hz: FloatArray, phase: FloatArray) -> LawWithEffects:
        term = lambda s, p, u: a * np.sin(2 * np.pi * hz * (u[time] - origin) + phase)  # noqa: E731
        return motion.plus(terms=((state, term),))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        size, period = value_with_sd(mean[0], sd[0]), period_with_sd(mean[1], sd[1], per)
        of = f"an amplitude of {size} per {per} and a period of {period}"
        return f"the rate of {state} lacks a sinusoidal term with {of}"

    own = declared_wave(about, frequencies, f"{state} per {per}")
    name = f"periodic_forcing:{state}"
    yield from about.form(name, Stage.RATE, act=act, says=says, guess=trial_rate(about, state), **own)


def _limit_form(about: ReferenceFit, state: str) -> Iterator[Form]:
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
        shares = {other: value_with_sd(mean[k], sd[k]) for k, other in enumerate(others, 1) if mean[k] > _NO_SHARE}
        taken = (f"; {other} takes up {share} of the rest" for other, share in shares.items())
        return says_where(mean, sd) + "".join(taken)

    def variant(taking: str | None) -> Form:
        shares = {other: Uniform(0.0, 1.0) if other == taking else Fixed(0.0, _NO_SHARE) for other in others}
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
    values, time = about.states[state], about.table.time_s
    rates = []
    for rows in about.table.rows_by_scan():
        gaps = np.diff(time[rows])
        there = gaps > rounding_error(time)
        rates.append(np.diff(values[rows])[there] / gaps[there])
    joined = np.concatenate(rates)
    return float(np.sqrt(np.mean(joined**2))) or 1.0
