"""Proposals of a column: an influence that varies with the reading, or by dose. They count as out of vocabulary."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.vocabulary import single_column_bank
from probewise.priors import LogUniform
from probewise.sensor import Stage
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import Form
from probewise.systems.forms.origins import rounded_to_spread, text_rounded_to_spread
from probewise.systems.table import RunTable, covariate_of_column

_N_DOSES = 9  # doses that are tried as the one at which the reading has changed by 1 - 1/e of the whole change
_LEAST_DOSE, _MOST_DOSE = 0.02, 3.0  # of the largest dose in a run: beyond the latter the change is a straight line


def formula_forms_of_columns(about: ReferenceFit, columns: Mapping[str, FloatArray]) -> Iterator[Form]:
    """Yield proposals that add to the reading: each column's influence, varying with the reading, and its dose.

    The dose integrates abs(column - mean) or abs(column) from the start of the run; the change saturates with it.
    """
    for name, values in columns.items():
        yield from _varying_influence_form(about, name, values)
        yield from _dose_forms(about, name, values)


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

    entries = np.eye(3)[None, :, :]
    typical = about.typical_amplitude(Stage.OFFSET, act, about.sd * entries, about.sd, (0, 1, 2))
    if typical is None:
        return
    scaled = f"({name} - {text_rounded_to_spread(centre, spread)}) / {spread:.4g}"
    z = f"({own.reading} - {text_rounded_to_spread(middle, half)}) / {half:.4g}"
    text = f"(a + b z + c z^2) {scaled}, z = {z}"
    yield Form(
        f"formula:reading:{own.reading}:{text}",
        Stage.OFFSET,
        marginals=dict.fromkeys("abc", about.amplitude_prior(typical)),
        units=(own.unit,) * 3,
        covariates=(covariate_of_column(name), "level"),
        act=act,
        entries=typical * entries,
        amplitudes=(0, 1, 2),
        says=lambda mean, sd: (
            f"{own.reading} rises with {name} by {value_with_sd(mean[0], sd[0], own.unit)} per sd in the middle of its "
            f"range, {value_with_sd(float(mean @ (1, -1, 1)), float(np.hypot(*sd[1:])), own.unit)} at its low end and "
            f"{value_with_sd(float(mean.sum()), float(np.hypot(*sd[1:])), own.unit)} at its high end: a proposal, "
            "not a known effect"
        ),
        expression=text,
    )


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
        typical = about.typical_amplitude(Stage.OFFSET, act, single_column_bank(about.sd, tried), about.sd)
        if typical is None:
            continue
        text = f"1 - exp(-D / d), D the {summed} of {what} since the start of the run"
        yield Form(
            f"formula:reading:{own.reading}:{text}",
            Stage.OFFSET,
            marginals={"a": about.amplitude_prior(typical), "d": saturating},
            units=(own.unit, ""),
            covariates=(covariate_of_column(name), "time", "run"),
            act=act,
            entries=single_column_bank(typical, tried),
            amplitudes=(0,),
            says=lambda mean, sd, what=what: (  # type: ignore[misc]  # the second name of a value, not a parameter
                f"{own.reading} shifts in the end by {value_with_sd(mean[0], sd[0], own.unit)} as the {summed} of "
                f"{what} grows in a run, by 63 % of it when that is {value_with_sd(mean[1], sd[1], '')}: a proposal, "
                "not a known effect"
            ),
            expression=f"a ({text.split(',')[0]}),{text.split(',', 1)[1]}",
            needs_rising_time=in_time,
        )


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
