"""Rivals of an effect: forms that, fitted together with the nominal model, explain it up to a few nats.

First linearised, for every form at once; then by full fits of the closest ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.fit import LeastSquaresFit, ModelWithForms, project_out
from probewise.proof.systems.form import Form, FormWithParameters, TrueSystem, parameter_arrays
from probewise.proof.systems.simulate import apply_reading_effects, simulate_noise_free

TELLING_NATS = 3.0
"""Evidence below which two explanations cannot be distinguished."""

_NEAR = 12.0  # nats within which a form is a rival; linearised ones within which a full fit is made
_COSINE = 0.9
_MOST_FITS = 6
_CHUNK = 160  # settings simulated together
_NEUTRAL = {"level": np.inf, "period": 1.0}


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
    out = []
    for form, changes in templates_of(true, forms, fitted, model).items():
        own = []
        groups = [list(group) for group in form.bank]
        at = 0
        for group in groups:
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


def templates_of(
    true: TrueSystem, forms: Sequence[Form], fitted: LeastSquaresFit, model: ModelWithForms
) -> dict[Form, FloatArray]:
    """Return the change of readings by each setting of a form's bank, about a fit: form to (n_settings, n_points)."""
    settings = {form: [each for group in form.bank for each in group] for form in forms}
    x = fitted.coordinates[None, :]
    parameters, beside = model.parameters_at(x), model.effects_at(x)
    inner = [e for e in beside if e[0].side != "reading"]
    outer = [e for e in beside if e[0].side == "reading"]
    bare = simulate_noise_free(true.kind, true.table, parameters, inner).readings
    out: dict[Form, FloatArray] = {}
    with np.errstate(all="ignore"):
        for form in (f for f in forms if f.side == "reading"):
            unread = np.repeat(bare, len(settings[form]), axis=0)
            out[form] = (
                apply_reading_effects(unread, true.table, [*outer, (form, parameter_arrays(settings[form]))])
                - fitted.readings
            )
        alone, together = _split_by_way_of_simulation(true, [f for f in forms if f.side != "reading"])
        for form in alone:
            found = _simulated_or_nan(
                true, parameters, [*beside, (form, parameter_arrays(settings[form]))], len(settings[form])
            )
            out[form] = found - fitted.readings
        for chunk in _chunks_of_forms(together, settings):
            out |= _changes_of_chunk(true, chunk, settings, fitted, model)
    return out


def _split_by_way_of_simulation(true: TrueSystem, forms: Sequence[Form]) -> tuple[list[Form], list[Form]]:
    """Return forms to be simulated each alone (friction, bounds, or no law), and forms that share one integration."""
    alone = [f for f in forms if f.sticks or f.stops or true.kind.law is None]
    return alone, [f for f in forms if f not in alone]


def _chunks_of_forms(forms: Sequence[Form], settings: dict[Form, list[dict[str, float]]]) -> list[list[Form]]:
    out: list[list[Form]] = []
    n = _CHUNK
    for form in forms:
        if n + len(settings[form]) > _CHUNK:
            out.append([])
            n = 0
        out[-1].append(form)
        n += len(settings[form])
    return out


def _changes_of_chunk(
    true: TrueSystem,
    forms: Sequence[Form],
    settings: dict[Form, list[dict[str, float]]],
    fitted: LeastSquaresFit,
    model: ModelWithForms,
) -> dict[Form, FloatArray]:
    """Return as `templates_of`, for forms simulated at once: each has neutral parameters in the others' samples."""
    ends = np.cumsum([len(settings[form]) for form in forms])
    total, x = int(ends[-1]), fitted.coordinates[None, :]
    placed = []
    for form, end in zip(forms, ends, strict=True):
        own = parameter_arrays(settings[form])
        numbers = {}
        for name, values in own.items():
            whole = np.full((total, 1), _NEUTRAL.get(name, 0.0))
            whole[end - len(values) : end] = values
            numbers[name] = whole
        # For screening, a delayed column may be interpolated; a full fit treats its jumps exactly.
        placed.append((replace(form, late=""), numbers))
    found = _simulated_or_nan(true, model.parameters_at(x), [*model.effects_at(x), *placed], total) - fitted.readings
    if len(forms) > 1 and not np.isfinite(found).all():  # one of them diverges, which stops the integration of all
        return {
            form: each
            for own in forms
            for form, each in _changes_of_chunk(true, [own], settings, fitted, model).items()
        }
    return {form: found[end - len(settings[form]) : end] for form, end in zip(forms, ends, strict=True)}


def _simulated_or_nan(
    true: TrueSystem, parameters: Mapping[str, FloatArray], effects: Sequence[FormWithParameters], n: int
) -> FloatArray:
    """Return noise-free readings, (n, n_points), all NaN if the law diverges."""
    try:
        return simulate_noise_free(true.kind, true.table, parameters, effects).readings
    except NotConvergedError:
        return np.full((n, len(true.table)), np.nan)


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
