"""Rivals of an effect: forms that, fitted together with the nominal model, explain it up to a few nats.

First linearised, for every form at once; then by full fits of the closest ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.fit import LeastSquaresFit, ModelWithForms, project_out
from probewise.proof.systems.form import Form, TrueSystem, parameter_arrays
from probewise.proof.systems.simulate import apply_reading_effects, simulate_noise_free

TELLING_NATS = 3.0
"""Evidence below which two explanations cannot be distinguished."""

_NEAR = 12.0  # nats within which a form is a rival; linearised ones within which a full fit is made
_COSINE = 0.9
_MOST_FITS = 6


def vocabulary_name(form: Form) -> str:
    """Return a form's name in the vocabulary: that of "saturation (floor)" is "saturation"."""
    return form.name.removesuffix(" (floor)")


def _has_costly_fit(form: Form) -> bool:
    return form.sticks or form.stops or bool(form.late)


@dataclass(frozen=True, eq=False)
class StartOfFit:
    """Where the fit of a form begins: start values of its parameters, and the linearised loss there, nats."""

    form: Form
    start: dict[str, float]
    nats: float


def rivals_with_nats(
    true: TrueSystem,
    forms: Sequence[Form],
    target: FloatArray,
    fitted: LeastSquaresFit,
    model: ModelWithForms,
    without: frozenset[str],
) -> dict[str, float]:
    """Find the forms that explain an effect's noise-free readings nearly as well as the effect itself, six at most.

    `forms`: forms to try; `target`: noise-free readings with the effect, (n_points,); `fitted`, `model`: the fit to
    `target` without the effect: the nominal model with the other concealed effects; `without`: names not to try.
    Returns loss of log likelihood in nats by name, for those below 12, the smallest first; below TELLING_NATS (3):
    aliases.
    """
    left = project_out((target - fitted.readings) / true.noise_sd, fitted.slopes)
    near = _best_by_linearisation(true, [f for f in forms if vocabulary_name(f) not in without], left, fitted, model)
    found: dict[str, float] = {}
    hard = any(_has_costly_fit(b.form) for b in model.added)
    for candidate in near:
        name = vocabulary_name(candidate.form)
        if hard:  # fits with dry friction or a bound take minutes: the linearised result is used
            found[name] = min(candidate.nats, found.get(name, np.inf))
            continue
        wider, begin = model.with_form(candidate.form, candidate.start, fitted.coordinates)
        try:
            again = wider.fit(target, begin, max_calls=5 if _has_costly_fit(candidate.form) else 7)
        except NotConvergedError:
            continue
        found[name] = min(0.5 * again.chi_square, found.get(name, np.inf))
    close = {name: nats for name, nats in found.items() if nats < _NEAR}
    return dict(sorted(close.items(), key=lambda item: item[1]))


def _best_by_linearisation(
    true: TrueSystem, forms: Sequence[Form], left: FloatArray, fitted: LeastSquaresFit, model: ModelWithForms
) -> list[StartOfFit]:
    """Return up to six candidates for full fits, smallest linearised loss first, with at most two starts per form."""
    size = float(left @ left)
    near = [
        candidate
        for candidate in linearised_starts(true, forms, left, fitted, model)
        if candidate.nats < _NEAR or 1 - 2 * candidate.nats / size > _COSINE**2
    ]
    return sorted(near, key=lambda c: c.nats)[:_MOST_FITS]


