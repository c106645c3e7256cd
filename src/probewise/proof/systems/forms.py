"""Every effect of the vocabulary, built for one system: on readings, inputs, clock, parameters and rates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.form import (
    Form,
    Instants,
    Modulation,
    Numbers,
    Side,
    TrueSystem,
    draw_log_uniform,
    linear_drift,
    proportional_to_column,
    settling,
    sinusoid_in_time,
    start_values_of_wave,
    step_at_change_point,
    value_per_run,
    wave_bank,
)
from probewise.proof.systems.kind import SystemTable

GAIN, OFFSET, _HYSTERESIS, _BEND, _LAG, _CEILING = range(6)
_N_WAVES = 240


def forms_of_readings(true: TrueSystem) -> Iterator[Form]:
    """Yield every form on the reading that this system can have."""
    yield from _modulated_forms(true)
    yield from _hysteresis_bend_and_saturation_forms(true)
    yield from _lag_and_delay_forms(true)


def modulated_reading_form(true: TrueSystem, name: str, how: Modulation, *, gain: bool = False) -> Form:
    """Return the form that adds a modulation to the reading or, with `gain`, multiplies by 1 + modulation."""

    def act(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        change = how.value_at(Instants.at_rows(rows), v)
        return np.asarray(y * (1 + change) if gain else y + change)

    typical = float(np.sqrt(np.mean(true.readings**2))) if gain else 1.0
    first = true.noise_sd / typical / how.reach
    return how.form(name, "reading", first, limit=1e4, act=act, order=GAIN if gain else OFFSET)


def _modulated_forms(true: TrueSystem) -> Iterator[Form]:
    timed = true.table.time is not None
    both = {"step": step_at_change_point(true)}
    if timed:
        both["drift"] = linear_drift(true)
    if true.kind.run is not None and len(true.table.rows_by_run) > 1:
        both["per_run"] = value_per_run(true)
    for kind, how in both.items():
        yield modulated_reading_form(true, f"offset_{kind}", how)
        yield modulated_reading_form(true, f"gain_{kind}", how, gain=True)
    for column in true.varying_columns:
        yield modulated_reading_form(true, f"sensitivity:{column}", proportional_to_column(true, column))
        yield from _curve_and_friction_forms(true, column)
    if timed:
        yield modulated_reading_form(true, "interference", sinusoid_in_time(true, _N_WAVES))
        if true.kind.run is not None:  # a table that does not name its runs cannot show that it settles in each
            yield modulated_reading_form(true, "settling", settling(true))


def _curve_and_friction_forms(true: TrueSystem, column: str) -> Iterator[Form]:
    """Yield a polynomial of an order of two to five in a column, and its friction if it moves both ways."""
    values, sd = true.table.columns[column], true.noise_sd
    middle, half = 0.5 * float(values.max() + values.min()), 0.5 * float(np.ptp(values))
    orders = range(1, 6)

    def curve(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = (rows.columns[column] - middle) / half
        return np.asarray(y + z * (v["a1"] + z * (v["a2"] + z * (v["a3"] + z * (v["a4"] + z * v["a5"])))))

    def draw_coefficients(rng: np.random.Generator) -> dict[str, float]:
        order = int(rng.integers(2, 6))
        size = np.append(rng.uniform(-1, 1, order - 1), 1.0)  # the highest is the largest
        return {f"a{k}": float(size[k - 1]) if k <= order else 0.0 for k in orders}

    none = {f"a{k}": 0.0 for k in orders}
    common: dict[str, Any] = {
        "covariates": (column,),
        "uses": (column,),
        "order": OFFSET,
        "first": sd,
        "limit": 1e4 * sd,
    }
    if len(np.unique(values)) > len(orders):
        yield Form(
            f"curve:{column}",
            "reading",
            act=curve,
            of_amplitude=lambda a, drawn: {name: a * size for name, size in drawn.items()},
            draw=draw_coefficients,
            bank=[[{**none, f"a{k}": sd} for k in orders]],
            start_values=lambda group, amounts: {f"a{k}": sd * float(amounts[k - 1]) for k in orders},
            steps={f"a{k}": sd for k in orders},
            **common,
        )
    speeds = np.sort(np.abs(values[values != 0]))
    if min(len(np.unique(side)) for side in (values[values < 0], values[values > 0])) >= 3:
        widths = np.geomspace(speeds[len(speeds) // 20], 0.3 * speeds[-1], 5)
        yield Form(
            f"friction:{column}",
            "reading",
            act=lambda y, rows, v: y + v["a"] * np.tanh(rows.columns[column] / np.maximum(v["width"], 1e-12 * half)),
            draw=lambda rng: {"width": 0.0 if rng.random() < 0.5 else draw_log_uniform(rng, widths[0], widths[-1])},
            bank=[[{"a": sd, "width": float(width)}] for width in (0.0, *widths)],
            steps={"a": sd, "width": 0.02 * float(widths[0])},
            **common,
        )


def direction_of_change(y: FloatArray, rows: SystemTable) -> FloatArray:
    """Return the sign of the change from the row before in a run; 0 keeps the last sign, the first row has the next."""
    out = np.zeros_like(y)
    for own in rows.rows_by_run:
        for i in range(len(y)):
            signs = np.sign(np.diff(y[i, own]))
            moving = np.flatnonzero(signs)
            if not moving.size:
                continue
            last = moving[np.clip(np.searchsorted(moving, np.arange(len(signs)), side="right") - 1, 0, None)]
            out[i, own] = np.concatenate([[signs[moving[0]]], signs[last]])
    return out


def _hysteresis_bend_and_saturation_forms(true: TrueSystem) -> Iterator[Form]:
    low, high, sd = float(true.readings.min()), float(true.readings.max()), true.noise_sd
    span = high - low
    yield form_of_amplitude(
        "hysteresis",
        "reading",
        lambda y, rows, v: y + v["a"] * direction_of_change(y, rows),
        sd,
        limit=1e3 * sd,
        covariates=("previous",),
        order=_HYSTERESIS,
    )

    def bend(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = (y - low) / span
        return np.asarray(y + v["a"] * span * (np.sign(z) * np.abs(z) ** v["power"] - z))

    if not high > low:
        return
    first = sd / span
    yield Form(
        "nonlinearity",
        "reading",
        act=bend,
        draw=lambda rng: {"power": float(rng.choice([0.6, 1.6, 2.0, 3.0]))},
        bank=[[{"a": first, "power": p}] for p in (0.5, 0.7, 1.4, 2.0, 3.0, 4.5)],
        steps={"a": first, "power": 0.05},
        first=first,
        limit=0.5,
        covariates=("level",),
        order=_BEND,
        also_in_truth={"lo": low, "hi": high},
    )
    ends: tuple[tuple[str, Any, float, float], ...] = (
        ("saturation", np.minimum, high, -1.0),
        ("saturation (floor)", np.maximum, low, 1.0),
    )
    for name, bound, end, sign in ends:
        yield _form_of_number(
            name,
            "reading",
            "level",
            _clip(bound),
            end + sign * span * np.geomspace(0.004, 0.5, 14),
            at=partial(_away_from, end, sign),
            step=0.01 * span,
            first=2 * sd,
            limit=0.5 * span,
            covariates=("level",),
            order=_CEILING,
        )


def _clip(bound: Callable[[FloatArray, Any], FloatArray]) -> Callable[..., FloatArray]:
    return lambda y, rows, v: bound(y, v["level"])


def _away_from(end: float, sign: float, a: float) -> float:
    return end + sign * a


def form_of_amplitude(
    name: str, side: Side, act: Callable[..., Any], first: float, *, bank: float = 1.0, **more: Any
) -> Form:
    """Return a form of an amplitude alone, in whose bank it is `bank` times the `first` tried."""
    return Form(name, side, act=act, bank=[[{"a": bank * first}]], steps={"a": first}, first=first, **more)


def _form_of_number(
    name: str,
    side: Side,
    number: str,
    act: Callable[..., Any],
    tried: FloatArray,
    *,
    step: float,
    at: Callable[[float], float] = lambda a: a,
    **more: Any,
) -> Form:
    """Return a form of one parameter, the `number`, which is `at(amplitude)`; its bank has those `tried`."""
    return Form(
        name,
        side,
        act=act,
        of_amplitude=lambda a, drawn: {number: at(a)},
        bank=[[{number: float(size)}] for size in tried],
        steps={number: step},
        signed=False,
        **more,
    )


def delayed_values(values: FloatArray, rows: SystemTable, tau: FloatArray) -> FloatArray:
    """Delay values (n or 1, n_points) by tau (n or 1, 1) within runs: interpolated, constant before the first row."""
    n = max(len(values), len(tau))
    values, tau = np.broadcast_to(values, (n, values.shape[1])), np.broadcast_to(tau, (n, 1))
    out = np.empty(values.shape)
    for own in rows.rows_by_run:
        t = rows.t[own]
        for i in range(n):
            out[i, own] = np.interp(t - tau[i, 0], t, values[i, own])
    return out


def _lagged(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
    tau = np.maximum(np.broadcast_to(v["tau_s"], (max(len(y), len(v["tau_s"])), 1)), 1e-12)
    out = np.array(np.broadcast_to(y, (len(tau), y.shape[1])))
    for own in rows.rows_by_run:
        for before, row in pairwise(own):
            stays = np.exp(-(rows.t[row] - rows.t[before]) / tau[:, 0])
            out[:, row] = stays * out[:, before] + (1 - stays) * out[:, row]
    return out


def _lag_and_delay_forms(true: TrueSystem) -> Iterator[Form]:
    if true.table.time is None:
        return
    gap = true.table.median_gap
    acts = {
        "lag": (_lagged, 0.3),
        "delay": (lambda y, rows, v: delayed_values(y, rows, np.maximum(v["tau_s"], 0.0)), 0.02),
    }
    for name, (act, least) in acts.items():
        yield _form_of_number(
            name,
            "reading",
            "tau_s",
            act,
            gap * np.geomspace(least, 12, 10),
            step=0.02 * gap,
            first=0.45 * gap,
            limit=15 * gap,
            covariates=("previous",),
            order=_LAG,
        )


def forms_of_inputs(true: TrueSystem) -> Iterator[Form]:
    """Yield the forms on each column that the law or formula uses, and the drift of the clock."""
    for column in true.kind.drives:
        yield from _forms_of_column(true, column)
    time = true.table.time
    # A clock error is detectable only if the law or the formula uses time.
    if time is not None and (true.kind.law is not None or true.kind.restarts_time):
        scaled = _act_on_column(time, lambda c, rows, v: c * (1 + v["a"]))
        yield form_of_amplitude("clock_drift", "input", scaled, 1e-3, limit=0.5, covariates=("time", time))


def _act_on_column(column: str, change: Callable[[FloatArray, SystemTable, Numbers], Any]) -> Callable[..., Any]:
    """Return a `Form.act` that replaces one column by `change(column, rows, parameters)`."""
    return lambda columns, rows, v: {**columns, column: np.asarray(change(columns[column], rows, v))}


def _forms_of_column(true: TrueSystem, column: str) -> Iterator[Form]:
    values, spread = true.table.columns[column], true.sd_of(column)
    low, high = float(values.min()), float(values.max())
    span, own, n_values = high - low, (column, "level"), len(np.unique(values))
    if not span > 0:
        return
    offset = _act_on_column(column, lambda c, rows, v: c + v["a"])
    yield form_of_amplitude(f"input_offset:{column}", "input", offset, 0.01 * spread, limit=5 * span, covariates=own)
    scaled = _act_on_column(column, lambda c, rows, v: c * (1 + v["a"]))
    yield form_of_amplitude(f"input_gain:{column}", "input", scaled, 0.01, limit=0.9, covariates=own)
    yield _form_of_number(
        f"input_saturation:{column}",
        "input",
        "level",
        _act_on_column(column, lambda c, rows, v: np.minimum(c, v["level"])),
        high - span * np.geomspace(0.004, 0.5, 12),
        at=lambda a: high - a,
        step=0.01 * span,
        first=0.05 * span,
        limit=0.6 * span,
        covariates=own,
    )

    def of_size(name: str, number: str, change: Callable[..., Any], tried: FloatArray, **more: Any) -> Form:
        middle = float(tried[len(tried) // 2])
        act = _act_on_column(column, change)
        sizes: dict[str, Any] = {"first": middle, "limit": float(tried[-1])}
        return _form_of_number(f"{name}:{column}", "input", number, act, tried, step=0.02 * middle, **sizes, **more)

    sizes = span * np.geomspace(1e-4, 0.3, 10)
    if low <= 0.1 * span:

        def narrowed(c: FloatArray, rows: SystemTable, v: Numbers) -> Any:
            return np.sign(c) * np.maximum(np.abs(c) - np.maximum(v["width"], 0.0), 0.0)

        yield of_size("dead_zone", "width", narrowed, sizes, covariates=own)
    moves = np.concatenate([np.diff(values[rows]) for rows in true.table.rows_by_run])
    if (moves > 0).mean() > 0.02 and (moves < 0).mean() > 0.02:
        yield of_size("backlash", "width", behind_gear_play, sizes, covariates=("previous", column))
    if n_values > 20:
        first = 0.01 * spread
        waves = wave_bank(first, np.linspace(0.4, min(n_values / 4, 60), 60) / span, "period")
        yield Form(
            f"periodic_error:{column}",
            "input",
            act=_act_on_column(
                column, lambda c, rows, v: c + v["a"] * np.sin(2 * np.pi * c / v["period"] + v["phase"])
            ),
            draw=lambda rng: {
                "period": span / draw_log_uniform(rng, 1.5, min(n_values / 6, 25)),
                "phase": float(rng.uniform(0, 2 * np.pi)),
            },
            bank=[[{**each, "period": 1 / each["period"]} for each in group] for group in waves],
            start_values=start_values_of_wave,
            steps={"a": first, "period": 0.002 * span, "phase": 0.05},
            first=first,
            limit=0.2 * span,
            covariates=own,
            signed=False,
        )
    if true.table.time is not None:
        taus = true.table.median_gap * np.geomspace(0.05, 6, 12 if true.kind.law is None else 5)

        def delayed(c: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
            return delayed_values(c, rows, np.maximum(v["tau_s"], 0.0))

        yield of_size("input_delay", "tau_s", delayed, taus, covariates=("previous", column), late=column)


def behind_gear_play(c: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
    """Return a column, (n_samples, n_points), behind gear play `v["width"]`: it rests until the play is taken up.

    At the start of each run, the play is taken up in the direction of the first motion.
    """
    half = 0.5 * np.maximum(v["width"][:, 0], 0.0)
    out = np.empty((max(len(c), len(half)), c.shape[1]))
    for own in rows.rows_by_run:
        moves = np.diff(c[0, own])
        ways = moves[moves != 0]
        at = c[:, own[0]] - half * (np.sign(ways[0]) if ways.size else 0.0)
        for row in own:
            at = np.minimum(np.maximum(at, c[:, row] - half), c[:, row] + half)
            out[:, row] = at
    return out


_N_FORCING_WAVES = 20


def forms_of_parameters(true: TrueSystem) -> Iterator[Form]:
    """Yield the forms by which each parameter may vary: in a step, a drift, from run to run, with a column."""
    common = {"steps": step_at_change_point(true)}
    if true.table.time is not None:
        common["drifts"] = linear_drift(true)
    for name in true.kind.priors:
        own = dict(common)
        if name not in true.kind.per_run and true.kind.run is not None and len(true.table.rows_by_run) > 1:
            own["differs"] = value_per_run(true)
        if name in true.kind.per_run and true.kind.law is not None:
            own = {}  # initial values do not vary within a run
        for kind, how in own.items():
            yield varying_parameter_form(true, f"{kind}:{name}", name, how)
        if not (name in true.kind.per_run and true.kind.law is not None):
            for column in true.varying_columns:
                yield varying_parameter_form(
                    true, f"depends:{name}:{column}", name, proportional_to_column(true, column)
                )


def varying_parameter_form(true: TrueSystem, name: str, target: str, how: Modulation) -> Form:
    """Return the form `name` by which the parameter `target` varies as the modulation `how`, e.g. a step."""
    first = 0.003 * float(np.abs(true.parameters[target]).mean()) / how.reach
    return how.form(name, "parameter", first, bank=0.1, limit=200, target=target)


def rate_term_form(
    true: TrueSystem, name: str, state: str, push: Callable[[Any, Any, Any], Any], size: float, **more: Any
) -> Form:
    """Return the form of a term a push(states, now, parameters) in the rate of a state; `size`: push's magnitude."""
    first = 0.01 * true.rms_rate(state) / size

    def act(s: Any, now: Any, v: Numbers) -> Any:
        return v["a"] * push(s, now, v)

    return form_of_amplitude(name, "rate", act, first, bank=0.1, limit=300 * first, target=state, **more)


