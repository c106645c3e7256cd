"""What is written of a verb's result: files that programs read, figures, and the page; by its command and by `save`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial, singledispatch
from pathlib import Path
from typing import cast

import numpy as np

from probewise._kinds import checked_path, checked_whole
from probewise._writing import Drawings, Output, StagedFiles, checked_output_directory
from probewise.calibration import Calibration, predict, write_sensor
from probewise.diagnosis import (
    CURE_PLAN,
    NEXT_PLAN,
    Diagnosis,
    PlanAudit,
    SystemFit,
    audit_json,
    calibrated_of,
    diagnosis_json,
    fit_json,
    generators_of_diagnosis,
    join,
    repaired_of,
)
from probewise.errors import ParameterError
from probewise.experiment import Exploration, repaired_sensor, result_json, samples_csv
from probewise.investigation import Investigation
from probewise.recordings import write_plan, write_recording
from probewise.report import audit, calibration, diagnosis, exploration, fit, investigation
from probewise.report.pictures import animated_gif
from probewise.sensor import Chain
from probewise.systems import RunTable, run_table_csv, write_fitted_system
from probewise.systems import samples_csv as system_samples_csv

DEFAULT_SEED = 2013  # of samples in files, if a result's own is not given; that of the command line


@singledispatch
def output_of(value: object, *, seed: int | None = None) -> Output:
    """Return what is written of a result, whose command had this seed (None: unknown, and not stated)."""
    raise ParameterError("result", value, "what calibrate, diagnose, fit, audit, explore or investigate returns")


def page_of(value: object, *, seed: int | None) -> str:
    """Return the page of a result, with its figures inside."""
    made = output_of(value, seed=_checked_seed(seed))
    return made.page({name: draw() for name, draw in made.drawers.items()})


def save(value: object, folder: str | Path, *, seed: int | None) -> Path:
    """Write a result into a folder, made if missing, and return it; errors as of `probewise._display.Reported.save`."""
    made, out = output_of(value, seed=_checked_seed(seed)), checked_path("folder", folder)
    drawings = Drawings(checked_output_directory(out, main=made.main))
    drawings.write_results(made)
    drawings.raise_if_any_failed()
    return out


def _checked_seed(seed: int | None) -> int | None:
    return None if seed is None else checked_whole("seed", seed, least=0, most=None)


@output_of.register
def _of_calibration(value: Calibration, *, seed: int | None = None) -> Output:
    prediction = predict(value.sensor, value.recording)
    return Output(
        lambda stage: write_sensor(value.sensor, stage / "sensor.json"),
        calibration.figure_drawers(value, value.recording, prediction),
        lambda drawn: calibration.page_html(value, value.recording, prediction, drawn, seed=seed),
        main="sensor.json",
    )


@output_of.register
def of_diagnosis(
    value: Diagnosis,
    *,
    seed: int | None = None,
    rng: np.random.Generator | None = None,
    source: str = "",
    audited: Callable[[], PlanAudit | None] = lambda: None,
) -> Output:
    """Return the files of a diagnosis: diagnosis.json, both models, the next readings; its figures and page.

    `rng` draws the samples in the sensors' files (default: by the seed); `source` names the recordings (default: the
    recording's own name); `audited` makes the audit of the plan, or None.
    """
    source = source or value.recording.source or "the readings"
    of_simulator = isinstance(value.recording.plan, RunTable)
    rng = rng or generators_of_diagnosis(DEFAULT_SEED if seed is None else seed)[2]
    return Output(
        partial(_write_files_of_simulator if of_simulator else partial(_write_files_of_light_sensor, rng=rng), value),
        diagnosis.figure_drawers(value),
        lambda drawn: diagnosis.page_html(value, drawn, source=source, seed=seed, audit=audited()),
        ("witness_*.svg", "gain.svg", *(("next.csv",) if of_simulator else (NEXT_PLAN, "next_plan.json"))),
        main="diagnosis.json",
    )


def _write_files_of_light_sensor(value: Diagnosis, stage: StagedFiles, *, rng: np.random.Generator) -> None:
    """Write diagnosis.json, both sensor models and the next plan."""
    stage.write_json("diagnosis.json", diagnosis_json(value))
    write_sensor(value.repaired.fitted_sensor(value.recording, rng=rng), stage / "sensor.json")
    write_sensor(value.null.fitted_sensor(value.recording, rng=rng), stage / "calibrated.json")
    if value.next_measurement is not None:
        write_plan(value.next_measurement.plan, stage / NEXT_PLAN)


def _write_files_of_simulator(value: Diagnosis, stage: StagedFiles) -> None:
    """Write diagnosis.json, the calibrated and the repaired simulator, and the next rows to take."""
    stage.write_json("diagnosis.json", diagnosis_json(value))
    write_fitted_system(repaired_of(value), stage / "repaired.json")
    write_fitted_system(calibrated_of(value), stage / "calibrated.json")
    if value.next_measurement is not None:
        rows = cast(RunTable, value.next_measurement.plan)
        stage.write(value.apparatus.words.next_plan, run_table_csv(rows))


@output_of.register
def _of_fit(value: SystemFit, *, seed: int | None = None) -> Output:
    def write_files(stage: StagedFiles) -> None:
        stage.write_json("fit.json", fit_json(value))
        write_fitted_system(value.fitted, stage / "fitted.json")
        stage.write("samples.csv", system_samples_csv(value.fitted))

    page = partial(fit.page_html, value, seed=seed)
    return Output(write_files, fit.figure_drawers(value), page, main="fit.json")


@output_of.register
def of_audit(value: PlanAudit, *, seed: int | None = None, source: str = "the plan") -> Output:
    """Return the files of an audit, which has no seed: audit.json and the plan that would help; figure and page."""

    def write_files(stage: StagedFiles) -> None:
        stage.write_json("audit.json", audit_json(value))
        if value.cure_plan is not None:
            write_plan(value.cure_plan, stage / CURE_PLAN)

    outdated = (CURE_PLAN, Path(CURE_PLAN).with_suffix(".json").name)
    page = partial(audit.page_html, value, source=source)
    return Output(write_files, audit.figure_drawers(value), page, outdated, main="audit.json")


@output_of.register
def of_investigation(
    value: Investigation,
    *,
    seed: int | None = None,
    rng: np.random.Generator | None = None,
    source: str = "the arm",
    concealed: Sequence[str] | None = None,
) -> Output:
    """Return the files of an investigation: those of its last diagnosis, and recording.csv; figures and page.

    `rng` as of a diagnosis; `source` names the arm; `concealed` are the effects of a simulated world, None for any
    other.
    """
    last = of_diagnosis(value.last.diagnosis, seed=seed, rng=rng)

    def write_files(stage: StagedFiles) -> None:
        last.files(stage)
        write_recording(join([each.recording for each in value.rounds]), stage / "recording.csv")

    page = partial(investigation.page_html, value, source=source, seed=seed, concealed=concealed)
    by_round = {"by_round.png": partial(investigation.probabilities_png, value)}
    return last._replace(files=write_files, drawers={**last.drawers, **by_round}, page=page)


@output_of.register
def _of_exploration(value: Exploration, *, seed: int | None = None) -> Output:
    known = None if value.hidden is None else value.hidden.parameters_by_hypothesis_name(value.experiment.names)
    frame = cache(partial(exploration.frame_png, value))  # the animation has them too
    frames = {f"frames/{k:03d}.png": partial(frame, k) for k in range(1, len(value.steps) + 1)}

    def write_files(stage: StagedFiles) -> None:
        stage.write("result.json", result_json(value))
        stage.write("samples.csv", samples_csv(value))
        if value.sensor is not None:
            rng = np.random.default_rng(DEFAULT_SEED if seed is None else seed)
            stage.write("sensor.json", repaired_sensor(value.sensor, value.last, rng=rng).to_json())

    def page(drawn: Mapping[str, bytes]) -> str:
        model = "ssf" if isinstance(value.experiment.model, Chain) else "naive"
        return exploration.page_html(value, [drawn[name] for name in frames], seed=seed, model=model, truth=known)

    animation = {"run.gif": lambda: animated_gif([draw() for draw in frames.values()])}
    return Output(write_files, frames | animation, page, ("frames/[0-9][0-9][0-9].png",), main="result.json")
