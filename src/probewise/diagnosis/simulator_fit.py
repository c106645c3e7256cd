"""The fit of a user's simulator, without effects, to the readings of a table, and its integration step.

The step is chosen at the best fit. Where a law is stiff, as one whose time constant may be far shorter than the time
between readings, that step makes predictions run away at parameters that fit the readings as well: the posterior would
end where the integration fails. There it is the step that likely parameters need.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence import covariance_root
from probewise.diagnosis.fit import FARTHEST, Fit, Model, fit, fit_each_start
from probewise.diagnosis.noise_law import NoiseLaw, white_noise_of_recording
from probewise.diagnosis.noise_models import rough_sd
from probewise.errors import ParameterError
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


_LINE = np.arange(-3.0, 3.01, 0.25)  # standard-normal coordinates at which the step is tried
_WRONG = 1.0  # noise sds, rms, by which half the step changes predictions where the step fails
_LIKELY = 5.0  # nats below the best fit
_LONGEST_STRIDE = 0.25  # of a coordinate
_FLAT = 1.0  # nats that a stride loses at most, from which the next one is twice as long
_REFITS = 2  # Gauss-Newton steps of the other coordinates after each stride


def with_step_for_likely_parameters(
    system: System, table: RunTable, recording: Recording, found: Fit, sd: float
) -> System:
    """Return the system with a step that integrates the law at all parameters that fit the readings.

    A shared parameter is followed from its best value to where the step fails, with the others refitted, as long as
    the log posterior density is within 5 nats of the best. The step becomes as short as the parameters on the way need.
    If this takes more than 4,096 steps beyond one per row, it stays longer, and `system.tally.too_stiff` is set.

    Parameters
    ----------
    system, table, recording
        The system, its table and its readings. One without a law is returned as it is.
    found, sd
        Its fit, and the sd of a reading.
    """
    if system.simulator.law is None:
        return system
    usable, tolerance = recording.usable, STANDS_STILL * sd
    scale = recording.relative_sd[usable] * max(sd, float(np.sqrt(np.mean(found.residuals**2))))
    root = covariance_root(found.slopes, sd**2)

    def refitted(system: System, z: FloatArray, others: IntArray) -> tuple[FloatArray, float]:
        """Return a point with the coordinates `others` refitted, and its log posterior density up to a constant."""
        model = Model(system, (), recording.plan)
        for _ in range(_REFITS):
            predicted, slopes = model.predict_and_differentiate(z, by=others)
            left, slopes = (recording.readings - predicted)[usable] / scale, slopes[usable] / scale[:, None]
            if not (np.isfinite(left).all() and np.isfinite(slopes).all()):
                return z, -np.inf
            curvature = slopes.T @ slopes + np.eye(len(others))
            z = z.copy()
            z[others] = np.clip(
                z[others] + np.linalg.solve(curvature, slopes.T @ left - z[others]), -FARTHEST, FARTHEST
            )
        left = (recording.readings - model.predict(z[None, :])[0])[usable] / scale
        return z, -0.5 * float(left @ left + z @ z) if np.isfinite(left).all() else -np.inf

    best = -0.5 * float(np.sum((found.residuals / scale) ** 2) + found.z @ found.z)
    for k, towards in _directions_in_which_step_fails(system, table, found, sd):
        others = np.flatnonzero(np.arange(len(found.z)) != k)
        z, density = found.z, best
        stride = min(_LONGEST_STRIDE, float(np.linalg.norm(root[k])))
        while abs(z[k]) < -_LINE[0] and density > best - _LIKELY:
            further, before = z + stride * towards * (np.arange(len(z)) == k), density
            try:
                finer = with_converged_step(system, table, system.theta(further[None, :]), tolerance=tolerance)
            except ParameterError:
                system.tally.too_stiff = True
                break
            z, density = refitted(finer, further, others)
            if density > best - _LIKELY:
                system = finer
            if density > before - _FLAT:
                stride = min(_LONGEST_STRIDE, 2 * stride)
    return system


def _directions_in_which_step_fails(
    system: System, table: RunTable, found: Fit, sd: float
) -> Iterator[tuple[int, float]]:
    """Yield (coordinate, 1 or -1) of each shared parameter and direction in which half the step changes predictions."""
    finer = replace(system, max_step=system.max_step / 2)
    for k, name in enumerate(system.marginals):
        if name not in system.simulator.parameters:  # of one run, as the state in which it starts
            continue
        z = np.tile(found.z, (len(_LINE), 1))
        z[:, k] = _LINE
        theta = system.theta(z)
        with np.errstate(all="ignore"):
            change = system.chain(table, ()).predict(theta, table) - finer.chain(table, ()).predict(theta, table)
            fails = ~(np.sqrt(np.mean(change**2, axis=1)) <= _WRONG * sd)
        for towards in (-1.0, 1.0):
            if fails[towards * (_LINE - found.z[k]) > 0].any():
                yield k, towards
