"""Fit of a user's simulator to a table: posterior and evidence, without a diagnosis, and as a file."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import numpy as np

from probewise import nested
from probewise._arrays import FloatArray, data_frame, own_arithmetic
from probewise._display import Reported
from probewise._kinds import require_flag, require_kind, require_progress, require_rng
from probewise.diagnosis.diagnose_simulator import modes_of, notes_on_simulator, prepare_system
from probewise.diagnosis.diagnosis import Diagnosis
from probewise.diagnosis.evidence import NUMBERS, laplace_evidence, log_evidence_of
from probewise.diagnosis.fit import Fit, Model, fit_each_start
from probewise.diagnosis.noise import (
    LEAST_SCALE,
    NoiseLaw,
    NoiseModel,
    rounding_that_hides_noise,
    white_noise_of_recording,
)
from probewise.diagnosis.outlying import note_on_improbable_rows
from probewise.diagnosis.posterior import HypothesisProblem, draw_by_importance
from probewise.diagnosis.samples import N_SAMPLES, ModelSamples, draw_noise_sd, noise_sd_by_node
from probewise.diagnosis.simulator_rows import SimulatorApparatus
from probewise.errors import DoubtfulResultWarning, NotConvergedError, ParameterError, require
from probewise.nested import Weighted
from probewise.nested.importance import repartitioned
from probewise.progress import Progress, silent
from probewise.recordings.plan import Recording
from probewise.systems import FittedSystem, RunTable, Simulator, System, table_for
from probewise.systems.forms import ReferenceFit
from probewise.systems.table import table_digest


@own_arithmetic
def repaired_of(diagnosis: Diagnosis) -> FittedSystem:
    """Return the repaired model of a diagnosis: the simulator with the effects that it leaves out.

    Raises ParameterError if it is not the diagnosis of a simulator.
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
    return fitted_system_from_samples(apparatus.about, model, diagnosis.recording, diagnosis.before.readings)


def fitted_system_from_samples(
    about: ReferenceFit, model: ModelSamples, recording: Recording, predicted: FloatArray
) -> FittedSystem:
    """Return posterior samples of a system with effects as a FittedSystem, which can be written to a file.

    `about`: the first fit and the recorded table, which the file needs if the model has effects, whose scales that fit
    set, or if a column holds the noise sds; `predicted`: prediction for every row, (n_points,).
    """
    level, system = predicted[recording.usable], about.system
    needed = bool(model.effects) or isinstance(system.simulator.noise.sd, str)
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
        known=about.stored if needed else None,
        recording=table_digest(cast(RunTable, recording.plan)),
        source=recording.source,
        notes=recording.notes,
    )


_N_LIVE = 200
_MOST_SAMPLES = 2000  # equally weighted, where many predictions cost little; else as few as a diagnosis has
_MISSED = 4.0  # nats by which all samples are less likely than the best fit, beyond the mean loss


@dataclass(frozen=True)
class Evidence:
    """Log evidence in nats, its standard error, the method, and a doubt about it ("" without one)."""

    log_z: float
    error: float
    method: str
    reason: str = ""

    @property
    def in_words(self) -> str:
        """Value, error and method, with the doubt."""
        doubt = f" ({self.reason})" if self.reason else ""
        return f"{self.log_z:.2f} ± {self.error:.2f} nats by {self.method}{doubt}"