def forms_of_rates(true: TrueSystem) -> Iterator[Form]:
    """Yield the terms that may be missing from the rate of each state, dry friction and an upper bound included."""
    for state in true.states:
        yield from _terms_in_rate(true, state)
        waves, first = sinusoid_in_time(true, _N_FORCING_WAVES), 0.02 * true.rms_rate(state)
        yield waves.form(
            f"periodic_forcing:{state}",
            "rate",
            first,
            bank=0.1,
            limit=100,
            act=lambda s, now, v, waves=waves: waves.value_at(now, v),
            target=state,
        )
        yield from _friction_and_bound_forms(true, state)


def _terms_in_rate(true: TrueSystem, state: str) -> Iterator[Form]:
    def term(name: str, of: str, change: Callable[[Any], Any], size: float, seen: tuple[str, ...], **more: Any) -> Form:
        """Return a term that is a function `change` of the state `of`."""
        return rate_term_form(true, name, state, lambda s, now, v: change(s[of]), size, covariates=seen, **more)

    size, own = float(np.abs(true.states[state]).max()), (f"state:{state}", "time")
    yield term(f"damping:{state}", state, lambda r: -r, size, own, signed=False)
    yield term(f"drag:{state}", state, lambda r: -np.abs(r) * r, size**2, own, signed=False)
    yield term(f"forcing:{state}", state, lambda r: 1.0 + 0.0 * r, 1.0, ("time", *own))
    for other, there in true.states.items():
        most, seen = float(np.abs(there).max()), (f"state:{other}", "time")
        yield term(f"cubic:{state}:{other}", other, lambda r: -(r**3), most**3, seen)
        yield term(f"quadratic:{state}:{other}", other, lambda r: -(r**2), most**2, seen)
        if other != state:
            yield term(f"coupling:{state}:{other}", other, lambda r: -r, most, seen)


