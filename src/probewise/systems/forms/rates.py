"""Forms on the rates of a law: damping, drag, friction, forces, couplings, bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, rounding_error
from probewise._words import value_with_sd
from probewise.effects import name_without_copy_suffix
from probewise.effects.effect import PHASE, Fixed, WaveEffect, in_words, sine_and_cosine_entries, single_column_bank
from probewise.priors import Marginal, Uniform
from probewise.sensor import Stage
from probewise.systems.forms.modulations import (
    frequency_prior,
    max_n_trial_frequencies,
    origin_in_words,
    origin_of_column,
    trial_frequencies_in_time,
)
from probewise.systems.forms.reference import (
    AMPLITUDE,
    POSITIVE,
    Form,
    ReferenceFit,
    clipping_levels,
    period_with_sd,
    says_of_limit,
)
from probewise.systems.law import LawWithEffects, Limit

_NO_SHARE = 1e-9  # of what a bound stops: none


def forms_on_rates(about: ReferenceFit) -> Iterator[Form]:
    """Yield a form for each term that may be missing from the rate of a state, for friction and for bounds."""
    if not about.table.has_varying_time:  # nothing moves
        return
    for state, values in about.states.items():
        unit = f"{state} per {about.time_unit}"
        for kind in ("damping", "drag", "forcing"):
            yield from _rate_term_form(about, f"{kind}:{state}", state, state)
        yield from _friction_form(about, state, unit)
        yield from _periodic_forcing_form(about, state, unit)
        yield from _limit_form(about, state, values)
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


def names_in_definitions(about: ReferenceFit, names: Iterable[str]) -> frozenset[str]:
    """Return those names of effects and formulas in the rate of a state that is another state by definition.

    A bound is none of them: a position may stop, though its rate is the speed.
    """
    places = tuple(
        begin
        for state in about.states_with_rates_by_definition
        for begin in (*(f"{kind}:{state}" for kind in RATE_WORDS if kind != "limit"), f"formula:rate:{state}")
    )
    return frozenset(
        name for name in names if f"{name_without_copy_suffix(name)}:".startswith(tuple(f"{p}:" for p in places))
    )


def _rate_term_form(about: ReferenceFit, name: str, state: str, other: str) -> Iterator[Form]:
    kind = name.split(":")[0]
    term, degree, what = _TERMS[kind]

    def act(value: LawWithEffects, theta: FloatArray, table: Any) -> LawWithEffects:
        a = theta[:, :1]
        return value.with_term(state, lambda s, p, u: a * term(s[other]))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        said, minus, of = what.format(other).partition(" -a ")
        if minus and mean[0] < 0:  # a term that adds to the rate, without a double negative
            return f"the rate of {state} lacks a term +b {of}, b = -a = {value_with_sd(-mean[0], sd[0], '')}"
        return f"the rate of {state} lacks {said}{minus}{of}, a = {value_with_sd(mean[0], sd[0], '')}"

    unit = f"{state} per {about.time_unit}" if kind == "forcing" else f"rate of {state}"
    along, entries = (f"state:{other}", "time"), np.ones((1, 1, 1))
    form = Form(name, Stage.RATE, {"a": AMPLITUDE}, (unit,), along, act, entries, says)
    largest = float(np.nanmax(np.abs(about.states[other]))) or 1.0
    yield from about.scaled(form, trial_rate(about, state) / largest**degree)


def _friction_form(about: ReferenceFit, state: str, unit: str) -> Iterator[Form]:
    def act(value: LawWithEffects, theta: FloatArray, table: Any) -> LawWithEffects:
        return value.with_friction(state, theta[:, :1])

    # A drive and the friction against it may each be far larger than what is left of the two, which moves the state.
    tried = _rms_rate(about, state) * np.geomspace(1e-6, 30.0, 31)
    along = f"state:{state}", "level"
    says = in_words(f"dry friction slows {state} by {{0}} per {about.time_unit}, and holds it at rest")
    return about.sized(f"friction:{state}", Stage.RATE, "a", unit, along, act, tried, says)


def _periodic_forcing_form(about: ReferenceFit, state: str, unit: str) -> Iterator[Form]:
    table = about.table
    time, origin = table.time, origin_of_column(table.time_s)
    frequencies = trial_frequencies_in_time(about, max_n_trial_frequencies(len(table)))

    def act(value: LawWithEffects, theta: FloatArray, rows: Any) -> LawWithEffects:
        a, hz, phase = theta[:, :1], theta[:, 1:2], theta[:, 2:3]
        return value.with_term(state, lambda s, p, u: a * np.sin(2 * np.pi * hz * (u[str(time)] - origin) + phase))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        size, per = value_with_sd(mean[0], sd[0], ""), about.time_unit
        period = period_with_sd(mean[1], sd[1], per)
        lacks = f"the rate of {state} lacks a sinusoidal term"
        return f"{lacks} with an amplitude of {size} per {per} and a period of {period}"

    priors: dict[str, Marginal] = {"a": POSITIVE, "hz": frequency_prior(frequencies), "phase": PHASE}
    units, bank = (unit, f"1/{about.time_unit}", "rad"), sine_and_cosine_entries(1.0, frequencies)
    own = (f"periodic_forcing:{state}", Stage.RATE, priors, units, ("time",), act, bank, says)
    form = WaveEffect(*own, counted_from=origin_in_words(time, origin, about.time_unit))
    yield from about.scaled(form, trial_rate(about, state))


def _limit_form(about: ReferenceFit, state: str, values: FloatArray) -> Iterator[Form]:
    """Yield a bound of a state: the rate beyond it is lost, or a state that it drives takes up a share (overflow)."""
    ends = clipping_levels(values)
    if ends is None:
        return
    others = [other for other in about.states if other != state]

    def act(value: LawWithEffects, theta: FloatArray, table: Any) -> LawWithEffects:
        level = theta[:, :1]
        above = level > ends.least_ceiling
        spilt = {other: theta[:, k : k + 1] for k, other in enumerate(others, 1) if theta[:, k].any()}
        ceiling = Limit(state, np.where(above, level, np.inf), spilt=spilt)
        floor = Limit(state, np.where(above, -np.inf, level), upper=False, spilt=spilt)
        return value.with_limit(ceiling).with_limit(floor)

    def says(mean: FloatArray, sd: FloatArray) -> str:
        taken = (
            f"; {other} takes up {value_with_sd(mean[k], sd[k])} of the rest"
            for k, other in enumerate(others, 1)
            if mean[k] > _NO_SHARE
        )
        return says_of_limit(state, ends.least_ceiling)(mean, sd) + "".join(taken)

    def variant(taking: str | None) -> Form:
        shares = {other: Uniform(0.0, 1.0) if other == taking else Fixed(0.0, _NO_SHARE) for other in others}
        tried = [0.5 * (other == taking) for other in others]
        priors = {
            "level": ends.prior,
            **{f"share[{other}]": prior for other, prior in shares.items()},
        }
        units, bank = (state, *("1" for _ in others)), single_column_bank(ends.trial_levels, *tried)
        own = (f"limit:{state}", Stage.RATE, priors, units, (f"state:{state}", "level"), act, bank, says)
        return Form(*own, amplitudes=(), absent=ends.absent)

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


RATE_WORDS = {
    "damping": "damping of {0}",
    "drag": "drag on {0}",
    "friction": "dry friction of {0}",
    "forcing": "a constant force on {0}",
    "periodic_forcing": "a periodic force on {0}",
    "cubic": "a cubic term of {1} in the rate of {0}",
    "quadratic": "a quadratic term of {1} in the rate of {0}",
    "coupling": "a coupling of {1} to {0}",
    "limit": "a bound of {0}",
}
"""A noun phrase for each form here, with places for its targets, to follow "the model leaves out"."""
