"""Fit of a user's simulator to a table: posterior and evidence, without a diagnosis, and as a file."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy.special import ndtri

from probewise import nested
from probewise._arrays import FloatArray, own_arithmetic
from probewise._display import ShowsItself
from probewise._kinds import require_kind, require_progress, require_rng
from probewise.diagnosis.diagnose_simulator import notes_on_declared_noise, prepare_system
from probewise.diagnosis.diagnosis import Diagnosis
from probewise.diagnosis.evidence import NoiseEvidence
from probewise.diagnosis.fit import FARTHEST
from probewise.diagnosis.hypothesis_problem import HypothesisProblem
from probewise.diagnosis.outlying import note_on_improbable_rows
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.samples import N_SAMPLES, ModelSamples, draw_noise_sd, noise_sd_by_node, sample_model
from probewise.diagnosis.search.refits import NoiseModels, Refits, WeighedFit
from probewise.diagnosis.search.stepwise import SearchState, fit_nulls, noise_sd_about_given_null
from probewise.diagnosis.simulator_rows import SimulatorApparatus
from probewise.diagnosis.templates import TemplateCache
from probewise.errors import DoubtfulResultWarning, ParameterError
from probewise.progress import Progress, silent
from probewise.recordings.plan import Recording
from probewise.systems import FittedSystem, RunTable, Simulator, System, run_table_csv, table_for
from probewise.systems.forms import ReferenceFit
from probewise.systems.forms.binding import StoredFit, extract_stored_fit


@own_arithmetic
def repaired_of(diagnosis: Diagnosis) -> FittedSystem:
    """Return the repaired model of a diagnosis: the simulator with the effects that it leaves out.

    Raises
    ------
    ParameterError
        If it is not the diagnosis of a simulator.
    """
    return _fitted_system_of(diagnosis, "repaired")


@own_arithmetic
def calibrated_of(diagnosis: Diagnosis) -> FittedSystem:
    """Return the calibrated null model of a diagnosis: the simulator alone. Raises as `repaired_of`."""
    return _fitted_system_of(diagnosis, "null")


def _fitted_system_of(diagnosis: Diagnosis, which: str) -> FittedSystem:
    allowed = "the Diagnosis of a simulator, as diagnose_system returns it"
    if isinstance(getattr(diagnosis, "fitted", None), FittedSystem):
        allowed += f"; of this {type(diagnosis).__name__} take its .fitted"
    require_kind("diagnosis", diagnosis, Diagnosis, allowed)
    apparatus, model = diagnosis.apparatus, getattr(diagnosis, which)
    if not isinstance(apparatus, SimulatorApparatus):
        raise ParameterError("diagnosis", diagnosis, f"{allowed}; a light sensor's is {which}.fitted_sensor(...)")
    before = diagnosis.repair.before.readings
    return fitted_system_from_samples(
        apparatus.system, model, diagnosis.recording, before, known=recorded_table_if_needed(apparatus.about, model)
    )


def recorded_table_if_needed(about: ReferenceFit, model: ModelSamples) -> StoredFit | None:
    """Return the recorded table with the first fit's predictions if a model's file needs them, else None.

    A file needs them if the model has effects, whose scales the first fit set, or if a column holds the noise sds.
    """
    return extract_stored_fit(about) if model.effects or isinstance(about.system.simulator.noise.sd, str) else None


def fitted_system_from_samples(
    system: System, model: ModelSamples, recording: Recording, predicted: FloatArray, *, known: StoredFit | None = None
) -> FittedSystem:
    """Return posterior samples of a system with effects as a FittedSystem, which can be written to a file.

    Parameters
    ----------
    system, model
        The simulator over the runs of the recording, and the samples.
    recording
        The fitted recording.
    predicted
        Prediction for every row, (n_points,).
    known
        The recorded table, if the file needs it (`recorded_table_if_needed`).
    """
    level = predicted[recording.usable]
    return FittedSystem(
        system.simulator,
        names=tuple(model.chain.names),
        samples=model.theta,
        noise_sd=model.noise_sd,
        effects=model.effects,
        absent=model.absent,
        level=(float(np.min(level)), float(np.max(level))),
        max_step=system.max_step,
        stiff=system.stiff,
        known=known,
        recording=hashlib.sha256(run_table_csv(cast(RunTable, recording.plan)).encode()).hexdigest()[:16],
        source=recording.source,
        notes=recording.notes,
    )


_N_LIVE = 200
_MOST_NUMBERS = 60_000_000  # readings that nested sampling predicts; those of a law, which is integrated, count twice
_LEAST_CALLS = 50_000  # of the likelihood, without which it would not end
_MOST_PARAMETERS = 24  # beyond them it would take more


@dataclass(frozen=True)
class Evidence:
    """Log evidence in nats, its standard error, 0 if unknown, the method, and why it is not nested sampling ("")."""

    log_z: float
    error: float
    method: str
    reason: str = ""


@dataclass(frozen=True, eq=False)
class SystemFit(ShowsItself):
    """A simulator fitted to a table: posterior, evidence and predictions.

    Parameters
    ----------
    recording
        The table with its readings.
    fitted
        The simulator with posterior samples.
    evidence
        Log evidence.
    predicted, sd
        Mean and sd of every row's posterior predictive distribution, (n_points,), in the unit of the readings; the sd
        includes the noise.
    """

    recording: Recording
    fitted: FittedSystem
    evidence: Evidence
    predicted: FloatArray
    sd: FloatArray

    @property
    def residuals(self) -> FloatArray:
        """Reading minus prediction, (n_points,), NaN where there is no usable reading."""
        return np.where(self.recording.usable, self.recording.readings - self.predicted, np.nan)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, in the unit of the readings; weighted where a column holds their sds."""
        return self.recording.rms(self.residuals[self.recording.usable])

    def summary(self) -> str:
        """Describe the fit in plain text."""
        own, unit = self.fitted, self.recording.plan.instrumentation.unit
        how = f" ({self.evidence.reason})" if self.evidence.reason else ""
        error = f" ± {self.evidence.error:.2f}" if self.evidence.error else ""
        lines = [
            f"{int(self.recording.usable.sum())} readings, rms of the residuals {self.rms:.4g} {unit}"
            f"{self.recording.weighting_in_words}",
            f"log evidence {self.evidence.log_z:.2f}{error} nats by {self.evidence.method}{how}",
            f"noise sd of a reading {np.median(own.noise_sd):.4g} {unit}",
        ]
        return "\n".join([*lines, own.parameter_table()])


