"""`probewise fit`: fit a user's simulator to a table, without a diagnosis."""

import argparse

import numpy as np

from probewise._writing import Drawings, checked_output_directory
from probewise.cli._common import CommandError, finish, progress_of
from probewise.cli._inputs import open_simulator, read_joined_table
from probewise.diagnosis import fit_simulator
from probewise.report.fit import output_of


def run(arguments: argparse.Namespace) -> int:
    """Fit a simulator; write fit.json, fitted.json, samples.csv, report.html and figures; return the exit status."""
    if arguments.simulator is None:
        raise CommandError("--simulator FILE.py is missing; to fit a light sensor, use probewise calibrate")
    drawings = Drawings(checked_output_directory(arguments.out, main="fit.json"))
    source = ", ".join(path.name for path in arguments.tables)
    with open_simulator(arguments) as simulator, progress_of(arguments) as progress:
        table, notes = read_joined_table(simulator, arguments.tables)
        rng = np.random.default_rng(arguments.seed)
        fitted = fit_simulator(
            simulator, table, source=source, notes=notes, thorough=arguments.thorough, rng=rng, progress=progress
        )
        inputs = [*arguments.tables, arguments.simulator]
        drawings.write_results(output_of(fitted, seed=arguments.seed), inputs=inputs, progress=progress)
    summary = f"{fitted.summary()}\nseed {arguments.seed}; written to {drawings.out}"
    return finish(arguments, drawings, summary)
