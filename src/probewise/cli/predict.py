"""`probewise predict`: predict the readings of a plan, and score the prediction of a recording."""

from __future__ import annotations

import argparse

from probewise.cli._common import Verb, add_path, add_seed_and_quiet, parse_path, print_result
from probewise.cli._journal import refuse_journal
from probewise.cli._output import checked_output_file, tables_and_descriptions
from probewise.cli._simulator import add_simulator


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise predict`."""
    add_path(
        parser,
        "sensor",
        "S.json",
        "sensor model, as calibrate and diagnose write it; with --simulator a repaired.json, calibrated.json or "
        "fitted.json",
    )
    add_path(parser, "plan", "PLAN.csv", "plan or recording, its JSON beside it; with --simulator any table")
    parser.add_argument("--out", type=parse_path, required=True, metavar="P.csv", help="where the prediction goes")
    add_simulator(parser)
    add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Predict every row of a plan, score the prediction of readings, write a CSV file; return the exit status."""
    refuse_journal(arguments.plan)
    if arguments.simulator is not None:
        return _predict_by_simulator(arguments)
    from probewise._progress import progress_shown
    from probewise.calibration import predict, read_sensor
    from probewise.recordings import read_plan_and_readings, write_prediction

    out = checked_output_file(arguments.out, arguments.sensor, *tables_and_descriptions([arguments.plan]))
    with progress_shown(quiet=arguments.quiet) as progress:
        sensor = read_sensor(arguments.sensor)
        plan, readings = read_plan_and_readings(arguments.plan, progress=progress)
        prediction = predict(sensor, plan, readings, progress=progress)
        progress(f"writing {out.name}")
        out.parent.mkdir(parents=True, exist_ok=True)
        write_prediction(prediction, out)
    print_result(f"{prediction.summary()}\nwritten to {out}", quiet=arguments.quiet)
    return 0


def _predict_by_simulator(arguments: argparse.Namespace) -> int:
    """Predict every row of a table with a user's simulator, fitted or repaired; return the exit status."""
    import numpy as np

    from probewise._progress import progress_shown
    from probewise.systems import (
        predict_system,
        read_fitted_system,
        read_table_for,
        write_system_prediction,
    )

    out = checked_output_file(arguments.out, arguments.sensor, arguments.plan, arguments.simulator)
    fitted = read_fitted_system(arguments.sensor, arguments.simulator)  # a file that was changed is not run
    table = read_table_for(fitted.simulator, arguments.plan)
    with progress_shown(quiet=arguments.quiet) as progress:
        prediction = predict_system(fitted, table, rng=np.random.default_rng(arguments.seed), progress=progress)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_system_prediction(prediction, out)
    for note in table.notes:
        print_result(f"note: {note}", quiet=arguments.quiet)
    print_result(f"{prediction.summary()}\nwritten to {out}", quiet=arguments.quiet)
    return 0


VERB = Verb("predict", "Predict the readings of a plan: mean, sd and log density of each row.", add_arguments, run)
