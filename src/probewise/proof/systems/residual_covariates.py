"""Covariates along which the residual of an effect is most visible."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.proof.systems.forms.form import Form
from probewise.proof.systems.forms.true_system import TrueSystem

_BINS = 20
_AS_PLAIN = 0.9  # share of the best covariate's explained variance that counts as equal
_PLAIN = 0.25  # least explained share of the sum of squares


def residual_covariates_of(form: Form, residuals: FloatArray, true: TrueSystem) -> tuple[str, ...]:
    """Return names that a diagnosis may rank first: the form's covariates, then others that explain about as much.

    Parameters
    ----------
    form
        The concealed form.
    residuals
        Residuals after the refit of the nominal model, (n_points,).
    true
        The system.
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
