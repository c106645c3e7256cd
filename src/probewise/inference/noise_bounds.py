"""Bounds of a recording's noise sd, between which its prior is proper."""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import IntArray
from probewise.effects.noise import lattice_step
from probewise.inference.student_t import StudentT
from probewise.recordings.plan import Recording


def reading_span(recording: Recording) -> float:
    """Return the range of the usable readings, max - min; if that is 0, the declared range, or else 1."""
    readings = recording.readings[recording.usable]
    span = float(np.ptp(readings)) if readings.size else 0.0
    if span > 0:
        return span
    inst = recording.plan.instrumentation
    if inst.min is not None and inst.max is not None and inst.max > inst.min:
        return inst.max - inst.min
    return 1.0


def sd_floor(recording: Recording) -> float:
    """Return the lower bound of the noise sd: that of rounding, step / sqrt(12), or a share of the range if larger.

    The step is the declared one, else that of the lattice on which all readings lie, if any: residuals of readings at
    levels of that lattice would otherwise be 0, and a heavy-tailed noise model would take 0 for the noise sd. The share
    is `recording.least_share_of_span`, 0.001 for a light sensor.
    """
    step = recording.plan.instrumentation.step or lattice_step(recording.readings[recording.usable])
    return max(step / math.sqrt(12.0), recording.least_share_of_span * reading_span(recording))


def sd_ceiling(recording: Recording) -> float:
    """Return the upper bound of the noise sd: the range of the readings, but at least ten times the floor."""
    return max(reading_span(recording), 10.0 * sd_floor(recording))


def student_t_of(recording: Recording, groups: IntArray | None = None) -> StudentT:
    """Build the Student-t likelihood of a recording's usable readings, with its `sd_floor` and `sd_ceiling`.

    Parameters
    ----------
    recording
        The recording.
    groups
        Data set of each row of the plan, (n_points,), each with its own noise sd; by default its scan.
    """
    rows = recording.plan.scan if groups is None else np.asarray(groups)
    return StudentT(rows[recording.usable], sd_floor(recording), sd_ceiling(recording))
