"""`probewise audit`: which effects a plan cannot detect or tell apart, and which readings would help."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from probewise.cli._common import Verb, add_path, add_quiet, print_result
from probewise.cli._journal import refuse_journal
from probewise.cli._output import (
    PAGE,
    Drawings,
    checked_output_directory,
    holds_readings,
    staged_output,
    tables_and_descriptions,
)
from probewise.cli._simulator import add_simulator, refuse_sensor_options

if TYPE_CHECKING:
    from probewise.diagnosis import PlanAudit
    from probewise.progress import Progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise audit`."""
    add_path(parser, "plan", "PLAN.csv", "plan or recording, its JSON beside it; with --simulator any table")
    add_path(parser, "--sensor", "S.json", "the calibrated sensor (default: a typical one)")
    add_simulator(parser)
    add_path(
        parser,
        "--out",
        "DIR",
        "directory for audit.json, audit.png, report.html and (without --simulator) cure_plan.csv; by default only the "
        "text is printed",
    )
    add_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Audit a plan, print the summary, and write the results if --out is given; return the exit status."""
    from probewise._progress import progress_shown
    from probewise.calibration import read_sensor
    from probewise.diagnosis import audit_plan
    from probewise.recordings import read_plan

    refuse_journal(arguments.plan)
    out = None if arguments.out is None else checked_output_directory(arguments.out)
    with progress_shown(quiet=arguments.quiet) as progress:
        if arguments.simulator is not None:
            audit = _audit_simulator(arguments, progress)
        else:
            plan = read_plan(arguments.plan, progress=progress)
            sensor = None if arguments.sensor is None else read_sensor(arguments.sensor)
            audit = audit_plan(plan, sensor=sensor, progress=progress)
        drawings = None if out is None else Drawings(out)
        notes = [] if drawings is None else _write_results(audit, drawings, arguments.plan, progress)
    print_result(audit.summary(), quiet=arguments.quiet)
    for note in (*getattr(audit.plan, "notes", ()), *notes):
        print_result(f"note: {note}", quiet=arguments.quiet)
    if drawings is not None:
        print_result(f"written to {out}", quiet=arguments.quiet)
        drawings.raise_if_any_failed()
    return 0


def _audit_simulator(arguments: argparse.Namespace, progress: Progress) -> PlanAudit:
    from probewise.diagnosis import audit_system
    from probewise.systems import read_simulator, read_table_for

    refuse_sensor_options(arguments, "sensor")
    simulator = read_simulator(arguments.simulator)
    table = read_table_for(simulator, arguments.plan)
    progress("building the effects")
    return audit_system(simulator, table)


def _write_results(audit: PlanAudit, drawings: Drawings, plan: Path, progress: Progress) -> list[str]:
    from probewise.diagnosis import CURE_PLAN, audit_json
    from probewise.recordings import write_plan
    from probewise.report import audit as report

    figures, read = report.figure_drawers(audit), _files_not_to_replace(plan, drawings.out)
    cures = (CURE_PLAN, Path(CURE_PLAN).with_suffix(".json").name)
    with staged_output(drawings.out, inputs=read, outdated=(*cures, *figures, PAGE)) as stage:
        stage.write_json("audit.json", audit_json(audit))
        if audit.cure_plan is not None:
            write_plan(audit.cure_plan, stage / CURE_PLAN)
    drawings.write_report(
        figures, lambda drawn: report.page_html(audit, drawn, source=plan.name), inputs=read, progress=progress
    )
    return stage.notes_on_renamed_inputs


def _files_not_to_replace(plan: Path, out: Path) -> list[Path]:
    """List files that results must not replace: the plan, and an earlier cure plan with readings filled in."""
    from probewise.diagnosis import CURE_PLAN

    filled_in = out / CURE_PLAN
    return tables_and_descriptions([plan, *([filled_in] if holds_readings(filled_in, "reading") else [])])


VERB = Verb("audit", "List, before any data, the effects that a plan cannot detect or tell apart.", add_arguments, run)
