"""Diagnosis of a user's simulator against a table: fit it, scale the effects to the fit, run the engine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise._kinds import require_progress, require_rng
from probewise.diagnosis.engine import Thorough, diagnosis_of_search, search_prepared
from probewise.diagnosis.fitting.fit import Fit, Model, fit, fit_each_start
from probewise.diagnosis.noise.law import NoiseLaw, white_noise_of_recording
from probewise.diagnosis.noise.models import rough_sd
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.system.apparatus import CALLS_OF_A_SEARCH, SimulatorApparatus
from probewise.diagnosis.system.finer_step import finer_step_for_repair, searched_at_step
from probewise.diagnosis.system.likely_step import with_step_for_likely_parameters
from probewise.diagnosis.system.prior_conflict import notes_on_declared_noise, notes_on_prior_conflict
from probewise.diagnosis.thinning import MOST_READINGS, positions_in_stretches
from probewise.diagnosis.verdict_report.diagnosis import Diagnosis
from probewise.errors import ParameterError
from probewise.progress import Progress, silent
from probewise.recordings.plan import Plan, Recording
from probewise.systems import ProgressWithCallCount, RunRecording, RunTable, Simulator, System, as_recording, table_for
from probewise.systems.calls import IntegrationTally
from probewise.systems.converged_step import STANDS_STILL, with_converged_step
from probewise.systems.forms import ReferenceFit
from probewise.systems.forms.readings import time_since_start_of_run
from probewise.systems.forms.sorted_rows import sorting_column
from probewise.systems.forms.stop import (
    MeterStop,
    find_meter_stop_and_mask,
    is_signal_beyond,
    possible_meter_stops_and_masks,
)
from probewise.systems.row_order import note_on_row_order, rows_are_in_order
from probewise.systems.table import median_sd_of_column

_STEPS_TRIED = 8  # of the fit of the simulator, from each start
_BEST_STARTS = 3  # of which it goes on
_BEGINNINGS = 0.25, 0.5  # shares of the longest run that are fitted before all of it
_NEAR_END = 2.0  # noise sds from an end of the declared range to a prediction whose noise the end may cut off
_EXPLAINED = 3.0  # noise sds from the prediction, limited to the range, to a reading that it explains


def diagnose_system(
    simulator: Simulator,
    table: RunTable | Mapping[str, Any],
    *,
    source: str = "",
    notes: Sequence[str] = (),
    thorough: Thorough | None = None,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Diagnosis:
    """Diagnose which physics a simulator leaves out, from a table of readings.

    Parameters
    ----------
    simulator
        The model that predicts the readings.
    table
        The recorded rows, with the predicted column: a table, a dict of arrays, or a DataFrame.
    source, notes
        Name of the table, and notes on it for the report.
    thorough
        As in `diagnose`.
    rng
        Source of randomness.
    progress
        Called with each stage, and with the number of calls of `simulate`.

    Returns
    -------
    Diagnosis
        As that of `diagnose`.

    Raises
    ------
    ParameterError
        If the table lacks a column that the simulator names or any reading, or time falls within a run.
    NotConvergedError
        If the fit of the simulator did not converge.
    """
    table = table_for(simulator, table)
    require_rng(rng)
    require_progress(progress)

    def fit_and_diagnose(simulator: Simulator, *, stiff: bool = False) -> tuple[Searched, Diagnosis]:
        prepared = prepare_system(simulator, table, source=source, notes=notes, progress=progress, stiff=stiff)
        told = _progress_with_call_count(progress, cast(SimulatorApparatus, prepared.apparatus).system)
        searched = search_prepared(prepared, progress=told)
        return searched, diagnosis_of_search(searched, thorough=thorough, progress=told, rng=rng)

    searched, diagnosis = fit_and_diagnose(simulator)
    needed = finer_step_for_repair(diagnosis)
    if needed is None:
        return diagnosis
    step, stiff = needed
    assert simulator.law is not None
    progress(f"once more, with integration steps of {step:.3g} {simulator.time_unit}, which the repaired law needs")
    finer = searched_at_step(searched, step, stiff=stiff, progress=progress)
    if finer is not None:
        return diagnosis_of_search(finer, thorough=thorough, progress=progress, rng=rng)
    return fit_and_diagnose(replace(simulator, law=replace(simulator.law, max_step_s=step)), stiff=stiff)[1]


def prepare_system(
    simulator: Simulator,
    table: RunTable,
    *,
    source: str = "",
    notes: Sequence[str] = (),
    progress: Progress = silent,
    with_effects: bool = True,
    stiff: bool = False,
) -> Prepared:
    """Fit the simulator, and build the engine's input; effects are scaled to the fit, none unless `with_effects`.

    A law is integrated by a linearly implicit method if `stiff`, or where it needs one.
    """
    recording = replace(
        recording_from_table(simulator, table),
        source=source or simulator.source,
        notes=(*notes, *note_on_row_order(simulator, table)),
    )
    system = System.of(simulator, table, stiff=stiff)
    if with_effects and len(table) < 2:  # nothing can change along it
        raise ParameterError("the table", "one row", f"{system.least_readings} rows or more, not all readings equal")
    plan, recording = recording.plan, without_unpredictable_readings(system, recording, every_row=with_effects)
    if recording.plan is not plan:
        table = replace(table, columns=cast(RunTable, recording.plan).columns)
    recording, stop = without_readings_at_stop(simulator, table, recording)
    if not recording.usable.any():
        raise ParameterError(
            "usable readings", 0, f"{system.least_readings} or more; column {simulator.reading} has none"
        )
    if not (recording.usable & ~recording.censored).any():
        allowed = f"{system.least_readings} or more within the range"
        raise ParameterError("usable readings", "all at an end of the declared range", allowed)
    told = _progress_with_call_count(progress, system)
    told("fitting the simulator")
    if stop is None:
        recording, stop = without_readings_at_scattered_stop(system, recording)
    system, found, sd = fit_system(system, recording)
    near_ends = readings_near_ends(system, found, sd, recording)
    if near_ends.any():
        recording = without_readings_near_ends(system, recording, near_ends)
        system, found, sd = fit_system(replace(system, first=found.z, slack=_NEAR_END * sd), recording)
    misfit = float(np.sqrt(np.mean(found.residuals**2))) / sd
    conflicts = tuple(notes_on_prior_conflict(system, found, white_noise_of_recording(recording)))
    recording = replace(recording, notes=(*recording.notes, *conflicts))
    apparatus = SimulatorApparatus(ReferenceFit(system, table, found.z, sd, misfit=misfit), stop)
    sorting = sorting_column(apparatus.about)
    if sorting is not None:
        note = f"rows are sorted by {sorting}: what jumps or wanders from row to row may change with {sorting} instead"
        recording = replace(recording, notes=(*recording.notes, note))
    begun = replace(system, first=found.z)
    told("building the effects")
    effects = apparatus.effects(recording, begun) if with_effects else {}
    return Prepared(recording, effects, begun, apparatus, recording)


def _progress_with_call_count(progress: Progress, system: System) -> Progress:
    """Return a progress that also shows the number of calls of `simulate`, if the system has this function."""
    return progress if system.caller is None else ProgressWithCallCount(progress, system.caller)


def without_unpredictable_readings(system: System, recording: RunRecording, *, every_row: bool = False) -> RunRecording:
    """Leave out, with a note, the readings of rows in which a missing column makes a prediction impossible.

    If there is such a row, missing values of all columns are interpolated from the other rows of the run, so that
    effects with a memory, such as backlash, are defined in later rows.

    Raises
    ------
    ParameterError
        If the simulator gives no finite reading in a row where no column is missing: one with a reading or, if
        `every_row`, any, since the change by an effect would not be finite there.
    """
    table = cast(RunTable, recording.plan)
    tried = system.chain(table, ()).predict(system.theta(system.starts), table)
    there = np.isfinite(tried)
    unpredictable = ~there[there.any(axis=1)].any(axis=0) if there.any() else np.ones(len(table), dtype=np.bool_)
    lost = unpredictable & recording.usable
    if not unpredictable.any():
        return recording
    missing = np.zeros(len(table), dtype=np.bool_)
    no_inputs = system.simulator.reading, system.simulator.noise.sd
    inputs = {name: values for name, values in table.covariates.items() if name not in no_inputs}
    for values in inputs.values():
        missing |= ~np.isfinite(values)
    gaps = np.flatnonzero(missing)
    if system.simulator.law is not None:  # what is missing once is missing to the end of its run
        for rows in table.rows_by_scan():
            missing[rows] = np.maximum.accumulate(missing[rows])
    wrong = np.flatnonzero((unpredictable if every_row else lost) & ~missing)
    if wrong.size:
        what = "simulate" if system.simulator.law is None else "rates"
        where = f"no finite reading in {len(wrong)} of {len(table)} rows, first in row {wrong[0] + 2}"
        allowed = "a finite reading in each row somewhere in the prior, or a table without these rows"
        raise ParameterError(what, where, allowed)
    filled = table.with_columns({name: table.interpolated_within_runs(values) for name, values in inputs.items()})
    return replace(
        recording,
        plan=cast(Plan, filled),
        readings=np.where(lost, np.nan, recording.readings),
        notes=(*recording.notes, _note_on_gaps(system, int(lost.sum()), gaps)) if lost.any() else recording.notes,
    )


def _note_on_gaps(system: System, n_lost: int, gaps: IntArray) -> str:
    """Say that readings are left out, since cells are missing in the rows `gaps`, counted from 0."""
    if system.simulator.law is None:
        return f"{n_lost} readings left out: a column that the simulator reads is missing there"
    more = f" and {len(gaps) - 1} more" if len(gaps) > 1 else ""
    return (
        f"{n_lost} readings left out: a column that the law reads is missing in row {gaps[0] + 2}{more}, "
        "and a law ends at the first gap of its run; fill the gaps in to use them"
    )


def without_readings_at_stop(
    simulator: Simulator, table: RunTable, recording: RunRecording
) -> tuple[RunRecording, MeterStop | None]:
    """Leave out, with a note, readings at an undeclared stop of the meter.

    Returns
    -------
    The recording without them, and the stop; None if there is none.
    """
    found = find_meter_stop_and_mask(as_recording(simulator, table), simulator.reading)
    if found is None:
        return recording, None
    stop, rows = found
    return _without_rows_at_stop(recording, stop, rows), stop


def without_readings_at_scattered_stop(
    system: System, recording: RunRecording
) -> tuple[RunRecording, MeterStop | None]:
    """Leave out, with a note, readings at a stop of the meter that they do not show by standing there in succession.

    A fit to the others must predict them beyond the stop. Returns as `without_readings_at_stop`.
    """
    for stop, rows in possible_meter_stops_and_masks(recording, system.simulator.reading):
        without = _without_rows_at_stop(recording, stop, rows)
        if without.usable.sum() < system.least_readings:
            continue
        fitted, found, sd = fit_system(system, without)
        predicted = fitted.chain(recording.plan, ()).predict(fitted.theta(found.z[None, :]), recording.plan)[0]
        if is_signal_beyond(stop, predicted[rows], sd):
            return without, stop
    return recording, None


def _without_rows_at_stop(recording: RunRecording, stop: MeterStop, rows: BoolArray) -> RunRecording:
    level = f"{stop.level:.6g} {stop.unit}".rstrip()
    note = f"{int(rows.sum())} readings left out: they stand at {level}, where the meter stops"
    return replace(recording, readings=np.where(rows, np.nan, recording.readings), notes=(*recording.notes, note))


def readings_near_ends(system: System, found: Fit, sd: float, recording: RunRecording) -> BoolArray:
    """Return the mask of the readings at an end of the declared range, and of those whose noise an end cuts off.

    Of the latter, the fit predicts the signal near an end or beyond, and explains the reading; (n_points,) in all.
    """
    table, own_sd = cast(RunTable, recording.plan), sd * recording.relative_sd
    low, high = system.simulator.noise.ends
    predicted = replace(system, limited=False).chain(table, ()).predict(system.theta(found.z[None, :]), table)[0]
    is_near = (predicted - low < _NEAR_END * own_sd) | (high - predicted < _NEAR_END * own_sd)
    is_explained = np.abs(recording.readings - np.clip(predicted, low, high)) < _EXPLAINED * own_sd
    return np.asarray(recording.usable & (recording.censored | is_near & is_explained))


def without_readings_near_ends(system: System, recording: RunRecording, near_ends: BoolArray) -> RunRecording:
    """Leave out, with a note, those of the readings `near_ends` that are not at an end.

    Of a signal near an end only the noise away from the end is seen: its mean would be wrong. Where too few readings
    would be left for a fit, all stay.
    """
    at_end = near_ends & recording.censored
    cut = near_ends & ~at_end
    if (recording.usable & ~near_ends).sum() < system.least_readings:
        cut = np.zeros_like(cut)
    said = []
    if at_end.any():
        said.append(
            f"{int(at_end.sum())} readings at an end of the declared range say that the signal is there or beyond"
        )
    if cut.any():
        said.append(f"{int(cut.sum())} readings near an end of the declared range left out: it cuts off their noise")
    return replace(recording, readings=np.where(cut, np.nan, recording.readings), notes=(*recording.notes, *said))


def notes_on_calls(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return notes on a simulator's calls (cut short, failed, by fixed values) and its declared noise; else ()."""
    apparatus = diagnosis.apparatus
    if not isinstance(apparatus, SimulatorApparatus):
        return ()
    white = diagnosis.report.noise.model == "white"
    out = [*notes_on_declared_noise(apparatus.system.simulator, diagnosis.repaired.noise_sd)] if white else []
    caller, tally = apparatus.system.caller, apparatus.system.tally
    if caller is None:
        law = apparatus.system.simulator.law
        sets_step = law is not None and law.max_step_s is not None
        return (*out, *_notes_on_integration(tally, apparatus.evaluations_of_a_search, sets_step=sets_step))
    if caller.cut_short:
        out.append(
            f"simulate takes one sample at a time: in {CALLS_OF_A_SEARCH:,} calls not every combination of effects "
            "that promised something was fitted; if simulate takes arrays, the search is complete"
        )
    if caller.n_failed:
        out.append(f"simulate raised an error for {caller.n_failed:,} parameter vectors, which count as impossible")
    if caller.interpolated:
        names = ", ".join(sorted(caller.interpolated))
        out.append(
            f"simulate takes no array of {names}: readings are interpolated between fixed values, each as if the "
            "parameter had always been as it is in its row; where earlier rows act on later ones let simulate take "
            "arrays, or write a law"
        )
    return tuple(out)


