"""Refits of noise-free readings by the engine: what a null model leaves of an effect, and what explains it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
from scipy.special import ndtri

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.diagnose_simulator import recording_from_table
from probewise.diagnosis.evidence import Linearised, OrthonormalBlocks, laplace_evidence
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.noise import NoiseModel, white_noise
from probewise.diagnosis.sensors import default_sensor, starts_of_one_gaussian, starts_with_more_gaussians
from probewise.diagnosis.templates import EffectTemplates, templates_of_effect
from probewise.effects import AGAIN, VOCABULARY, Effect, Extent, LightEffect
from probewise.errors import NotConvergedError
from probewise.proof.systems.cases import DrawnSystem, SystemCase
from probewise.proof.systems.forms import SystemEffect
from probewise.proof.systems.kinds import SystemKind, SystemTable
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import Stage
from probewise.systems import Noise, RunTable, System
from probewise.systems.forms import ReferenceFit, bind_forms
from probewise.systems.simulator import run_simulator_text
from probewise.systems.system import STANDS_STILL, with_converged_step

_NOISE_SD = 0.6  # the middle noise level of a challenge; weights the readings against the priors
_MOST_GAUSSIANS = 4
_BEHIND = 3.0  # nats: once an SSF order is this far behind the best, higher orders are not tried


class NullRefit:
    """The null model, fitted to clean readings once and refitted to readings with effects.

    The number of Gaussians in the SSF has the largest evidence on the clean readings, as in a diagnosis. The residuals
    of that fit (the true SSF may be no mixture of Gaussians) are subtracted before a refit.
    """

    def __init__(self) -> None:
        self._kept: tuple[Recording, Fit] | None = None

    def __call__(self, clean: Recording, changed: Recording) -> float:
        """Return the norm of an effect's residuals after a full refit of the null, in reading units."""
        return float(np.linalg.norm(self.rivalry(clean, changed).found.residuals))

    def rivalry(self, clean: Recording, changed: Recording) -> _Rivalry:
        """Return the null's fit to `changed` minus its residuals on `clean`, as if it fitted `clean` exactly."""
        null, readings = self.null_fit(clean), changed.readings.copy()
        readings[clean.usable] -= null.residuals
        without = Recording(changed.plan, readings)
        return _Rivalry(_white_noise_fit(null.model, without, null.z), without)

    def null_fit(self, clean: Recording) -> Fit:
        """Return the null model's fit to the clean readings, cached for the last recording."""
        if self._kept is not None and self._kept[0] is clean:
            return self._kept[1]
        extent, noise = Extent.of(clean), NoiseModel((), clean, least_sd=_NOISE_SD)
        sensor = default_sensor(extent, 1)
        starts = starts_of_one_gaussian(sensor)
        found = min(
            (_white_noise_fit(Model(sensor, (), clean.plan), clean, z) for z in starts), key=lambda one: one.objective
        )
        best, best_log_z = found, laplace_evidence(found, noise).log_z
        for _ in range(_MOST_GAUSSIANS - 1):
            found = min(_fits_with_one_more_gaussian(found, clean, extent), key=lambda one: one.objective)
            log_z = laplace_evidence(found, noise).log_z
            if log_z > best_log_z:
                best, best_log_z = found, log_z
            elif log_z < best_log_z - _BEHIND:
                break
        self._kept = clean, best
        return best


def _fits_with_one_more_gaussian(found: Fit, recording: Recording, extent: Extent) -> Iterator[Fit]:
    wanted = default_sensor(extent, found.model.sensor.n_gaussians + 1)
    for z in starts_with_more_gaussians(found.model.sensor, found.z, wanted):
        yield _white_noise_fit(Model(wanted, (), recording.plan), recording, z)


def _white_noise_fit(model: Model, recording: Recording, start: FloatArray) -> Fit:
    whitener = white_noise(int(recording.usable.sum()), least=_NOISE_SD)
    return fit(model, recording, start, whitener, tolerance=0.02)


_WORTH_A_REFIT = 0.8
_STARTS = 3  # entries of a template bank from which fits begin
_LIKE_AN_SSF = ("halo", "edge_blur")  # aliases of these may be an SSF with one more Gaussian


