"""`probewise fit`: fit a user's simulator to a table, without a diagnosis."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from probewise._writing import Drawings, checked_output_directory
from probewise.cli._common import CommandError, add, add_out, add_seed_and_quiet, finish, parse_path
from probewise.cli._simulator import add_simulator, add_workers, open_simulator, read_joined_table

if TYPE_CHECKING:
    from probewise._writing import StagedFiles


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise fit`."""
    add(parser, "tables DATA.csv", "table of readings; several are fitted together", type=parse_path, nargs="+")
    add_simulator(parser, replaces="")
    add_workers(parser)
    add(parser, "--thorough", "compute the evidence by nested sampling as well")
    add_out(parser)
    add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fit a simulator; write fit.json, fitted.json, samples.csv, report.html and figures; return the exit status."""
    import numpy as np

    from probewise._progress import progress_shown
    from probewise.diagnosis import fit_json, fit_simulator
    from probewise.report import fit as report
    from probewise.systems import samples_csv, write_fitted_system

    if arguments.simulator is None:
        raise CommandError("--simulator FILE.py is missing; to fit a light sensor, use probewise calibrate")
    drawings = Drawings(checked_output_directory(arguments.out, main="fit.json"))
    source = ", ".join(path.name for path in arguments.tables)
    with (
        open_simulator(arguments.simulator, arguments.workers) as simulator,
        progress_shown(quiet=arguments.quiet) as progress,
    ):
        table, notes = read_joined_table(simulator, arguments.tables)
        rng = np.random.default_rng(arguments.seed)
        fitted = fit_simulator(
            simulator, table, source=source, notes=notes, thorough=arguments.thorough, rng=rng, progress=progress
        )

        def write_files(stage: StagedFiles) -> None:
            stage.write_json("fit.json", fit_json(fitted))
            write_fitted_system(fitted.fitted, stage / "fitted.json")
            stage.write("samples.csv", samples_csv(fitted.fitted))

        renamed = drawings.write_results(
            write_files,
            report.figure_drawers(fitted),
            lambda drawn: report.page_html(fitted, drawn, seed=arguments.seed),
            inputs=[*arguments.tables, arguments.simulator],
            progress=progress,
        )
    return finish(
        drawings,
        *renamed,
        f"{fitted.summary()}\nseed {arguments.seed}; written to {drawings.out}",
        quiet=arguments.quiet,
    )
