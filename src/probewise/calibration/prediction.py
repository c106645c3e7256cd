"""Predict the readings of any plan by a fitted sensor (paper, eq. "modelI" and its figure of predicted readings)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from probewise._arrays import FloatArray, floats
from probewise.calibration.distinct import DistinctRows
from probewise.calibration.sensor_file import FittedSensor, require_sensor
from probewise.effects import PredictiveMixture
from probewise.errors import DoubtfulResultWarning, ParameterError, ShapeError
from probewise.progress import Progress, silent
from probewise.recordings import Plan, Prediction, Recording
from probewise.recordings.plan import require_described, require_plan
from probewise.scene import KnownScene

__all__ = ["predict"]

# Numbers held at once by one pass over a block of samples: about 30 MB.
_BLOCK = 4_000_000


def predict(
    sensor: FittedSensor,
    plan: Plan | Recording,
    readings: FloatArray | Sequence[float] | None = None,
    *,
    progress: Progress = silent,
) -> Prediction:
    """Predict every row of a plan, and score its readings where there are any.

    Mean and sd are those of one new reading that is not lost, parameter uncertainty and noise together.
    The density is the mixture, over the posterior samples, of the law of that sample's noise about its
    prediction: normal with the pooled sd, and as the sensor's effects on the noise have it (a tail,
    losses, a spread that follows the signal). Where the plan declares a quantisation step, or the sensor
    has one, it is the mass of the reading's cell divided by the step. Each row is scored alone. New
    patterns, scans and angles are predicted like any other; an effect that belongs to one scan plays no
    part (see `FittedSensor.chain`).

    Parameters
    ----------
    sensor
        The fitted sensor.
    plan
        Where, when and over what to read, n_points rows; or a recording, whose readings are then scored.
    readings
        What was read, shape (n_points,), NaN where missing; `None` for a plan, and where a recording is given.
    progress
        Told how many posterior samples have predicted.

    Returns
    -------
    Prediction
        `log_density` is NaN where a reading is missing or out of the plan's declared range.

    Raises
    ------
    ShapeError
        If there are not as many readings as rows.

    Warns
    -----
    DoubtfulResultWarning
        If the plan declares another unit than the sensor was calibrated in, or lacks a column that an effect reads.
    """
    require_sensor(sensor, "in the order predict(sensor, plan)")
    if isinstance(plan, Recording):
        if readings is not None:
            raise ParameterError("readings", readings, "none beside a recording, which has its own")
        readings, plan = plan.readings, plan.plan
    require_plan(plan)
    require_described(plan)
    recorded = np.full(len(plan), np.nan) if readings is None else floats(readings, "readings")
    if recorded.shape != (len(plan),):
        raise ShapeError(f"readings have shape {recorded.shape}; allowed: ({len(plan)},), one a row of the plan")
    if plan.instrumentation.unit != sensor.instrumentation.unit:
        warnings.warn(
            f"the plan's readings are in {plan.instrumentation.unit!r}, "
            f"the sensor was calibrated in {sensor.instrumentation.unit!r}; predictions are in the sensor's",
            DoubtfulResultWarning,
            stacklevel=2,
        )
    scored = Recording(plan, recorded).usable
    step = plan.instrumentation.step
    chain = sensor.chain(KnownScene(plan.patterns))
    model = chain if sensor.effects else DistinctRows(chain, plan)
    for effect in sensor.carried_effects:
        for column in {*getattr(effect, "reads", ())} - {*plan.covariates}:
            warnings.warn(
                f"the plan has no column {column}, which {effect.name} reads: predicted as for its reference value",
                DoubtfulResultWarning,
                stacklevel=2,
            )
    theta = sensor.carried_samples
    n_samples, n_points = len(theta), len(plan)
    per_block = max(1, _BLOCK // max(1, n_points * sensor.n_gaussians))

    mixture = PredictiveMixture(recorded, scored, step)
    for first in range(0, n_samples, per_block):
        progress("predicting", first, n_samples)
        block = slice(first, first + per_block)
        level = chain.noise_level(theta[block], plan, sensor.noise_sd[block, None])
        mixture.add(model.predict(theta[block], plan), level)
    return Prediction(plan, *mixture.finished(), recorded)
