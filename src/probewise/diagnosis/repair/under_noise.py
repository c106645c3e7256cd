"""A model under the noise that was found, and its residuals beside a random walk."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.fit import Fit, fit_each_start
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.noise.memory import walk_given_readings
from probewise.diagnosis.search.weighed_fit import WeighedFit
from probewise.recordings.plan import Recording


def fit_under_noise(candidate: WeighedFit, law: NoiseLaw, recording: Recording) -> Fit:
    """Return a candidate's fit, repeated under a noise distribution if that or its own contains a random walk.

    A walk begins at 0 before the first row: it ties the mean to the first readings and leaves it far from the others.
    So a fit with a walk shows no model without one, and other noise hardly moves a fit. Without a walk, the null's
    starts are tried too.
    """
    found, own = candidate.found, candidate.law
    if not (law.walk.size or own.walk.size) or law.is_practically_equal(own):
        return found
    sensor = found.model.sensor
    starts = [found.z]
    if not law.walk.size:
        starts += [np.concatenate([start, found.z[sensor.n_params :]]) for start in sensor.starts]
    again = min(fit_each_start(found.model, recording, starts, law), key=lambda each: each.objective)
    return again if np.isfinite(again.objective) else found


def residuals_beside_walk(residuals: FloatArray, law: NoiseLaw) -> FloatArray:
    """Return residuals without the random walk that they all together show, if the noise has one, (n_usable,)."""
    return residuals - walk_given_readings(law, residuals)
