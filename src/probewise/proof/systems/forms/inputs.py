"""Forms on the inputs of a system: offset, gain, saturation, dead zone, play, waves, delay; and on its clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.forms.form import Form, Numbers
from probewise.proof.systems.forms.modulations import start_values_of_single_member, start_values_of_wave, wave_bank
from probewise.proof.systems.forms.readings import delayed_values
from probewise.proof.systems.forms.true_system import TrueSystem, draw_log_uniform
from probewise.proof.systems.table import SystemTable

Change = Callable[[FloatArray, SystemTable, Numbers], Any]


def forms_of_inputs(true: TrueSystem) -> Iterator[Form]:
    """Yield the forms on each column that the law or formula uses, and the drift of the clock."""
    for column in true.kind.drives:
        yield from _forms_of_column(true, column)
    time = true.table.time
    # A clock error is detectable only if the law or the formula uses time.
    if time is not None and (true.kind.law is not None or true.kind.restarts_time):
        yield _linear_one_parameter_form(
            "clock_drift", time, lambda c, rows, v: c * (1 + v["a"]), 1e-3, 0.5, ("time", time)
        )


def _make_act_on_column(
    column: str, change: Change
) -> Callable[[Mapping[str, FloatArray], SystemTable, Numbers], dict[str, Any]]:
    """Return a `Form.act` that replaces one column by `change(column, rows, parameters)`."""
    return lambda columns, rows, v: {**columns, column: np.asarray(change(columns[column], rows, v))}


def _linear_one_parameter_form(
    name: str, column: str, change: Change, first: float, limit: float, covariates: tuple[str, ...]
) -> Form:
    return Form(
        name,
        "input",
        act=_make_act_on_column(column, change),
        of_amplitude=lambda a, drawn: {"a": a},
        draw=lambda rng: {},
        bank=[[{"a": first}]],
        start_values=start_values_of_single_member,
        steps={"a": first},
        first=first,
        limit=limit,
        covariates=covariates,
        uses=(),
    )


def _nonlinear_one_parameter_form(
    name: str, number: str, change: Change, column: str, tried: FloatArray, covariates: tuple[str, ...], late: str = ""
) -> Form:
    return Form(
        name,
        "input",
        act=_make_act_on_column(column, change),
        of_amplitude=lambda a, drawn: {number: a},
        draw=lambda rng: {},
        bank=[[{number: float(size)}] for size in tried],
        start_values=lambda group, amounts: dict(group[0]),
        steps={number: 0.02 * float(tried[len(tried) // 2])},
        first=float(tried[len(tried) // 2]),
        limit=float(tried[-1]),
        covariates=covariates,
        signed=False,
        late=late,
    )


def _forms_of_column(true: TrueSystem, column: str) -> Iterator[Form]:
    values, spread = true.table.columns[column], true.sd_of(column)
    low, high = float(values.min()), float(values.max())
    span, own = high - low, (column, "level")
    if not span > 0:
        return
    yield _linear_one_parameter_form(
        f"input_offset:{column}", column, lambda c, rows, v: c + v["a"], 0.01 * spread, 5 * span, own
    )
    yield _linear_one_parameter_form(
        f"input_gain:{column}", column, lambda c, rows, v: c * (1 + v["a"]), 0.01, 0.9, own
    )
    levels = high - span * np.geomspace(0.004, 0.5, 12)
    yield Form(
        f"input_saturation:{column}",
        "input",
        act=_make_act_on_column(column, lambda c, rows, v: np.minimum(c, v["level"])),
        of_amplitude=lambda a, drawn: {"level": high - a},
        draw=lambda rng: {},
        bank=[[{"level": float(level)}] for level in levels],
        start_values=lambda group, amounts: dict(group[0]),
        steps={"level": 0.01 * span},
        first=0.05 * span,
        limit=0.6 * span,
        covariates=own,
        signed=False,
    )
    sizes = span * np.geomspace(1e-4, 0.3, 10)
    if low <= 0.1 * span:
        yield _nonlinear_one_parameter_form(
            f"dead_zone:{column}",
            "width",
            lambda c, rows, v: np.sign(c) * np.maximum(np.abs(c) - np.maximum(v["width"], 0.0), 0.0),
            column,
            sizes,
            own,
        )
    moves = np.concatenate([np.diff(values[rows]) for rows in true.table.rows_by_run])
    if (moves > 0).mean() > 0.02 and (moves < 0).mean() > 0.02:
        yield _nonlinear_one_parameter_form(
            f"backlash:{column}", "width", behind_gear_play, column, sizes, ("previous", column)
        )
    if len(np.unique(values)) > 20:
        waves = np.linspace(0.4, min(len(np.unique(values)) / 4, 60), 60) / span

        def column_plus_sine_error(c: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
            return np.asarray(c + v["a"] * np.sin(2 * np.pi * c / v["period"] + v["phase"]))

        first = 0.01 * spread
        bank = [
            [{**each, "period": 1 / each["period"]} for each in group] for group in wave_bank(first, waves, "period")
        ]
        yield Form(
            f"periodic_error:{column}",
            "input",
            act=_make_act_on_column(column, column_plus_sine_error),
            of_amplitude=lambda a, drawn: {"a": a, **drawn},
            draw=lambda rng: {
                "period": span / draw_log_uniform(rng, 1.5, min(len(np.unique(values)) / 6, 25)),
                "phase": float(rng.uniform(0, 2 * np.pi)),
            },
            bank=bank,
            start_values=start_values_of_wave,
            steps={"a": first, "period": 0.002 * span, "phase": 0.05},
            first=first,
            limit=0.2 * span,
            covariates=own,
            signed=False,
        )
    if true.table.time is not None:
        taus = true.table.median_gap * np.geomspace(0.05, 6, 12 if true.kind.law is None else 5)
        yield _nonlinear_one_parameter_form(
            f"input_delay:{column}",
            "tau_s",
            lambda c, rows, v: delayed_values(c, rows, np.maximum(v["tau_s"], 0.0)),
            column,
            taus,
            ("previous", column),
            late=column,
        )


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
