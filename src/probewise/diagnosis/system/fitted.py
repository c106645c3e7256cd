"""The models of a diagnosed simulator as they are written to files: simulator, posterior samples, effects."""

from __future__ import annotations

import hashlib
from typing import cast

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise._kinds import require_kind
from probewise.diagnosis.repair.samples import ModelSamples
from probewise.diagnosis.system.apparatus import SimulatorApparatus
from probewise.diagnosis.verdict_report.diagnosis import Diagnosis
from probewise.errors import ParameterError
from probewise.recordings.plan import Recording
from probewise.systems import FittedSystem, RunTable, System, run_table_csv
from probewise.systems.forms import ReferenceFit
from probewise.systems.forms.binding import StoredFit, extract_stored_fit


@own_arithmetic
def repaired_of(diagnosis: Diagnosis) -> FittedSystem:
    """Return the repaired model of a diagnosis: the simulator with the effects that it leaves out.

    Raises
    ------
    ParameterError
        If it is not the diagnosis of a simulator.
    """
    return _fitted_system_of(diagnosis, "repaired")


@own_arithmetic
def calibrated_of(diagnosis: Diagnosis) -> FittedSystem:
    """Return the calibrated null model of a diagnosis: the simulator alone. Raises as `repaired_of`."""
    return _fitted_system_of(diagnosis, "null")


def _fitted_system_of(diagnosis: Diagnosis, which: str) -> FittedSystem:
    allowed = "the Diagnosis of a simulator, as diagnose_system returns it"
    if isinstance(getattr(diagnosis, "fitted", None), FittedSystem):
        allowed += f"; of this {type(diagnosis).__name__} take its .fitted"
    require_kind("diagnosis", diagnosis, Diagnosis, allowed)
    apparatus, model = diagnosis.apparatus, getattr(diagnosis, which)
    if not isinstance(apparatus, SimulatorApparatus):
        raise ParameterError("diagnosis", diagnosis, f"{allowed}; a light sensor's is {which}.fitted_sensor(...)")
    before = diagnosis.repair.before.readings
    return fitted_system_from_samples(
        apparatus.system, model, diagnosis.recording, before, known=recorded_table_if_needed(apparatus.about, model)
    )


def recorded_table_if_needed(about: ReferenceFit, model: ModelSamples) -> StoredFit | None:
    """Return the recorded table with the first fit's predictions if a model's file needs them, else None.

    A file needs them if the model has effects, whose scales the first fit set, or if a column holds the noise sds.
    """
    return extract_stored_fit(about) if model.effects or isinstance(about.system.simulator.noise.sd, str) else None


def fitted_system_from_samples(
    system: System, model: ModelSamples, recording: Recording, predicted: FloatArray, *, known: StoredFit | None = None
) -> FittedSystem:
    """Return posterior samples of a system with effects as a FittedSystem, which can be written to a file.

    Parameters
    ----------
    system, model
        The simulator over the runs of the recording, and the samples.
    recording
        The fitted recording.
    predicted
        Prediction for every row, (n_points,).
    known
        The recorded table, if the file needs it (`recorded_table_if_needed`).
    """
    level = predicted[recording.usable]
    return FittedSystem(
        system.simulator,
        names=tuple(model.chain.names),
        samples=model.theta,
        noise_sd=model.noise_sd,
        effects=model.effects,
        absent=model.absent,
        level=(float(np.min(level)), float(np.max(level))),
        max_step=system.max_step,
        stiff=system.stiff,
        known=known,
        recording=hashlib.sha256(run_table_csv(cast(RunTable, recording.plan)).encode()).hexdigest()[:16],
        source=recording.source,
        notes=recording.notes,
    )