class _Rivalry:
    """A fit, and the effects that may be added to it to explain the rest of its readings."""

    def __init__(self, found: Fit, readings: Recording) -> None:
        self.found, self.readings = found, readings
        self._usable = np.flatnonzero(readings.usable)

    @cached_property
    def _problem(self) -> Linearised:
        return Linearised.of(self.found, white_noise(len(self._usable)))

    def entries(self, effect: Effect) -> tuple[EffectTemplates, IntArray, float]:
        """Return the template bank of an effect, its entries from the best to the worst, and the cosine of the best."""
        templates = templates_of_effect(self.found, effect, self._usable)
        blocks = OrthonormalBlocks.of(self._problem, templates.columns)
        explained = np.add.reduceat((blocks.u.T @ self._problem.residual) ** 2, blocks.starts)
        order = np.argsort(-explained, kind="stable")
        whole = float(self._problem.residual @ self._problem.residual)
        return templates, order, float(np.sqrt(min(explained[order[0]] / whole, 1.0)))

    def refits(self, effect: Effect, templates: EffectTemplates, entries: Iterable[int]) -> Iterator[Fit]:
        found, n = self.found, len(self._usable)
        for at in entries:
            columns = templates.columns[at]
            amount = np.linalg.lstsq(self._problem.project(columns), self._problem.residual)[0]
            start = effect.start(templates.settings[at], np.asarray(amount, dtype=np.float64))
            z = found.z + self._problem.absorbing_shift(found, columns @ amount)
            model = found.model.with_effect(templates.variant_of_entry(at))
            start_z = np.concatenate([z, model.z_of_last_effect(start[None, :])[0]])
            # The least sd is a tenth of the residual: small for accuracy, large enough not to force an exact fit.
            least = 0.1 * np.sqrt(float(found.residuals @ found.residuals) / n)
            yield fit(model, self.readings, start_z, white_noise(n, least=least), tolerance=0.02)

    def cosine(self, by: Fit) -> float:
        """Return the square root of the share of the residual sum of squares by which that of `by` is smaller."""
        left = float(by.residuals @ by.residuals) / float(self.found.residuals @ self.found.residuals)
        return float(np.sqrt(np.clip(1 - left, 0.0, 1.0)))


def cosines_with_vocabulary(
    refit: NullRefit, clean: Recording, changed: Recording, *, vocabulary: Mapping[str, LightEffect] = VOCABULARY
) -> dict[str, float]:
    """Return the cosine of an effect's residuals, after a refit of the null model, with every named effect on the mean.

    `clean`, `changed`: noise-free readings without and with the effect. Effects that cannot act in this plan or act on
    the noise are left out. The cosine rho is the square root of the share of the residual sum of squares that the named
    effect, at its best fit and together with the null model, explains: from a full refit if the linearised rho is above
    0.8. If "halo" or "edge_blur" is above 0.8, also of "ssf_order": one more Gaussian in the SSF.
    """
    rivalry = refit.rivalry(clean, changed)
    out: dict[str, float] = {}
    for name, kind in vocabulary.items():
        effect = kind.for_extent(Extent.of(clean))
        if effect is None or effect.stage is Stage.NOISE:
            continue
        templates, entries, rho = rivalry.entries(effect)
        if rho > _WORTH_A_REFIT:
            (by,) = rivalry.refits(effect, templates, entries[:1])
            rho = rivalry.cosine(by)
        out[name] = rho
    if max(out.get(name, 0.0) for name in _LIKE_AN_SSF) > _WORTH_A_REFIT:
        more = _fits_with_one_more_gaussian(rivalry.found, rivalry.readings, Extent.of(clean))
        out["ssf_order"] = rivalry.cosine(min(more, key=lambda f: float(np.linalg.norm(f.residuals))))
    return out


_LEAST_SD = 0.01  # of the noise sd: so small that priors hardly pull at what readings determine
_NEAR = 12.0  # nats within which a form is a rival; linearised ones within which a full fit is made
_LIKE = 0.9  # cosine from which one is made too
_MOST_FITS = 6
_TOLERANCE = 1e-3  # nats
_MOST_NAMES = 2


class SystemRefit:
    """The simulator of a drawn system, fitted by the engine to noise-free readings of its rows, from the truth.

    After a fit, `model` is the model without effects and `true_z` the truth in its coordinates, (n_params,).
    """

    def __init__(self) -> None:
        self._drawn: DrawnSystem | None = None

    def __call__(self, drawn: DrawnSystem, readings: FloatArray) -> FloatArray:
        """Return the residuals of noise-free readings, (n_points,) both, in sds; NotConvergedError without a fit."""
        return self.refit(drawn, readings).residuals / drawn.kind.sd

    def refit(self, drawn: DrawnSystem, readings: FloatArray, *, beside: Fit | None = None) -> Fit:
        """Return the fit of the model without effects, or of `beside`, to readings that are not held out."""
        if self._drawn is not drawn:
            self._prepare(drawn)
        model, z = (self.model, self.true_z) if beside is None else (beside.model, beside.z)
        found = fit(model, self.recording(readings), z, self._law, tolerance=_TOLERANCE)
        if not np.isfinite(found.objective):
            raise NotConvergedError(f"a fit of the {drawn.kind.name} left the finite numbers")
        return found

    def recording(self, readings: FloatArray) -> Recording:
        """Return readings as a recording, with the error of the integration at the truth, which a fit would absorb."""
        return self._recording.with_readings(readings + self._error)

    def forms(self, found: Fit) -> dict[str, Effect]:
        """Return by name every form of the engine's vocabulary about a fit, of two waves of a kind the first."""
        return {name: form for name, form in bind_forms(self.reference(found)).items() if not name.endswith(AGAIN)}

    def reference(self, found: Fit) -> ReferenceFit:
        """Return a fit as that to which forms are bound."""
        system, table = cast(System, self.model.sensor), cast(RunTable, self.model.plan)
        misfit = float(np.sqrt(np.mean(found.residuals**2))) / self._sd
        return ReferenceFit(system, table, found.z, self._sd, misfit=misfit)

    def _prepare(self, drawn: DrawnSystem) -> None:
        kind, true = drawn.kind, drawn.true_system
        simulator = run_simulator_text(kind.text.replace("{noise}", ""), Path("simulator.py"))
        simulator = replace(simulator, noise=Noise(sd=kind.sd))
        table = run_table(drawn.diagnosed_table, kind, true.readings)
        system = System.of(simulator, table)
        of_runs = {f"{n}[{run}]": float(v[int(run)]) for n, v in drawn.by_run.items() for run in table.scan_names}
        values = {**drawn.shared, **of_runs}
        theta = np.array([[values[name] for name in system.marginals]])
        system = with_converged_step(system, table, theta, tolerance=STANDS_STILL * kind.sd)
        self.model, self.true_z = Model(system, (), cast(Plan, table)), ndtri(system.prior.to_unit_cube(theta))[0]
        self._error = self.model.predict(self.true_z[None, :])[0] - true.readings
        self._recording = recording_from_table(simulator, table)
        self._law = white_noise(len(table), least=_LEAST_SD * kind.sd)
        self._drawn, self._sd = drawn, kind.sd


