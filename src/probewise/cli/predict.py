"""`probewise predict`: predict the readings of a plan, and score the prediction of a recording."""

import argparse

import numpy as np

from probewise import calibration, recordings, systems
from probewise._writing import checked_output_file
from probewise.cli._common import note_if_replaced, progress_of, say
from probewise.cli._inputs import refuse_journal, tables_and_descriptions


def run(arguments: argparse.Namespace) -> int:
    """Predict every row of a plan, score the prediction of readings, write a CSV file; return the exit status."""
    refuse_journal(arguments.plan)
    simulator = arguments.simulator
    read = tables_and_descriptions([arguments.plan]) if simulator is None else [arguments.plan, simulator]
    out = checked_output_file(arguments.out, arguments.sensor, *read)
    earlier = note_if_replaced(out)
    with progress_of(arguments) as progress:
        if simulator is not None:
            fitted = systems.read_fitted_system(arguments.sensor, simulator)  # a changed file is not run
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
    say(arguments, *earlier, f"{summary}\nwritten to {out}")
    return 0