def _notes_on_integration(tally: IntegrationTally, most: int, *, sets_step: bool) -> Iterator[str]:
    if tally.cut_short:
        way_out = "a larger max_step_s, shorter runs" if sets_step else "shorter runs"
        yield (
            f"integrating the law takes long: in {most:,} evaluations of its rates not every "
            f"combination of effects that promised something was fitted; with {way_out} or fewer rows the search is "
            "complete"
        )
    if tally.too_stiff:
        yield (
            "the law is stiff: parameters that may fit the readings would need more integration steps than are taken, "
            "and count as impossible; their intervals may be too narrow; set max_step_s, or bring simulate with an "
            "integrator"
        )
    if tally.n_failed:
        yield f"rates raised an error for {tally.n_failed:,} parameter vectors, which count as impossible"


def recording_from_table(simulator: Simulator, table: RunTable) -> RunRecording:
    """Convert a table to a recording whose readings are the predicted column.

    Of more than 2,400 readings, about that many are used, in stretches of six, and a note says so; the simulator still
    predicts every row.

    Raises
    ------
    ParameterError
        If the column is missing or contains no number, or if time falls within a run.
    """
    if simulator.reading not in table.columns:
        raise ParameterError("reading", simulator.reading, f"a column of the table: {', '.join(table.columns)}")
    table.require_rising_time()
    whole = as_recording(simulator, table)
    readings = whole.readings
    usable = np.flatnonzero(whole.usable)
    chosen = usable[positions_in_stretches(table.scan[usable], MOST_READINGS)]
    if len(chosen) == len(usable):
        return whole
    kept = np.full(len(readings), np.nan)
    kept[chosen] = readings[chosen]
    note = f"{len(chosen):,} of {len(usable):,} readings are used, in stretches of six spread over the whole table"
    return replace(whole, readings=kept, notes=(*whole.notes, note))


