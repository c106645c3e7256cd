"""`probewise predict`: predict the readings of a plan, and score the prediction of a recording."""

from __future__ import annotations

import argparse

from probewise._writing import checked_output_file
from probewise.cli import _common as common
from probewise.cli._journal import refuse_journal
from probewise.cli._simulator import add_simulator


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise predict`."""
    about = "sensor model, as calibrate and diagnose write it; with --simulator a repaired.json, calibrated.json or "
    common.add(parser, "sensor S.json", f"{about}fitted.json", type=common.parse_path)
    about = "plan or recording, its JSON beside it; or paper or concealed, which ship; with --simulator any table"
    common.add(parser, "plan PLAN.csv", about, type=common.parse_recording)
    common.add(parser, "--out P.csv", "where the prediction goes", type=common.parse_path, required=True)
    add_simulator(parser)
    common.add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Predict every row of a plan, score the prediction of readings, write a CSV file; return the exit status."""
    import numpy as np

    from probewise import calibration, recordings, systems
    from probewise._progress import progress_shown

    refuse_journal(arguments.plan)
    read = common.tables_and_descriptions([arguments.plan]) if arguments.simulator is None else [arguments.plan]
    read += [] if arguments.simulator is None else [arguments.simulator]
    out = checked_output_file(arguments.out, arguments.sensor, *read)
    earlier = common.note_if_replaced(out)
    with progress_shown(quiet=arguments.quiet) as progress:
        if arguments.simulator is not None:
            fitted = systems.read_fitted_system(arguments.sensor, arguments.simulator)  # a changed file is not run
            table = systems.read_table_for(fitted.simulator, arguments.plan)
            rng = np.random.default_rng(arguments.seed)
            by_system = systems.predict_system(fitted, table, rng=rng, progress=progress)
            out.parent.mkdir(parents=True, exist_ok=True)
            systems.write_system_prediction(by_system, out)
            summary = by_system.summary()
        else:
            sensor = calibration.read_sensor(arguments.sensor)
            plan, readings = recordings.read_plan_and_readings(arguments.plan, progress=progress)
            prediction = calibration.predict(sensor, plan, readings, progress=progress)
            progress(f"writing {out.name}")
            out.parent.mkdir(parents=True, exist_ok=True)
            recordings.write_prediction(prediction, out)
            summary = prediction.summary()
    for note in earlier:
        common.print_result(note, quiet=arguments.quiet)
    common.print_result(f"{summary}\nwritten to {out}", quiet=arguments.quiet)
    return 0
