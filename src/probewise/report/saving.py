"""What is written of a verb's result: files that programs read, figures, and the page; by its command and by `save`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial, singledispatch
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from probewise._kinds import checked_path
from probewise._writing import Drawings, StagedFiles, checked_output_directory
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


class Output(NamedTuple):
    """What is written: files by `files`, figures by name of file, a page of the drawn figures; what it replaces.

    `main` is the file by which the results are known, `outdated` are patterns of files that an earlier run may have.
    """

    main: str
    files: Callable[[StagedFiles], None]
    drawers: Mapping[str, Callable[[], bytes]]
    page: Callable[[Mapping[str, bytes]], str]
    outdated: Sequence[str] = ()


@singledispatch
def output_of(value: object, *, seed: int | None = None) -> Output:
    """Return what is written of a result, whose command had this seed (None: unknown, and not stated)."""
    raise ParameterError("result", value, "what calibrate, diagnose, fit, audit, explore or investigate returns")


def page_of(value: object, *, seed: int | None) -> str:
    """Return the page of a result, with its figures inside."""
    made = output_of(value, seed=seed)
    return made.page({name: draw() for name, draw in made.drawers.items()})


def save(value: object, folder: str | Path, *, seed: int | None) -> Path:
    """Write a result into a folder, made if missing, and return it; errors as of `probewise._display.Reported.save`."""
    made, out = output_of(value, seed=seed), Path(checked_path("folder", folder))
    drawings = Drawings(checked_output_directory(out, main=made.main))
    drawings.write_results(made.files, made.drawers, made.page, outdated=made.outdated)
    drawings.raise_if_any_failed()
    return out


@output_of.register
def _of_calibration(value: Calibration, *, seed: int | None = None) -> Output:
    prediction = predict(value.sensor, value.recording)
    return Output(
        "sensor.json",
        lambda stage: write_sensor(value.sensor, stage / "sensor.json"),
        calibration.figure_drawers(value, value.recording, prediction),
        lambda drawn: calibration.page_html(value, value.recording, prediction, drawn, seed=seed),
    )


@output_of.register
def of_diagnosis(
    value: Diagnosis, *, seed: int | None = None, source: str = "", audited: Callable[[], PlanAudit] | None = None
) -> Output:
    """Return the files of a diagnosis: diagnosis.json, both models, the next readings; its figures and page.

    `source` names the recordings (default: the recording's own name), `audited` makes the audit of the plan, if any.
    """
    of_simulator = isinstance(value.recording.plan, RunTable)
    rng = np.random.default_rng(DEFAULT_SEED if seed is None else seed).spawn(3)[2]  # two others made the diagnosis
    files = _write_files_of_simulator if of_simulator else partial(write_files_of_light_sensor, rng=rng)
    return Output(
        "diagnosis.json",
        partial(files, value),
        diagnosis.figure_drawers(value),
        lambda drawn: diagnosis.page_html(
            value,
            drawn,
            source=source or value.recording.source or "the readings",
            seed=seed,
            audit=None if audited is None else audited(),
        ),
        ("witness_*.svg", "gain.svg", *(("next.csv",) if of_simulator else (NEXT_PLAN, "next_plan.json"))),
    )


def write_files_of_light_sensor(value: Diagnosis, stage: StagedFiles, *, rng: np.random.Generator) -> None:
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

    figures = fit.figure_drawers(value)
    return Output("fit.json", write_files, figures, lambda drawn: fit.page_html(value, drawn, seed=seed))


@output_of.register
def of_audit(value: PlanAudit, *, seed: int | None = None, source: str = "the plan") -> Output:
    """Return the files of an audit, which has no seed: audit.json and the plan that would help; figure and page."""

    def write_files(stage: StagedFiles) -> None:
        stage.write_json("audit.json", audit_json(value))
        if value.cure_plan is not None:
            write_plan(value.cure_plan, stage / CURE_PLAN)

    return Output(
        "audit.json",
        write_files,
        audit.figure_drawers(value),
        lambda drawn: audit.page_html(value, drawn, source=source),
        (CURE_PLAN, Path(CURE_PLAN).with_suffix(".json").name),
    )


@output_of.register
def of_investigation(
    value: Investigation, *, seed: int | None = None, source: str = "the arm", concealed: Sequence[str] | None = None
) -> Output:
    """Return the files of an investigation: those of its last diagnosis, and recording.csv; figures and page.

    `source` names the arm; `concealed` are the effects of a simulated world, None for any other.
    """
    last = of_diagnosis(value.last.diagnosis, seed=seed)

    def write_files(stage: StagedFiles) -> None:
        last.files(stage)
        write_recording(join([each.recording for each in value.rounds]), stage / "recording.csv")

    return Output(
        "diagnosis.json",
        write_files,
        {**last.drawers, "by_round.png": partial(investigation.probabilities_png, value)},
        lambda drawn: investigation.page_html(value, drawn, source=source, seed=seed, concealed=concealed),
        last.outdated,
    )


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
    return Output("result.json", write_files, frames | animation, page, ("frames/*.png",))
