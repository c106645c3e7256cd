"""The integration step that likely parameters need, where the step of the best fit fails at them.

The step is chosen at the best fit. Where a law is stiff, as one whose time constant may be far shorter than the time
between readings, that step makes predictions run away at parameters that fit the readings as well: the posterior would
end where the integration fails.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.laplace import covariance_root
from probewise.diagnosis.fitting.coordinates import FARTHEST
from probewise.diagnosis.fitting.fit import Fit, Model
from probewise.errors import ParameterError
from probewise.recordings.plan import Recording
from probewise.systems import RunTable, System
from probewise.systems.system import STANDS_STILL, with_converged_step

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