@dataclass(frozen=True, eq=False)
class SystemFit(Reported):
    """A simulator fitted to a table: posterior, evidence and predictions.

    `predicted`, `sd`: mean and sd of every row's posterior predictive distribution, (n_points,), in the unit of the
    readings; the sd includes the noise. `nested`: the evidence by nested sampling, if it was run beside (`thorough`).
    """

    recording: Recording
    fitted: FittedSystem
    evidence: Evidence
    predicted: FloatArray
    sd: FloatArray
    nested: Evidence | None = None

    @property
    def residuals(self) -> FloatArray:
        """Reading minus prediction, (n_points,), NaN where there is no usable reading."""
        return np.where(self.recording.usable, self.recording.readings - self.predicted, np.nan)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, in the unit of the readings; weighted where a column holds their sds."""
        return self.recording.rms(self.residuals[self.recording.usable])

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: `mode`, `median`, `sd`, `low`, `high` (95 %) of each parameter, a row each."""
        own = self.fitted
        low, high = zip(*own.interval().values(), strict=True)
        columns = {name: getattr(own, name)().values() for name in ("mode", "median", "sd")}
        return data_frame({"parameter": own.names, **columns, "low": low, "high": high})

    def summary(self) -> str:
        """Describe the fit in plain text."""
        own, unit = self.fitted, self.recording.plan.instrumentation.unit
        lines = [
            f"{int(self.recording.usable.sum())} readings, rms of the residuals {self.rms:.4g} {unit}"
            f"{self.recording.weighting_in_words}",
            *(f"log evidence {evidence.in_words}" for evidence in (self.evidence, self.nested) if evidence is not None),
            f"noise sd of a reading {np.median(own.noise_sd):.4g} {unit}",
        ]
        return "\n".join([*lines, own.parameter_table(), *(f"note: {note}" for note in self.recording.notes)])


