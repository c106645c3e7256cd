"""Log predictive densities of held-out readings under the null, repaired, right and true models."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration import FittedSensor, predict
from probewise.diagnosis import Diagnosis, model_with
from probewise.effects import VOCABULARY, Extent
from probewise.effects.noise_distribution import log_gaussian_density
from probewise.errors import ParameterError
from probewise.proof.sensors import NO_PHYSICS, Case, held_out_recordings
from probewise.recordings.plan import Recording


def log_densities_of_scans(
    case: Case, diagnosis: Diagnosis, *, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """Return the log predictive density of each held-out scan under up to four models, in nats, summed over readings.

    "null" and "repaired" are the diagnosis's models without effects and with those found. "right", if all concealed
    effects are in the vocabulary and detectable in this plan, is the model with exactly these effects, fitted to the
    same readings. "true" is an upper limit (exact for white noise): it knows the noise-free readings and the noise sd.

    Returns
    -------
    Values by name of the scan ("angle", "pattern", "direction"), then of the model.
    """
    fitting, *drawing = rng.spawn(4)
    models = {"null": diagnosis.null, "repaired": diagnosis.repaired}
    extent = Extent.of(case.recording)
    names = [h.name for h in case.truth.hidden if h.name not in NO_PHYSICS and h.name in VOCABULARY]
    showing = [name for name in names if VOCABULARY[name].for_extent(extent) is not None]
    if showing and len(showing) == len(case.truth.hidden):
        with suppress(ParameterError):  # under a model with dropouts, none of these readings was lost
            models["right"] = model_with(case.recording, showing, rng=fitting)
    scans = held_out_recordings(case)
    scores: dict[str, dict[str, float]] = {}
    for (name, samples), child in zip(models.items(), drawing, strict=False):
        if name == "repaired" and samples is diagnosis.null:  # nothing is concealed: the right model is the null
            scores[name] = scores["null"]
            continue
        sensor = samples.fitted_sensor(diagnosis.recording, rng=child)
        scores[name] = {scan: _total_log_density(sensor, recording) for scan, recording in scans.items()}
    scores["true"] = {
        scan: _true_log_density(case.world.expected_readings(recording.plan), case.world.noise_sd, recording)
        for scan, recording in scans.items()
    }
    return {scan: {name: own[scan] for name, own in scores.items()} for scan in scans}


def _total_log_density(sensor: FittedSensor, recording: Recording) -> float:
    return float(np.nansum(predict(sensor, recording.plan, recording.readings).log_density))


def _true_log_density(expected: FloatArray, sd: float, recording: Recording) -> float:
    return float(log_gaussian_density(recording.readings, expected, sd)[recording.usable].sum())
