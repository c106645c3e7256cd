"""Diagnose a person's simulator against their table: fit it, bind the forms about the fit, go the engine's road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.engine import Thorough, diagnose_prepared
from probewise.diagnosis.fitting.fit import Fit, Model, fit
from probewise.diagnosis.noise.law import white
from probewise.diagnosis.noise.models import rough_sd
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.system.apparatus import PersonsSystem
from probewise.diagnosis.verdict_report.diagnosis import Diagnosis
from probewise.errors import ParameterError
from probewise.progress import Progress, silent
from probewise.recordings.plan import Recording
from probewise.systems import CountedCalls, RunRecording, RunTable, Simulator, System, as_recording
from probewise.systems.forms import About

__all__ = ["diagnose_system", "fit_system", "notes_on_calls", "prepare_system", "recording_of"]

_STANDS_STILL = 0.02  # noise sds, rms, that predictions may move by when the step of the integration is halved
_MOST_COMPARED = 2400


def diagnose_system(
    simulator: Simulator,
    table: RunTable,
    *,
    source: str = "",
    notes: Sequence[str] = (),
    thorough: Thorough | None = None,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Diagnosis:
    """Tell what physics a simulator leaves out of a table of readings.

    Parameters
    ----------
    simulator
        What predicts the readings.
    table
        What was recorded, with the column that is predicted.
    source, notes
        What the table is called, and what is to be noted of it.
    thorough
        Weighs what leads a second time: `weigh_thoroughly`, by nested sampling.
    rng
        Source of randomness.
    progress
        Told what is being done, and how often `simulate` has been called.

    Raises
    ------
    ParameterError
        If the simulator and the table do not fit together.
    NotConvergedError
        If the fit of the simulator did not arrive anywhere.
    """
    prepared = prepare_system(simulator, table, source=source, notes=notes, progress=progress)
    return diagnose_prepared(prepared, thorough=thorough, rng=rng)


def prepare_system(
    simulator: Simulator,
    table: RunTable,
    *,
    source: str = "",
    notes: Sequence[str] = (),
    progress: Progress = silent,
    bound: bool = True,
) -> Prepared:
    """Fit the simulator, and bind the forms about the fit; none where they are not to be `bound`."""
    recording = replace(recording_of(simulator, table), source=source or simulator.source, notes=tuple(notes))
    system = System.of(simulator, table)
    told = progress if system.caller is None else CountedCalls(progress, system.caller)
    told("fitting the simulator")
    system, found, sd = fit_system(system, recording)
    apparatus = PersonsSystem(About(system, table, found.z, sd))
    begun = replace(system, first=found.z)
    told("binding effects")
    effects = apparatus.effects(recording, begun) if bound else {}
    told("diagnosing")
    return Prepared(recording, effects, begun, apparatus, recording)


def notes_on_calls(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Say where a person's `simulate` gave no readings, and which parameters it could not take row by row."""
    apparatus = diagnosis.apparatus
    caller = apparatus.system.caller if isinstance(apparatus, PersonsSystem) else None
    if caller is None:
        return ()
    out = []
    if caller.n_failed:
        out.append(f"simulate raised an error for {caller.n_failed:,} parameters tried: taken to be impossible")
    if caller.interpolated:
        names = ", ".join(sorted(caller.interpolated))
        out.append(f"simulate takes no array of {names}: where it varies by row, it is interpolated between fixed values")
    return tuple(out)


def recording_of(simulator: Simulator, table: RunTable) -> RunRecording:
    """Take the predicted column as readings; the simulator gets every row, at most 2,400 readings are compared.

    Raises
    ------
    ParameterError
        If the column is missing, or holds no number.
    """
    if simulator.reading not in table.columns:
        raise ParameterError("reading", simulator.reading, f"a column of the table: {', '.join(table.columns)}")
    whole = as_recording(simulator, table)
    own, readings = whole.plan, whole.readings
    usable = np.flatnonzero(whole.usable)
    if len(usable) <= _MOST_COMPARED:
        return whole
    stretch, every = 6, round(6 * len(usable) / _MOST_COMPARED)
    kept = np.full(len(readings), np.nan)
    chosen = usable[np.arange(len(usable)) % every < stretch]
    kept[chosen] = readings[chosen]
    return RunRecording(own, kept, simulator.source)


def fit_system(system: System, recording: Recording) -> tuple[System, Fit, float]:
    """Fit a system to readings, with a step of its integration at which predictions there stand still.

    Returns
    -------
    The system with that step, the fit, and the sd of a reading: as declared, or else the least of what the fit and
    neighbouring readings show.
    """
    table = cast(RunTable, recording.plan)
    law = white(int(recording.usable.sum()))
    found = min((fit(Model(system, (), recording.plan), recording, z, law) for z in system.starts), key=_height)
    sd = _sd(system.simulator, table, recording, found)
    for _ in range(4):
        finer = system.standing_still(table, found.z[None, :], tolerance=_STANDS_STILL * sd)
        if finer is system:
            break
        system = finer
        found = fit(Model(system, (), recording.plan), recording, found.z, law)
        sd = _sd(system.simulator, table, recording, found)
    return system, found, sd


def _height(found: Fit) -> float:
    return found.objective if np.isfinite(found.objective) else np.inf


def _sd(simulator: Simulator, table: RunTable, recording: Recording, found: Fit) -> float:
    declared = simulator.noise.sd
    if isinstance(declared, str):
        values: FloatArray = table.covariates[declared]
        return float(np.median(values[np.isfinite(values)]))
    if declared is not None:
        return float(declared)
    rough = rough_sd(recording)
    return min(found.sd, rough) if rough > 0 else found.sd
