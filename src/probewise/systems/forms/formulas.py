"""Proposals: short formulas of columns, states and time, in the reading or in a rate, for effects out of vocabulary.

Most are one term with one amplitude. Their evidence is computed as for any other effect; a winning proposal counts as
out of vocabulary and is reported as a formula.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from probewise._arrays import ROUNDING, FloatArray, varies
from probewise._words import value_with_sd
from probewise.effects.effect import (
    AMPLITUDE,
    PHASE,
    POSITIVE,
    Binding,
    ChangePoints,
    Declared,
    Effect,
    StepEffect,
    WaveEffect,
    acting,
    sine_and_cosine_entries,
    single_column_bank,
    thinned,
)
from probewise.priors import LogUniform, Uniform
from probewise.sensor import Stage
from probewise.systems.forms.inputs import sorting_column, trial_rate
from probewise.systems.forms.modulations import (
    frequency_prior,
    origin_in_words,
    origin_of_column,
    text_rounded_to_spread,
    time_since_start_of_run,
    trial_frequencies_in_time,
)
from probewise.systems.forms.readings import settling_time_prior
from probewise.systems.forms.reference import N_SIZES, ReferenceFit, switch_points
from probewise.systems.table import RunTable, covariate_of_column

_MOST_SWITCHES = 128  # thresholds of a switch in a column
_THRESHOLDS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9)  # quantiles of a state beyond which a term may act
_SAME = 0.9999  # cosine of two terms over the rows above which only the shorter one is kept
_MOST_SQUARE_WAVES = 160  # periods of a square wave that are tried
_ROWS_OF_A_WAVE = 6  # least rows per period: with fewer a square wave is not told from a sinusoid
_SOFT = 0.5  # steepness of its edges to begin with; to 0.6 its tops are flat to a tenth, at 1 it is nearly a sinusoid
_MOST_SWEPT = 40  # waves in the recording of which the frequency may change: faster ones would need gigabytes
_SWEEPS = 1.5  # changes of the frequency that are tried, per wave in the recording: phases to within a radian
_N_DOSES = 9  # doses that are tried as the one at which the reading has changed by 1 - 1/e of the whole change
_LEAST_DOSE, _MOST_DOSE = 0.02, 3.0  # of the largest dose in a run: beyond the latter the change is a straight line


class _Variable(NamedTuple):
    """A column, a state or the reading `name`, of which terms take (value - middle) / scale; `text` is value - middle.

    `has_sides` tells whether enough rows are on either side of the middle for a term with a kink there.
    """

    name: str
    middle: float
    scale: float
    text: str
    has_sides: bool = True

    @classmethod
    def of(cls, name: str, values: FloatArray, middle: float) -> _Variable:
        """Build from a column's values, (n_points,), of which the scale is the rms about the middle."""
        points, scale = switch_points(values), float(np.sqrt(np.mean((values - middle) ** 2))) or 1.0
        apart = f"{'-' if middle > 0 else '+'} {text_rounded_to_spread(abs(middle), scale)}"
        has_sides = bool(points.size and points[0] < middle < points[-1])
        return cls(name, middle, scale, f"({name} {apart})" if middle else name, has_sides)


_Term: TypeAlias = tuple[str, tuple[_Variable, ...], Callable[..., Any], float]
"""A formula without its amplitude, its variables, and its value: a function of these, divided by a scale."""


