"""Variation over the rows: drift, step, per run, wave, or in proportion to a column."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects import HeavyTailedPrior
from probewise.effects.waves import PHASE, sine_and_cosine_entries, starting_point_of_wave
from probewise.priors import LogUniform, Uniform
from probewise.systems.forms.form import ChangePoints, with_unit
from probewise.systems.table import RunTable

_MOST_MOMENTS = 512
_MOST_WAVES = 1024
_ROWS_OF_WAVES = 250_000  # rows at which a law is solved for the trial waves of one form: a fifth of a second


@dataclass(frozen=True, eq=False)
class Modulation:
    """A function of the rows: `over(theta, table)` (n_samples, n_points), 0 where the amplitude is 0.

    `marginals` is a function of the amplitude's prior; `units` and `says` of the unit of the varying quantity.
    """

    over: Callable[[FloatArray, RunTable], FloatArray]
    marginals: Callable[[HeavyTailedPrior], Mapping[str, Any]]
    entries: Callable[[float], FloatArray]
    units: Callable[[str], tuple[str, ...]]
    says: Callable[[str, str, FloatArray, FloatArray], str]
    covariates: tuple[str, ...]
    amplitudes: tuple[int, ...] = (0,)
    change_points: ChangePoints | None = None
    joined: Callable[[FloatArray, FloatArray], FloatArray] | None = None


def _single_entry(size: float) -> FloatArray:
    return np.full((1, 1, 1), size)


def drift(table: RunTable, time_unit: str) -> Modulation:
    """Linear drift in time as recorded: a t."""
    return Modulation(
        over=lambda theta, rows: theta[:, :1] * rows.time_s,
        marginals=lambda a: {"a": a},
        entries=_single_entry,
        units=lambda unit: (f"{unit}/{time_unit}",),
        says=lambda what, unit, mean, sd: f"{what} drifts by {with_unit(mean[0], sd[0], unit)} per {time_unit}",
        covariates=("time",),
    )


def column(name: str, table: RunTable) -> Modulation:
    """Variation in proportion to a column, about its mean over the recording: a (C - mean C)."""
    values = table.covariates[name]
    middle = float(np.nanmean(values))

    def over(theta: FloatArray, rows: RunTable) -> FloatArray:
        return np.asarray(theta[:, :1] * np.nan_to_num(rows.covariates[name] - middle))

    return Modulation(
        over=over,
        marginals=lambda a: {"a": a},
        entries=_single_entry,
        units=lambda unit: (f"{unit} per {name}",),
        says=lambda what, unit, mean, sd: f"{what} changes by {with_unit(mean[0], sd[0], unit)} per unit of {name}",
        covariates=(name,),
    )


def step(table: RunTable, time_unit: str, *, gated: bool) -> Modulation:
    """Step at a change point: a 1(t > t0), in time if recorded, else in row number."""
    by_row = not table.has_time
    along = np.unique(np.arange(float(len(table))) if by_row else table.time_s)
    stride = -(-(len(along) - 1) // _MOST_MOMENTS)
    at = tuple(np.append(along[:-1:stride], along[-1]).tolist())
    change_points, name = ChangePoints(at, by_row, gated), "at_row" if by_row else "at_s"

    def over(theta: FloatArray, rows: RunTable) -> FloatArray:
        return np.asarray(theta[:, :1] * (change_points.along(rows) > theta[:, 1:2]))

    def says(what: str, unit: str, mean: FloatArray, sd: FloatArray) -> str:
        when = f"row {mean[1]:.0f}" if by_row else with_unit(mean[1], sd[1], time_unit)
        return f"{what} jumps by {with_unit(mean[0], sd[0], unit)} at {when} and stays there"

    return Modulation(
        over=over,
        marginals=lambda a: {"a": a, name: Uniform(at[0], at[-1])},
        entries=lambda size: np.array([[[size, 0.5 * (at[0] + at[-1])]]]),
        units=lambda unit: (unit, "row" if by_row else time_unit),
        says=says,
        covariates=("row",) if by_row else ("time",),
        change_points=change_points,
    )


def per_run(table: RunTable) -> Modulation:
    """One value per run: a_run; 0 for runs outside the recording."""
    names = table.scan_names

    def over(theta: FloatArray, rows: RunTable) -> FloatArray:
        known = {name: k for k, name in enumerate(names)}
        at = np.array([known.get(name, len(names)) for name in rows.scan_names])
        values = np.concatenate([theta, np.zeros((len(theta), 1))], axis=1)
        return np.asarray(values[:, at[rows.scan]])

    def says(what: str, unit: str, mean: FloatArray, sd: FloatArray) -> str:
        far = int(np.argmax(np.abs(mean)))
        return f"{what} differs from run to run, most in run {names[far]}: by {with_unit(mean[far], sd[far], unit)}"

    return Modulation(
        over=over,
        marginals=lambda a: {f"values[{name}]": a for name in names},
        entries=lambda size: size * np.eye(len(names))[None, :, :],
        units=lambda unit: (unit,) * len(names),
        says=says,
        covariates=("run",),
        amplitudes=tuple(range(len(names))),
    )


def wave_numbers(values: FloatArray, groups: list[Any], most: int = _MOST_WAVES, rows_each: int = 2) -> FloatArray:
    """Return trial wave numbers along a covariate: up to one wave in `rows_each` rows, twice as dense as resolvable."""
    reach = float(np.ptp(values))
    gaps = np.concatenate([np.abs(np.diff(values[rows])) for rows in groups])
    gaps = gaps[gaps > 1e-9 * max(reach, 1e-300)]
    highest = 1 / (rows_each * float(np.median(gaps))) if gaps.size else 1.0 / reach
    highest = min(highest, len(np.unique(values)) / (rows_each * reach))
    n = int(np.clip(np.ceil(2 * highest * reach), 8, most))
    return np.asarray(np.linspace(0.5 / reach, max(highest, 2 / reach), n))


def most_waves_of_a_law(n_points: int) -> int:
    """Return how many trial waves of one form a law is solved for: two times as many solutions."""
    return int(np.clip(_ROWS_OF_WAVES // (2 * n_points), 64, _MOST_WAVES))


def wave_number_prior(waves: FloatArray) -> LogUniform:
    """Return the prior of a wave number: the trial ones, and a little beyond."""
    return LogUniform(float(0.9 * waves[0]), float(waves[-1] * 1.02))


def wave(table: RunTable, time_unit: str) -> Modulation:
    """One sinusoid in time: a sin(2 pi hz t + phase)."""
    waves = wave_numbers(table.time_s, table.rows_by_scan())

    def over(theta: FloatArray, rows: RunTable) -> FloatArray:
        return np.asarray(theta[:, :1] * np.sin(2 * np.pi * theta[:, 1:2] * rows.time_s + theta[:, 2:3]))

    return Modulation(
        over=over,
        marginals=lambda a: {
            "a": replace(a, positive=True),
            "hz": wave_number_prior(waves),
            "phase": PHASE,
        },
        entries=lambda size: sine_and_cosine_entries(size, waves),
        units=lambda unit: (unit, f"1/{time_unit}", "rad"),
        says=lambda what, unit, mean, sd: (
            f"{what} oscillates with an amplitude of {with_unit(mean[0], sd[0], unit)} and a period of "
            f"{1 / mean[1]:.4g} {time_unit}"
        ),
        covariates=("time",),
        joined=starting_point_of_wave,
    )
