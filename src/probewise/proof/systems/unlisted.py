"""Effects outside the vocabulary: products, leaks, switches, one-sided springs, memories."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.form import (
    Form,
    Instants,
    Numbers,
    TrueSystem,
    draw_log_uniform,
)
from probewise.proof.systems.forms import OFFSET, form_of_amplitude, rate_term_form
from probewise.proof.systems.kind import SystemTable

OUT_OF_VOCABULARY = (
    "product",
    "square_wave",
    "switch",
    "one_sided_spring",
    "leak",
    "memory",
    "two_settlings",
    "column_times_state",
    "chirp",
    "fading_bend",
)
"""Names of these effects, without targets."""


def forms_out_of_vocabulary(true: TrueSystem, rng: np.random.Generator) -> Iterator[Form]:
    """Yield the effects outside the vocabulary that this system can have, on randomly drawn columns and states."""
    columns = [str(name) for name in rng.permutation(true.varying_columns)]
    first, second = columns[0], columns[1]
    yield _product_form(true, first, second)
    yield _switch_form(true, first, float(rng.uniform(0.55, 0.8)))
    yield _soft_limited_sum_form(true, first)
    yield _column_dependent_bend_form(true, first)
    if true.table.time is not None:
        yield _square_wave_form(true, rng)
        yield _chirp_form(true)
        if true.kind.run is not None:
            yield _two_settlings_form(true)
    if true.kind.law is not None and true.states:
        state = str(rng.choice(list(true.states)))
        yield _one_sided_spring_form(true, state)
        yield _leak_form(true, state)
        yield _column_times_state_form(true, state, first)


def _form_added_to_reading(
    true: TrueSystem,
    name: str,
    shape: str,
    addition: Callable[..., Any],
    covariates: tuple[str, ...],
    drawn: dict[str, float] | None = None,
) -> Form:
    def act(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        return np.asarray(y + v["a"] * addition(y, rows, v))

    sd = true.noise_sd
    more: dict[str, Any] = {"draw": lambda rng: dict(drawn or {}), "order": OFFSET, "shape": shape}
    return form_of_amplitude(f"strange_{name}", "reading", act, sd, limit=1e4 * sd, covariates=covariates, **more)


def _product_form(true: TrueSystem, one: str, other: str) -> Form:
    a, b = true.mean_of(one), true.mean_of(other)
    scale = true.sd_of(one) * true.sd_of(other)
    return _form_added_to_reading(
        true,
        f"product:{one}:{other}",
        "y + a (C - mean C)(D - mean D) / (sd C sd D)",
        lambda y, rows, v: (rows.columns[one] - a) * (rows.columns[other] - b) / scale,
        (one, other, "time", "run"),
    )


def _switch_form(true: TrueSystem, column: str, share: float) -> Form:
    at = float(np.quantile(true.table.columns[column], share))
    return _form_added_to_reading(
        true,
        f"switch:{column}",
        "y + a 1(C > c)",
        lambda y, rows, v: 1.0 * (rows.columns[column] > at),
        (column, "time", "run"),
    )


def _soft_limited_sum_form(true: TrueSystem, column: str) -> Form:
    """Return the form that adds a tanh of the sum of a column's absolute deviations since the start of the run."""
    middle, spread = true.mean_of(column), true.sd_of(column)

    def addition(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        out = np.empty(len(rows))
        for own in rows.rows_by_run:
            out[own] = np.tanh(np.cumsum(np.abs(rows.columns[column][own] - middle)) / spread / 12)
        return out

    return _form_added_to_reading(
        true,
        f"memory:{column}",
        "y + a tanh(sum of abs(C - mean C) since the start of the run)",
        addition,
        ("time", "run", column),
    )


def _column_dependent_bend_form(true: TrueSystem, column: str) -> Form:
    middle, spread, low, high = (
        true.mean_of(column),
        true.sd_of(column),
        float(true.readings.min()),
        float(true.readings.max()),
    )

    def addition(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = np.clip((y - low) / (high - low), 0, 1)
        return np.asarray(4 * z * (1 - z) * (rows.columns[column] - middle) / spread)

    return _form_added_to_reading(
        true, f"fading_bend:{column}", "y + a 4 z (1 - z)(C - mean C) / sd C", addition, (column, "level")
    )


def _square_wave_form(true: TrueSystem, rng: np.random.Generator) -> Form:
    hz = draw_log_uniform(rng, 4 / true.table.duration, 0.06 / true.table.median_gap)

    def addition(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        return np.where((hz * rows.t) % 1.0 < 0.3, 1.0, 0.0)

    return _form_added_to_reading(
        true, "square_wave", "y + a while (t / P) mod 1 < 0.3", addition, ("time", str(true.table.time)), {"hz": hz}
    )


def _chirp_form(true: TrueSystem) -> Form:
    begin, end = float(true.table.t.min()), float(true.table.t.max())

    def addition(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        z = (rows.t - begin) / (end - begin)
        return np.asarray(np.sin(2 * np.pi * (3 * z + 8 * z**2)))

    return _form_added_to_reading(
        true,
        "chirp",
        "y + a sin(2 pi (3 z + 8 z^2)), z the share of the time",
        addition,
        ("time", str(true.table.time)),
    )


def _two_settlings_form(true: TrueSystem) -> Form:
    longest = float(true.table.time_since_start.max())

    def addition(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
        since = Instants.at_rows(rows).since[0]
        return np.asarray(np.exp(-since / (0.05 * longest)) - 1.5 * np.exp(-since / (0.35 * longest)))

    return _form_added_to_reading(
        true,
        "two_settlings",
        "y + a (exp(-t / tau) - 1.5 exp(-t / (7 tau)))",
        addition,
        ("time", "run", str(true.table.time)),
    )


def _one_sided_spring_form(true: TrueSystem, state: str) -> Form:
    at = float(np.quantile(true.states[state], 0.6))
    size = float(np.ptp(true.states[state]))
    return rate_term_form(
        true,
        f"strange_one_sided_spring:{state}",
        state,
        lambda s, now, v: -np.maximum(s[state] - at, 0.0),
        size,
        covariates=(f"state:{state}", "level", "time"),
        shape="-a max(S - s, 0) in the rate of S",
    )


def _leak_form(true: TrueSystem, state: str) -> Form:
    scale = 0.3 * float(np.abs(true.states[state]).max())

    def leak_rate(s: dict[str, FloatArray], now: object, v: Numbers) -> FloatArray:
        return np.asarray(-np.expm1(np.clip(s[state] / scale, -30, 12)))

    return rate_term_form(
        true,
        f"strange_leak:{state}",
        state,
        leak_rate,
        20.0,
        covariates=(f"state:{state}", "level", "time"),
        shape="-a (exp(S / s) - 1) in the rate of S",
    )


def _column_times_state_form(true: TrueSystem, state: str, column: str) -> Form:
    middle, spread, most = true.mean_of(column), true.sd_of(column), float(np.abs(true.states[state]).max())
    return rate_term_form(
        true,
        f"strange_column_times_state:{state}:{column}",
        state,
        lambda s, now, v: -(now.u[column] - middle) / spread * s[state] ** 2 / most**2,
        1.0,
        covariates=(column, f"state:{state}", "time", "run", "level"),
        uses=(column,),
        shape="-a (C - mean C) S^2 in the rate of S",
    )