def formula_forms(about: ReferenceFit) -> Iterator[Effect]:
    """Yield all proposals: terms of the reading or of a state's rate, thresholds, and shapes in time or of a column."""
    own, table = about.system.simulator, about.table
    columns = {name: values for name, values in about.varying_columns.items() if np.isfinite(values).all()}
    shapes = [term for name in columns for term in _terms_of_column(name)]
    in_time = {str(table.time): table.time_s} if table.has_varying_time else {}

    def look_up(value: Any, rows: RunTable, name: str) -> Any:
        return value if name == own.reading else rows.time_s if name == rows.time else rows.covariates[name]

    every = {**columns, **in_time, own.reading: about.predicted}
    centred = [_Variable.of(name, column, _rounded_mean(column)) for name, column in every.items()]
    yield from _forms_of_terms(about, [*_terms_of(centred), *shapes], look_up, (about.predicted, table))
    for name in columns:
        yield from _threshold_form(about, name)
    # What adds up along rows that a column sorts is a function of that column, in runs that take the same values.
    adds_up = bool(in_time) or (about.rows_are_in_order and sorting_column(about, in_runs=True) is None)
    for name, values in columns.items():
        yield from _varying_influence_form(about, name, values)
        if adds_up:
            yield from _dose_forms(about, name, values)
    if in_time:
        yield from _fading_gain_form(about)
        yield from _square_wave_form(about)
        yield from _swept_wave_form(about)
    still = [_Variable.of(name, column, 0.0) for name, column in about.states.items() if varies(column)]
    still += [_Variable.of(n, c, _rounded_mean(c)) for n, c in columns.items() if n not in about.states]
    for state in about.states:
        # Dry friction has a name.
        terms = [term for term in _terms_of(still) if term[0] != f"sign({state})"]
        at_rows = about.states, table.covariates
        yield from _forms_of_terms(about, terms, lambda s, u, n: s[n] if n in s else u[n], at_rows, state)
        yield from _one_sided_rate_forms(about, state)


def _proposal(
    about: ReferenceFit,
    text: str,
    parameters: Declared,
    change: Callable[..., Any],
    covariates: tuple[str, ...],
    entries: FloatArray | None = None,
    *,
    guess: float | None = None,
    state: str = "",
    expression: str = "",
    **more: Any,
) -> Iterator[Effect]:
    """Yield a formula of a name that ends in `text`; none if without effect.

    `change` is a function of the readings, the table and the parameters, (n_samples, 1) each: what is added to the
    readings. Of the rate of a `state` it is a function of the states, the columns and the parameters. `expression` is
    by default `text` times the amplitude.
    """
    side, target = ("rate", state) if state else ("reading", about.system.simulator.reading)
    what, expression = f"the rate of {state}" if state else target, expression or f"a {text}"

    @acting
    def act(value: Any, rows: RunTable, *v: FloatArray) -> Any:
        if not state:
            return value + change(value, rows, *v)
        return value.plus(terms=((state, lambda s, p, u: change(s, u, *v)),))

    def says(mean: FloatArray, sd: FloatArray) -> str:
        each = zip(parameters.items(), mean, sd, strict=True)
        sizes = ", ".join(f"{name} = {value_with_sd(m, s, unit)}" for (name, (_, unit)), m, s in each)
        return f"{what} lacks the term {expression} with {sizes}: a proposal, not a known effect"

    stage, name = Stage.RATE if state else Stage.OFFSET, f"formula:{side}:{target}:{text}"
    own = (name, stage, parameters, covariates, act, says, entries)
    return about.form(*own, guess=guess, expression=expression, **more)


_OF_ONE: Mapping[str, tuple[Callable[[Any], Any], float]] = {
    "{0}^2": (lambda v: v**2, 2),
    "{0}^3": (lambda v: v * v * v, 3),
    "|{0}|": (np.abs, 1),
    "|{0}| {0}": (lambda v: np.abs(v) * v, 2),
    "sqrt(|{0}|) sign({0})": (lambda v: np.sqrt(np.abs(v)) * np.sign(v), 0.5),
    "sign({0})": (np.sign, 0),
}
"""Terms of one variable, and their degree in it."""

_OF_TWO: Mapping[str, tuple[Callable[[Any, Any], Any], int, int]] = {
    "{0} {1}": (lambda v, w: v * w, 1, 1),
    "{0}^2 {1}": (lambda v, w: v**2 * w, 2, 1),
    "{0} {1}^2": (lambda v, w: v * w**2, 1, 2),
    "|{0}| {1}": (lambda v, w: np.abs(v) * w, 1, 1),
    "{0} |{1}|": (lambda v, w: v * np.abs(w), 1, 1),
}
"""Terms of two variables, and their degrees in them."""

_OF_COLUMN: Mapping[str, Callable[[Any], Any]] = {
    "1 / {0}": lambda v: 1 / v,
    "1 / {0}^2": lambda v: v**-2,
    "log({0})": np.log,
}
_OF_ANGLE: Mapping[str, Callable[[Any], Any]] = {"tan({0})": np.tan, "1 / cos({0})": lambda v: 1 / np.cos(v)}
_RADIANS = {"deg": np.pi / 180, "rad": 1.0}


