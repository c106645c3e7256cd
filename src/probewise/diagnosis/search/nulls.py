"""Fit the null without effects: as it is given, or in each form that is calibrated from the recording."""

from __future__ import annotations

import math

import numpy as np

from probewise.diagnosis.fitting.fit import Model, fit_each_start
from probewise.diagnosis.fitting.ssf_forms import Start
from probewise.diagnosis.noise.law import NoiseLaw, white_noise_of_recording
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.search.constants import STEERING
from probewise.diagnosis.search.state import SearchState
from probewise.diagnosis.search.weighed_fit import WeighedFit
from probewise.effects import lattice_step

_MOST_EXACT = 0.25  # share of the readings, those of the smallest declared sds, in which rounding shows first


def fit_nulls(state: SearchState, prepared: Prepared, *, max_order: int) -> None:
    """Fit the given null; if there is none, each form of the SSF: one Gaussian, the free form, more Gaussians.

    At most `max_order` + 1 Gaussians, and no more once a fit is three nats behind the best; one Gaussian alone if
    `max_order` is 1. The fits are stored in the state. Then pairs of noise effects are added to the noise models, if
    single ones are significant.
    """
    noises, refits, null = state.noises, state.refits, prepared.null
    recording = prepared.recording
    plan, law = recording.plan, white_noise_of_recording(recording, least=noises.least_sd)

    n_forms = 1 if null is not None or max_order == 1 else max_order + 2

    def fit_and_keep(form: Start, law: NoiseLaw) -> WeighedFit:
        state.progress("fitting the sensor alone", len(state.sensors), n_forms)
        sensor, starts = form
        state.sensors[sensor.n_gaussians] = sensor
        return state.store_candidate(refits.fit_and_weigh(Model(sensor, (), plan), starts, law))

    if null is not None:
        fit_and_keep((null, null.starts), law)
    else:
        forms = prepared.apparatus.null_forms(recording)
        last = fit_and_keep(forms.one_gaussian_and_starts(), law)
        if max_order > 1:
            best = max(
                fit_and_keep(forms.free_form_and_starts(last.found), refits.likeliest_law(last)).log_z, last.log_z
            )
            for n in range(2, max_order + 2):
                # One more than the best is always a rival; beyond one that is far behind nothing is to be found.
                if n > 2 and last.log_z < best - STEERING:
                    break
                last = fit_and_keep(forms.more_gaussians_and_starts(last.found, n), refits.likeliest_law(last))
                best = max(best, last.log_z)
    if noises.add_significant_pairs(state.null.found, state.null.evidence):
        state.progress("weighing pairs of noises")
        for candidate in state.nulls:
            state.store_candidate(candidate.with_evidence(noises.evidence_by_noise(candidate.found)))


def noise_sd_about_given_null(prepared: Prepared) -> float:
    """Estimate the noise sd, rounding included, from residuals about the given null, by their median.

    Of readings with declared sds, it is that of the most exact. A null with one start is taken there: it is an earlier
    fit, or a calibration. Infinite without a given null, and where the readings lie on no lattice, since it serves to
    judge rounding alone.
    """
    null, recording, rows = prepared.null, prepared.recording, prepared.usable_rows
    readings = recording.readings[rows]
    step = lattice_step(readings)
    if null is None or not step:
        return math.inf
    model, starts = Model(null, (), recording.plan), null.starts
    if len(starts) > 1:
        law = white_noise_of_recording(recording)
        z = min(fit_each_start(model, recording, list(starts), law), key=lambda found: found.objective).z
    else:
        z = starts[0]
    with np.errstate(all="ignore"):  # of a start from which the model runs away
        residuals = np.abs(readings - model.predict(z[None, :])[0, rows])
    relative_sd = recording.relative_sd[rows]
    median = float(np.median(residuals[relative_sd <= np.quantile(relative_sd, _MOST_EXACT)])) / 0.6745
    free = max(len(rows) - model.n_params, 1)
    # Readings that are all as predicted still have the sd of rounding.
    return max(median, step / math.sqrt(12)) * math.sqrt(len(rows) / free) if math.isfinite(median) else math.inf
