"""Effects on a system: their formulas bound to targets, in the vocabulary and outside."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.kinds import SystemKind, SystemTable

Side: TypeAlias = Literal["input", "parameter", "rate", "reading"]

Numbers: TypeAlias = Mapping[str, float]
"""A form's parameters by name."""


@dataclass(frozen=True, eq=False)
class Instants:
    """Instants of runs, at rows or between them; arrays broadcast.

    `t` is the recorded time, `since` the time since the start of the run, `u` the columns by name, `run` the number of
    the run, `row` the index of the row.
    """

    t: FloatArray
    since: FloatArray
    u: Mapping[str, Any]
    run: IntArray
    row: FloatArray

    @classmethod
    def at_rows(cls, rows: SystemTable) -> Self:
        """Return the instants of all rows of a table."""
        return cls(rows.t, rows.time_since_start, rows.columns, rows.run, np.arange(float(len(rows))))


@dataclass(frozen=True, eq=False)
class Form:
    """The formula of an effect, in the vocabulary or outside, bound to a target.

    It changes a `side` by `act`: of an input, a function of columns, rows and parameters that returns columns; of a
    parameter, of now and parameters, that returns a term to add; of the rate of a state, of states, now and parameters,
    that returns a term to add; of the reading, of readings, rows and parameters, that returns readings.
    """

    name: str  # or name:target
    side: Side
    act: Callable[..., Any]
    first: float  # amplitude that is tried first
    limit: float  # largest amplitude
    covariates: tuple[str, ...]  # along which its residual is visible
    # All parameters by name, from the amplitude and the others; `draw` draws these.
    of_amplitude: Callable[[float, dict[str, float]], dict[str, float]] = lambda a, drawn: {"a": a, **drawn}
    draw: Callable[[np.random.Generator], dict[str, float]] = lambda rng: {}
    signed: bool = True  # whether the amplitude may be negative
    target: str = ""  # the parameter or state on which it acts
    order: int = 0  # forms of readings act in ascending order
    uses: tuple[str, ...] = ()  # columns that it uses
    breaks: Callable[[Numbers], float] | None = None  # time of a discontinuity, from the parameters
    late: str = ""  # the column that it delays
    sticks: bool = False  # it is dry friction of the target
    stops: bool = False  # it is an upper bound of the target
    outside: bool = False  # of the vocabulary of a diagnosis


@dataclass(frozen=True, eq=False)
class SystemEffect:
    """An effect of a system: form, parameters, size lambda, and the covariates along which it shows."""

    form: Form
    values: Numbers
    size_lambda: float = 0.0
    covariates: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The effect's name in the vocabulary, with its target: "saturation (floor)" is a saturation."""
        return self.form.name.removesuffix(" (floor)")

    @property
    def in_vocabulary(self) -> bool:
        """Whether the effect is one that a diagnosis can name."""
        return not self.form.outside


@dataclass(frozen=True, eq=False)
class SimulatedSystem:
    """A system simulated without noise over the rows of a table, at parameters that are numbers or (n_points,).

    `readings`, (n_points,), and `states` by name of the same shape ({} for a static system). Effects are made for one
    at its true parameters, without effects, over the rows that are not held out.
    """

    kind: SystemKind
    table: SystemTable
    parameters: Mapping[str, Any]
    readings: FloatArray
    states: Mapping[str, FloatArray]

    @property
    def varying_columns(self) -> tuple[str, ...]:
        """Names of the columns that vary, except time."""
        return tuple(name for name, v in self.table.columns.items() if name != self.table.time and np.ptp(v) > 0)

    def deviation(self, column: str) -> tuple[float, float]:
        """Return mean and sd of a column."""
        values = self.table.columns[column]
        return float(values.mean()), float(values.std())

    def rms_rate(self, state: str) -> float:
        """Return the root-mean-square rate of a state, from differences between successive rows of a run."""
        found = []
        for own in self.table.rows_by_run:
            gaps = np.diff(self.table.t[own])
            found.append(np.diff(self.states[state][own])[gaps > 0] / gaps[gaps > 0])
        return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))