def _friction_and_bound_forms(true: TrueSystem, state: str) -> Iterator[Form]:
    speed, values = true.rms_rate(state), true.states[state]
    sizes = speed * np.geomspace(1e-3, 0.3, 4)
    yield Form(
        f"friction:{state}",
        "rate",
        act=lambda s, now, v: 0.0,
        bank=[[{"a": float(size)}] for size in sizes],
        start_values=lambda group, amounts: dict(group[0]),
        steps={"a": 0.01 * speed},
        first=0.02 * speed,
        limit=2 * speed,
        covariates=(f"state:{state}", "level"),
        signed=False,
        target=state,
        sticks=True,
    )
    low, high = float(values.min()), float(values.max())
    yield _form_of_number(
        f"limit:{state}",
        "rate",
        "level",
        lambda s, now, v: 0.0,
        high - (high - low) * np.array([0.01, 0.04, 0.12, 0.3]),
        at=lambda a: high - a,
        step=0.01 * (high - low),
        first=0.05 * (high - low),
        limit=0.6 * (high - low),
        covariates=(f"state:{state}", "level"),
        target=state,
        stops=True,
    )


FAMILIES = (
    "offset_drift",
    "offset_step",
    "offset_per_run",
    "gain_drift",
    "gain_step",
    "gain_per_run",
    "nonlinearity",
    "saturation",
    "hysteresis",
    "lag",
    "delay",
    "settling",
    "interference",
    "sensitivity",
    "input_offset",
    "input_gain",
    "input_delay",
    "input_saturation",
    "dead_zone",
    "periodic_error",
    "backlash",
    "clock_drift",
    "drifts",
    "steps",
    "differs",
    "depends",
    "damping",
    "drag",
    "friction",
    "forcing",
    "periodic_forcing",
    "cubic",
    "quadratic",
    "coupling",
    "limit",
)
"""Names of forms without targets."""


ADDED_FAMILIES = "curve", "friction of a column"
"""Further families, drawn after all others: the cases of a seed without them stay as they are."""


def family_of(form: Form) -> str:
    """Return the family of a form."""
    of_column = form.side == "reading" and form.name.startswith("friction:")
    return ADDED_FAMILIES[1] if of_column else form.name.split(":")[0].removesuffix(" (floor)")


def forms_of(true: TrueSystem) -> list[Form]:
    """Return every form of the vocabulary, once for each of its possible targets in this system."""
    of_rates = forms_of_rates(true) if true.kind.defines_states else ()
    return [*forms_of_readings(true), *forms_of_inputs(true), *forms_of_parameters(true), *of_rates]