def fit_system(system: System, recording: Recording) -> tuple[System, Fit, float]:
    """Fit a system to readings, at an integration step at which likely predictions no longer change.

    Returns
    -------
    The system with that step, the fit, and the sd of a reading: as declared, or else the smaller of the estimates from
    the fit and from successive readings.
    """
    table = cast(RunTable, recording.plan)
    law = white_noise_of_recording(recording)
    found = _fit_from_best_starts(system, recording, law)
    sd = _noise_sd_of(system.simulator, table, recording, found)

    def refitted(finer: System) -> tuple[System, Fit, float]:
        again = fit(Model(finer, (), recording.plan), recording, found.z, law)
        return finer, again, _noise_sd_of(finer.simulator, table, recording, again)

    for _ in range(4):
        finer = with_converged_step(system, table, system.theta(found.z[None, :]), tolerance=STANDS_STILL * sd)
        if finer is system:
            break
        system, found, sd = refitted(finer)
    finer = with_step_for_likely_parameters(system, table, recording, found, sd)
    return (system, found, sd) if finer is system else refitted(finer)


def _fit_from_best_starts(system: System, recording: Recording, law: NoiseLaw) -> Fit:
    """Fit a few steps from every start, then to convergence from the best and from `_starts_from_partial_runs`."""
    model = Model(system, (), recording.plan)
    tried = sorted(
        fit_each_start(model, recording, list(system.starts), law, max_steps=_STEPS_TRIED), key=_objective_or_infinity
    )[:_BEST_STARTS]
    longer = _starts_from_partial_runs(model, recording)
    if not longer and all(found.settled for found in tried):
        return tried[0]
    return min(
        fit_each_start(model, recording, [*(found.z for found in tried), *longer], law), key=_objective_or_infinity
    )


