"""Fit a model with chosen effects, without a search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from probewise._kinds import checked_texts, require_one_of, require_rng
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.samples import ModelSamples, sample_model
from probewise.diagnosis.search.constants import MAX_ORDER
from probewise.diagnosis.search.search import search
from probewise.effects import EFFECTS, Extent, NamedEffect
from probewise.errors import ParameterError
from probewise.recordings.plan import Recording, require_recording
from probewise.sensor import Stage


def model_with(recording: Recording, names: Sequence[str], *, rng: np.random.Generator) -> ModelSamples:
    """Fit the sensor with these effects, at the SSF order (number of Gaussians) with the largest evidence.

    Parameters
    ----------
    recording
        What was read.
    names
        Names of `EFFECTS`, in the vocabulary or out of it; empty for the calibrated sensor alone.
    rng
        Source of randomness, for the posterior samples.

    Returns
    -------
    ModelSamples
        The samples; without any effect on the mean if the search kept no refit with all of them, and without the noise
        effects (but those beyond doubt) if it kept no noise model of just these.

    Raises
    ------
    ParameterError
        If there is no effect of a name, or it cannot act in this recording.
    """
    require_recording(recording)
    require_rng(rng)
    names = checked_texts("names", names, "names of effects")
    extent = Extent.of(recording)
    effects: dict[str, NamedEffect[Any]] = {}
    for name in names:
        require_one_of("names", name, list(EFFECTS))
        effect = EFFECTS[name].for_extent(extent)
        if effect is None:
            raise ParameterError("names", name, "effects of the vocabulary that this recording can show")
        effects[name] = effect
    prepared = Prepared(recording, effects, None, LightSensorApparatus(), recording)
    found = search(prepared, max_order=MAX_ORDER, depth=max(len(names), 1))
    on_mean = tuple(sorted(name for name, effect in effects.items() if effect.stage is not Stage.NOISE))
    on_noise = tuple(sorted(set(names) - set(on_mean)))
    noise = on_noise if on_noise in found.noise_models else found.certain
    best = found.best_refit_of(on_mean, noise) or found.best_refit_of((), noise)
    assert best is not None  # the calibrated sensor is always fitted
    if not np.isfinite(best.evidence[noise].log_z):
        raise ParameterError("names", ", ".join(noise), "effects of the vocabulary that this recording can show")
    return sample_model(best.found, best.evidence[noise], recording, weights=best.weights, rng=rng)
