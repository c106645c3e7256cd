"""Proposals: short formulas of columns, states and time, in the reading or in a rate, for effects out of vocabulary.

Most are one term with one amplitude. Their evidence is computed as for any other effect; a winning proposal counts as
out of vocabulary and is reported as a formula.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, distinct_values, varies
from probewise._words import value_with_sd
from probewise.effects.effect import PHASE, ChangePoints, sine_and_cosine_entries, single_column_bank, thinned
from probewise.priors import LogUniform, Uniform
from probewise.sensor import Stage
from probewise.systems.forms.form import AMPLITUDE, POSITIVE, Act, Form, StepForm, WaveForm, period_with_sd
from probewise.systems.forms.modulations import (
    frequency_prior,
    origin_in_words,
    rounded_to_spread,
    text_rounded_to_spread,
    time_origin,
    trial_frequencies_in_time,
)
from probewise.systems.forms.rates import trial_rate
from probewise.systems.forms.readings import settling_time_prior, time_since_start_of_run
from probewise.systems.forms.reference import ReferenceFit
from probewise.systems.law import LawWithEffects
from probewise.systems.table import RunTable, covariate_of_column

_MOST_SWITCHES = 128  # thresholds of a switch in a column
_THRESHOLDS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9)  # quantiles of a state beyond which a term may act
_SAME = 0.9999  # cosine of two terms over the rows above which only the shorter one is kept
_MOST_SQUARE_WAVES = 160  # periods of a square wave that are tried
_ROWS_OF_A_WAVE = 6  # least rows per period: with fewer a square wave is not told from a sinusoid
_SOFT = 0.5  # steepness of its edges to begin with: at 1 it is nearly a sinusoid
# Mean number of waves in the recording, up to which a wave whose frequency changes is tried, in steps of a half: faster
# ones would need tens of thousands of templates, gigabytes in a long table.
_MOST_SWEPT = 40
_SWEEPS = 1.5  # changes of the frequency that are tried, per wave in the recording: phases to within a radian
_N_SETTLING, _APART = 9, 2  # time constants of two settlings, and how far apart they are in the row of those
_N_DOSES = 9  # doses that are tried as the one at which the reading has changed by 1 - 1/e of the whole change
_LEAST_DOSE, _MOST_DOSE = 0.02, 3.0  # of the largest dose in a run: beyond the latter the change is a straight line


@dataclass(frozen=True)
class _ScaledVariable:
    """A column, a state or the reading `name`, which a term takes as (value - middle) / scale."""

    name: str
    middle: float
    scale: float

    def scaled(self, values: Any) -> Any:
        return (values - self.middle) / self.scale

    @property
    def text(self) -> str:
        if self.middle == 0.0:
            return self.name
        middle = text_rounded_to_spread(abs(self.middle), self.scale)
        return f"({self.name} {'-' if self.middle > 0 else '+'} {middle})"


@dataclass(frozen=True)
class _Term:
    """A function of scaled variables, divided by `scale`; `text` is its formula without the amplitude."""

    text: str
    variables: tuple[_ScaledVariable, ...]
    function: Callable[..., Any]
    scale: float = 1.0

    def evaluate(self, look_up: Callable[[str], Any]) -> Any:
        return self.function(*(variable.scaled(look_up(variable.name)) for variable in self.variables)) / self.scale


def formula_forms(about: ReferenceFit) -> Iterator[Form]:
    """Yield all proposals: terms of the reading or of a state's rate, thresholds, and shapes in time or of a column."""
    yield from _reading_formula_forms(about)
    columns = _varying_columns_by_name(about)
    for name in columns:
        yield from _threshold_form(about, name)
    for name, values in columns.items():
        yield from _varying_influence_form(about, name, values)
        yield from _dose_forms(about, name, values)
    if about.table.has_varying_time:
        yield from _square_wave_form(about)
        yield from _swept_wave_form(about)
        yield from _double_settling_form(about)
    for state in about.states:
        yield from _rate_formula_forms(about, state)
        yield from _one_sided_rate_forms(about, state)