@own_arithmetic
def fit_simulator(
    simulator: Simulator,
    table: RunTable | Mapping[str, Any],
    *,
    source: str = "",
    notes: Sequence[str] = (),
    rng: np.random.Generator,
    progress: Progress = silent,
) -> SystemFit:
    """Fit a simulator to a table of readings: posterior and evidence, without a diagnosis.

    Parameters
    ----------
    simulator
        The model that predicts the readings.
    table
        The recorded rows, with the predicted column: a table, a dict of arrays, or a DataFrame.
    source, notes
        Name of the table, and notes on it for the report.
    rng
        Source of randomness.
    progress
        Called with each stage.

    Returns
    -------
    SystemFit
        Evidence and posterior, by nested sampling if `simulate` takes all samples at once, or there is a law, with at
        most 24 parameters, and if the run ends without warning before 60 million readings (30 million of a law) have
        been predicted; otherwise by the Laplace approximation, with the reason.

    Raises
    ------
    ParameterError
        If the table lacks a column that the simulator names, has too few readings, or all are equal; if readings are
        not finite, or change when `simulate` is called again; or if no affordable step integrates the law.
    FileError
        If `simulate`, `rates` or `observe` raises an error at every point of the prior that is tried.
    ShapeError
        If `simulate` or `observe` does not return one reading per row.
    NotConvergedError
        If the fit did not converge.
    """
    table = table_for(simulator, table)
    require_rng(rng)
    require_progress(progress)
    prepared = prepare_system(simulator, table, source=source, notes=notes, progress=progress, with_effects=False)
    if prepared.has_too_little_data:
        found = (
            f"{len(prepared.usable_rows)} usable readings"
            if len(prepared.usable_rows) < prepared.least_readings
            else "all equal"
        )
        raise ParameterError("readings", found, f"{prepared.least_readings} or more, which are not all equal")
    null, noise = _null_fit_and_evidence(prepared)
    samples = sample_model(null.found, noise, prepared.recording, weights={}, rng=rng)
    evidence = Evidence(noise.log_z, 0.0, "the Laplace approximation", _reason_against_sampling(prepared))
    if not evidence.reason:
        samples, evidence = _nested_samples_and_evidence(
            prepared, null, noise, samples, evidence, rng=rng, progress=progress
        )
    recording, system = prepared.recording, cast(SimulatorApparatus, prepared.apparatus).system
    notes = (
        *note_on_improbable_rows(null.found, recording),
        *notes_on_declared_noise(simulator, np.asarray(samples.noise_sd)),
    )
    recording = replace(recording, notes=(*recording.notes, *notes))
    predicted = samples.chain.predict(samples.theta, recording.plan)
    sd = np.sqrt(predicted.var(axis=0) + np.mean(samples.noise_sd**2) * recording.relative_sd**2)
    known = recorded_table_if_needed(cast(SimulatorApparatus, prepared.apparatus).about, samples)
    fitted = fitted_system_from_samples(system, samples, recording, predicted.mean(axis=0), known=known)
    return SystemFit(recording, fitted, evidence, predicted.mean(axis=0), sd)


