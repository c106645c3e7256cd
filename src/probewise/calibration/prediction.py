"""Predict the readings of any plan with a fitted sensor (paper, eq. 7 and its figure of predicted readings)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from probewise._arrays import FloatArray, floats, own_arithmetic
from probewise.calibration.sensor_file import FittedSensor, require_fitted_sensor
from probewise.effects import EFFECTS, Origin
from probewise.effects.noise_distribution import PredictiveMixture
from probewise.errors import DoubtfulResultWarning, ShapeError, require, warn
from probewise.progress import Progress, silent
from probewise.recordings import Plan, Prediction, Recording
from probewise.recordings.plan import require_patterns_described, require_plan
from probewise.scene import KnownScene

# Numbers held in memory by one block of samples: about 30 MB.
_BLOCK = 4_000_000


@own_arithmetic
def predict(
    sensor: FittedSensor,
    plan: Plan | Recording,
    readings: FloatArray | Sequence[float] | None = None,
    *,
    progress: Progress = silent,
) -> Prediction:
    """Compute the predictive distribution of every row of a plan, and score its readings if there are any.

    Mean and sd are those of a new reading that is not lost, with parameter uncertainty and noise. The density is a
    mixture over the posterior samples of each sample's noise distribution: normal with the pooled sd, modified by the
    sensor's effects on the noise (outliers, losses, signal dependence). If the plan declares a rounding step, or else
    the sensor's calibration did, the density is the mass of the reading's cell divided by the step. Each row is scored
    by its marginal density. New patterns, scans and angles are predicted like any other; effects of single scans are
    left out (see `FittedSensor.chain`). Where the plan declares another height than the calibration, the readings are
    predicted at the plan's height.

    Parameters
    ----------
    plan
        Pose, time and pattern of every reading, n_points rows; or a recording, whose readings are then scored.
    readings
        Measured readings, shape (n_points,), NaN where missing; `None` for a plan or a recording.
    progress
        Called with "predicting", the number of posterior samples done, and their number.

    Returns
    -------
    Prediction
        `log_density` is NaN where a reading is missing or outside the plan's declared range.

    Raises
    ------
    ShapeError, ParameterError
        If readings and rows differ in number; if readings are given with a recording, or the plan reads over a pattern
        that is not described.

    Warns
    -----
    DoubtfulResultWarning
        If the plan's unit is not that of the calibration, the plan commands heights but its description gives none, it
        lacks a column that an effect reads, or it lies before the time from which an effect counts.
    """
    require_fitted_sensor(sensor, "in the order predict(sensor, plan)")
    if isinstance(plan, Recording):
        require(readings is None, "readings", readings, "none together with a recording, which has its own")
        readings, plan = plan.readings, plan.plan
    require_plan(plan)
    require_patterns_described(plan)
    recorded = np.full(len(plan), np.nan) if readings is None else floats(readings, "readings")
    if recorded.shape != (len(plan),):
        raise ShapeError(f"readings have shape {recorded.shape}; allowed: ({len(plan)},), one per row of the plan")
    for doubt in _doubts(sensor, plan):
        warn(doubt, DoubtfulResultWarning)
    scored = Recording(plan, recorded).usable
    step = sensor.instrumentation.step if plan.instrumentation.step is None else plan.instrumentation.step
    chain = sensor.chain(KnownScene(plan.patterns))
    there = chain.plan_at_calibrated_height(plan)  # once, so that the chain lays out the scene once for all blocks
    theta = sensor.samples_for_new_scans
    n_samples, n_points = len(theta), len(plan)
    per_block = max(1, _BLOCK // max(1, n_points * sensor.n_gaussians))

    mixture = PredictiveMixture(recorded, scored, step)
    for first in range(0, n_samples, per_block):
        progress("predicting", first, n_samples)
        block = slice(first, first + per_block)
        noise = chain.noise_parameters(theta[block], there, sensor.noise_sd[block, None])
        mixture.add(chain.predict(theta[block], there), noise)
    return Prediction(plan, *mixture.mean_sd_and_log_density(), recorded)


def _doubts(sensor: FittedSensor, plan: Plan) -> Iterator[str]:
    """Yield what makes predictions of a plan doubtful: another unit, heights, a missing column, another clock."""
    if plan.instrumentation.unit != sensor.instrumentation.unit:
        yield (
            f"the plan's readings are in {plan.instrumentation.unit!r}, "
            f"the sensor was calibrated in {sensor.instrumentation.unit!r}; predictions are in the sensor's"
        )
    if plan.instrumentation.height_mm is None:
        calibrated_mm, column = sensor.instrumentation.height_mm, plan.covariates.get("height_mm", np.empty(0))
        commanded_mm = column[np.isfinite(column)]
        said = "the plan has a column height_mm, but its description gives no height_mm of the sensor"
        # Where all are the height of the calibration, or may be, nothing is lost.
        if (commanded_mm != (commanded_mm[:1] if calibrated_mm is None else calibrated_mm)).any():
            yield f"{said}: predicted as at the height of the calibration"
    for effect in sensor.effects_on_new_scans:
        kind, from_s = EFFECTS[effect.name], sensor.origins.get(effect.name, Origin()).time_s
        for lacking in {*kind.reads} - {*plan.covariates}:
            yield f"the plan has no column {lacking}, which {effect.name} reads: predicted as for its reference value"
        if kind.counts == "time" and (plan.time_s < from_s).all():
            yield (
                f"the plan's times, up to {plan.time_s.max():.12g} s, lie before {from_s:.12g} s, "
                f"from which {effect.name} counts: is it another clock?"
            )
