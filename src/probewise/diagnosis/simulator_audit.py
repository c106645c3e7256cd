"""Audit of a table before any reading: which effects on a user's simulator it can detect and tell apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray, IntArray, own_arithmetic
from probewise.diagnosis.aliases import LAMBDA
from probewise.diagnosis.audit import EffectAudit, ExpectedSensor, PlanAudit, PlanTemplates, audits_and_cosines
from probewise.diagnosis.simulator_rows import ON_NOISE, SimulatorApparatus
from probewise.effects import NUISANCES, NamedEffect, name_of_first_copy
from probewise.effects.noise import NoisePerRun
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan
from probewise.systems import RunTable, Simulator, System, as_recording, table_for
from probewise.systems.forms import ReferenceFit, bind_forms, driving_columns
from probewise.systems.system import STANDS_STILL, with_converged_step
from probewise.systems.table import median_sd_of_column

_NOISE = 0.01  # of the range of the readings, if no noise is declared
_SETTINGS = 64  # of an effect's bank
_MOST_ROWS = 1200  # rows used
_GOLDEN = (math.sqrt(5) - 1) / 2


@own_arithmetic
def audit_system(simulator: Simulator, table: RunTable | Mapping[str, Any]) -> PlanAudit:
    """Determine for each effect whether readings in the rows of a table can detect it and tell it from the others.

    The simulator is evaluated at the middle of its prior. If the readings there are constant, as those of a pendulum at
    rest, or not finite, another point of the prior is taken, and `assumed` says so. The column of readings is not used.

    Parameters
    ----------
    simulator
        The simulator.
    table
        Its input columns, row by row: a table, a dict of arrays, or a DataFrame.

    Returns
    -------
    PlanAudit
        Without cures; of each effect with the rows that it needs, and groups of aliased effects.

    Raises
    ------
    ParameterError
        If the table lacks a column that the simulator reads, time falls within a run, or the predicted readings are
        constant, or not finite in some row, at all points of the prior that are tried.
    FileError
        If `simulate`, `rates` or `observe` raises an error at every point of the prior that is tried.
    ShapeError
        If `simulate` or `observe` does not return one reading per row.
    """
    table = table_for(simulator, table)
    table.require_rising_time()
    inputs = replace(table, columns={name: v for name, v in table.columns.items() if name != simulator.reading})
    own = cast(RunTable, as_recording(simulator, inputs).plan)
    system = System.of(simulator, own)
    z, predicted, where = _point_where_readings_vary(system, own)
    sd, noise = _noise_sd_and_source(simulator, own, predicted)
    system = with_converged_step(system, own, system.theta(z[None, :]), tolerance=STANDS_STILL * sd)
    about = ReferenceFit(system, own.with_columns({simulator.reading: predicted}), z, sd)
    forms = {name: form for name, form in bind_forms(about).items() if name_of_first_copy(name) is None}
    kinds = [kind for kind in ON_NOISE if kind not in NUISANCES.values()]
    on_noise: dict[str, NamedEffect[Any]] = {str(kind.name): kind() for kind in kinds}
    if len(own.scan_names) > 1:
        on_noise[NoisePerRun.name] = NoisePerRun(own.scan_names)
    else:
        del on_noise[NoisePerRun.name]
    built = cast(dict[str, NamedEffect[Any]], {**forms, **on_noise})
    reasons = _reasons_for_absence(about)
    names = dict.fromkeys([*forms, *(name for name in reasons if name not in forms), *on_noise])
    expected = ExpectedSensor(cast(Any, system), z, (float(predicted.min()), float(predicted.max())), sd)
    laid = PlanTemplates.of_scaled_effects(expected, cast(Plan, own), built, most=_SETTINGS)
    rows = _evenly_spread_rows(len(own), _MOST_ROWS)
    each = math.sqrt(len(own) / len(rows))  # every row taken stands for several, with as much information as they have
    laid = replace(laid, slopes=each * laid.slopes[rows], columns=each * laid.columns[rows])
    found, cosines = audits_and_cosines(laid, cast(Any, names), simulator.unit)
    effects = tuple(
        replace(e, reason=e.reason if e.share > 0 else reasons.get(e.name, e.reason))
        if e.detectability == "invisible"
        else replace(e, rows=math.ceil((LAMBDA / e.share) ** 2))
        for e in found
    )
    assumed = f"{simulator.source or 'the simulator'} at {where}, noise {sd:.3g} {simulator.unit} ({noise})"
    words = SimulatorApparatus(about).words
    return PlanAudit(
        cast(Plan, own),
        assumed,
        effects=effects,
        cosines=cosines,
        cures=(),
        after=effects,
        words=words,
        classes=_alias_classes(effects),
    )


def _evenly_spread_rows(n_points: int, most: int) -> IntArray:
    """Return all row numbers of a table or, of a longer one, `most` of them: one in each of as many equal stretches.

    Its place there differs from stretch to stretch, by the golden ratio, so that no column of the table keeps step.
    """
    if n_points <= most:
        return np.arange(n_points)
    stretch = np.arange(most)
    return np.asarray((stretch + stretch * _GOLDEN % 1.0) * n_points / most, dtype=np.int64)


def _point_where_readings_vary(system: System, table: RunTable) -> tuple[FloatArray, FloatArray, str]:
    """Return a point of the prior at which readings vary, its middle if possible, (n_params,).

    With the predicted readings there, (n_points,), and the point in words. Raises ParameterError if there is none, or a
    row has no reading at any.
    """
    never, is_constant = np.ones(len(table), dtype=np.bool_), False
    for k, z in enumerate(system.starts):
        predicted = system.chain(table, ()).predict(system.theta(z[None, :]), table)[0]
        if np.isfinite(predicted).all() and np.ptp(predicted) > 1e-12 * max(float(np.abs(predicted).max()), 1e-300):
            at = (
                "the middle of the prior"
                if k == 0
                else "another point of the prior (at its middle, readings are constant or not finite)"
            )
            return z, predicted, at
        never &= ~np.isfinite(predicted)
        is_constant |= bool(np.isfinite(predicted).all())
    if never.any():
        first = int(np.argmax(never)) + table.first_line
        found = f"no finite reading in {int(never.sum())} of {len(table)} rows, first in row {first}"
        raise ParameterError("the table", found, "a number in each cell that the simulator reads")
    if not is_constant:
        found = f"not finite in some row at any of the {len(system.starts)} points of the prior that were tried"
        raise ParameterError("the predicted reading", found, "narrower priors, with which all readings are finite")
    raise ParameterError(
        "the predicted reading", "the same in all rows, wherever the prior was tried", "rows over which it changes"
    )


def _noise_sd_and_source(simulator: Simulator, table: RunTable, predicted: FloatArray) -> tuple[float, str]:
    declared = simulator.noise.sd
    if isinstance(declared, str):
        median = median_sd_of_column(table, declared)
        if median is not None:
            return median, f"the median of {declared}"
    elif declared is not None:
        return float(declared), "as declared"
    return _NOISE * float(np.ptp(predicted)), "a hundredth of the range of the readings, since none is declared"


def _reasons_for_absence(about: ReferenceFit) -> dict[str, str]:
    """Return, for every possible effect by name, the reason to give if it cannot act in this table."""
    own, table = about.system.simulator, about.table
    nothing = "it leaves no trace here"
    timeless = "no time was recorded" if not table.has_varying_time else nothing
    too_few = nothing if about.can_fit_value_per_run else "runs have too few rows"
    one_run = "there is one run" if len(table.scan_names) == 1 else too_few
    out = {"offset_drift": timeless, "gain_drift": timeless, "offset_step": nothing, "gain_step": nothing}
    out |= {"offset_per_run": one_run, "gain_per_run": one_run, "nonlinearity": nothing, "saturation": nothing}
    out |= {"hysteresis": "the readings move one way only"}
    out |= dict.fromkeys(("lag", "delay", "settling", "interference"), timeless)
    for column in (c for c in table.covariates if c not in (own.reading, own.noise.sd)):
        out |= {
            f"sensitivity:{column}": "the column does not vary",
            f"curve:{column}": "it has fewer than three values",
        }
        out |= {f"friction:{column}": "the column does not move both ways"}
    for column in driving_columns(about):
        out |= {f"{kind}:{column}": nothing for kind in ("input_offset", "input_gain", "input_saturation", "dead_zone")}
        out |= {f"backlash:{column}": f"{column} does not turn back", f"input_delay:{column}": timeless}
        out |= {f"periodic_error:{column}": "the column has too few values"}
    out |= {"clock_drift": timeless, NoisePerRun.name: one_run}
    for name in own.parameters:
        out |= {f"drifts:{name}": timeless, f"steps:{name}": nothing}
        if name not in own.per_run:
            out[f"differs:{name}"] = one_run
    for state in about.states:
        kinds = ("damping", "drag", "friction", "forcing", "periodic_forcing", "limit")
        out |= {f"{kind}:{state}": nothing for kind in kinds}
    return out


def _alias_classes(effects: Sequence[EffectAudit]) -> tuple[tuple[str, ...], ...]:
    """Return sorted groups of names: effects aliased directly, or through others of the group."""
    group = {effect.name: {effect.name} for effect in effects}
    for effect in effects:
        for name, _ in effect.alike:
            if group[name] is not group[effect.name]:
                joined = group[name] | group[effect.name]
                group |= dict.fromkeys(joined, joined)
    kept = {id(members): tuple(sorted(members)) for members in group.values() if len(members) > 1}
    return tuple(sorted(kept.values()))