def _terms_of(variables: list[_Variable]) -> Iterator[_Term]:
    for x in variables:
        for text, (function, degree) in _OF_ONE.items():
            if x.has_sides or not ("|" in text or "sign" in text):
                yield text.format(x.text), (x,), function, x.scale**-degree
        for k in (-1.0, 1.0, 2.0, -2.0):
            rate = f"{k / x.scale:.4g}"
            yield f"exp({rate} {x.text})", (x,), lambda v, k=k: np.exp(np.clip(k * v, -50, 50)), 1.0
        yield f"sin({1 / x.scale:.4g} {x.text})", (x,), np.sin, 1.0
    for x, z in itertools.combinations(variables, 2):
        for text, (both, first, second) in _OF_TWO.items():
            kinked = x.has_sides if "|{0}" in text else z.has_sides
            if kinked or "|" not in text:
                yield text.format(x.text, z.text), (x, z), both, 1 / (x.scale**first * z.scale**second)


def _terms_of_column(name: str) -> Iterator[_Term]:
    """Yield terms of a column itself, not of what it is above its mean; those of an angle by its unit."""
    for text, function in _OF_COLUMN.items():
        yield text.format(name), (_Variable(name, 0.0, 1.0, name),), function, 1.0
    unit = _RADIANS.get(name.split("_")[-1], 0.0)
    for text, function in _OF_ANGLE.items() if unit else ():
        yield text.format(f"{unit:.6g} {name}"), (_Variable(name, 0.0, 1 / unit, name),), function, 1.0


def _rounded_mean(values: FloatArray) -> float:
    return float(text_rounded_to_spread(float(np.mean(values)), float(np.std(values)), 6))


def _threshold_form(about: ReferenceFit, name: str) -> Iterator[Effect]:
    """Yield a shift of the reading where a column exceeds an unknown threshold with enough rows on either side."""
    points = switch_points(about.table.covariates[name][about.has_reading])
    if len(points) < 2:
        return
    at = thinned(points, _MOST_SWITCHES)
    yield from _proposal(
        about,
        f"(1 + sign({name} - at)) / 2",
        {"a": (AMPLITUDE, about.reading_unit), "at": (Uniform(at[0], at[-1]), name)},
        lambda value, rows, a, at: a * (rows.covariates[name] > at),
        (covariate_of_column(name),),
        single_column_bank(1.0, 0.5 * (at[0] + at[-1])),
        kind=StepEffect,
        change_points=ChangePoints(at, column=name),
    )


def _one_sided_rate_forms(about: ReferenceFit, state: str) -> Iterator[Effect]:
    """Yield terms `a max(state - at, 0)` and `a max(at - state, 0)` of a state's rate, as of a stop or a spring."""
    values = about.states[state]
    points = switch_points(values)
    for sign, text in ((1.0, f"max({state} - at, 0)"), (-1.0, f"max(at - {state}, 0)")) if len(points) > 1 else ():
        change = partial(lambda sign, s, u, a, at: a * np.maximum(sign * (s[state] - at), 0.0), sign)
        parameters: Declared = {"a": (AMPLITUDE, ""), "at": (Uniform(points[0], points[-1]), state)}
        bank = single_column_bank(1.0, np.clip(np.quantile(values, _THRESHOLDS), points[0], points[-1]))
        own, guess = (text, parameters, change, (f"state:{state}", "time"), bank), trial_rate(about, state)
        yield from _proposal(about, *own, guess=guess / float(np.ptp(values)), state=state)


