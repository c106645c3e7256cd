"""`probewise diagnose --simulator`: which physics a user's simulator leaves out."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, cast

from probewise.cli._common import print_result
from probewise.cli._output import (
    PAGE,
    Drawings,
    StagedFiles,
    checked_output_directory,
    holds_readings,
    staged_output,
)
from probewise.cli._simulator import read_joined_table, refuse_sensor_options

if TYPE_CHECKING:
    from probewise.diagnosis import Diagnosis
    from probewise.systems import RunTable

_OF_ONE_RUN = ("witness_*.svg", "gain.svg", "next.csv")


def diagnose_simulator(arguments: argparse.Namespace) -> int:
    """Diagnose a user's simulator; write diagnosis.json, both models, next.csv and report; return the exit status."""
    from functools import partial

    import numpy as np

    from probewise._progress import progress_shown
    from probewise.diagnosis import diagnose_system, notes_on_calls, weigh_thoroughly
    from probewise.report import diagnosis as report
    from probewise.systems import read_simulator

    refuse_sensor_options(arguments, "sensor")
    out = checked_output_directory(arguments.out)
    simulator = read_simulator(arguments.simulator)
    table, notes = read_joined_table(simulator, arguments.recordings)
    diagnosis_rng, nested_rng = np.random.default_rng(arguments.seed).spawn(2)
    with progress_shown(quiet=arguments.quiet) as progress:
        weigh_again = partial(weigh_thoroughly, rng=nested_rng, progress=progress)
        diagnosis = diagnose_system(
            simulator,
            table,
            source=", ".join(path.name for path in arguments.recordings),
            notes=notes,
            thorough=weigh_again if arguments.thorough else None,
            rng=diagnosis_rng,
            progress=progress,
        )
        read, source = _files_not_to_replace(arguments, out, simulator.reading), diagnosis.recording.source
        figures, drawings = report.figure_drawers(diagnosis), Drawings(out)
        with staged_output(out, inputs=read, outdated=(*_OF_ONE_RUN, *figures, PAGE)) as stage:
            write_results(diagnosis, stage)
        drawings.write_report(
            figures,
            lambda drawn: report.page_html(diagnosis, drawn, source=source, seed=arguments.seed),
            inputs=read,
            progress=progress,
        )
    for note in (*diagnosis.recording.notes, *notes_on_calls(diagnosis), *stage.notes_on_renamed_inputs):
        print_result(f"note: {note}", quiet=arguments.quiet)
    print_result(f"{diagnosis.summary()}\nseed {arguments.seed}; written to {out}", quiet=arguments.quiet)
    drawings.raise_if_any_failed()
    return 0


def write_results(diagnosis: Diagnosis, stage: StagedFiles) -> None:
    """Write diagnosis.json, the calibrated and the repaired simulator, and the next rows to take."""
    from probewise.diagnosis import calibrated_of, diagnosis_json, repaired_of
    from probewise.systems import run_table_csv, write_fitted_system

    stage.write_json("diagnosis.json", diagnosis_json(diagnosis))
    write_fitted_system(repaired_of(diagnosis), stage / "repaired.json")
    write_fitted_system(calibrated_of(diagnosis), stage / "calibrated.json")
    if diagnosis.next_measurement is not None:
        asked = cast("RunTable", diagnosis.next_measurement.plan)
        stage.write(diagnosis.apparatus.words.next_plan, run_table_csv(asked))


def _files_not_to_replace(arguments: argparse.Namespace, out: Path, reading: str) -> list[Path]:
    """List files that results must not replace: inputs, and an earlier next.csv with readings filled in."""
    read = [*arguments.recordings, arguments.simulator]
    filled_in = out / "next.csv"
    return [*read, *([filled_in] if holds_readings(filled_in, reading) else [])]