def draw_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number between `low` and `high` whose logarithm is uniform; NotConvergedError if the range is empty."""
    if not 0 < low < high:
        raise NotConvergedError(f"nothing lies between {low:g} and {high:g}: too few rows")
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _modulation(
    value_at: Callable[[Instants, Numbers], Any], *covariates: str, reach: float = 1.0, **more: Any
) -> Form:
    """Return a variation in proportion to an amplitude; `reach`: its typical magnitude at amplitude 1."""
    return Form("", "parameter", value_at, 1 / reach, math.inf, covariates, **more)


def _modulated(how: Form, name: str, side: Side, size: float, *, limit: float, **more: Any) -> Form:
    """Return the form that varies so, by default a term added; `size` of its first amplitude, `limit` in that."""
    first = size * how.first
    return replace(how, name=name, side=side, first=first, limit=limit * first, **more)


def _modulations(true: SimulatedSystem) -> dict[str, Form]:
    """Return by name the variations that a system can have.

    "step" at a change point, after a time "at_s" or, without time, a row "at_row"; "drift" with the recorded time;
    "per_run", a normal random value for each run, held-out ones included; "wave", with a period of four rows to two
    thirds of the recording; "settling" from the start of each run.
    """
    rows, timed = true.table, true.table.time is not None
    at, time = ("at_s", ("time", str(rows.time))) if timed else ("at_row", ("row",))
    names, longest = [f"values[{k}]" for k in range(rows.n_runs)], float(rows.time_since_start.max())

    def change_point(rng: np.random.Generator) -> dict[str, float]:  # from the middle 60 % of the rows
        found = float(np.quantile(rows.t, rng.uniform(0.2, 0.8)))
        return {at: found if timed else math.floor(found) + 0.5}

    def wave(rng: np.random.Generator) -> dict[str, float]:
        hz = draw_log_uniform(rng, 1.5 / rows.duration, 0.25 / rows.median_gap)
        return {"hz": hz, "phase": float(rng.uniform(0, 2 * np.pi))}

    step = lambda now, v: v["a"] * ((now.t if timed else now.row) > v[at])
    out = {"step": _modulation(step, *time, draw=change_point, breaks=(lambda v: v[at]) if timed else None)}
    if timed:
        out["drift"] = _modulation(lambda now, v: v["a"] * now.t, *time, reach=float(np.abs(rows.t).max()))
    if true.kind.run is not None and len(rows.rows_by_run) > 1:
        out["per_run"] = _modulation(
            lambda now, v: np.array([v[name] for name in names])[now.run],
            "run",
            of_amplitude=lambda a, drawn: {name: a * drawn[name] for name in names},
            draw=lambda rng: dict(zip(names, rng.standard_normal(len(names)).tolist(), strict=True)),
        )
    if timed:
        sine = lambda now, v: v["a"] * np.sin(2 * np.pi * v["hz"] * now.t + v["phase"])
        out["wave"] = _modulation(sine, *time, draw=wave, signed=False)
    if timed and true.kind.run is not None:  # a table that does not name its runs cannot show that it settles in each
        tau = lambda rng: {"tau_s": draw_log_uniform(rng, 3 * rows.median_gap, 0.4 * longest)}
        fading = lambda now, v: v["a"] * np.exp(-now.since / v["tau_s"])
        out["settling"] = _modulation(fading, "time", "run", str(rows.time), draw=tau)
    return out


def _proportional_to_column(true: SimulatedSystem, column: str) -> Form:
    middle, sd = true.deviation(column)
    return _modulation(lambda now, v: v["a"] * (now.u[column] - middle), column, reach=sd, uses=(column,))


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
    name = form.name.split(":")[0]
    return ADDED_FAMILIES[1] if (name, form.side) == ("friction", "reading") else name.removesuffix(" (floor)")


def forms_of(true: SimulatedSystem) -> list[Form]:
    """Return every form of the vocabulary, once for each of its possible targets in this system."""
    modulations = _modulations(true)
    out = [*_forms_of_readings(true, modulations), *_forms_of_levels(true)]
    for column in true.kind.drives:
        out += _forms_of_input(true, column)
    time = true.table.time
    # A clock error is detectable only if the law or the formula uses time.
    if time is not None and (true.kind.law is not None or true.kind.restarts_time):
        out.append(_input_form("clock_drift", time, lambda c, rows, v: c * (1 + v["a"]), 1e-3, 0.5, "time", time))
    out += _forms_of_parameters(true, modulations)
    for state in true.states if true.kind.stated_law is None else ():
        out += _forms_of_rate(true, state, modulations["wave"])
    return out


def _is(number: str) -> dict[str, Any]:
    return {"of_amplitude": lambda a, drawn: {number: a}, "signed": False}


def _bounded_by(end: float, inwards: float) -> dict[str, Any]:
    return {"of_amplitude": lambda a, drawn: {"level": end + inwards * a}, "signed": False}


def _added_form(
    true: SimulatedSystem, name: str, addition: Callable[..., Any], *covariates: str, order: int = OFFSET, **more: Any
) -> Form:
    sd, act = true.kind.sd, lambda y, rows, v: np.asarray(y + v["a"] * addition(y, rows, v))
    return Form(name, "reading", act, sd, _MANY * sd, covariates, order=order, **more)


def _forms_of_readings(true: SimulatedSystem, modulations: Mapping[str, Form]) -> Iterator[Form]:
    sd, typical = true.kind.sd, float(np.sqrt(np.mean(true.readings**2)))

    def added(name: str, how: Form) -> Form:
        act = lambda y, rows, v: np.asarray(y + how.act(Instants.at_rows(rows), v))
        return _modulated(how, name, "reading", sd, limit=_MANY, act=act, order=OFFSET)

    def multiplied(name: str, how: Form) -> Form:
        act = lambda y, rows, v: np.asarray(y * (1 + how.act(Instants.at_rows(rows), v)))
        return _modulated(how, name, "reading", sd / typical, limit=_MANY, act=act, order=GAIN)

    for kind in ("step", "drift", "per_run"):
        if kind in modulations:
            yield added(f"offset_{kind}", modulations[kind])
            yield multiplied(f"gain_{kind}", modulations[kind])
    for column in true.varying_columns:
        yield added(f"sensitivity:{column}", _proportional_to_column(true, column))
        yield from _curve_and_friction_forms(true, column)
    for name, kind in (("interference", "wave"), ("settling", "settling")):
        if kind in modulations:
            yield added(name, modulations[kind])


def _curve_and_friction_forms(true: SimulatedSystem, column: str) -> Iterator[Form]:
    """Yield a polynomial of an order of two to five in a column, and its friction if it moves both ways."""
    values, sd, orders = true.table.columns[column], true.kind.sd, range(1, 6)
    middle, half = 0.5 * float(values.max() + values.min()), 0.5 * float(np.ptp(values))

    def curve(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = (rows.columns[column] - middle) / half
        return np.asarray(y + np.polyval([*(v[f"a{k}"] for k in reversed(orders)), 0.0], z))

    def coefficients(rng: np.random.Generator) -> dict[str, float]:
        order = int(rng.integers(2, 6))
        size = np.append(rng.uniform(-1, 1, order - 1), 1.0)  # the highest is the largest
        return {f"a{k}": float(size[k - 1]) if k <= order else 0.0 for k in orders}

    if len(np.unique(values)) > len(orders):
        scaled = lambda a, drawn: {name: a * size for name, size in drawn.items()}
        name, limit = f"curve:{column}", _MANY * sd
        yield Form(name, "reading", curve, sd, limit, (column,), scaled, coefficients, order=OFFSET)
    speeds = np.sort(np.abs(values[values != 0]))
    if min(len(np.unique(side)) for side in (values[values < 0], values[values > 0])) >= 3:
        low, high = float(speeds[len(speeds) // 20]), 0.3 * float(speeds[-1])
        pull = lambda y, rows, v: np.tanh(rows.columns[column] / max(v["width"], 1e-12 * half))
        width = lambda rng: {"width": 0.0 if rng.random() < 0.5 else draw_log_uniform(rng, low, high)}
        yield _added_form(true, f"friction:{column}", pull, column, draw=width)


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


def delayed_values(values: FloatArray, rows: SystemTable, tau: float) -> FloatArray:
    """Delay values (n_points,) by `tau` within runs: interpolated, constant before the first row."""
    out = np.empty(values.shape)
    for own in rows.rows_by_run:
        out[own] = np.interp(rows.t[own] - tau, rows.t[own], values[own])
    return out


def _late(values: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
    return delayed_values(values, rows, v["tau_s"])


def _lagged(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
    out = y.copy()
    for own in rows.rows_by_run:
        for before, row in pairwise(own):
            stays = np.exp(-(rows.t[row] - rows.t[before]) / v["tau_s"])
            out[row] = stays * out[before] + (1 - stays) * out[row]
    return out


def _forms_of_levels(true: SimulatedSystem) -> Iterator[Form]:
    low, high, sd = float(true.readings.min()), float(true.readings.max()), true.kind.sd
    span, level = high - low, ("level",)

    def bend(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = (y - low) / span
        return np.asarray(y + v["a"] * span * (np.sign(z) * np.abs(z) ** v["power"] - z))

    yield _added_form(
        true, "hysteresis", lambda y, rows, v: direction_of_change(y, rows), "previous", order=_HYSTERESIS
    )
    if span > 0:
        power = lambda rng: {"power": float(rng.choice([0.6, 1.6, 2.0, 3.0]))}
        yield Form("nonlinearity", "reading", bend, sd / span, 0.5, level, draw=power, order=_BEND)
        ceiling = lambda y, rows, v: np.minimum(y, v["level"])
        floor = lambda y, rows, v: np.maximum(y, v["level"])
        for name, act, *end in (("saturation", ceiling, high, -1.0), ("saturation (floor)", floor, low, 1.0)):
            yield Form(name, "reading", act, 2 * sd, 0.5 * span, level, **_bounded_by(*end), order=_CEILING)
    if true.table.time is not None:
        gap = true.table.median_gap
        for name, late in (("lag", _lagged), ("delay", _late)):
            yield Form(name, "reading", late, 0.5 * gap, 15 * gap, ("previous",), **_is("tau_s"), order=_LAG)


def _input_form(
    name: str, column: str, change: Callable[..., Any], first: float, limit: float, *covariates: str, **more: Any
) -> Form:
    act = lambda columns, rows, v: {**columns, column: np.asarray(change(columns[column], rows, v))}
    return Form(name, "input", act, first, limit, covariates, **more)


def _forms_of_input(true: SimulatedSystem, column: str) -> Iterator[Form]:
    values, (_, spread) = true.table.columns[column], true.deviation(column)
    low, high = float(values.min()), float(values.max())
    span, n_values = high - low, len(np.unique(values))
    if not span > 0:
        return

    def form(name: str, change: Callable[..., Any], first: float, limit: float, *seen: str, **more: Any) -> Form:
        seen = seen or (column, "level")
        return _input_form(f"{name}:{column}", column, change, first, limit, *seen, **more)

    def wave(rng: np.random.Generator) -> dict[str, float]:
        period = span / draw_log_uniform(rng, 1.5, min(n_values / 6, 25))
        return {"period": period, "phase": float(rng.uniform(0, 2 * np.pi))}

    yield form("input_offset", lambda c, rows, v: c + v["a"], 0.01 * spread, 5 * span)
    yield form("input_gain", lambda c, rows, v: c * (1 + v["a"]), 0.01, 0.9)
    ceiling = _bounded_by(high, -1.0)
    yield form("input_saturation", lambda c, rows, v: np.minimum(c, v["level"]), 0.05 * span, 0.6 * span, **ceiling)
    if low <= 0.1 * span:
        narrowed = lambda c, rows, v: np.sign(c) * np.maximum(np.abs(c) - v["width"], 0.0)
        yield form("dead_zone", narrowed, 0.01 * span, 0.3 * span, **_is("width"))
    moves = np.concatenate([np.diff(values[rows]) for rows in true.table.rows_by_run])
    if (moves > 0).mean() > 0.02 and (moves < 0).mean() > 0.02:
        yield form("backlash", behind_gear_play, 0.01 * span, 0.3 * span, "previous", column, **_is("width"))
    if n_values > 20:
        runout = lambda c, rows, v: c + v["a"] * np.sin(2 * np.pi * c / v["period"] + v["phase"])
        yield form("periodic_error", runout, 0.01 * spread, 0.2 * span, draw=wave, signed=False)
    if true.table.time is not None:
        gap = true.table.median_gap
        yield form("input_delay", _late, 0.5 * gap, 6 * gap, "previous", column, **_is("tau_s"), late=column)


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


def _forms_of_parameters(true: SimulatedSystem, modulations: Mapping[str, Form]) -> Iterator[Form]:
    for name, values in true.parameters.items():
        of_run = name in true.kind.per_run
        if of_run and true.kind.law is not None:
            continue  # initial values do not vary within a run
        words = {"steps": "step", "drifts": "drift"} | ({} if of_run else {"differs": "per_run"})
        own = {f"{word}:{name}": modulations[kind] for word, kind in words.items() if kind in modulations}
        own |= {f"depends:{name}:{column}": _proportional_to_column(true, column) for column in true.varying_columns}
        size = 0.003 * float(np.abs(values).mean())
        yield from (_modulated(how, called, "parameter", size, limit=200, target=name) for called, how in own.items())


def _rate_form(
    true: SimulatedSystem, name: str, state: str, push: Callable[[Any, Any, Any], Any], size: float, *seen: str,
    **more: Any,
) -> Form:  # fmt: skip
    """Return the form of a term a push(states, now, parameters) in the rate of a state; `size`: push's magnitude."""
    first, act = 0.01 * true.rms_rate(state) / size, lambda s, now, v: v["a"] * push(s, now, v)
    return Form(name, "rate", act, first, 300 * first, seen, target=state, **more)


