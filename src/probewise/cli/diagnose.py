"""`probewise diagnose`: which physics a sensor model, or a user's simulator, leaves out."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from probewise._writing import Drawings, StagedFiles, checked_output_directory
from probewise.cli import _common as common
from probewise.cli._executor import add_executor
from probewise.cli._journal import find_journal_sensor_file, is_journal, journal_recording_and_shape
from probewise.cli._simulator import add_simulator, open_simulator, read_joined_table
from probewise.errors import ParameterError

if TYPE_CHECKING:
    import numpy as np

    from probewise.calibration import FittedSensor
    from probewise.diagnosis import Diagnosis, PlanAudit
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
    if arguments.each:
        from probewise.cli._each import diagnose_each

        return diagnose_each(arguments, run)
    of_simulator = arguments.simulator is not None and arguments.scheduler is None
    if of_simulator:
        common.refuse_options(arguments, "--simulator, which replaces it", "sensor")
    elif arguments.workers > 1 or arguments.scheduler is not None:
        raise common.CommandError(
            "--workers and --scheduler are for --each, which diagnoses several recordings one by one"
        )
    from probewise import diagnosis as engine
    from probewise._progress import progress_shown
    from probewise.report import diagnosis as report

    drawings = Drawings(checked_output_directory(arguments.out, main="diagnosis.json"))
    source = ", ".join(path.name for path in arguments.recordings)
    rng, nested_rng, files_rng = generators_of_diagnosis(arguments.seed)
    outdated: tuple[str, ...] = OF_ONE_RUN
    audited: Callable[[], PlanAudit] | None = None
    with contextlib.ExitStack() as stack:
        simulator = (
            stack.enter_context(open_simulator(arguments.simulator, arguments.workers)) if of_simulator else None
        )
        progress = stack.enter_context(progress_shown(quiet=arguments.quiet))
        weigh_again = partial(engine.weigh_thoroughly, rng=nested_rng, progress=progress)
        options: dict[str, Any] = {"thorough": weigh_again if arguments.thorough else None, "rng": rng}
        if simulator is not None:
            table, said = read_joined_table(simulator, arguments.recordings)
            diagnosis = engine.diagnose_system(
                simulator, table, source=source, notes=said, progress=progress, **options
            )
            notes = (*diagnosis.recording.notes, *engine.notes_on_calls(diagnosis))
            files, read = partial(_write_files_of_simulator, diagnosis), [*arguments.recordings, arguments.simulator]
            advised, column, outdated = "next.csv", simulator.reading, _OF_ONE_RUN_OF_SIMULATOR
        else:
            recordings, sensor, shape = _read_inputs(arguments, progress=progress)
            joined = engine.join(recordings)
            null = None
            if sensor is not None and shape is not None:
                progress("searching for shapes that fit")
                null = engine.SensorAndShape.of(sensor, shape, joined, rng=rng)
            given = sensor if null is None else None
            diagnosis = engine.diagnose(joined, sensor=given, null=null, progress=progress, **options)
            if null is not None:
                diagnosis = diagnosis.with_shape_in_next_plan(null.shape)
            else:
                audited = partial(engine.audit_plan_of_diagnosis, diagnosis, sensor=sensor)
            files, notes = partial(write_files, diagnosis, rng=files_rng), joined.notes
            read = [*arguments.recordings, *([] if arguments.sensor is None else [arguments.sensor])]
            advised, column = engine.NEXT_PLAN, "reading"
        renamed = drawings.write_results(
            files,
            report.figure_drawers(diagnosis),
            lambda drawn: report.page_html(
                diagnosis, drawn, source=source, seed=arguments.seed, audit=None if audited is None else audited()
            ),
            inputs=common.inputs_and_filled_in_plan(read, drawings.out / advised, column),
            outdated=outdated,
            progress=progress,
        )
    summary = f"{diagnosis.summary()}\nseed {arguments.seed}; written to {drawings.out}"
    return common.finish(drawings, *(f"note: {n}" for n in notes), *renamed, summary, quiet=arguments.quiet)


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