def _terms_of_variables(variables: list[_ScaledVariable]) -> Iterator[_Term]:
    for x in variables:
        name, own = x.text, x.scale
        yield _Term(f"{name}^2", (x,), lambda v: v**2, 1 / own**2)
        yield _Term(f"{name}^3", (x,), lambda v: v * v * v, 1 / own**3)
        yield _Term(f"|{name}|", (x,), np.abs, 1 / own)
        yield _Term(f"|{name}| {name}", (x,), lambda v: np.abs(v) * v, 1 / own**2)
        yield _Term(f"sqrt(|{name}|) sign({name})", (x,), lambda v: np.sqrt(np.abs(v)) * np.sign(v), own**-0.5)
        yield _Term(f"sign({name})", (x,), np.sign)
        for k in (-1.0, 1.0, 2.0, -2.0):
            rate = f"{k / own:.4g}"
            yield _Term(f"exp({rate} {name})", (x,), lambda v, k=k: np.exp(np.clip(k * v, -50, 50)))
        yield _Term(f"sin({1 / own:.4g} {name})", (x,), np.sin)
    for x, z in itertools.combinations(variables, 2):
        yield _Term(f"{x.text} {z.text}", (x, z), lambda v, w: v * w, 1 / (x.scale * z.scale))
        yield _Term(f"{x.text}^2 {z.text}", (x, z), lambda v, w: v**2 * w, 1 / (x.scale**2 * z.scale))
        yield _Term(f"{x.text} {z.text}^2", (x, z), lambda v, w: v * w**2, 1 / (x.scale * z.scale**2))
        yield _Term(f"|{x.text}| {z.text}", (x, z), lambda v, w: np.abs(v) * w, 1 / (x.scale * z.scale))
        yield _Term(f"{x.text} |{z.text}|", (x, z), lambda v, w: v * np.abs(w), 1 / (x.scale * z.scale))


def _varying_columns_by_name(about: ReferenceFit) -> dict[str, FloatArray]:
    """Return the columns of numbers that vary and are never missing, except the reading and its declared sd."""
    own = about.system.simulator
    kept = {c: v for c, v in about.table.covariates.items() if c not in (own.reading, own.noise.sd)}
    return {c: v for c, v in kept.items() if np.isfinite(v).all() and varies(v)}


def _scaled_variable(name: str, values: FloatArray, *, centred: bool) -> _ScaledVariable:
    middle = rounded_to_spread(float(np.mean(values)), float(np.std(values)), 6) if centred else 0.0
    return _ScaledVariable(name, middle, float(np.sqrt(np.mean((values - middle) ** 2))) or 1.0)


def _reading_formula_forms(about: ReferenceFit) -> Iterator[Form]:
    own = about.system.simulator
    columns = _varying_columns_by_name(about)
    if about.table.has_varying_time and about.table.time is not None:
        columns[about.table.time] = about.table.time_s
    variables = [_scaled_variable(name, values, centred=True) for name, values in columns.items()]
    level = _scaled_variable(own.reading, about.predicted, centred=True)
    known: list[FloatArray] = []
    for term in _terms_of_variables([*variables, level]):

        def value_at_rows(value: FloatArray, table: RunTable, term: _Term = term) -> FloatArray:
            def look_up(name: str) -> Any:
                return value if name == own.reading else table.time_s if name == table.time else table.covariates[name]

            return np.asarray(term.evaluate(look_up))

        def act(
            value: FloatArray,
            theta: FloatArray,
            table: RunTable,
            term_of: Callable[[FloatArray, RunTable], FloatArray] = value_at_rows,
        ) -> FloatArray:
            return np.asarray(value + theta[:, :1] * term_of(value, table))

        if _add_if_new(value_at_rows(about.predicted, about.table), known):
            yield from _single_term_form(about, "reading", own.reading, Stage.OFFSET, act, term, about.sd)


