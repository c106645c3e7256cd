"""What explains a case: the model with exactly its effects (the best possible identification), and other effects."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.cases import DrawnSystem, SystemCase
from probewise.proof.systems.fit import (
    AddedForm,
    LeastSquaresFit,
    ModelWithForms,
    project_out,
)
from probewise.proof.systems.form import Form, Numbers
from probewise.proof.systems.forms import forms_of
from probewise.proof.systems.rivals import linearised_starts, vocabulary_name
from probewise.proof.systems.simulate import simulate_noise_free

_MOMENTS = 8  # distinct values of a dead time over samples, since the integration stops at each of them in every gap


def right_predictions(case: SystemCase, n_samples: int, *, rng: np.random.Generator) -> FloatArray:
    """Predict the held-out rows by posterior samples of the model with the concealed effects, (n_samples, n_rows).

    Samples are from the Gaussian approximation about the least-squares fit; `per_run` parameters of the held-out runs
    are drawn from the prior. Raises NotConvergedError if the fit diverges.
    """
    drawn, kind = case.drawn, case.drawn.kind
    beside = [AddedForm(e.form, e.values) for e in case.effects]
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


_MOST_NAMES = 2
_N_STARTS = 2  # of each effect, those of the least linearised loss
_N_CHANGE_POINTS = 80


def nats_of_alternative(case: SystemCase, names: Sequence[str]) -> float:
    """Return how many nats of log likelihood the best fit of other effects loses on a case's noise-free readings.

    `case`: the case, with one concealed effect or more; `names`: one or two names of the vocabulary, with their
    targets; fitted together with the nominal model. Returns the loss, 0 or more; infinite for more names, for those
    that this system does not have, and where no fit converges.
    """
    drawn = case.drawn
    forms = [_forms_of_name(drawn, name) for name in names]
    if not 0 < len(names) <= _MOST_NAMES or not all(forms):
        return np.inf
    target = drawn.simulate_diagnosed_rows([effect.form_with_parameters for effect in case.effects])
    start = drawn.nominal_model.fit(target, drawn.true_coordinates)
    # Which effect is added first decides where the fit begins.
    orders = list(itertools.permutations(forms))
    return min(_least_nats(drawn, target, drawn.nominal_model, start, order) for order in orders)


def _least_nats(
    drawn: DrawnSystem, target: FloatArray, model: ModelWithForms, fitted: LeastSquaresFit, more: Sequence[list[Form]]
) -> float:
    """Add effects, one of each list of forms, to a fit one after the other; return the least loss, nats."""
    if not more:
        return 0.5 * fitted.chi_square
    left = project_out((target - fitted.readings) / drawn.true_system.noise_sd, fitted.slopes)
    starts = linearised_starts(drawn.true_system, more[0], left, fitted, model)
    found = [np.inf]
    for candidate in sorted(starts, key=lambda candidate: candidate.nats)[:_N_STARTS]:
        wider, begin = model.with_form(candidate.form, candidate.start, fitted.coordinates)
        try:
            again = wider.fit(target, begin, max_calls=12)
        except NotConvergedError:
            continue
        found.append(_least_nats(drawn, target, wider, again, more[1:]))
    return min(found)


def _forms_of_name(drawn: DrawnSystem, name: str) -> list[Form]:
    """Return the forms of a name of the vocabulary in this system, steps at many times; none if it has no such form."""
    return [
        _with_many_change_points(form, drawn) for form in forms_of(drawn.true_system) if vocabulary_name(form) == name
    ]


def _with_many_change_points(form: Form, drawn: DrawnSystem) -> Form:
    """Return a form whose bank has a step, if it is one, at 80 quantiles of the rows and at the start of each run."""
    first = form.bank[0][0]
    at = next((key for key in ("at_s", "at_row") if key in first), None)
    if at is None:
        return form
    table = drawn.diagnosed_table
    along = table.t if at == "at_s" else np.arange(float(len(table)))
    between = np.unique(0.5 * (np.sort(along)[1:] + np.sort(along)[:-1]))
    starts = [0.5 * (along[own[0]] + along[own[0] - 1]) for own in table.rows_by_run if own[0] > 0]
    moments = np.unique([*np.quantile(between, np.linspace(0, 1, _N_CHANGE_POINTS), method="nearest"), *starts])
    return replace(form, bank=[[{**first, at: float(moment)}] for moment in moments])