def _forms_of_terms(
    about: ReferenceFit, terms: list[_Term], look_up: Callable[..., Any], at_rows: tuple[Any, Any], state: str = ""
) -> Iterator[Effect]:
    """Yield terms of the reading or the rate of a state, unless infinite, constant or collinear with an earlier one.

    `look_up` finds a variable by its name in two values that an act gets, of which `at_rows` are those of the fit.
    """
    reading, time = about.system.simulator.reading, about.table.time
    states = [name for name in about.states if state or name == reading]
    along = {str(time): "time", reading: "level"} | {name: f"state:{name}" for name in states}
    known: list[FloatArray] = []
    for text, variables, function, scale in terms:

        def change(
            one: Any, other: Any, a: Any, own: Any = variables, function: Any = function, scale: float = scale
        ) -> Any:
            with np.errstate(all="ignore"):  # one that diverges at some row is no number there
                return a * (function(*((look_up(one, other, v.name) - v.middle) / v.scale for v in own)) / scale)

        shape = np.asarray(change(*at_rows, 1.0))
        if not np.isfinite(shape).all():
            continue
        centred = shape - shape.mean()
        size = float(np.linalg.norm(centred))
        is_constant = size <= ROUNDING * float(np.linalg.norm(shape))
        if is_constant or any(abs(centred @ other) > _SAME * size for other in known):
            continue
        known.append(centred / size)
        guess = trial_rate(about, state) / float(np.sqrt(np.mean(shape**2))) if state else None
        names = dict.fromkeys(variable.name for variable in variables)
        covariates = tuple(along.get(name) or covariate_of_column(name) for name in names)
        yield from _proposal(about, text, {"a": (AMPLITUDE, "")}, change, covariates, guess=guess, state=state)


def _fading_gain_form(about: ReferenceFit) -> Iterator[Effect]:
    """Yield a share of the reading that fades from the start of each run: creep, warming up, a second decay."""
    own, prior = about.system.simulator, settling_time_prior(about)

    def change(value: Any, rows: RunTable, a: Any, tau_s: Any) -> Any:
        return a * (value - own.noise.zero) * np.exp(-time_since_start_of_run(rows) / tau_s)

    faded = f"({own.reading} - {own.noise.zero:g})" if own.noise.zero else own.reading
    yield from _proposal(
        about,
        f"{faded} exp(-s / tau_s), s the {about.table.time} since the start of the run",
        {"a": (AMPLITUDE, "1"), "tau_s": (prior, about.time_unit)},
        change,
        ("time", "run"),
        single_column_bank(1.0, np.geomspace(1.5 * prior.low, 0.5 * prior.high, N_SIZES)),
        guess=1.0,
    )


def _square_wave_form(about: ReferenceFit) -> Iterator[Effect]:
    """Yield a shift of the reading during a share of every period: flat tops, and edges of unknown steepness."""
    table, origin = about.table, origin_of_column(about.table.time_s)
    frequencies = trial_frequencies_in_time(about, _MOST_SQUARE_WAVES, _ROWS_OF_A_WAVE)

    def change(value: Any, rows: RunTable, a: Any, hz: Any, phase: Any, share: Any, edge: Any) -> Any:
        inside = np.cos(2 * np.pi * (hz * (rows.time_s - origin) + phase)) - np.cos(np.pi * share)
        return 0.5 * a * (1 + np.tanh(inside / edge))

    phases, shares = np.arange(8) / 8 - 0.5, np.array([0.25, 0.5, 0.75])
    grid = np.meshgrid(1.0, frequencies, phases, shares, _SOFT, indexing="ij")
    since = f"({table.time} - {origin:.12g})" if origin else table.time
    yield from _proposal(
        about,
        f"while |({since} / period + phase) mod 1| < share / 2",
        {
            "a": (AMPLITUDE, about.reading_unit),
            "hz": (frequency_prior(frequencies), f"1/{about.time_unit}"),
            "phase": (Uniform(-1.0, 1.0), "1"),
            "share": (Uniform(0.03, 0.97), "1"),
            "edge": (LogUniform(0.03, 0.6), "1"),
        },
        change,
        ("time",),
        single_column_bank(*(each.ravel() for each in grid)),
        binding=Binding(origin_in_words(table.time, origin, about.time_unit)),
    )