def _starts_from_partial_runs(model: Model, recording: Recording) -> list[FloatArray]:
    """Return starts of a fit, (n_params,) each: the best three fits to the beginning of every run.

    A quarter of the longest run's duration is fitted first, then half of it. There are no starts without a time, with
    too few readings, or if predictions are costly. For an oscillating system the objective has a local minimum for
    every period by which a run can be wrong; over the first quarter of a run there are few.
    """
    system, table = cast(System, model.sensor), cast(RunTable, recording.plan)
    if not (system.predicts_in_bulk and table.has_varying_time):
        return []
    since = time_since_start_of_run(table)
    starts = list(system.starts)
    for share in _BEGINNINGS:
        begun = since <= share * since.max()
        part = recording.with_readings(np.where(begun, recording.readings, np.nan))
        if (part.usable & ~part.censored).sum() < system.least_readings:
            return []
        found = sorted(
            fit_each_start(model, part, starts, white_noise_of_recording(part), max_steps=_STEPS_TRIED),
            key=_objective_or_infinity,
        )
        starts = [each.z for each in found[:_BEST_STARTS]]
    return starts


def _objective_or_infinity(found: Fit) -> float:
    return found.objective if np.isfinite(found.objective) else np.inf


def _noise_sd_of(simulator: Simulator, table: RunTable, recording: Recording, found: Fit) -> float:
    declared = simulator.noise.sd
    known = median_sd_of_column(table, declared) if isinstance(declared, str) else declared
    if known is not None:
        return float(known)
    rough = rough_sd(recording) if rows_are_in_order(simulator, table) else 0.0  # sorted, successive ones are too alike
    return min(found.sd, rough) if rough > 0 else found.sd
