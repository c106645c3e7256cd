"""`probewise diagnose`: which physics the sensor model leaves out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from probewise.cli._common import Verb, add_out_directory, add_path, add_seed_and_quiet, parse_path, print_result
from probewise.cli._diagnose_system import diagnose_simulator
from probewise.cli._journal import find_journal_sensor_file, is_journal, journal_recording_and_shape
from probewise.cli._output import (
    PAGE,
    Drawings,
    StagedFiles,
    checked_output_directory,
    holds_readings,
    staged_output,
    tables_and_descriptions,
)
from probewise.cli._simulator import add_simulator
from probewise.errors import ParameterError

if TYPE_CHECKING:
    import numpy as np

    from probewise.calibration import FittedSensor
    from probewise.diagnosis import Diagnosis
    from probewise.progress import Progress
    from probewise.recordings import Recording
    from probewise.scene import Shape

OF_ONE_RUN = ("witness_*.svg", "gain.svg", "next_plan.csv", "next_plan.json")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise diagnose`."""
    parser.add_argument(
        "recordings",
        type=parse_path,
        nargs="+",
        metavar="REC.csv",
        help="recording, its JSON beside it, or the journal.jsonl of an explore run; with --simulator any table; "
        "several are diagnosed together",
    )
    add_path(
        parser,
        "--sensor",
        "S.json",
        "an earlier calibration, whose posterior becomes the prior (default with a journal: the one of its run)",
    )
    add_simulator(parser)
    parser.add_argument(
        "--thorough",
        action="store_true",
        help="compute the evidence of the leading hypotheses by nested sampling too; it replaces the Laplace "
        "approximation where they differ by more than one nat plus its standard error and no run gives a warning "
        "(first says how long it may take)",
    )
    add_out_directory(parser)
    add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Diagnose; write diagnosis.json, both models, the next plan, report and figures; return the exit status."""
    if arguments.simulator is not None:
        return diagnose_simulator(arguments)
    from functools import partial

    from probewise._progress import progress_shown
    from probewise.diagnosis import SensorAndShape, audit_plan_of_diagnosis, diagnose, join, weigh_thoroughly
    from probewise.report import diagnosis as report

    out = checked_output_directory(arguments.out)
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
            diagnosis = null.with_shape_in_next_plan(diagnosis)
        source = ", ".join(path.name for path in arguments.recordings)
        read = [*arguments.recordings, *([] if arguments.sensor is None else [arguments.sensor])]
        spared, figures, drawings = files_not_to_replace(read, out), report.figure_drawers(diagnosis), Drawings(out)
        with staged_output(out, inputs=spared, outdated=(*OF_ONE_RUN, *figures, PAGE)) as stage:
            write_results(diagnosis, stage, rng=files_rng)

        def page(drawn: Mapping[str, bytes]) -> str:
            audit = None if null is not None else audit_plan_of_diagnosis(diagnosis, sensor=sensor)
            return report.page_html(diagnosis, drawn, source=source, seed=arguments.seed, audit=audit)

        drawings.write_report(figures, page, inputs=spared, progress=progress)
    for note in (*joined.notes, *stage.notes_on_renamed_inputs):
        print_result(f"note: {note}", quiet=arguments.quiet)
    print_result(f"{diagnosis.summary()}\nseed {arguments.seed}; written to {out}", quiet=arguments.quiet)
    drawings.raise_if_any_failed()
    return 0


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
    if arguments.sensor is None:
        return [read_recording(path, progress=progress) for path in arguments.recordings], None, None
    if len(journals) > 1:
        raise ParameterError("journals", len(journals), "one at a time: each run has its own unknown shape")
    sensor, recordings, shape = read_sensor(arguments.sensor), [], None
    for path in arguments.recordings:
        if path in journals:
            recording, shape = journal_recording_and_shape(path, sensor)
        else:
            recording = read_recording(path, progress=progress)
        recordings.append(recording)
    return recordings, sensor, shape


def generators_of_diagnosis(seed: int) -> Sequence[np.random.Generator]:
    """Return the generators of a diagnosis, of its nested sampling, and of the samples in its files."""
    import numpy as np

    return np.random.default_rng(seed).spawn(3)


def files_not_to_replace(read: Sequence[Path], out: Path) -> list[Path]:
    """List files that results must not replace: inputs, and an earlier next plan with readings filled in."""
    from probewise.diagnosis import NEXT_PLAN

    filled_in = out / NEXT_PLAN
    return tables_and_descriptions([*read, *([filled_in] if holds_readings(filled_in, "reading") else [])])


def write_results(diagnosis: Diagnosis, stage: StagedFiles, *, rng: np.random.Generator) -> None:
    """Write diagnosis.json, both sensor models and the next plan."""
    from probewise.calibration import write_sensor
    from probewise.diagnosis import NEXT_PLAN, diagnosis_json
    from probewise.recordings import write_plan

    stage.write_json("diagnosis.json", diagnosis_json(diagnosis))
    write_sensor(diagnosis.repaired.fitted_sensor(diagnosis.recording, rng=rng), stage / "sensor.json")
    write_sensor(diagnosis.null.fitted_sensor(diagnosis.recording, rng=rng), stage / "calibrated.json")
    if diagnosis.next_measurement is not None:
        write_plan(diagnosis.next_measurement.plan, stage / NEXT_PLAN)


VERB = Verb(
    "diagnose",
    "Find which physics a sensor model, or a simulator of your own, leaves out of recordings.",
    add_arguments,
    run,
)