def _forms_of_rate(true: SimulatedSystem, state: str, wave: Form) -> Iterator[Form]:
    """Yield the terms that may be missing from the rate of a state, dry friction and an upper bound included."""
    speed, values = true.rms_rate(state), true.states[state]
    high, span, size = float(values.max()), float(np.ptp(values)), float(np.abs(values).max())
    own = f"state:{state}", "time"

    def term(name: str, of: str, change: Callable[[Any], Any], size: float, *seen: str, **more: Any) -> Form:
        return _rate_form(true, f"{name}:{state}", state, lambda s, now, v: change(s[of]), size, *seen, **more)

    def falling(power: int) -> Callable[[Any], Any]:
        return lambda r: -(r**power)

    yield term("damping", state, lambda r: -r, size, *own, signed=False)
    yield term("drag", state, lambda r: -np.abs(r) * r, size**2, *own, signed=False)
    yield term("forcing", state, lambda r: 1.0 + 0.0 * r, 1.0, "time", *own)
    for other, there in true.states.items():
        most, seen = float(np.abs(there).max()), (f"state:{other}", "time")
        for name, power in (("cubic", 3), ("quadratic", 2), ("coupling", 1)):
            if power > 1 or other != state:
                form = term(name, other, falling(power), most**power, *seen)
                yield replace(form, name=f"{name}:{state}:{other}")
    act = lambda s, now, v: wave.act(now, v)
    yield _modulated(wave, f"periodic_forcing:{state}", "rate", 0.02 * speed, limit=100, act=act, target=state)
    held = partial(Form, side="rate", act=lambda s, now, v: 0.0, covariates=(f"state:{state}", "level"), target=state)
    yield held(f"friction:{state}", first=0.02 * speed, limit=2 * speed, sticks=True, signed=False)
    yield held(f"limit:{state}", first=0.05 * span, limit=0.6 * span, stops=True, **_bounded_by(high, -1.0))