def _threshold_form(about: ReferenceFit, name: str) -> Iterator[Form]:
    """Yield a shift of the reading where a column, of three values or more, exceeds an unknown threshold."""
    own, values = about.system.simulator, distinct_values(about.table.covariates[name])
    if len(values) <= 2:
        return
    at = thinned(values, _MOST_SWITCHES)

    def act(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        return np.asarray(value + theta[:, :1] * (table.covariates[name] > theta[:, 1:2]))

    text = f"(1 + sign({name} - at)) / 2"
    form = StepForm(
        name=f"formula:reading:{own.reading}:{text}",
        stage=Stage.OFFSET,
        parameters={"a": AMPLITUDE, "at": Uniform(at[0], at[-1])},
        units=(own.unit, name),
        covariates=(covariate_of_column(name),),
        act=act,
        entries=np.array([[[1.0, 0.5 * (at[0] + at[-1])]]]),
        says=lambda mean, sd: (
            f"{own.reading} shifts by {value_with_sd(mean[0], sd[0], own.unit)} where {name} is above "
            f"{value_with_sd(mean[1], sd[1], '')}: a proposal, not a known effect"
        ),
        expression=f"a {text}",
        change_points=ChangePoints(at, column=name),
    )
    yield from about.scaled(form, about.sd)


def _one_sided_rate_forms(about: ReferenceFit, state: str) -> Iterator[Form]:
    """Yield terms `a max(state - at, 0)` and `a max(at - state, 0)` of a state's rate, as of a stop or a spring."""
    values = about.states[state]
    low, high = float(values.min()), float(values.max())
    if not low < high:
        return
    for sign, text in ((1.0, f"max({state} - at, 0)"), (-1.0, f"max(at - {state}, 0)")):

        def act(value: LawWithEffects, theta: FloatArray, table: RunTable, sign: float = sign) -> LawWithEffects:
            a, at = theta[:, :1], theta[:, 1:2]
            return value.with_term(state, lambda s, p, u: a * np.maximum(sign * (s[state] - at), 0.0))

        def says(mean: FloatArray, sd: FloatArray, text: str = text) -> str:
            sizes = f"a = {value_with_sd(mean[0], sd[0], '')} and at = {value_with_sd(mean[1], sd[1], '')}"
            return f"the rate of {state} lacks the term a {text} with {sizes}: a proposal, not a known effect"

        form = Form(
            f"formula:rate:{state}:{text}",
            Stage.RATE,
            {"a": AMPLITUDE, "at": Uniform(low, high)},
            units=("", state),
            covariates=(f"state:{state}", "time"),
            act=act,
            entries=single_column_bank(1.0, np.quantile(values, _THRESHOLDS)),
            says=says,
            expression=f"a {text}",
        )
        yield from about.scaled(form, trial_rate(about, state) / (high - low))


def _rate_formula_forms(about: ReferenceFit, state: str) -> Iterator[Form]:
    states = about.states
    variables = [_scaled_variable(name, values, centred=False) for name, values in states.items() if varies(values)]
    columns = {name: values for name, values in _varying_columns_by_name(about).items() if name not in states}
    variables += [_scaled_variable(name, values, centred=True) for name, values in columns.items()]
    rate = trial_rate(about, state)
    known: list[FloatArray] = []
    for term in _terms_of_variables(variables):
        if term.text == f"sign({state})":
            continue  # dry friction, which has a name

        def act(value: LawWithEffects, theta: FloatArray, table: RunTable, term: _Term = term) -> LawWithEffects:
            a = theta[:, :1]
            return value.with_term(
                state, lambda s, p, u: a * term.evaluate(lambda name: s[name] if name in s else u[name])
            )

        shape = np.asarray(term.evaluate(lambda name: states.get(name, about.table.covariates.get(name))))
        if _add_if_new(shape, known):
            guess = rate / float(np.sqrt(np.mean(shape**2)))
            yield from _single_term_form(about, "rate", state, Stage.RATE, act, term, guess)


def _add_if_new(shape: FloatArray, known: list[FloatArray]) -> bool:
    """Append a term's centred values at the rows to `known`, unless constant or collinear; return whether it was."""
    centred = shape - shape.mean()
    size = float(np.linalg.norm(centred))
    if not np.isfinite(size) or size <= 1e-9 * float(np.linalg.norm(shape)):
        return False
    own = centred / size
    if any(abs(float(own @ other)) > _SAME for other in known):
        return False
    known.append(own)
    return True


def _covariate_name_of_variable(about: ReferenceFit, side: str, name: str) -> str:
    """Return the covariate along which a term's variable shows: "level", "time", a state's or a column's."""
    reading = about.system.simulator.reading
    if name in about.states and (side == "rate" or name == reading):
        return f"state:{name}"
    return "level" if name == reading else "time" if name == about.table.time else covariate_of_column(name)


def _single_term_form(
    about: ReferenceFit, side: str, target: str, stage: Stage, act: Act, term: _Term, guess: float
) -> Iterator[Form]:
    where = tuple(
        _covariate_name_of_variable(about, side, c) for c in dict.fromkeys(variable.name for variable in term.variables)
    )
    text = f"a {term.text}"
    what = target if side == "reading" else f"the rate of {target}"
    form = Form(
        f"formula:{side}:{target}:{term.text}",
        stage,
        {"a": AMPLITUDE},
        units=("",),
        covariates=where,
        act=act,
        entries=np.ones((1, 1, 1)),
        says=lambda mean, sd: (
            f"{what} lacks the term {text} with a = {value_with_sd(mean[0], sd[0], '')}: a proposal, not a known effect"
        ),
        expression=text,
    )
    yield from about.scaled(form, guess)


def _square_wave_form(about: ReferenceFit) -> Iterator[Form]:
    """Yield a shift of the reading during a share of every period: flat tops, and edges of unknown steepness."""
    own, table, origin = about.system.simulator, about.table, time_origin(about.table)
    frequencies = trial_frequencies_in_time(about, _MOST_SQUARE_WAVES, _ROWS_OF_A_WAVE)

    def act(value: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        a, hz, phase, share, edge = (theta[:, k : k + 1] for k in range(5))
        inside = np.cos(2 * np.pi * (hz * (rows.time_s - origin) + phase)) - np.cos(np.pi * share)
        return np.asarray(value + 0.5 * a * (1 + np.tanh(inside / edge)))

    phases, shares = np.arange(8) / 8 - 0.5, np.array([0.25, 0.5, 0.75])
    grid = np.meshgrid(1.0, frequencies, phases, shares, _SOFT, indexing="ij")
    since = f"({table.time} - {origin:.12g})" if origin else table.time
    text = f"while |({since} / period + phase) mod 1| < share / 2"
    form = Form(
        f"formula:reading:{own.reading}:{text}",
        Stage.OFFSET,
        {
            "a": AMPLITUDE,
            "hz": frequency_prior(frequencies),
            "phase": Uniform(-1.0, 1.0),
            "share": Uniform(0.03, 0.97),
            "edge": LogUniform(0.03, 1.0),
        },
        units=(own.unit, f"1/{about.time_unit}", "1", "1", "1"),
        covariates=("time",),
        act=act,
        entries=np.stack([each.ravel() for each in grid], axis=-1)[:, None, :],
        says=lambda mean, sd: (
            f"{own.reading} shifts by {value_with_sd(mean[0], sd[0], own.unit)} during "
            f"{value_with_sd(mean[3], sd[3], '')} of every "
            f"{period_with_sd(mean[1], sd[1], about.time_unit)}: a proposal, not a known effect"
        ),
        expression=f"a {text}",
        counted_from=origin_in_words(table.time, origin, about.time_unit),
    )
    yield from about.scaled(form, about.sd)


def _swept_wave_form(about: ReferenceFit) -> Iterator[Form]:
    """Yield a sinusoid in the reading whose frequency rises or falls linearly along the recording."""
    own, table = about.system.simulator, about.table
    begin, end = float(table.time_s.min()), float(table.time_s.max())
    frequencies = trial_frequencies_in_time(about, 2 * _MOST_SWEPT, _ROWS_OF_A_WAVE, most_waves=_MOST_SWEPT)
    middle, half = 0.5 * (begin + end), 0.5 * (end - begin)

    def act(value: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        a, hz, sweep, phase = (theta[:, k : k + 1] for k in range(4))
        u = (rows.time_s - middle) / half
        return np.asarray(value + a * np.sin(2 * np.pi * hz * half * (u + 0.5 * sweep * u**2) + phase))

    settings = []
    for hz in frequencies:
        n = 2 * max(int(np.ceil(_SWEEPS * hz * half)), 1)
        settings += [(hz, sweep) for sweep in np.linspace(-1, 1, n)]
    turned = f"2 pi hz (u + sweep u^2 / (2 {half:.4g})) + phase"
    text = f"sin({turned}), u = {table.time} - {text_rounded_to_spread(middle, half)}"
    form = WaveForm(
        name=f"formula:reading:{own.reading}:{text}",
        stage=Stage.OFFSET,
        parameters={
            "a": POSITIVE,
            "hz": frequency_prior(frequencies),
            "sweep": Uniform(-1.2, 1.2),
            "phase": PHASE,
        },
        units=(own.unit, f"1/{about.time_unit}", "1", "rad"),
        covariates=("time",),
        act=act,
        entries=sine_and_cosine_entries(1.0, *np.transpose(settings)),
        says=lambda mean, sd: (
            f"{own.reading} oscillates with an amplitude of {value_with_sd(mean[0], sd[0], own.unit)} and a frequency "
            f"that goes from {mean[1] * (1 - mean[2]):.4g} to {mean[1] * (1 + mean[2]):.4g} per {about.time_unit}: a "
            "proposal, not a known effect"
        ),
        expression=f"a {text}",
    )
    yield from about.scaled(form, about.sd)


def _double_settling_form(about: ReferenceFit) -> Iterator[Form]:
    """Yield a settling of the reading with two time constants from the start of each run."""
    own = about.system.simulator

    def act(value: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        a, b, first, second = (theta[:, k : k + 1] for k in range(4))
        since = time_since_start_of_run(rows)
        return np.asarray(value + a * np.exp(-since / first) + b * np.exp(-since / second))

    between = settling_time_prior(about)
    taus = np.geomspace(1.5 * between.low, 0.5 * between.high, _N_SETTLING)
    entries = np.array(
        [
            [[1.0, 0.0, taus[i], taus[j]], [0.0, 1.0, taus[i], taus[j]]]
            for i in range(_N_SETTLING)
            for j in range(i + _APART, _N_SETTLING)
        ]
    )
    text = "a exp(-t / tau1) + b exp(-t / tau2), t since the start of the run"
    form = Form(
        f"formula:reading:{own.reading}:{text}",
        Stage.OFFSET,
        {"a": AMPLITUDE, "b": AMPLITUDE, "tau1": between, "tau2": between},
        units=(own.unit, own.unit, about.time_unit, about.time_unit),
        covariates=("time", "run"),
        act=act,
        entries=entries,
        says=lambda mean, sd: (
            f"{own.reading} is off by {value_with_sd(mean[0], sd[0], own.unit)} and "
            f"{value_with_sd(mean[1], sd[1], own.unit)} at the start of each run, which settle with time constants of "
            f"{value_with_sd(mean[2], sd[2], about.time_unit)} and {value_with_sd(mean[3], sd[3], about.time_unit)}: a "
            "proposal, not a known effect"
        ),
        amplitudes=(0, 1),
        expression=text,
    )
    yield from about.scaled(form, 1.0)


def _varying_influence_form(about: ReferenceFit, name: str, values: FloatArray) -> Iterator[Form]:
    """Yield a form in which a column adds to the reading, by a coefficient quadratic in the reading."""
    own, level = about.system.simulator, about.predicted
    middle, half = 0.5 * float(level.max() + level.min()), 0.5 * float(np.ptp(level))
    centre, spread = float(np.mean(values)), float(np.std(values))
    if half <= 0:
        return

    def act(value: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        z = (value - middle) / half
        a, b, c = (theta[:, k : k + 1] for k in range(3))
        return np.asarray(value + (a + b * z + c * z**2) * (rows.covariates[name] - centre) / spread)

    scaled = f"({name} - {text_rounded_to_spread(centre, spread)}) / {spread:.4g}"
    z = f"({own.reading} - {text_rounded_to_spread(middle, half)}) / {half:.4g}"
    text = f"(a + b z + c z^2) {scaled}, z = {z}"
    form = Form(
        f"formula:reading:{own.reading}:{text}",
        Stage.OFFSET,
        dict.fromkeys("abc", AMPLITUDE),
        units=(own.unit,) * 3,
        covariates=(covariate_of_column(name), "level"),
        act=act,
        entries=np.eye(3)[None, :, :],
        says=lambda mean, sd: (
            f"{own.reading} rises with {name} by {value_with_sd(mean[0], sd[0], own.unit)} per sd in the middle of its "
            f"range, {value_with_sd(float(mean @ (1, -1, 1)), float(np.hypot(*sd[1:])), own.unit)} at its low end and "
            f"{value_with_sd(float(mean.sum()), float(np.hypot(*sd[1:])), own.unit)} at its high end: a proposal, "
            "not a known effect"
        ),
        amplitudes=(0, 1, 2),
        expression=text,
    )
    yield from about.scaled(form, about.sd)


def _dose_forms(about: ReferenceFit, name: str, values: FloatArray) -> Iterator[Form]:
    """Yield changes of the reading that saturate with a dose: the integral of |column - mean|, or |column|."""
    own, table = about.system.simulator, about.table
    spread = float(np.std(values))
    centre = rounded_to_spread(float(np.mean(values)), spread, 6)
    each: dict[str, Callable[[FloatArray], FloatArray]] = {
        f"|{name} - {text_rounded_to_spread(centre, spread)}|": lambda c: np.abs(c - centre)
    }
    if values.min() >= 0 or values.max() <= 0:
        each[f"|{name}|"] = np.abs
    in_time = table.has_varying_time
    if not in_time and not about.rows_are_in_order:
        return
    summed = f"integral over {table.time}" if in_time else "sum over rows"
    for what, rate in each.items():

        def dose_at_rows(rows: RunTable, rate: Callable[[FloatArray], FloatArray] = rate) -> FloatArray:
            return _integral_since_start_of_run(rate(rows.covariates[name]), rows, in_time=in_time)

        def act(
            value: FloatArray, theta: FloatArray, rows: RunTable, dose: Callable[[RunTable], FloatArray] = dose_at_rows
        ) -> FloatArray:
            return np.asarray(value - theta[:, :1] * np.expm1(-dose(rows) / theta[:, 1:2]))

        largest = float(dose_at_rows(table).max())
        if not largest > 0:
            continue
        saturating = LogUniform(_LEAST_DOSE * largest, _MOST_DOSE * largest)
        tried = np.geomspace(1.5 * saturating.low, 0.7 * saturating.high, _N_DOSES)
        text = f"1 - exp(-D / d), D the {summed} of {what} since the start of the run"
        form = Form(
            f"formula:reading:{own.reading}:{text}",
            Stage.OFFSET,
            {"a": AMPLITUDE, "d": saturating},
            units=(own.unit, ""),
            covariates=(covariate_of_column(name), "time", "run"),
            act=act,
            entries=single_column_bank(1.0, tried),
            says=lambda mean, sd, what=what: (  # type: ignore[misc]  # the second name of a value, not a parameter
                f"{own.reading} shifts in the end by {value_with_sd(mean[0], sd[0], own.unit)} as the {summed} of "
                f"{what} grows in a run, by 63 % of it when that is {value_with_sd(mean[1], sd[1], '')}: a proposal, "
                "not a known effect"
            ),
            expression=f"a ({text.split(',')[0]}),{text.split(',', 1)[1]}",
            needs_rising_time=in_time,
        )
        yield from about.scaled(form, about.sd)


def _integral_since_start_of_run(values: FloatArray, rows: RunTable, *, in_time: bool) -> FloatArray:
    """Return the integral of values over time from the start of each row's run, (n_points,); or their sum over rows."""
    out = np.zeros(len(rows))
    for own in rows.rows_by_scan():
        if not in_time:
            out[own] = np.cumsum(values[own])
        elif own.size:
            widths = np.diff(rows.time_s[own], prepend=rows.time_s[own][0])
            before = np.append(values[own][:1], values[own][:-1])
            out[own] = np.cumsum(widths * 0.5 * (values[own] + before))
    return out
