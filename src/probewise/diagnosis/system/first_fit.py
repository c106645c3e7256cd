"""The fit of a user's simulator, without effects, to the readings of a table."""

from __future__ import annotations

from typing import cast

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.fit import Fit, Model, fit, fit_each_start
from probewise.diagnosis.noise.law import NoiseLaw, white_noise_of_recording
from probewise.diagnosis.noise.models import rough_sd
from probewise.diagnosis.system.likely_step import with_step_for_likely_parameters
from probewise.recordings.plan import Recording
from probewise.systems import RunTable, Simulator, System
from probewise.systems.forms.readings import time_since_start_of_run
from probewise.systems.forms.reference import rows_are_in_order
from probewise.systems.system import STANDS_STILL, with_converged_step
from probewise.systems.table import median_sd_of_column

_STEPS_TRIED = 8  # from each start
_BEST_STARTS = 3  # of which it goes on
_BEGINNINGS = 0.25, 0.5  # shares of the longest run that are fitted before all of it


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


def is_noise_sd_known_beside_misfit(simulator: Simulator, table: RunTable) -> bool:
    """Return whether the noise sd is declared, or successive readings tell it: not from residuals alone."""
    return simulator.noise.sd is not None or rows_are_in_order(simulator, table)


def _noise_sd_of(simulator: Simulator, table: RunTable, recording: Recording, found: Fit) -> float:
    declared = simulator.noise.sd
    known = median_sd_of_column(table, declared) if isinstance(declared, str) else declared
    if known is not None:
        return float(known)
    rough = rough_sd(recording) if rows_are_in_order(simulator, table) else 0.0  # sorted, successive ones are too alike
    return min(found.sd, rough) if rough > 0 else found.sd