def run_table(rows: SystemTable, kind: SystemKind, readings: FloatArray) -> RunTable:
    """Return rows of a system with readings as the engine's table; a run's name is its number."""
    runs = {} if kind.run is None else {kind.run: rows.run.astype(str)}
    return RunTable({**runs, **rows.columns, kind.reading: readings}, time=kind.time, run=kind.run)


def _best_fit(found: Fit, readings: Recording, forms: Sequence[Effect]) -> Fit:
    if not forms:
        return found
    rivalry = _Rivalry(found, readings)
    templates, entries, _ = rivalry.entries(forms[0])
    begun = rivalry.refits(forms[0], templates, entries[:_STARTS])
    return min((_best_fit(by, readings, forms[1:]) for by in begun), key=_sum_of_squares)


def _sum_of_squares(found: Fit) -> float:
    return float(found.residuals @ found.residuals) if np.isfinite(found.objective) else np.inf


def rivals_with_nats(refit: SystemRefit, case: SystemCase, effect: SystemEffect) -> dict[str, float]:
    """Find the forms that explain one concealed effect's noise-free readings nearly as well as it does, six at most.

    Another concealed effect is part of the model. Returns the loss of log likelihood in nats by name, for those below
    12, the smallest first.
    """
    drawn, readings = case.drawn, case.noise_free[case.drawn.diagnosed_row_numbers]
    found = refit.refit(drawn, readings)
    forms = refit.forms(found)
    for other in case.effects:
        if other is not effect and other.name in forms:  # it is known from readings with it alone
            alone = drawn.simulate_diagnosed_rows([other])
            with_other = _best_fit(refit.refit(drawn, alone), refit.recording(alone), [forms[other.name]])
            found = refit.refit(drawn, readings, beside=with_other)
    rivalry = _Rivalry(found, refit.recording(readings))
    size = _sum_of_squares(found) / drawn.kind.sd**2
    near = []
    for name in forms.keys() - {e.name for e in case.effects}:
        templates, entries, rho = rivalry.entries(forms[name])
        if 0.5 * size * (1 - rho**2) < _NEAR or rho > _LIKE:
            near.append((-rho, name, templates, entries[:_STARTS]))
    nats = []
    for _, name, templates, entries in sorted(near, key=lambda each: each[:2])[:_MOST_FITS]:
        left = min(map(_sum_of_squares, rivalry.refits(forms[name], templates, entries)))
        nats.append((0.5 * left / drawn.kind.sd**2, name))
    return {name: loss for loss, name in sorted(nats, key=lambda each: each[0]) if loss < _NEAR}


def nats_of_alternative(refit: SystemRefit, case: SystemCase, names: Sequence[str]) -> float:
    """Return how many nats of log likelihood the best fit of other effects loses on a case's noise-free readings.

    `case`: the case, with one concealed effect or more; `names`: one or two names of the vocabulary, with their
    targets; fitted together with the model without effects. Returns the loss, 0 or more; infinite for more names, for
    those that this system does not have, and where no fit converges.
    """
    readings = case.noise_free[case.drawn.diagnosed_row_numbers]
    found = refit.refit(case.drawn, readings)
    forms = refit.forms(found)
    if not 0 < len(names) <= _MOST_NAMES or not forms.keys() >= set(names):
        return np.inf
    # Which effect is added first decides where the fit begins.
    orders = itertools.permutations([forms[name] for name in names])
    left = min(_sum_of_squares(_best_fit(found, refit.recording(readings), order)) for order in orders)
    return left / (2 * case.drawn.kind.sd**2)
