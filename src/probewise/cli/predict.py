"""`probewise predict`: what a sensor model expects of a plan, and how well it expected a recording."""

from __future__ import annotations

import argparse

from probewise.cli._common import Verb, a_path, add_quiet, say
from probewise.cli._output import check_out_file

__all__ = ["VERB"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fill the verb's parser."""
    parser.add_argument(
        "sensor", type=a_path, metavar="S.json", help="sensor model, as calibrate and diagnose write it"
    )
    parser.add_argument("plan", type=a_path, metavar="PLAN.csv", help="plan or recording, its JSON beside it")
    parser.add_argument("--out", type=a_path, required=True, metavar="P.csv", help="where the prediction goes")
    add_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Predict every row, and say how well the readings were expected where there are any."""
    from probewise._progress import progress_shown
    from probewise.calibration import predict, read_sensor
    from probewise.recordings import read_plan_and_readings, write_prediction

    out = check_out_file(arguments.out, arguments.sensor, arguments.plan)
    with progress_shown(quiet=arguments.quiet) as progress:
        sensor = read_sensor(arguments.sensor)
        plan, readings = read_plan_and_readings(arguments.plan, progress=progress)
        prediction = predict(sensor, plan, readings, progress=progress)
        progress(f"writing {out.name}")
        out.parent.mkdir(parents=True, exist_ok=True)
        write_prediction(prediction, out)
    say(f"{prediction.summary()}\nwritten to {out}", quiet=arguments.quiet)
    return 0


VERB = Verb("predict", "Predict the readings of a plan: mean, sd, log density, a row each.", add_arguments, run)
