"""The model with exactly the concealed effects, fitted to the same readings: the best possible identification."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.cases import SystemCase
from probewise.proof.systems.chain import simulate_noise_free
from probewise.proof.systems.fit import AddedForm, ModelWithForms, names_of_fitted_parameters
from probewise.proof.systems.forms.form import Numbers

_MOMENTS = 8  # distinct values of a dead time over samples, since the integration stops at each of them in every gap


def right_predictions(case: SystemCase, n_samples: int, *, rng: np.random.Generator) -> FloatArray:
    """Predict the held-out rows by posterior samples of the model with the concealed effects, (n_samples, n_rows).

    Samples are from the Gaussian approximation about the least-squares fit; `per_run` parameters of the held-out runs
    are drawn from the prior. Raises NotConvergedError if the fit diverges.
    """
    drawn, kind = case.drawn, case.drawn.kind
    beside = [AddedForm(e.form, e.values, names_of_fitted_parameters(e.form)) for e in case.effects]
    model = ModelWithForms(kind, drawn.diagnosed_table, beside)
    fitted = model.fit(case.readings[drawn.diagnosed_row_numbers], model.coordinates_of(drawn.shared, drawn.by_run))
    _, s, vt = np.linalg.svd(fitted.slopes / kind.sd, full_matrices=False)
    wide = np.where(s > 1e-6 * s.max(), 1 / np.maximum(s, 1e-300), 0.0)
    x = fitted.coordinates + (rng.standard_normal((n_samples, len(s))) * wide) @ vt
    for k, name in enumerate(name for b in beside for name in b.free):
        if name == "tau_s" and kind.law is not None:
            x[:, model.n_nominal_coordinates + k] = _rounded_to_quantiles(x[:, model.n_nominal_coordinates + k])
    later = drawn.table.select_rows(np.flatnonzero(drawn.table.run >= drawn.table.n_runs - 2))
    ahead = ModelWithForms(kind, later, beside)
    n_shared = len(kind.shared_parameter_names)
    n_runs = len(later.rows_by_run)
    own = [
        np.stack(
            [
                kind.priors[name].coordinate(kind.priors[name].stratified_draws(n_samples, rng=rng))
                for _ in range(n_runs)
            ],
            axis=1,
        )
        for name in kind.per_run
    ]
    parts = [x[:, :n_shared], *own, x[:, model.n_nominal_coordinates :]]
    there = np.concatenate(parts, axis=1)
    effects = [
        (form, _with_unseen_runs_at_mean(numbers, b.free))
        for (form, numbers), b in zip(ahead.effects_at(there), beside, strict=True)
    ]
    with np.errstate(all="ignore"):
        return simulate_noise_free(kind, later, ahead.parameters_at(there), effects).readings


def _with_unseen_runs_at_mean(numbers: Numbers, free: Sequence[str]) -> Numbers:
    """Return a form's parameters, with "values[k]" of held-out runs set to the mean of the fitted runs."""
    fitted = [numbers[name] for name in free if name.startswith("values[")]
    if not fitted:
        return numbers
    typical = np.mean(fitted, axis=0)
    return {k: typical if k.startswith("values[") and k not in free else v for k, v in numbers.items()}


def _rounded_to_quantiles(values: FloatArray) -> FloatArray:
    """Round each value (n_samples,) to the nearest of eight quantiles of all."""
    few = np.quantile(values, (np.arange(_MOMENTS) + 0.5) / _MOMENTS)
    return np.asarray(few[np.searchsorted(0.5 * (few[1:] + few[:-1]), values)])
