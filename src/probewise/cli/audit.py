"""`probewise audit`: which effects a plan cannot detect or tell apart, and which readings would help."""

import argparse

from probewise import diagnosis
from probewise._writing import Drawings, checked_output_directory
from probewise.calibration import read_sensor
from probewise.cli._common import finish, progress_of, say
from probewise.cli._inputs import open_simulator, read_or_shipped_plan, refuse_journal, tables_and_descriptions
from probewise.cli._options import refuse_options
from probewise.report.audit import output_of
from probewise.systems import read_table_for


def run(arguments: argparse.Namespace) -> int:
    """Audit a plan, print the summary, and write the results if --out is given; return the exit status."""
    refuse_journal(arguments.plan)
    drawings = None if arguments.out is None else Drawings(checked_output_directory(arguments.out, main="audit.json"))
    with progress_of(arguments) as progress:
        if arguments.simulator is not None:
            refuse_options(arguments, "--simulator, which replaces it", "sensor")
            with open_simulator(arguments) as simulator:
                table = read_table_for(simulator, arguments.plan)
                progress("building the effects")
                audit = diagnosis.audit_system(simulator, table)
        else:
            plan = read_or_shipped_plan(str(arguments.plan), progress=progress)
            sensor = None if arguments.sensor is None else read_sensor(arguments.sensor)
            audit = diagnosis.audit_plan(plan, sensor=sensor, progress=progress)
        if drawings is not None:
            made, inputs = output_of(audit, source=arguments.plan.name), tables_and_descriptions([arguments.plan])
            drawings.write_results(made, inputs=inputs, progress=progress)
    say(arguments, audit.summary(), *(f"note: {note}" for note in getattr(audit.plan, "notes", ())))
    return 0 if drawings is None else finish(arguments, drawings, f"written to {drawings.out}")