@own_arithmetic
def fit_simulator(
    simulator: Simulator,
    table: RunTable | Mapping[str, Any],
    *,
    source: str = "",
    notes: Sequence[str] = (),
    thorough: bool = False,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> SystemFit:
    """Fit a simulator to a table of readings: mode, posterior and evidence, without a diagnosis.

    Parameters
    ----------
    simulator
        The model that predicts the readings.
    table
        The recorded rows, with the predicted column: a table, a dict of arrays, or a DataFrame.
    source, notes
        Name of the table, and notes on it for the report.
    thorough
        Whether to compute the evidence by nested sampling as well.
    rng
        Source of randomness.
    progress
        Called with each stage.

    Returns
    -------
    SystemFit
        Evidence and posterior by importance sampling from the best of many fits, and the mode.

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
    require_flag("thorough", thorough)
    require_progress(progress)
    prepared = prepare_system(simulator, table, source=source, notes=notes, progress=progress, with_effects=False)
    recording, apparatus = prepared.recording, cast(SimulatorApparatus, prepared.apparatus)
    about, system = apparatus.about, apparatus.system
    usable = recording.usable
    require(not prepared.has_only_equal_readings, "readings", "all equal", "readings of which some differ")
    progress("looking for the modes")
    law = white_noise_of_recording(recording)
    first = cast(FloatArray, cast(System, prepared.null).first)
    modes, n_even = modes_of(system, recording, law, first)
    fits = _distinct(fit_each_start(Model(system, (), recording.plan), recording, [first, *modes], law), law)
    rounding = rounding_that_hides_noise(recording, recording.plan.instrumentation.step or 0.0, fits[0].sd)
    noise = laplace_evidence(fits[0], NoiseModel((), recording, {}, rounding))
    problem = HypothesisProblem(fits[0].model, recording, noise)
    progress("sampling the posterior")
    draws, is_settled = draw_by_importance(problem, fits, law, rng=rng, progress=progress)
    n_samples = N_SAMPLES
    if system.predicts_in_bulk:
        n_samples = int(np.clip(NUMBERS // len(recording), N_SAMPLES, _MOST_SAMPLES))
    z = draws.samples(n_samples, rng=rng)
    predicted = problem.predict(z)
    likeliest = noise.likeliest_law
    if likeliest.flat:
        nodes = rng.choice(len(noise.weights), n_samples, p=noise.weights)
        noise_sd = noise_sd_by_node(noise, with_rounding=True)[nodes]
    else:
        noise_sd = draw_noise_sd(likeliest, recording.readings[usable] - predicted[:, usable], rng=rng)
    samples = ModelSamples(system.chain(recording.plan, ()), system.theta(z), noise_sd, 0)
    said = [*note_on_improbable_rows(fits[0], recording), *notes_on_simulator(apparatus, noise_sd)]
    said += _doubts(problem, draws, modes[0], n_even, is_settled=is_settled)
    recording = replace(recording, notes=(*recording.notes, *said))
    mean = predicted.mean(axis=0)
    sd = np.sqrt(predicted.var(axis=0) + np.mean(noise_sd**2) * recording.relative_sd**2)
    fitted = fitted_system_from_samples(about, samples, recording, mean)
    fitted = replace(fitted, best=tuple(system.theta(modes[:1])[0].tolist()))
    evidence = Evidence(draws.log_z, max(draws.log_z_error, 1e-3), "importance sampling")  # no error is surely less
    beside = _nested(problem, z, rng=rng, progress=progress) if thorough else None
    if system.caller is not None:
        system.caller.on_call = None
    return SystemFit(recording, fitted, evidence, mean, sd, beside)


def _distinct(fits: Sequence[Fit], law: NoiseLaw) -> list[Fit]:
    """Return the fits with finite predictions that are more than an sd apart, the most probable first."""
    out: list[Fit] = []
    for found in sorted(fits, key=lambda found: -log_evidence_of(found, law)):
        apart = (np.append(law(o.slopes @ (found.z - o.z)) / max(o.sd, LEAST_SCALE), found.z - o.z) for o in out)
        if np.isfinite(found.objective) and all(np.linalg.norm(each) > 1.0 for each in apart):
            out.append(found)
    if not out:
        raise NotConvergedError("the simulator gives no finite readings near its best fit")
    return out


def _doubts(
    problem: HypothesisProblem, draws: Weighted, mode: FloatArray, n_even: int, *, is_settled: bool
) -> Iterator[str]:
    """Yield a note if parameters can be exchanged, if draws are few, and if all are far less likely than the mode."""
    if n_even > 1:
        yield (
            f"{n_even} sets of parameters fit equally well, as where terms can be exchanged or a parameter changes no "
            "reading: the samples hold all, the mode is the one nearest to the middle of the priors"
        )
    if not is_settled:
        yield (
            f"the posterior is hard to sample ({draws.n_eff:.0f} effective draws, Pareto k "
            f"{draws.pareto_k:.2f}): medians, sds and log evidence are rough; the mode is not"
        )
    lost = float(problem.log_likelihood(mode[None, :])[0] - draws.log_likelihood.max())
    if lost > 0.5 * len(mode) + _MISSED:
        yield (
            f"the samples miss the best fit, which is {lost:.0f} nats more likely than any of them: it lies where the "
            "priors have next to no mass; compare the modes with the medians"
        )


def _nested(problem: HypothesisProblem, z: FloatArray, *, rng: np.random.Generator, progress: Progress) -> Evidence:
    """Compute the evidence by nested sampling; of a law, from a prior near the samples, which takes fewer calls."""
    method, target = "nested sampling", cast(nested.Samplable, problem)
    if problem.model.sensor.predicts_dearly:
        method, target = "nested sampling near the posterior", repartitioned(problem, z)

    def report_round(state: nested.RoundSummary) -> None:
        progress("nested sampling", note=state.in_words)

    n_live = max(_N_LIVE, nested.LIVE_PER_PARAM * z.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # the doubt is part of the result
        found = nested.run(target, rng=rng, n_live=n_live, progress=report_round, max_cost=1.0)
    return Evidence(found.log_z, found.log_z_error, method, "; ".join(found.warnings[:1]))


def fit_json(fit: SystemFit) -> dict[str, Any]:
    """Convert a fit to the content of fit.json, format "fit/1"."""
    require_kind("fit", fit, SystemFit, "a SystemFit, as fit_simulator returns it")
    own = fit.fitted
    return {
        "format": "fit/1",
        "simulator": {"source": own.simulator.source, "fingerprint": own.simulator.fingerprint},
        "recording": {"source": own.source, "fingerprint": own.recording, "readings": int(fit.recording.usable.sum())},
        "parameters": own.rows_by_parameter("median", "sd", "interval95"),
        "mode": own.mode(),
        "noise": {"unit": own.simulator.unit, "median": float(np.median(own.noise_sd))},
        "log_evidence": {"value" if key == "log_z" else key: value for key, value in asdict(fit.evidence).items()},
        **({"nested_sampling": asdict(fit.nested)} if fit.nested is not None else {}),
        "rms": fit.rms,
        "samples": "samples.csv",
        "model": "fitted.json",
    }
