"""Variations of a quantity over the rows: drift, step, per run, wave, or in proportion to a column."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, distinct_values
from probewise._words import unit_of_name, value_with_sd
from probewise.effects import HeavyTailedPrior
from probewise.effects.waves import PHASE, sine_and_cosine_entries, starting_point_of_wave
from probewise.priors import Uniform
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import ActBetween, ChangePoints, period_with_sd
from probewise.systems.forms.frequencies import frequency_prior, residual_peaks, trial_frequencies_in_time
from probewise.systems.forms.origins import origin_in_words, time_origin
from probewise.systems.law_inputs import Jump
from probewise.systems.table import RunTable, covariate_of_column

_MOST_MOMENTS = 512
_MOST_OF_ONE_SCALE = 24  # values per run: with 36 a vector of typical length has 6 sds, a coordinate's bound, in one


@dataclass(frozen=True, eq=False)
class Modulation:
    """Variation of a quantity over the rows: `at_rows(theta, table)`, (n_samples, n_points), is 0 at amplitude 0.

    `marginals` is a function of the amplitude's prior, `entries` and `suggested` of the amplitude's typical size,
    `units` of the quantity's unit, `says` of the quantity's name and unit and the parameters' mean and sd.
    `between_rows` is a function of the name of a parameter that varies so, where it does not go on between the rows of
    a law as the law's `hold` says. The other attributes become those of the `Form`.
    """

    at_rows: Callable[[FloatArray, RunTable], FloatArray]
    marginals: Callable[[HeavyTailedPrior], Mapping[str, Any]]
    entries: Callable[[float], FloatArray]
    units: Callable[[str], tuple[str, ...]]
    says: Callable[[str, str, FloatArray, FloatArray], str]
    covariates: tuple[str, ...]
    amplitudes: tuple[int, ...] = (0,)
    change_points: ChangePoints | None = None
    joined: Callable[[FloatArray, FloatArray], FloatArray] | None = None
    counted_from: str = ""
    suggested: Callable[[float], FloatArray | None] = lambda size: None
    shared_scale: bool = False
    between_rows: Callable[[str], ActBetween] | None = None


def _single_entry_bank(size: float) -> FloatArray:
    return np.full((1, 1, 1), size)


def linear_drift_modulation(table: RunTable, time_unit: str) -> Modulation:
    """Return a linear drift a t, with recorded time t from `time_origin`: 0, or the first time if far from 0."""
    origin = time_origin(table)
    return Modulation(
        at_rows=lambda theta, rows: theta[:, :1] * (rows.time_s - origin),
        marginals=lambda a: {"a": a},
        entries=_single_entry_bank,
        units=lambda unit: (f"{unit or '1'}/{time_unit}",),
        says=lambda what, unit, mean, sd: f"{what} drifts by {value_with_sd(mean[0], sd[0], unit)} per {time_unit}",
        covariates=("time",),
        counted_from=origin_in_words(table.time, origin, time_unit),
        between_rows=lambda name: lambda between, theta: between.with_drift(name, theta[:, :1]),
    )


def column_proportional_modulation(name: str, table: RunTable) -> Modulation:
    """Return a variation in proportion to a column, about its mean over the recording: a (C - mean C)."""
    values = table.covariates[name]
    middle, per = float(np.nanmean(values)), unit_of_name(name) or "unit"

    def at_rows(theta: FloatArray, rows: RunTable) -> FloatArray:
        return np.asarray(theta[:, :1] * np.nan_to_num(rows.covariates[name] - middle))

    return Modulation(
        at_rows=at_rows,
        marginals=lambda a: {"a": a},
        entries=_single_entry_bank,
        units=lambda unit: (f"{unit or '1'} per {name}",),
        says=lambda what, unit, mean, sd: (
            f"{what} changes by {value_with_sd(mean[0], sd[0], unit)} per {per} of {name}"
        ),
        covariates=(covariate_of_column(name),),
    )


def change_point_step_modulation(table: RunTable, time_unit: str, *, gated: bool) -> Modulation:
    """Return a step at a change point: a 1(t > t0), in time if recorded, else in row number."""
    by_row = not table.has_varying_time
    along = distinct_values(np.arange(float(len(table))) if by_row else table.time_s)
    stride = -(-(len(along) - 1) // _MOST_MOMENTS)
    at = tuple(np.append(along[:-1:stride], along[-1]).tolist())
    change_points, name = ChangePoints(at, by_row, gated), "at_row" if by_row else "at_s"

    def at_rows(theta: FloatArray, rows: RunTable) -> FloatArray:
        return np.asarray(theta[:, :1] * (change_points.variable_at_rows(rows) > theta[:, 1:2]))

    def says(what: str, unit: str, mean: FloatArray, sd: FloatArray) -> str:
        jump = f"{what} jumps by {value_with_sd(mean[0], sd[0], unit)}"
        if by_row:  # a point between two rows, counted from 0
            return f"{jump} at row {int(mean[1]) + 3} of the table (the header is row 1) and stays there"
        return f"{jump} at {value_with_sd(mean[1], sd[1], time_unit)} and stays there"

    def jump_in_time(parameter: str) -> ActBetween:
        return lambda between, theta: between.with_jump(Jump(parameter, theta[:, :1], theta[:, 1:2]))

    return Modulation(
        at_rows=at_rows,
        marginals=lambda a: {"a": a, name: Uniform(at[0], at[-1])},
        entries=lambda size: np.array([[[size, 0.5 * (at[0] + at[-1])]]]),
        units=lambda unit: (unit, "row" if by_row else time_unit),
        says=says,
        covariates=("row",) if by_row else ("time",),
        change_points=change_points,
        between_rows=None if by_row else jump_in_time,
    )


def value_per_run_modulation(table: RunTable) -> Modulation:
    """Return a variation by one value per run: a_run; 0 for runs outside the recording that are like none of it.

    The values have one scale in common, unless runs are so many that a single one could not differ much more than the
    others within the bounds of a coordinate.
    """
    names = table.scan_names

    def at_rows(theta: FloatArray, rows: RunTable) -> FloatArray:
        known = {name: k for k, name in enumerate(names)}
        at = np.array([known.get(rows.like.get(name, name), len(names)) for name in rows.scan_names])
        values = np.concatenate([theta, np.zeros((len(theta), 1))], axis=1)
        return np.asarray(values[:, at[rows.scan]])

    def says(what: str, unit: str, mean: FloatArray, sd: FloatArray) -> str:
        far = int(np.argmax(np.abs(mean)))
        return f"{what} differs from run to run, most in run {names[far]}: by {value_with_sd(mean[far], sd[far], unit)}"

    return Modulation(
        at_rows=at_rows,
        marginals=lambda a: {f"values[{name}]": a for name in names},
        entries=lambda size: size * np.eye(len(names))[None, :, :],
        units=lambda unit: (unit,) * len(names),
        says=says,
        covariates=("run",),
        amplitudes=tuple(range(len(names))),
        shared_scale=1 < len(names) <= _MOST_OF_ONE_SCALE,
    )


def sinusoid_modulation(about: ReferenceFit) -> Modulation:
    """Return the modulation a sin(2 pi hz t + phase), all three free; hz per unit of time, t from `time_origin`."""
    table, time_unit = about.table, about.time_unit
    origin = time_origin(table)
    frequencies = trial_frequencies_in_time(about)
    peaks = residual_peaks(about, frequencies)

    def at_rows(theta: FloatArray, rows: RunTable) -> FloatArray:
        return np.asarray(theta[:, :1] * np.sin(2 * np.pi * theta[:, 1:2] * (rows.time_s - origin) + theta[:, 2:3]))

    return Modulation(
        at_rows=at_rows,
        marginals=lambda a: {
            "a": replace(a, positive=True),
            "hz": frequency_prior(np.append(frequencies, peaks.highest)),
            "phase": PHASE,
        },
        entries=lambda size: sine_and_cosine_entries(size, frequencies),
        units=lambda unit: (unit, f"1/{time_unit}", "rad"),
        says=lambda what, unit, mean, sd: (
            f"{what} oscillates with an amplitude of {value_with_sd(mean[0], sd[0], unit)} and a period of "
            f"{period_with_sd(mean[1], sd[1], time_unit)}"
        ),
        covariates=("time",),
        counted_from=origin_in_words(table.time, origin, time_unit),
        joined=starting_point_of_wave,
        suggested=lambda size: sine_and_cosine_entries(size, peaks.at) if peaks.at.size else None,
    )
