"""Effects outside the vocabulary: products, leaks, switches, one-sided springs, memories."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.form import Form, Numbers, TrueSystem, draw_log_uniform
from probewise.proof.systems.forms import added_form, rate_term_form
from probewise.proof.systems.kind import SystemTable

OUT_OF_VOCABULARY = (
    *("product", "square_wave", "switch", "one_sided_spring", "leak", "memory", "two_settlings", "column_times_state"),
    *("chirp", "fading_bend"),
)
"""Names of these effects, without targets."""


def forms_out_of_vocabulary(true: TrueSystem, rng: np.random.Generator) -> Iterator[Form]:
    """Yield the effects outside the vocabulary that this system can have, on randomly drawn columns and states."""
    one, other = (str(name) for name in rng.permutation(true.varying_columns)[:2])
    (middle, spread), (middle_of_other, spread_of_other) = true.deviation(one), true.deviation(other)
    low, high = float(true.readings.min()), float(true.readings.max())
    at = float(np.quantile(true.table.columns[one], rng.uniform(0.55, 0.8)))

    def adds(name: str, addition: Callable[..., Any], *covariates: str, **more: Any) -> Form:
        return added_form(true, f"strange_{name}", addition, covariates, outside=True, **more)

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

    yield adds(f"product:{one}:{other}", product, one, other, "time", "run")
    yield adds(f"switch:{one}", lambda y, rows, v: 1.0 * (rows.columns[one] > at), one, "time", "run")
    yield adds(f"memory:{one}", memory, "time", "run", one)
    yield adds(f"fading_bend:{one}", fading_bend, one, "level")
    if true.table.time is not None:
        timed = ("time", str(true.table.time))
        hz = draw_log_uniform(rng, 4 / true.table.duration, 0.06 / true.table.median_gap)
        begin, longest = float(true.table.t.min()), float(true.table.time_since_start.max())

        def chirp(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
            z = (rows.t - begin) / true.table.duration
            return np.sin(2 * np.pi * (3 * z + 8 * z**2))

        def two_settlings(y: FloatArray, rows: SystemTable, v: Numbers) -> FloatArray:
            z = rows.time_since_start / longest
            return np.exp(-z / 0.05) - 1.5 * np.exp(-z / 0.35)

        yield adds(
            "square_wave", lambda y, rows, v: 1.0 * ((hz * rows.t) % 1.0 < 0.3), *timed, draw=lambda rng: {"hz": hz}
        )
        yield adds("chirp", chirp, *timed)
        if true.kind.run is not None:
            yield adds("two_settlings", two_settlings, "time", "run", timed[1])
    if true.states:
        state = str(rng.choice(list(true.states)))
        most, sprung = float(np.abs(true.states[state]).max()), float(np.quantile(true.states[state], 0.6))

        def pushes(name: str, push: Callable[..., Any], size: float, *covariates: str, **more: Any) -> Form:
            return rate_term_form(
                true, f"strange_{name}", state, push, size, covariates=covariates, outside=True, **more
            )

        def leak(s: dict[str, FloatArray], now: object, v: Numbers) -> FloatArray:
            return -np.expm1(np.clip(s[state] / (0.3 * most), -30, 12))

        own = (f"state:{state}", "level", "time")
        yield pushes(
            f"one_sided_spring:{state}",
            lambda s, now, v: -np.maximum(s[state] - sprung, 0.0),
            float(np.ptp(true.states[state])),
            *own,
        )
        yield pushes(f"leak:{state}", leak, 20.0, *own)
        yield pushes(
            f"column_times_state:{state}:{one}",
            lambda s, now, v: -(now.u[one] - middle) / spread * s[state] ** 2 / most**2,
            1.0,
            *(one, f"state:{state}", "time", "run", "level"),
            uses=(one,),
        )
