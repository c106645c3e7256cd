"""Log predictive densities of a system's two held-out runs under the null, repaired, right and true models."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.diagnosis import Diagnosis, ModelSamples
from probewise.diagnosis.simulator_rows import SimulatorApparatus
from probewise.effects.noise_distribution import log_gaussian_density
from probewise.errors import NotConvergedError
from probewise.proof.systems import SystemCase, right_predictions
from probewise.systems import RunTable
from probewise.systems.forms import ReferenceFit
from probewise.systems.forms.binding import extract_stored_fit, has_value_per_run, rebind_forms
from probewise.systems.prediction import draw_value_for_new_run
from probewise.systems.system import SystemChain

_N_SAMPLES = 200
_N_OF_A_RUN = 4000  # for parameters per run: their prior is wide, and the density must not depend on a few draws


def log_densities_of_runs(
    case: SystemCase, diagnosis: Diagnosis, later: RunTable, *, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """Return the log predictive density of each held-out run under up to four models, in nats, summed over readings.

    "null" and "repaired" are the diagnosis's models without effects and with those found. "right" is the model with
    exactly the concealed effects, fitted by the simulator; absent without effects or if the fit fails. "true" knows the
    noise-free reading.

    Returns
    -------
    Values by run, "inside" the range of the recorded runs and "beyond" it, then by model; not finite ones are left out.
    """
    fitting, *drawing = rng.spawn(3)
    readings = later.covariates[case.drawn.kind.reading]
    sd = case.drawn.kind.sd
    rows = np.flatnonzero(case.drawn.table.run >= case.drawn.table.n_runs - 2)
    about = cast(SimulatorApparatus, diagnosis.apparatus).about
    scores = {
        "null": _log_mean_density(*predict_runs(diagnosis.null, about, later, rng=drawing[0]), readings),
        "true": _log_mean_density(case.noise_free[None, rows], np.array([sd]), readings),
    }
    same = diagnosis.repaired is diagnosis.null
    scores["repaired"] = (
        scores["null"]
        if same
        else _log_mean_density(*predict_runs(diagnosis.repaired, about, later, rng=drawing[1]), readings)
    )
    if case.effects:
        try:
            right = right_predictions(case, _N_OF_A_RUN if case.drawn.kind.per_run else _N_SAMPLES, rng=fitting)
            scores["right"] = _log_mean_density(right, np.full(len(right), sd), readings)
        except NotConvergedError:
            pass  # no fit was possible, so the case does not count for the share
    run = case.drawn.table.run[rows]
    names = {case.drawn.table.n_runs - 2: "inside", case.drawn.table.n_runs - 1: "beyond"}
    return {
        name: {model: float(own[run == k].sum()) for model, own in scores.items() if np.isfinite(own[run == k]).all()}
        for k, name in names.items()
    }


def predict_runs(
    samples: ModelSamples, about: ReferenceFit, table: RunTable, *, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Predict new runs: noise-free readings (n_samples, n_points), and the sd of a reading (n_samples,).

    Parameters per run are drawn from their prior, and an effect's values per run as `predict_system` draws them.

    Parameters
    ----------
    samples
        Posterior samples of the model.
    about
        The reference fit of the diagnosis, from which its effects have their scales.
    table
        The new runs.
    rng
        Random generator, for the choice of samples and for the values per run.
    """
    chain = cast(SystemChain, samples.chain)
    system = chain.system.with_added_runs(table)
    own = [effect.name for effect in chain.effects if has_value_per_run(effect.name)]
    longer = rebind_forms(own, system.simulator, extract_stored_fit(about), more_runs=table.scan_names)
    effects = tuple(longer.get(effect.name, effect) for effect in chain.effects)
    wider = replace(chain, system=system, effects=effects)
    of_run = [name for name in wider.names if name not in chain.names]
    n = _N_OF_A_RUN if of_run else _N_SAMPLES
    chosen = rng.permutation(np.arange(n) % len(samples.theta))
    known = dict(zip(chain.names, samples.theta[chosen].T, strict=True))
    drawn = {}
    for name in of_run:
        if name in system.marginals:  # stratified: one from each of n parts of equal prior mass
            drawn[name] = system.marginals[name].from_unit((rng.permutation(n) + rng.random(n)) / n)
        else:
            effect = next(own_name for own_name in own if name.startswith(f"{own_name}."))
            drawn[name] = draw_value_for_new_run(samples.effect_samples(effect)[chosen], rng=rng)
    theta = np.stack([(known | drawn)[name] for name in wider.names], axis=1)
    with np.errstate(all="ignore"):
        predicted = np.concatenate([wider.predict(part, table) for part in np.array_split(theta, max(n // 500, 1))])
    return predicted, samples.noise_sd[chosen]


def _log_mean_density(predicted: FloatArray, sd: FloatArray, readings: FloatArray) -> FloatArray:
    """Return the log of the mean density over samples, (n_points,), of readings predicted with `sd` (n_samples,)."""
    each = log_gaussian_density(readings, predicted, sd[:, None])
    return np.asarray(logsumexp(each, axis=0) - math.log(len(each)))
