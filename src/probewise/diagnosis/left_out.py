"""Readings of a table that are left out of a diagnosis: thinned, not predictable, or at an end of the meter's range."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from probewise._arrays import BoolArray
from probewise._words import count_with_noun
from probewise.diagnosis.fit import Fit
from probewise.diagnosis.prepared import MOST_READINGS, positions_in_stretches
from probewise.diagnosis.simulator_fit import fit_system, is_noise_sd_known_beside_misfit
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan, masks_of_readings_at_ends
from probewise.systems import RunRecording, RunTable, Simulator, System, as_recording
from probewise.systems.forms.stop import (
    MeterStop,
    find_meter_stop_and_mask,
    is_signal_beyond,
    possible_meter_stops_and_masks,
)

NEAR_END = 2.0  # noise sds from an end of the declared range to a prediction whose noise the end may cut off
_EXPLAINED = 3.0  # noise sds from the prediction, limited to the range, to a reading that it explains


def recording_from_table(simulator: Simulator, table: RunTable) -> RunRecording:
    """Convert a table to a recording whose readings are the predicted column.

    Of more than 2,400 readings, about that many are used, in stretches of six, and a note says so; the simulator still
    predicts every row.

    Raises ParameterError if the column is missing or contains no number, or if time falls within a run.
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


def without_unpredictable_readings(system: System, recording: RunRecording, *, every_row: bool = False) -> RunRecording:
    """Leave out, with a note, the readings of rows in which a missing column makes a prediction impossible.

    If there is such a row, missing values of all columns are interpolated from the other rows of the run, so that
    effects with a memory, such as backlash, are defined in later rows.

    Raises ParameterError if the simulator gives no finite reading in a row where no column is missing: one with a
    reading or, if `every_row`, any, since the change by an effect would not be finite there.
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
        where = f"no finite reading in {len(wrong)} of {len(table)} rows, first in row {wrong[0] + table.first_line}"
        allowed = "a finite reading in each row somewhere in the prior, or a table without these rows"
        raise ParameterError(what, where, allowed)
    filled = table.with_columns({name: table.interpolated_within_runs(values) for name, values in inputs.items()})
    said = list[str]()
    if lost.any():
        note = f"{count_with_noun(int(lost.sum()), 'reading')} left out: a column that the "
        more = f" and {len(gaps) - 1} more" if len(gaps) > 1 else ""
        if system.simulator.law is None:
            note += "simulator reads is missing there"
        else:
            note += f"law reads is missing in row {gaps[0] + table.first_line}{more}, and a law ends at the first gap "
            note += "of its run; fill the gaps in to use them"
        said.append(note)
    kept, notes = np.where(lost, np.nan, recording.readings), (*recording.notes, *said)
    return replace(recording, plan=cast(Plan, filled), readings=kept, notes=notes)


def without_readings_at_stop(
    simulator: Simulator, table: RunTable, recording: RunRecording
) -> tuple[RunRecording, MeterStop | None]:
    """Leave out, with a note, readings at an undeclared stop of the meter.

    Returns the recording without them, and the stop; None if there is none.
    """
    found = find_meter_stop_and_mask(as_recording(simulator, table), simulator.reading)
    if found is None:
        return recording, None
    stop, rows = found
    return _without_rows_at_stop(recording, stop, rows), stop


def without_readings_at_scattered_stop(
    system: System, recording: RunRecording
) -> tuple[RunRecording, MeterStop | None]:
    """Leave out, with a note, readings at an undeclared stop of the meter that are scattered over the table.

    The stop counts only if a fit to the other readings predicts these beyond it. Returns as `without_readings_at_stop`.
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
    note = f"{count_with_noun(int(rows.sum()), 'reading')} left out, at {level}, where the meter stops"
    return replace(recording, readings=np.where(rows, np.nan, recording.readings), notes=(*recording.notes, note))


def readings_near_ends(system: System, found: Fit, sd: float, recording: RunRecording) -> BoolArray:
    """Return the mask of the readings at an end of the declared range, and of those whose noise an end cuts off.

    Of the latter, the fit predicts the signal near an end or beyond, and explains the reading; (n_points,) in all.
    There are none at an end that no reading reaches, nor where only the misfit of the simulator tells the noise sd.
    """
    table, own_sd = cast(RunTable, recording.plan), sd * recording.relative_sd
    low, high = system.simulator.noise.ends
    if not is_noise_sd_known_beside_misfit(system.simulator, table):
        return recording.usable & recording.censored
    at_low, at_high = masks_of_readings_at_ends(recording.readings, low, high, system.simulator.noise.step)
    predicted = replace(system, limited=False).chain(table, ()).predict(system.theta(found.z[None, :]), table)[0]
    is_near = at_low.any() & (predicted - low < NEAR_END * own_sd)
    is_near |= at_high.any() & (high - predicted < NEAR_END * own_sd)
    is_explained = np.abs(recording.readings - np.clip(predicted, low, high)) < _EXPLAINED * own_sd
    return np.asarray(recording.usable & (recording.censored | is_near & is_explained))


def without_readings_near_ends(system: System, recording: RunRecording, near_ends: BoolArray) -> RunRecording:
    """Leave out, with a note, those of the readings `near_ends` that are not at an end.

    Near an end only noise away from the end is seen, so the mean of these readings is biased. Where too few readings
    would be left for a fit, all stay.
    """
    at_end = near_ends & recording.censored
    cut = near_ends & ~at_end
    if (recording.usable & ~near_ends).sum() < system.least_readings:
        cut = np.zeros_like(cut)
    said = []
    if at_end.any():
        n_at_end = count_with_noun(int(at_end.sum()), "reading")
        said.append(
            f"{n_at_end} at an end of the declared range: used only as the statement that the signal is there or beyond"
        )
    if cut.any():
        n_cut = count_with_noun(int(cut.sum()), "reading")
        said.append(f"{n_cut} left out near an end of the declared range, which cuts off the noise")
    return replace(recording, readings=np.where(cut, np.nan, recording.readings), notes=(*recording.notes, *said))
