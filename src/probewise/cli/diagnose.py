"""`probewise diagnose`: which physics a sensor model, or a user's simulator, leaves out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, cast

from probewise._writing import Drawings, StagedFiles, checked_output_directory
from probewise.cli import _common as common
from probewise.cli._executor import add_executor
from probewise.cli._journal import find_journal_sensor_file, is_journal, journal_recording_and_shape
from probewise.cli._simulator import add_simulator, open_simulator, read_joined_table
from probewise.errors import ParameterError

if TYPE_CHECKING:
    import numpy as np

    from probewise.calibration import FittedSensor
    from probewise.diagnosis import Diagnosis
    from probewise.progress import Progress
    from probewise.recordings import Recording
    from probewise.scene import Shape
    from probewise.systems import RunTable

OF_ONE_RUN = ("witness_*.svg", "gain.svg", "next_plan.csv", "next_plan.json")
_OF_ONE_RUN_OF_SIMULATOR = ("witness_*.svg", "gain.svg", "next.csv")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise diagnose`."""
    about = (
        "recording, its JSON beside it, or paper or concealed, which ship, or the journal.jsonl of an explore "
        "run; with --simulator any table; several are diagnosed together"
    )
    common.add(parser, "recordings REC.csv", about, type=common.parse_recording, nargs="+")
    about = "an earlier calibration, whose posterior becomes the prior (default with a journal: the one of its run)"
    common.add(parser, "--sensor S.json", about, type=common.parse_path)
    add_simulator(parser)
    common.add(
        parser,
        "--thorough",
        "compute the evidence of the leading hypotheses by nested sampling too; it replaces the Laplace "
        "approximation where they differ by more than one nat plus its standard error and no run gives a warning",
    )
    common.add(
        parser,
        "--each",
        "diagnose each recording by itself, into a folder of its name; table.csv and report.html sort them by "
        "what ails them; the same command resumes",
    )
    add_executor(parser)
    common.add_out(parser)
    common.add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Diagnose; write diagnosis.json, both models, the next plan, report and figures; return the exit status."""
    from probewise._progress import progress_shown

    if arguments.each:
        from probewise.cli._each import diagnose_each

        return diagnose_each(arguments, run)
    if arguments.simulator is not None and arguments.scheduler is None:
        return _diagnose_simulator(arguments)
    if arguments.workers > 1 or arguments.scheduler is not None:
        raise common.CommandError(
            "--workers and --scheduler are for --each, which diagnoses several recordings one by one"
        )
    from probewise.diagnosis import NEXT_PLAN, SensorAndShape, audit_plan_of_diagnosis, diagnose, join, weigh_thoroughly
    from probewise.report import diagnosis as report

    drawings = Drawings(checked_output_directory(arguments.out, main="diagnosis.json"))
    with progress_shown(quiet=arguments.quiet) as progress:
        recordings, sensor, shape = _read_inputs(arguments, progress=progress)
        diagnosis_rng, nested_rng, files_rng = generators_of_diagnosis(arguments.seed)
        joined = join(recordings)
        null = None
        if sensor is not None and shape is not None:
            progress("searching for shapes that fit")
            null = SensorAndShape.of(sensor, shape, joined, rng=diagnosis_rng)
        weigh_again = partial(weigh_thoroughly, rng=nested_rng, progress=progress)
        diagnosis = diagnose(
            joined,
            sensor=None if shape is not None else sensor,
            null=null,
            thorough=weigh_again if arguments.thorough else None,
            rng=diagnosis_rng,
            progress=progress,
        )
        if null is not None:
            diagnosis = diagnosis.with_shape_in_next_plan(null.shape)
        source = ", ".join(path.name for path in arguments.recordings)

        def page(drawn: Mapping[str, bytes]) -> str:
            audit = None if null is not None else audit_plan_of_diagnosis(diagnosis, sensor=sensor)
            return report.page_html(diagnosis, drawn, source=source, seed=arguments.seed, audit=audit)

        read = [*arguments.recordings, *([] if arguments.sensor is None else [arguments.sensor])]
        renamed = drawings.write_results(
            partial(write_files, diagnosis, rng=files_rng),
            report.figure_drawers(diagnosis),
            page,
            inputs=common.inputs_and_filled_in_plan(read, drawings.out / NEXT_PLAN),
            outdated=OF_ONE_RUN,
            progress=progress,
        )
    return _finish(arguments, drawings, diagnosis, [f"note: {note}" for note in joined.notes] + renamed)


def _diagnose_simulator(arguments: argparse.Namespace) -> int:
    """Diagnose a user's simulator; write diagnosis.json, both models, next.csv and report; return the exit status."""
    import numpy as np

    from probewise._progress import progress_shown
    from probewise.diagnosis import diagnose_system, notes_on_calls, weigh_thoroughly
    from probewise.report import diagnosis as report

    common.refuse_options(arguments, "--simulator, which replaces it", "sensor")
    drawings = Drawings(checked_output_directory(arguments.out, main="diagnosis.json"))
    diagnosis_rng, nested_rng = np.random.default_rng(arguments.seed).spawn(2)
    source = ", ".join(path.name for path in arguments.recordings)
    with (
        open_simulator(arguments.simulator, arguments.workers) as simulator,
        progress_shown(quiet=arguments.quiet) as progress,
    ):
        table, notes = read_joined_table(simulator, arguments.recordings)
        diagnosis = diagnose_system(
            simulator,
            table,
            source=source,
            notes=notes,
            thorough=partial(weigh_thoroughly, rng=nested_rng, progress=progress) if arguments.thorough else None,
            rng=diagnosis_rng,
            progress=progress,
        )
        read = [*arguments.recordings, arguments.simulator]
        renamed = drawings.write_results(
            partial(_write_files_of_simulator, diagnosis),
            report.figure_drawers(diagnosis),
            lambda drawn: report.page_html(diagnosis, drawn, source=source, seed=arguments.seed),
            inputs=common.inputs_and_filled_in_plan(read, drawings.out / "next.csv", simulator.reading),
            outdated=_OF_ONE_RUN_OF_SIMULATOR,
            progress=progress,
        )
    said = (*diagnosis.recording.notes, *notes_on_calls(diagnosis))
    return _finish(arguments, drawings, diagnosis, [f"note: {note}" for note in said] + renamed)