OUT_OF_VOCABULARY = (
    *("product", "square_wave", "switch", "one_sided_spring", "leak", "memory", "two_settlings", "column_times_state"),
    *("chirp", "fading_bend"),
)
"""Names of effects outside the vocabulary, without targets."""


def forms_out_of_vocabulary(true: SimulatedSystem, rng: np.random.Generator) -> Iterator[Form]:
    """Yield the effects outside the vocabulary that this system can have, on randomly drawn columns and states."""
    one, other = (str(name) for name in rng.permutation(true.varying_columns)[:2])
    (middle, spread), (middle_of_other, spread_of_other) = true.deviation(one), true.deviation(other)
    low, high = float(true.readings.min()), float(true.readings.max())
    at = float(np.quantile(true.table.columns[one], rng.uniform(0.55, 0.8)))
    adds = partial(_added_form, true, outside=True)

    def memory(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        """Saturate with the sum of the column's absolute deviations since the start of the run."""
        out = np.empty(len(rows))
        for own in rows.rows_by_run:
            out[own] = np.tanh(np.cumsum(np.abs(rows.columns[one][own] - middle)) / spread / 12)
        return out

    def fading_bend(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = np.clip((y - low) / (high - low), 0, 1)
        return np.asarray(4 * z * (1 - z) * (rows.columns[one] - middle) / spread)

    def product(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        factors = rows.columns[one] - middle, rows.columns[other] - middle_of_other
        return factors[0] * factors[1] / (spread * spread_of_other)

    yield adds(f"strange_product:{one}:{other}", product, one, other, "time", "run")
    yield adds(f"strange_switch:{one}", lambda y, rows, v: 1.0 * (rows.columns[one] > at), one, "time", "run")
    yield adds(f"strange_memory:{one}", memory, "time", "run", one)
    yield adds(f"strange_fading_bend:{one}", fading_bend, one, "level")
    if true.table.time is not None:
        timed, duration = ("time", str(true.table.time)), true.table.duration
        hz = draw_log_uniform(rng, 4 / duration, 0.06 / true.table.median_gap)
        begin, longest = float(true.table.t.min()), float(true.table.time_since_start.max())

        def chirp(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
            z = (rows.t - begin) / duration
            return np.sin(2 * np.pi * (3 * z + 8 * z**2))

        def two_settlings(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
            z = rows.time_since_start / longest
            return np.exp(-z / 0.05) - 1.5 * np.exp(-z / 0.35)

        square = lambda y, rows, v: 1.0 * ((hz * rows.t) % 1.0 < 0.3)
        yield adds("strange_square_wave", square, *timed, draw=lambda rng: {"hz": hz})
        yield adds("strange_chirp", chirp, *timed)
        if true.kind.run is not None:
            yield adds("strange_two_settlings", two_settlings, "time", "run", timed[1])
    if true.states:
        state = str(rng.choice(list(true.states)))
        values, own = true.states[state], (f"state:{state}", "level", "time")
        most, sprung = float(np.abs(values).max()), float(np.quantile(values, 0.6))
        pushes = partial(_rate_form, true, outside=True)
        spring = lambda s, now, v: -np.maximum(s[state] - sprung, 0.0)
        leak = lambda s, now, v: -np.expm1(np.clip(s[state] / (0.3 * most), -30, 12))
        pull = lambda s, now, v: -(now.u[one] - middle) / spread * s[state] ** 2 / most**2
        yield pushes(f"strange_one_sided_spring:{state}", state, spring, float(np.ptp(values)), *own)
        yield pushes(f"strange_leak:{state}", state, leak, 20.0, *own)
        seen = (one, f"state:{state}", "time", "run", "level")
        yield pushes(f"strange_column_times_state:{state}:{one}", state, pull, 1.0, *seen, uses=(one,))
