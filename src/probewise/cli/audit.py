"""`probewise audit`: which effects a plan cannot detect or tell apart, and which readings would help."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from probewise._writing import Drawings, checked_output_directory
from probewise.cli._arm import SHIPPED, read_or_shipped_plan
from probewise.cli._common import (
    add,
    add_quiet,
    finish,
    inputs_and_filled_in_plan,
    parse_path,
    print_result,
    refuse_options,
)
from probewise.cli._journal import refuse_journal
from probewise.cli._simulator import add_simulator, add_workers, open_simulator

if TYPE_CHECKING:
    from probewise._writing import StagedFiles


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise audit`."""
    about = f"plan or recording, its JSON beside it; or {' or '.join(SHIPPED)}, which ship; with --simulator any table"
    add(parser, "plan PLAN.csv", about, type=parse_path)
    add(parser, "--sensor S.json", "the calibrated sensor (default: a typical one)", type=parse_path)
    add_simulator(parser)
    add_workers(parser)
    about = (
        "directory for audit.json, audit.png, report.html and (without --simulator) cure_plan.csv; by default only the "
        "text is printed"
    )
    add(parser, "--out DIR", about, type=parse_path)
    add_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Audit a plan, print the summary, and write the results if --out is given; return the exit status."""
    from probewise import diagnosis
    from probewise._progress import progress_shown
    from probewise.calibration import read_sensor
    from probewise.diagnosis import CURE_PLAN, audit_json
    from probewise.recordings import write_plan
    from probewise.report import audit as report
    from probewise.systems import read_table_for

    refuse_journal(arguments.plan)
    drawings = None if arguments.out is None else Drawings(checked_output_directory(arguments.out, main="audit.json"))
    with progress_shown(quiet=arguments.quiet) as progress:
        if arguments.simulator is not None:
            refuse_options(arguments, "--simulator, which replaces it", "sensor")
            with open_simulator(arguments.simulator, arguments.workers) as simulator:
                table = read_table_for(simulator, arguments.plan)
                progress("building the effects")
                audit = diagnosis.audit_system(simulator, table)
        else:
            plan = read_or_shipped_plan(str(arguments.plan), progress=progress)
            sensor = None if arguments.sensor is None else read_sensor(arguments.sensor)
            audit = diagnosis.audit_plan(plan, sensor=sensor, progress=progress)

        def write_files(stage: StagedFiles) -> None:
            stage.write_json("audit.json", audit_json(audit))
            if audit.cure_plan is not None:
                write_plan(audit.cure_plan, stage / CURE_PLAN)

        renamed = []
        if drawings is not None:
            renamed = drawings.write_results(
                write_files,
                report.figure_drawers(audit),
                lambda drawn: report.page_html(audit, drawn, source=arguments.plan.name),
                inputs=inputs_and_filled_in_plan([arguments.plan], drawings.out / CURE_PLAN),
                outdated=(CURE_PLAN, Path(CURE_PLAN).with_suffix(".json").name),
                progress=progress,
            )
    lines = [audit.summary(), *(f"note: {note}" for note in getattr(audit.plan, "notes", ())), *renamed]
    if drawings is not None:
        return finish(drawings, *lines, f"written to {drawings.out}", quiet=arguments.quiet)
    for line in lines:
        print_result(line, quiet=arguments.quiet)
    return 0