def linearised_starts(
    true: TrueSystem, forms: Sequence[Form], left: FloatArray, fitted: LeastSquaresFit, model: ModelWithForms
) -> list[StartOfFit]:
    """Return up to two starts of each form for a fit beside `model`: those of the smallest linearised loss.

    `left`, (n_points,), are the residuals in noise sds, less what the fit's own coordinates could still absorb.
    """
    x, out = fitted.coordinates[None, :], []
    inner = [effect for effect in model.effects_at(x) if effect[0].side != "reading"]
    bare = simulate_noise_free(true.kind, true.table, model.parameters_at(x), inner).readings
    for form in forms:
        own, at = [], 0
        changes = _changes_by_bank(true, form, bare, fitted, model)
        for group in form.bank:
            columns = project_out(changes[at : at + len(group)].T / true.noise_sd, fitted.slopes)
            at += len(group)
            good = np.isfinite(columns).all(axis=0) & (np.sqrt(np.sum(columns**2, axis=0)) > 1e-6)
            if not good.any():
                continue
            columns = np.where(good, np.nan_to_num(columns), 0.0)
            amounts, *_ = np.linalg.lstsq(columns, left, rcond=1e-9)
            rest = left - columns @ amounts
            nats = 0.5 * float(rest @ rest)
            own.append(StartOfFit(form, form.start_values(group, np.asarray(amounts, dtype=np.float64)), nats))
        out += sorted(own, key=lambda c: c.nats)[:2]
    return out


def _changes_by_bank(
    true: TrueSystem, form: Form, bare: FloatArray, fitted: LeastSquaresFit, model: ModelWithForms
) -> FloatArray:
    """Return the change of readings by each setting of a form's bank, (n_settings, n_points); NaN where it diverges.

    `bare`, (1, n_points), are the readings of the model without its effects on readings.
    """
    settings = [each for group in form.bank for each in group]
    # For screening, a delayed column may be interpolated; a full fit treats its jumps exactly.
    tried = form if true.kind.law is None else replace(form, late="")
    x, more = fitted.coordinates[None, :], (tried, parameter_arrays(settings))
    effects = [*model.effects_at(x), more]
    try:
        with np.errstate(all="ignore"):
            if form.side == "reading":
                readings = apply_reading_effects(np.repeat(bare, len(settings), axis=0), true.table, effects)
            else:
                readings = simulate_noise_free(true.kind, true.table, model.parameters_at(x), effects).readings
    except NotConvergedError:
        return np.full((len(settings), len(true.table)), np.nan)
    return readings - fitted.readings


_BINS = 20
_AS_PLAIN = 0.9  # share of the best covariate's explained variance that counts as equal
_PLAIN = 0.25  # least explained share of the sum of squares


def residual_covariates_of(form: Form, residuals: FloatArray, true: TrueSystem) -> tuple[str, ...]:
    """Return names that a diagnosis may rank first: the form's covariates, then others that explain about as much.

    `form`: the concealed form; `residuals`: residuals after the refit of the nominal model, (n_points,).
    """
    rows = true.table
    pooled = {name: values for name, values in rows.columns.items() if name != rows.time}
    pooled |= {"level": true.readings, "previous": _change_from_previous_row(true)}
    pooled |= {f"state:{name}": values for name, values in true.states.items()}
    if rows.time is not None:
        pooled["time"] = rows.t
    shares = {
        name: _excess_share_explained_by_groups(residuals, _bin_numbers(values)) for name, values in pooled.items()
    }
    if len(rows.rows_by_run) > 1:
        shares["run"] = _excess_share_explained_by_groups(residuals, rows.run)
    best = max(shares.values())
    plain = [name for name, share in shares.items() if share >= _AS_PLAIN * best and share > _PLAIN]
    return tuple(dict.fromkeys((*form.covariates, *sorted(plain, key=lambda name: -shares[name]))))


def _change_from_previous_row(true: TrueSystem) -> FloatArray:
    out = np.zeros(len(true.table))
    for own in true.table.rows_by_run:
        out[own[1:]] = np.diff(true.readings[own])
    return out


def _bin_numbers(values: FloatArray) -> FloatArray:
    edges = np.unique(np.quantile(values, np.linspace(0, 1, _BINS + 1)))
    return np.asarray(np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0)))


def _excess_share_explained_by_groups(residuals: FloatArray, groups: FloatArray | IntArray) -> float:
    """Return the share of the sum of squares that group means explain, minus its expectation for white noise."""
    total, explained, n_groups = float(residuals @ residuals), 0.0, 0
    for group in np.unique(groups):
        own = residuals[groups == group]
        explained += len(own) * float(own.mean()) ** 2
        n_groups += 1
    return explained / total - n_groups / len(residuals)