def _swept_wave_form(about: ReferenceFit) -> Iterator[Effect]:
    """Yield a sinusoid in the reading whose frequency rises or falls linearly along the recording."""
    table = about.table
    begin, end = float(table.time_s.min()), float(table.time_s.max())
    frequencies = trial_frequencies_in_time(about, 2 * _MOST_SWEPT, _ROWS_OF_A_WAVE, most_waves=_MOST_SWEPT)
    middle, half = 0.5 * (begin + end), 0.5 * (end - begin)

    def change(value: Any, rows: RunTable, a: Any, hz: Any, sweep: Any, phase: Any) -> Any:
        u = (rows.time_s - middle) / half
        return a * np.sin(2 * np.pi * hz * half * (u + 0.5 * sweep * u**2) + phase)

    n_sweeps = 2 * np.maximum(np.ceil(_SWEEPS * half * frequencies), 1).astype(np.int64)
    settings = [(hz, sweep) for hz, n in zip(frequencies, n_sweeps, strict=True) for sweep in np.linspace(-1, 1, n)]
    turned = f"2 pi hz (u + sweep u^2 / (2 {half:.4g})) + phase"
    yield from _proposal(
        about,
        f"sin({turned}), u = {table.time} - {text_rounded_to_spread(middle, half)}",
        {
            "a": (POSITIVE, about.reading_unit),
            "hz": (frequency_prior(frequencies), f"1/{about.time_unit}"),
            "sweep": (Uniform(-1.2, 1.2), "1"),
            "phase": (PHASE, "rad"),
        },
        change,
        ("time",),
        sine_and_cosine_entries(1.0, *np.transpose(settings)),
        kind=WaveEffect,
    )


def _varying_influence_form(about: ReferenceFit, name: str, values: FloatArray) -> Iterator[Effect]:
    """Yield a form in which a column adds to the reading, by a coefficient quadratic in the reading."""
    own, level = about.system.simulator, about.predicted
    middle, half = 0.5 * float(level.max() + level.min()), 0.5 * float(np.ptp(level))
    centre, spread = float(np.mean(values)), float(np.std(values))
    if half <= 0:
        return

    def change(value: Any, rows: RunTable, a: Any, b: Any, c: Any) -> Any:
        z = (value - middle) / half
        return (a + b * z + c * z**2) * (rows.covariates[name] - centre) / spread

    scaled = f"({name} - {text_rounded_to_spread(centre, spread)}) / {spread:.4g}"
    text = f"(a + b z + c z^2) {scaled}, z = ({own.reading} - {text_rounded_to_spread(middle, half)}) / {half:.4g}"
    given = (text, dict.fromkeys("abc", (AMPLITUDE, own.unit)), change, (covariate_of_column(name), "level"))
    yield from _proposal(about, *given, expression=text)


def _dose_forms(about: ReferenceFit, name: str, values: FloatArray) -> Iterator[Effect]:
    """Yield changes of the reading that saturate with a dose: the integral of |column - mean|, or |column|."""
    table, centre, in_time = about.table, _rounded_mean(values), about.table.has_varying_time
    origins = {f"|{name} - {text_rounded_to_spread(centre, float(np.std(values)))}|": centre}
    if values.min() >= 0 or values.max() <= 0:
        origins[f"|{name}|"] = 0.0
    for what, origin in origins.items():

        def dose(rows: RunTable, origin: float = origin) -> FloatArray:
            from scipy.integrate import cumulative_trapezoid  # here, since it loads SciPy's optimisers

            size, out = np.abs(rows.covariates[name] - origin), np.zeros(len(rows))
            for own in rows.rows_by_scan():
                at = rows.time_s[own]
                out[own] = cumulative_trapezoid(size[own], at, initial=0) if in_time else np.cumsum(size[own])
            return out

        def change(value: Any, rows: RunTable, a: Any, d: Any, dose: Callable[[RunTable], FloatArray] = dose) -> Any:
            return -a * np.expm1(-dose(rows) / d)

        largest = float(dose(table).max())
        if not largest > 0:
            continue
        saturating = LogUniform(_LEAST_DOSE * largest, _MOST_DOSE * largest)
        summed = f"integral over {table.time}" if in_time else "sum over rows"
        grown = f"D the {summed} of {what} since the start of the run"
        yield from _proposal(
            about,
            f"1 - exp(-D / d), {grown}",
            {"a": (AMPLITUDE, about.reading_unit), "d": (saturating, "")},
            change,
            (covariate_of_column(name), "time", "run"),
            single_column_bank(1.0, np.geomspace(1.5 * saturating.low, 0.7 * saturating.high, _N_DOSES)),
            expression=f"a (1 - exp(-D / d)), {grown}",
            needs_rising_time=in_time,
        )
