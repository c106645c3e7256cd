"""Every effect of the vocabulary, built for one system: on readings, inputs, clock, parameters and rates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.form import (
    Form,
    Instants,
    Numbers,
    Side,
    TrueSystem,
    draw_log_uniform,
    linear_drift,
    modulated,
    proportional_to_column,
    settling,
    sinusoid_in_time,
    step_at_change_point,
    value_per_run,
)
from probewise.proof.systems.kind import SystemTable

GAIN, OFFSET, _HYSTERESIS, _BEND, _LAG, _CEILING = range(6)
_MANY = 1e4  # largest amplitude of a term, in noise sds

FAMILIES = (
    *("offset_drift", "offset_step", "offset_per_run", "gain_drift", "gain_step", "gain_per_run", "nonlinearity"),
    *("saturation", "hysteresis", "lag", "delay", "settling", "interference", "sensitivity", "input_offset"),
    *("input_gain", "input_delay", "input_saturation", "dead_zone", "periodic_error", "backlash", "clock_drift"),
    *("drifts", "steps", "differs", "depends", "damping", "drag", "friction", "forcing", "periodic_forcing"),
    *("cubic", "quadratic", "coupling", "limit"),
)
"""Names of forms without targets."""

ADDED_FAMILIES = "curve", "friction of a column"
"""Further families, drawn after all others: the cases of a seed without them stay as they are."""


def family_of(form: Form) -> str:
    """Return the family of a form."""
    of_column = form.side == "reading" and form.name.startswith("friction:")
    return ADDED_FAMILIES[1] if of_column else form.vocabulary_name.split(":")[0]


def forms_of(true: TrueSystem) -> list[Form]:
    """Return every form of the vocabulary, once for each of its possible targets in this system."""
    out = [*_modulated_forms(true), *_forms_of_levels(true), *_lag_and_delay_forms(true)]
    for column in true.kind.drives:
        out += _forms_of_input(true, column)
    time = true.table.time
    # A clock error is detectable only if the law or the formula uses time.
    if time is not None and (true.kind.law is not None or true.kind.restarts_time):
        scaled = _act_on_column(time, lambda c, rows, v: c * (1 + v["a"]))
        out.append(Form("clock_drift", "input", scaled, 1e-3, 0.5, ("time", time)))
    out += _varying_parameter_forms(true)
    if true.kind.defines_states:
        for state in true.states:
            out += _forms_of_rate(true, state)
    return out


def modulated_reading_form(true: TrueSystem, name: str, how: Form, *, gain: bool = False) -> Form:
    """Return the form that adds a modulation to the reading or, with `gain`, multiplies by 1 + modulation."""

    def act(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        change = how.act(Instants.at_rows(rows), v)
        return np.asarray(y * (1 + change) if gain else y + change)

    typical = float(np.sqrt(np.mean(true.readings**2))) if gain else 1.0
    order = GAIN if gain else OFFSET
    return modulated(how, name, "reading", true.noise_sd / typical, limit=_MANY, act=act, order=order)


def added_form(
    true: TrueSystem, name: str, addition: Callable[..., Any], covariates: tuple[str, ...], **more: Any
) -> Form:
    """Return the form that adds `a` times `addition` (readings, rows, parameters) to the reading."""
    return Form(
        name,
        "reading",
        lambda y, rows, v: y + v["a"] * addition(y, rows, v),
        true.noise_sd,
        _MANY * true.noise_sd,
        covariates,
        **{"order": OFFSET, **more},
    )


def _modulated_forms(true: TrueSystem) -> Iterator[Form]:
    timed = true.table.time is not None
    both = {"step": step_at_change_point(true)}
    if timed:
        both["drift"] = linear_drift(true)
    if true.names_runs:
        both["per_run"] = value_per_run(true)
    for kind, how in both.items():
        yield modulated_reading_form(true, f"offset_{kind}", how)
        yield modulated_reading_form(true, f"gain_{kind}", how, gain=True)
    for column in true.varying_columns:
        yield modulated_reading_form(true, f"sensitivity:{column}", proportional_to_column(true, column))
        yield from _curve_and_friction_forms(true, column)
    if timed:
        yield modulated_reading_form(true, "interference", sinusoid_in_time(true))
        if true.kind.run is not None:  # a table that does not name its runs cannot show that it settles in each
            yield modulated_reading_form(true, "settling", settling(true))


def _curve_and_friction_forms(true: TrueSystem, column: str) -> Iterator[Form]:
    """Yield a polynomial of an order of two to five in a column, and its friction if it moves both ways."""
    values = true.table.columns[column]
    middle, half = 0.5 * float(values.max() + values.min()), 0.5 * float(np.ptp(values))
    orders = range(1, 6)

    def curve(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = (rows.columns[column] - middle) / half
        return np.asarray(y + np.polyval([*(v[f"a{k}"] for k in reversed(orders)), 0.0], z))

    def draw_coefficients(rng: np.random.Generator) -> dict[str, float]:
        order = int(rng.integers(2, 6))
        size = np.append(rng.uniform(-1, 1, order - 1), 1.0)  # the highest is the largest
        return {f"a{k}": float(size[k - 1]) if k <= order else 0.0 for k in orders}

    if len(np.unique(values)) > len(orders):
        yield Form(
            f"curve:{column}",
            "reading",
            curve,
            true.noise_sd,
            _MANY * true.noise_sd,
            (column,),
            of_amplitude=lambda a, drawn: {name: a * size for name, size in drawn.items()},
            draw=draw_coefficients,
            order=OFFSET,
        )
    speeds = np.sort(np.abs(values[values != 0]))
    if min(len(np.unique(side)) for side in (values[values < 0], values[values > 0])) >= 3:
        low, high = float(speeds[len(speeds) // 20]), 0.3 * float(speeds[-1])
        yield added_form(
            true,
            f"friction:{column}",
            lambda y, rows, v: np.tanh(rows.columns[column] / max(v["width"], 1e-12 * half)),
            (column,),
            draw=lambda rng: {"width": 0.0 if rng.random() < 0.5 else draw_log_uniform(rng, low, high)},
        )


def direction_of_change(y: FloatArray, rows: SystemTable) -> FloatArray:
    """Return the sign of the change from the row before in a run; 0 keeps the last sign, the first row has the next."""
    out = np.zeros_like(y)
    for own in rows.rows_by_run:
        signs = np.sign(np.diff(y[own]))
        moving = np.flatnonzero(signs)
        if moving.size:
            last = moving[np.clip(np.searchsorted(moving, np.arange(len(signs)), side="right") - 1, 0, None)]
            out[own] = np.concatenate([[signs[moving[0]]], signs[last]])
    return out


def _forms_of_levels(true: TrueSystem) -> Iterator[Form]:
    """Yield what depends on the reading itself: hysteresis, a bend, a ceiling and a floor."""
    low, high, sd = float(true.readings.min()), float(true.readings.max()), true.noise_sd
    span = high - low
    yield added_form(
        true, "hysteresis", lambda y, rows, v: direction_of_change(y, rows), ("previous",), order=_HYSTERESIS
    )
    if not span > 0:
        return

    def bend(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = (y - low) / span
        return np.asarray(y + v["a"] * span * (np.sign(z) * np.abs(z) ** v["power"] - z))

    def drawn_power(rng: np.random.Generator) -> dict[str, float]:
        return {"power": float(rng.choice([0.6, 1.6, 2.0, 3.0]))}

    yield Form("nonlinearity", "reading", bend, sd / span, 0.5, ("level",), draw=drawn_power, order=_BEND)
    common: dict[str, Any] = {"signed": False, "order": _CEILING}
    for name, bound, end in (("saturation", np.minimum, high), ("saturation (floor)", np.maximum, low)):
        inwards = -1.0 if end == high else 1.0

        def bounded(y: FloatArray, rows: SystemTable, v: Any, bound: Any = bound) -> FloatArray:
            return np.asarray(bound(y, v["level"]))

        def level_at(a: float, drawn: Any, end: float = end, inwards: float = inwards) -> dict[str, float]:
            return {"level": end + inwards * a}

        yield Form(
            name,
            "reading",
            bounded,
            2 * sd,
            0.5 * span,
            ("level",),
            of_amplitude=level_at,
            **common,
        )


def _form_of_number(
    name: str, side: Side, number: str, act: Callable[..., Any], first: float, limit: float, *more: Any, **others: Any
) -> Form:
    """Return a form of one parameter, the `number`, which is the amplitude."""
    others |= {"of_amplitude": lambda a, drawn: {number: a}, "signed": False}
    return Form(name, side, act, first, limit, *more, **others)


def delayed_values(values: FloatArray, rows: SystemTable, tau: float) -> FloatArray:
    """Delay values (n_points,) by `tau` within runs: interpolated, constant before the first row."""
    out = np.empty(values.shape)
    for own in rows.rows_by_run:
        t = rows.t[own]
        out[own] = np.interp(t - tau, t, values[own])
    return out


def _lagged(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
    out = y.copy()
    for own in rows.rows_by_run:
        for before, row in pairwise(own):
            stays = np.exp(-(rows.t[row] - rows.t[before]) / v["tau_s"])
            out[row] = stays * out[before] + (1 - stays) * out[row]
    return out


def _lag_and_delay_forms(true: TrueSystem) -> Iterator[Form]:
    if true.table.time is not None:
        gap, acts = (
            true.table.median_gap,
            {"lag": _lagged, "delay": lambda y, rows, v: delayed_values(y, rows, v["tau_s"])},
        )
        for name, act in acts.items():
            yield _form_of_number(name, "reading", "tau_s", act, 0.5 * gap, 15 * gap, ("previous",), order=_LAG)


def _act_on_column(column: str, change: Callable[[FloatArray, SystemTable, Numbers], Any]) -> Callable[..., Any]:
    """Return a `Form.act` that replaces one column by `change(column, rows, parameters)`."""
    return lambda columns, rows, v: {**columns, column: np.asarray(change(columns[column], rows, v))}


def _narrowed(c: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
    return np.asarray(np.sign(c) * np.maximum(np.abs(c) - v["width"], 0.0))


def _forms_of_input(true: TrueSystem, column: str) -> Iterator[Form]:
    """Yield the forms on a column that the law or formula uses."""
    values, (_, spread) = true.table.columns[column], true.deviation(column)
    low, high = float(values.min()), float(values.max())
    span, own, n_values = high - low, (column, "level"), len(np.unique(values))
    if not span > 0:
        return
    begin = 0.01 * spread
    offset = _act_on_column(column, lambda c, rows, v: c + v["a"])
    yield Form(f"input_offset:{column}", "input", offset, begin, 5 * span, own)
    scaled = _act_on_column(column, lambda c, rows, v: c * (1 + v["a"]))
    yield Form(f"input_gain:{column}", "input", scaled, 0.01, 0.9, own)
    yield Form(
        f"input_saturation:{column}",
        "input",
        _act_on_column(column, lambda c, rows, v: np.minimum(c, v["level"])),
        0.05 * span,
        0.6 * span,
        own,
        lambda a, drawn: {"level": high - a},
        signed=False,
    )

    def of_width(name: str, change: Callable[..., Any], seen: tuple[str, ...]) -> Form:
        act = _act_on_column(column, change)
        return _form_of_number(f"{name}:{column}", "input", "width", act, 0.01 * span, 0.3 * span, seen)

    if low <= 0.1 * span:
        yield of_width("dead_zone", _narrowed, own)
    moves = np.concatenate([np.diff(values[rows]) for rows in true.table.rows_by_run])
    if (moves > 0).mean() > 0.02 and (moves < 0).mean() > 0.02:
        yield of_width("backlash", behind_gear_play, ("previous", column))
    if n_values > 20:
        yield Form(
            f"periodic_error:{column}",
            "input",
            _act_on_column(column, lambda c, rows, v: c + v["a"] * np.sin(2 * np.pi * c / v["period"] + v["phase"])),
            begin,
            0.2 * span,
            own,
            draw=lambda rng: {
                "period": span / draw_log_uniform(rng, 1.5, min(n_values / 6, 25)),
                "phase": float(rng.uniform(0, 2 * np.pi)),
            },
            signed=False,
        )
    if true.table.time is not None:
        gap, act = true.table.median_gap, _act_on_column(column, lambda c, rows, v: delayed_values(c, rows, v["tau_s"]))
        seen = ("previous", column)
        yield _form_of_number(f"input_delay:{column}", "input", "tau_s", act, 0.5 * gap, 6 * gap, seen, late=column)


def behind_gear_play(c: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
    """Return a column, (n_points,), behind gear play `v["width"]`: it rests until the play is taken up.

    At the start of each run, the play is taken up in the direction of the first motion.
    """
    half, out = 0.5 * v["width"], np.empty(len(c))
    for own in rows.rows_by_run:
        ways = np.sign(np.diff(c[own]))
        ways = ways[ways != 0]
        at = c[own[0]] - half * (ways[0] if ways.size else 0.0)
        for row in own:
            at = out[row] = min(max(at, c[row] - half), c[row] + half)
    return out


def _varying_parameter_forms(true: TrueSystem) -> Iterator[Form]:
    """Yield the forms by which each parameter may vary: in a step, a drift, from run to run, with a column."""
    common = {"steps": step_at_change_point(true)}
    if true.table.time is not None:
        common["drifts"] = linear_drift(true)
    for name, values in true.parameters.items():
        of_run = name in true.kind.per_run
        if of_run and true.kind.law is not None:
            continue  # initial values do not vary within a run
        own = {f"{kind}:{name}": how for kind, how in common.items()}
        if not of_run and true.names_runs:
            own[f"differs:{name}"] = value_per_run(true)
        own |= {f"depends:{name}:{column}": proportional_to_column(true, column) for column in true.varying_columns}
        for called, how in own.items():
            size = 0.003 * float(np.abs(values).mean())
            yield modulated(how, called, "parameter", size, limit=200, target=name)


def rate_term_form(
    true: TrueSystem, name: str, state: str, push: Callable[[Any, Any, Any], Any], size: float, **more: Any
) -> Form:
    """Return the form of a term a push(states, now, parameters) in the rate of a state; `size`: push's magnitude."""
    first = 0.01 * true.rms_rate(state) / size
    return Form(name, "rate", lambda s, now, v: v["a"] * push(s, now, v), first, 300 * first, target=state, **more)