def _null_fit_and_evidence(prepared: Prepared) -> tuple[WeighedFit, NoiseEvidence]:
    """Fit the simulator without effects under white noise; return the fit and its evidence."""
    prior = PriorOdds.for_effects({})
    noises = NoiseModels(prepared.recording, {}, prior, noise_sd_about_given_null(prepared))
    templates = TemplateCache(prepared.usable_rows)
    state = SearchState({}, prior, noises, templates, Refits(prepared.null, noises, templates), frozenset())
    fit_nulls(state, prepared, max_order=1)
    return state.null, state.null.evidence[()]


def _reason_against_sampling(prepared: Prepared) -> str:
    """Return the reason why nested sampling would take too long; "" if it would not."""
    system = cast(SimulatorApparatus, prepared.apparatus).system
    if system.n_params > _MOST_PARAMETERS:
        return f"nested sampling of {system.n_params} parameters would take too many calls"
    if system.caller is not None and not system.caller.broadcasts:
        return "nested sampling would take too many calls of simulate, which takes one sample at a time"
    if _most_affordable_calls(prepared) < _LEAST_CALLS:
        return f"nested sampling would take too long with {len(prepared.recording)} rows"
    return ""


def _most_affordable_calls(prepared: Prepared) -> int:
    each = 1 if cast(SimulatorApparatus, prepared.apparatus).system.simulator.law is None else 2
    return _MOST_NUMBERS // (each * len(prepared.recording))


def _nested_samples_and_evidence(
    prepared: Prepared,
    null: WeighedFit,
    noise: NoiseEvidence,
    samples: ModelSamples,
    otherwise: Evidence,
    *,
    rng: np.random.Generator,
    progress: Progress,
) -> tuple[ModelSamples, Evidence]:
    """Compute samples and evidence by nested sampling; return those given if the run ends with a warning.

    With a law, which must be integrated, nested sampling starts from a prior near the given samples, which takes far
    fewer calls.
    """
    problem: nested.Samplable = HypothesisProblem(null.found.model, prepared.recording, noise)
    system = cast(SimulatorApparatus, prepared.apparatus).system
    n_live = max(_N_LIVE, nested.LIVE_PER_PARAM * system.n_params)
    method = "nested sampling"
    if system.simulator.law is not None:
        u = system.prior.to_unit_cube(samples.theta[:, : system.n_params])
        problem = nested.repartitioned(problem, np.clip(ndtri(u), -FARTHEST, FARTHEST))
        method = "nested sampling near the posterior"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # the reason is reported below
        found = nested.run(
            problem, rng=rng, n_live=n_live, max_calls=_most_affordable_calls(prepared),
            progress=_sampling_progress(progress), max_cost=1.0, return_interrupted=False,
        )  # fmt: skip
    if found.warnings:
        return samples, replace(otherwise, reason=f"nested sampling: {found.warnings[0]}")
    z = np.clip(found.samples(N_SAMPLES, rng=rng), -FARTHEST, FARTHEST)
    law, usable = noise.likeliest_law, prepared.recording.usable
    residuals = prepared.recording.readings[usable] - null.found.model.predict(z)[:, usable]
    if law.flat:
        nodes = rng.choice(len(noise.weights), N_SAMPLES, p=noise.weights)
        noise_sd = noise_sd_by_node(noise, with_rounding=True)[nodes]
    else:
        noise_sd = draw_noise_sd(law, residuals, rng=rng)
    theta = cast(Any, null.found.model.sensor).theta(z)
    evidence = Evidence(found.log_z + null.log_prior_factor, found.log_z_error, method)
    return replace(samples, theta=theta, noise_sd=noise_sd), evidence


def _sampling_progress(progress: Progress) -> Callable[[nested.RoundSummary], None]:
    def report_round(state: nested.RoundSummary) -> None:
        to_come = state.log_ratio_remaining
        progress(
            "nested sampling", note=f"{state.n_dead} points, ln Z {state.log_z:.1f}, at most {to_come:+.1f} to come"
        )

    return report_round


def fit_json(fit: SystemFit) -> dict[str, Any]:
    """Convert a fit to the content of fit.json, format "fit/1"."""
    require_kind("fit", fit, SystemFit, "a SystemFit, as fit_simulator returns it")
    own, interval = fit.fitted, fit.fitted.interval()
    median, sd = np.median(own.samples, axis=0).tolist(), own.samples.std(axis=0).tolist()
    return {
        "format": "fit/1",
        "simulator": {"source": own.simulator.source, "fingerprint": own.simulator.fingerprint},
        "recording": {"source": own.source, "fingerprint": own.recording, "readings": int(fit.recording.usable.sum())},
        "parameters": [
            {"name": name, "median": median[k], "sd": sd[k], "interval95": list(interval[name])}
            for k, name in enumerate(own.names)
        ],
        "noise": {"unit": own.simulator.unit, "median": float(np.median(own.noise_sd))},
        "log_evidence": {
            "value": fit.evidence.log_z,
            "error": fit.evidence.error or None,
            "method": fit.evidence.method,
            "reason": fit.evidence.reason,
        },
        "rms": fit.rms,
        "samples": "samples.csv",
        "model": "fitted.json",
    }