def _finish(arguments: argparse.Namespace, drawings: Drawings, diagnosis: Diagnosis, notes: Sequence[str]) -> int:
    summary = f"{diagnosis.summary()}\nseed {arguments.seed}; written to {drawings.out}"
    return common.finish(drawings, *notes, summary, quiet=arguments.quiet)


def _read_inputs(
    arguments: argparse.Namespace, *, progress: Progress
) -> tuple[list[Recording], FittedSensor | None, Shape | None]:
    """Return the recordings, the sensor or None, and the shape that a journal's run looked for (None: no journal).

    Without --sensor, that of the journal's run is read, and `arguments.sensor` is set to its file.
    """
    from probewise.calibration import read_sensor
    from probewise.recordings import read_recording

    journals = [path for path in arguments.recordings if is_journal(path)]
    if arguments.sensor is None and journals:
        arguments.sensor = find_journal_sensor_file(journals[0])
    if arguments.sensor is not None and len(journals) > 1:
        raise ParameterError("journals", len(journals), "one at a time: each run has its own unknown shape")
    sensor = None if arguments.sensor is None else read_sensor(arguments.sensor)
    recordings, shape = [], None
    for path in arguments.recordings:
        if sensor is not None and path in journals:
            recording, shape = journal_recording_and_shape(path, sensor)
        else:
            recording = read_recording(path, progress=progress)
        recordings.append(recording)
    return recordings, sensor, shape


def generators_of_diagnosis(seed: int) -> Sequence[np.random.Generator]:
    """Return the generators of a diagnosis, of its nested sampling, and of the samples in its files."""
    import numpy as np

    return np.random.default_rng(seed).spawn(3)


def write_files(diagnosis: Diagnosis, stage: StagedFiles, *, rng: np.random.Generator) -> None:
    """Write diagnosis.json, both sensor models and the next plan."""
    from probewise.calibration import write_sensor
    from probewise.diagnosis import NEXT_PLAN, diagnosis_json
    from probewise.recordings import write_plan

    stage.write_json("diagnosis.json", diagnosis_json(diagnosis))
    write_sensor(diagnosis.repaired.fitted_sensor(diagnosis.recording, rng=rng), stage / "sensor.json")
    write_sensor(diagnosis.null.fitted_sensor(diagnosis.recording, rng=rng), stage / "calibrated.json")
    if diagnosis.next_measurement is not None:
        write_plan(diagnosis.next_measurement.plan, stage / NEXT_PLAN)


def _write_files_of_simulator(diagnosis: Diagnosis, stage: StagedFiles) -> None:
    """Write diagnosis.json, the calibrated and the repaired simulator, and the next rows to take."""
    from probewise.diagnosis import calibrated_of, diagnosis_json, repaired_of
    from probewise.systems import run_table_csv, write_fitted_system

    stage.write_json("diagnosis.json", diagnosis_json(diagnosis))
    write_fitted_system(repaired_of(diagnosis), stage / "repaired.json")
    write_fitted_system(calibrated_of(diagnosis), stage / "calibrated.json")
    if diagnosis.next_measurement is not None:
        rows = cast("RunTable", diagnosis.next_measurement.plan)
        stage.write(diagnosis.apparatus.words.next_plan, run_table_csv(rows))
