"""Proposals: short formulas of columns and states, in the reading or in a rate, for effects out of vocabulary.

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
from probewise.priors import Uniform
from probewise.sensor import Stage
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import Act, ChangePoints, Form
from probewise.systems.forms.origins import rounded_to_spread, text_rounded_to_spread
from probewise.systems.forms.proposals_in_time import formula_forms_in_time
from probewise.systems.forms.proposals_of_columns import formula_forms_of_columns
from probewise.systems.forms.rates import trial_rate
from probewise.systems.motion import LawWithEffects
from probewise.systems.table import RunTable, covariate_of_column

_MOST_SWITCHES = 128  # thresholds of a switch in a column
_THRESHOLDS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9)  # quantiles of a state beyond which a term may act
_SAME = 0.9999  # cosine of two terms over the rows above which only the shorter one is kept


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
    yield from formula_forms_of_columns(about, columns)
    if about.table.has_varying_time:
        yield from formula_forms_in_time(about)
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
    at = np.append(values[: -1 : -(-(len(values) - 1) // _MOST_SWITCHES)], values[-1]).tolist()

    def act(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        return np.asarray(value + theta[:, :1] * (table.covariates[name] > theta[:, 1:2]))

    entry = np.array([[[about.sd, 0.5 * (at[0] + at[-1])]]])
    typical = about.typical_amplitude(Stage.OFFSET, act, entry, about.sd)
    if typical is None:
        return
    entry[..., 0] = typical
    text = f"(1 + sign({name} - at)) / 2"
    yield Form(
        f"formula:reading:{own.reading}:{text}",
        Stage.OFFSET,
        marginals={"a": about.amplitude_prior(typical), "at": Uniform(at[0], at[-1])},
        units=(own.unit, name),
        covariates=(covariate_of_column(name),),
        act=act,
        entries=entry,
        amplitudes=(0,),
        says=lambda mean, sd: (
            f"{own.reading} shifts by {value_with_sd(mean[0], sd[0], own.unit)} where {name} is above "
            f"{value_with_sd(mean[1], sd[1], '')}: a proposal, not a known effect"
        ),
        change_points=ChangePoints(tuple(at), by_row=False, gated=True, column=name),
        expression=f"a {text}",
    )


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

        guess = trial_rate(about, state) / (high - low)
        entries = np.array([[[guess, at]] for at in np.quantile(values, _THRESHOLDS)])
        typical = about.typical_amplitude(Stage.RATE, act, entries, guess)
        if typical is None or not np.isfinite(typical):
            continue
        entries[:, :, 0] = typical
        yield Form(
            f"formula:rate:{state}:{text}",
            Stage.RATE,
            marginals={"a": about.amplitude_prior(typical), "at": Uniform(low, high)},
            units=("", state),
            covariates=(f"state:{state}", "time"),
            act=act,
            entries=entries,
            amplitudes=(0,),
            says=says,
            expression=f"a {text}",
        )


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
    typical = about.typical_amplitude(stage, act, np.full((1, 1, 1), guess), guess)
    if typical is None or not np.isfinite(typical):
        return
    where = tuple(
        _covariate_name_of_variable(about, side, c) for c in dict.fromkeys(variable.name for variable in term.variables)
    )
    text = f"a {term.text}"
    what = target if side == "reading" else f"the rate of {target}"
    yield Form(
        f"formula:{side}:{target}:{term.text}",
        stage,
        marginals={"a": about.amplitude_prior(typical)},
        units=("",),
        covariates=where,
        act=act,
        entries=np.full((1, 1, 1), typical),
        amplitudes=(0,),
        says=lambda mean, sd: (
            f"{what} lacks the term {text} with a = {value_with_sd(mean[0], sd[0], '')}: a proposal, not a known effect"
        ),
        expression=text,
    )
