"""`probewise fit`: fit a user's simulator to a table, without a diagnosis."""

import argparse

import numpy as np

from probewise._writing import Drawings, StagedFiles, checked_output_directory
from probewise.cli._common import CommandError, finish, progress_of
from probewise.cli._inputs import open_simulator, read_joined_table
from probewise.diagnosis import fit_json, fit_simulator
from probewise.report import fit as report
from probewise.systems import samples_csv, write_fitted_system


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

        def write_files(stage: StagedFiles) -> None:
            stage.write_json("fit.json", fit_json(fitted))
            write_fitted_system(fitted.fitted, stage / "fitted.json")
            stage.write("samples.csv", samples_csv(fitted.fitted))

        drawings.write_results(
            write_files,
            report.figure_drawers(fitted),
            lambda drawn: report.page_html(fitted, drawn, seed=arguments.seed),
            inputs=[*arguments.tables, arguments.simulator],
            progress=progress,
        )
    summary = f"{fitted.summary()}\nseed {arguments.seed}; written to {drawings.out}"
    return finish(arguments, drawings, *drawings.notes, summary)