def _forms_of_rate(true: TrueSystem, state: str) -> Iterator[Form]:
    """Yield the terms that may be missing from the rate of a state, dry friction and an upper bound included."""
    speed, values = true.rms_rate(state), true.states[state]

    def term(name: str, of: str, change: Callable[[Any], Any], size: float, seen: tuple[str, ...], **more: Any) -> Form:
        """Return a term that is a function `change` of the state `of`."""
        return rate_term_form(true, name, state, lambda s, now, v: change(s[of]), size, covariates=seen, **more)

    size, own = float(np.abs(values).max()), (f"state:{state}", "time")
    yield term(f"damping:{state}", state, lambda r: -r, size, own, signed=False)
    yield term(f"drag:{state}", state, lambda r: -np.abs(r) * r, size**2, own, signed=False)
    yield term(f"forcing:{state}", state, lambda r: 1.0 + 0.0 * r, 1.0, ("time", *own))
    for other, there in true.states.items():
        most, seen = float(np.abs(there).max()), (f"state:{other}", "time")
        yield term(f"cubic:{state}:{other}", other, lambda r: -(r**3), most**3, seen)
        yield term(f"quadratic:{state}:{other}", other, lambda r: -(r**2), most**2, seen)
        if other != state:
            yield term(f"coupling:{state}:{other}", other, lambda r: -r, most, seen)
    waves = sinusoid_in_time(true)
    act, name = (lambda s, now, v: waves.act(now, v)), f"periodic_forcing:{state}"
    yield modulated(waves, name, "rate", 0.02 * speed, limit=100, act=act, target=state)
    held: dict[str, Any] = {"covariates": (f"state:{state}", "level"), "signed": False, "target": state}
    yield Form(f"friction:{state}", "rate", lambda s, now, v: 0.0, 0.02 * speed, 2 * speed, sticks=True, **held)
    high, span = float(values.max()), float(np.ptp(values))
    yield Form(
        f"limit:{state}",
        "rate",
        lambda s, now, v: 0.0,
        0.05 * span,
        0.6 * span,
        of_amplitude=lambda a, drawn: {"level": high - a},
        stops=True,
        **held,
    )
