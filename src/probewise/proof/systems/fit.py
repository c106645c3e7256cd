"""Least squares with the simulator's own model: residuals of an effect after a full refit of the nominal model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.form import Form, FormWithParameters
from probewise.proof.systems.kind import SystemKind, SystemTable
from probewise.proof.systems.simulate import simulate_noise_free

_STEP = 1e-4  # step of a coordinate for derivatives
_FORM_STEP = 0.1  # of the form's own step
_FAR = 1e9  # residual in sds where a law diverges


@dataclass(frozen=True, eq=False)
class AddedForm:
    """A form in a model, and start values of its parameters by name."""

    form: Form
    start: Mapping[str, float]

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the fitted parameters: not a step's time, nor values of runs without rows."""
        return tuple(name for name, step in self.form.steps.items() if step > 0)


@dataclass(frozen=True, eq=False)
class LeastSquaresFit:
    """A fit: coordinates, readings (n_points,), their derivatives (n_points, n_coordinates), chi-square (true sd)."""

    coordinates: FloatArray
    readings: FloatArray
    slopes: FloatArray
    chi_square: float


@dataclass(frozen=True, eq=False)
class ModelWithForms:
    """A nominal model with additional forms, as a function of coordinates.

    Coordinates, in this order: shared parameters (`Prior.coordinate`), each `per_run` parameter in every run of the
    table, and the fitted parameters of the forms in units of a tenth of `Form.steps`.
    """

    kind: SystemKind
    table: SystemTable
    added: Sequence[AddedForm] = field(default=())

    @cached_property
    def _run_numbers(self) -> list[int]:
        return [int(self.table.run[own[0]]) for own in self.table.rows_by_run]

    @property
    def n_nominal_coordinates(self) -> int:
        """Number of coordinates of the nominal model."""
        return len(self.kind.shared_parameter_names) + len(self.kind.per_run) * len(self._run_numbers)

    def coordinates_of(self, shared: Mapping[str, float], by_run: Mapping[str, FloatArray]) -> FloatArray:
        """Return the coordinates, (n_coordinates,), of parameters (`by_run`: all runs of the case) and start values."""
        own = [self.kind.priors[name].coordinate(np.array(shared[name])) for name in self.kind.shared_parameter_names]
        each = [self.kind.priors[name].coordinate(by_run[name][self._run_numbers]) for name in self.kind.per_run]
        numbers = [b.start[name] / (b.form.steps[name] * _FORM_STEP) for b in self.added for name in b.free]
        return np.concatenate([np.ravel(own), *each, numbers])

    def with_form(self, form: Form, start: Mapping[str, float], x: FloatArray) -> tuple[ModelWithForms, FloatArray]:
        """Return the model with one more form, and the coordinates `x` (n_coordinates,) with that form at its start."""
        more = AddedForm(form, start)
        own = [start[name] / (form.steps[name] * _FORM_STEP) for name in more.free]
        return replace(self, added=[*self.added, more]), np.concatenate([x, own])

    def parameters_at(self, x: FloatArray) -> dict[str, FloatArray]:
        """Return parameters by name at coordinates (n_samples, n_coordinates), (n_samples, 1 or, per run, n_points)."""
        out, n = {}, len(self.kind.shared_parameter_names)
        for k, name in enumerate(self.kind.shared_parameter_names):
            out[name] = self.kind.priors[name].value(x[:, k : k + 1])
        at = np.searchsorted(self._run_numbers, self.table.run)
        for name in self.kind.per_run:
            out[name] = self.kind.priors[name].value(x[:, n : n + len(self._run_numbers)])[:, at]
            n += len(self._run_numbers)
        return out

    def effects_at(self, x: FloatArray) -> list[FormWithParameters]:
        """Return each form with its parameters by name, (n_samples, 1), at coordinates (n_samples, n_coordinates)."""
        out: list[FormWithParameters] = []
        n = self.n_nominal_coordinates
        for b in self.added:
            numbers: dict[str, FloatArray] = {name: np.full((len(x), 1), value) for name, value in b.start.items()}
            for name in b.free:
                numbers[name] = x[:, n : n + 1] * b.form.steps[name] * _FORM_STEP
                n += 1
            out.append((b.form, numbers))
        return out

    def predict(self, x: FloatArray) -> FloatArray:
        """Return noise-free readings, (n_samples, n_points), at coordinates (n_samples, n_coordinates)."""
        return simulate_noise_free(self.kind, self.table, self.parameters_at(x), self.effects_at(x)).readings

    def predict_with_slopes(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings (n_points,) at coordinates (n_coordinates,), and derivatives (n_points, n_coordinates).

        Derivatives are central differences; a `per_run` parameter is varied in all runs in one simulation.
        """
        n_shared, n_runs = len(self.kind.shared_parameter_names), len(self._run_numbers)
        moves = [np.eye(len(x))[k] for k in range(n_shared)]
        for j in range(len(self.kind.per_run)):
            moves.append(np.isin(np.arange(len(x)), n_shared + j * n_runs + np.arange(n_runs)).astype(float))
        moves += [np.eye(len(x))[k] for k in range(self.n_nominal_coordinates, len(x))]
        sizes = np.where([np.flatnonzero(m)[0] >= self.n_nominal_coordinates for m in moves], 1.0, _STEP)
        steps = np.array(moves) * sizes[:, None]
        found = self.predict(np.concatenate([x[None], x + steps, x - steps]))
        n = len(moves)
        slopes = (found[1 : 1 + n] - found[1 + n :]) / (2 * sizes[:, None])
        out = np.zeros((len(self.table), len(x)))
        for move, slope in zip(moves, slopes, strict=True):
            columns = np.flatnonzero(move)
            if len(columns) == 1 and not n_shared <= columns[0] < self.n_nominal_coordinates:
                out[:, columns[0]] = slope
            else:
                for column, run in zip(columns, self._run_numbers, strict=True):
                    here = self.table.run == run
                    out[here, column] = slope[here]
        return found[0], out

    def _predict_with_slopes_or_huge(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings and derivatives; if the law diverges, huge readings and zeros, so that the fit steps back."""
        try:
            readings, slopes = self.predict_with_slopes(x)
        except NotConvergedError:
            readings = np.full(len(self.table), np.nan)
        if not np.isfinite(readings).all():
            return np.full(len(self.table), _FAR * self.kind.sd), np.zeros((len(self.table), len(x)))
        return readings, np.nan_to_num(slopes)

    def fit(self, readings: FloatArray, start: FloatArray, *, max_calls: int = 25) -> LeastSquaresFit:
        """Fit readings (n_points,) by least squares from start coordinates, with at most `max_calls` evaluations.

        Raises NotConvergedError if the fit leaves the finite numbers or the law diverges where it ends.
        """
        last: dict[bytes, tuple[FloatArray, FloatArray]] = {}
        sd = self.kind.sd

        def readings_and_slopes(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            key = x.tobytes()
            if key not in last:
                last.clear()
                last[key] = self._predict_with_slopes_or_huge(x)
            return last[key]

        def standardised_residuals(x: FloatArray) -> FloatArray:
            return np.asarray((readings_and_slopes(x)[0] - readings) / sd)

        def standardised_slopes(x: FloatArray) -> FloatArray:
            return np.asarray(readings_and_slopes(x)[1] / sd)

        try:
            with np.errstate(all="ignore"):
                found = least_squares(
                    standardised_residuals,
                    start,
                    jac=standardised_slopes,
                    x_scale="jac",
                    xtol=1e-6,
                    ftol=1e-7,
                    gtol=1e-7,
                    max_nfev=max_calls,
                )
                f, slopes = readings_and_slopes(np.asarray(found.x))
        except (ValueError, np.linalg.LinAlgError) as error:
            raise NotConvergedError(f"a fit of the {self.kind.name} left the finite numbers") from error
        if not slopes.any():
            raise NotConvergedError(f"a fit of the {self.kind.name} ended where its law diverges")
        return LeastSquaresFit(found.x, f, slopes, float(np.sum(((f - readings) / sd) ** 2)))


def project_out(change: FloatArray, slopes: FloatArray) -> FloatArray:
    """Return the part of `change`, (n_points, ...), that is orthogonal to the columns of `slopes`, (n_points, n)."""
    scale = np.sqrt(np.sum(slopes**2, axis=0))
    basis, values, _ = np.linalg.svd(slopes / np.where(scale > 0, scale, 1.0), full_matrices=False)
    basis = basis[:, values > 1e-8 * values.max(initial=1e-300)]
    return np.asarray(change - basis @ (basis.T @ change))
