"""Forms on the reading: offset, gain, nonlinearity, saturation, hysteresis, lag, delay."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.forms import modulations
from probewise.proof.systems.forms.form import Form, Instants, Numbers
from probewise.proof.systems.forms.modulations import Modulation
from probewise.proof.systems.forms.true_system import TrueSystem
from probewise.proof.systems.table import SystemTable

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
    return Form(
        name,
        "reading",
        act=act,
        of_amplitude=how.of_amplitude,
        draw=how.draw,
        bank=how.bank(first),
        start_values=how.start_values,
        steps=how.steps(first),
        first=first,
        limit=1e4 * first,
        covariates=how.covariates,
        signed=how.signed,
        order=GAIN if gain else OFFSET,
    )


def _modulated_forms(true: TrueSystem) -> Iterator[Form]:
    timed = true.table.time is not None
    both = {"step": modulations.step_at_change_point(true)}
    if timed:
        both["drift"] = modulations.linear_drift(true)
    if true.kind.run is not None and len(true.table.rows_by_run) > 1:
        both["per_run"] = modulations.value_per_run(true)
    for kind, how in both.items():
        yield modulated_reading_form(true, f"offset_{kind}", how)
        yield modulated_reading_form(true, f"gain_{kind}", how, gain=True)
    for column in true.varying_columns:
        yield modulated_reading_form(true, f"sensitivity:{column}", modulations.proportional_to_column(true, column))
    if timed:
        yield modulated_reading_form(true, "interference", modulations.sinusoid_in_time(true, _N_WAVES))
        if true.kind.run is not None:  # a table that does not name its runs cannot show that it settles in each
            yield modulated_reading_form(true, "settling", modulations.settling(true))


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
    yield Form(
        "hysteresis",
        "reading",
        act=lambda y, rows, v: y + v["a"] * direction_of_change(y, rows),
        of_amplitude=lambda a, drawn: {"a": a},
        draw=lambda rng: {},
        bank=[[{"a": sd}]],
        start_values=modulations.start_values_of_single_member,
        steps={"a": sd},
        first=sd,
        limit=1e3 * sd,
        covariates=("previous",),
        order=_HYSTERESIS,
    )

    def bend(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = (y - low) / (high - low)
        return np.asarray(y + v["a"] * (high - low) * (np.sign(z) * np.abs(z) ** v["power"] - z))

    if not high > low:
        return
    first = sd / (high - low)
    yield Form(
        "nonlinearity",
        "reading",
        act=bend,
        of_amplitude=lambda a, drawn: {"a": a, **drawn},
        draw=lambda rng: {"power": float(rng.choice([0.6, 1.6, 2.0, 3.0]))},
        bank=[[{"a": first, "power": p}] for p in (0.5, 0.7, 1.4, 2.0, 3.0, 4.5)],
        start_values=modulations.start_values_of_single_member,
        steps={"a": first, "power": 0.05},
        first=first,
        limit=0.5,
        covariates=("level",),
        order=_BEND,
        also_in_truth={"lo": low, "hi": high},
    )
    for upper in (True, False):
        end, sign = (high, -1.0) if upper else (low, 1.0)
        levels = end + sign * (high - low) * np.geomspace(0.004, 0.5, 14)
        yield Form(
            "saturation" if upper else "saturation (floor)",
            "reading",
            act=_make_clip(upper),
            of_amplitude=_make_clip_level_of_amplitude(end, sign),
            draw=lambda rng: {},
            bank=[[{"level": float(level)}] for level in levels],
            start_values=lambda group, amounts: dict(group[0]),
            steps={"level": 0.01 * (high - low)},
            first=2 * sd,
            limit=0.5 * (high - low),
            covariates=("level",),
            signed=False,
            order=_CEILING,
        )


def _make_clip(upper: bool) -> Callable[[FloatArray, SystemTable, Numbers], FloatArray]:
    """Return a `Form.act` that limits readings to the parameter "level": at most this if `upper`, else at least."""
    bound = np.minimum if upper else np.maximum
    return lambda y, rows, v: np.asarray(bound(y, v["level"]))


def _make_clip_level_of_amplitude(end: float, sign: float) -> Callable[[float, dict[str, float]], dict[str, float]]:
    """Return a `Form.of_amplitude`: the clip level is `end` + `sign` times the amplitude."""
    return lambda a, drawn: {"level": end + sign * a}


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
        yield Form(
            name,
            "reading",
            act=act,
            of_amplitude=lambda a, drawn: {"tau_s": a},
            draw=lambda rng: {},
            bank=[[{"tau_s": float(tau)}] for tau in gap * np.geomspace(least, 12, 10)],
            start_values=lambda group, amounts: dict(group[0]),
            steps={"tau_s": 0.02 * gap},
            first=0.45 * gap,
            limit=15 * gap,
            covariates=("previous",),
            signed=False,
            order=_LAG,
        )
