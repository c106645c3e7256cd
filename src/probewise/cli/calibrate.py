"""`probewise calibrate`: fit a sensor model to a recording, with the number of Gaussians chosen by evidence."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from probewise._writing import Drawings, checked_output_directory
from probewise.cli import _common as common
from probewise.cli._journal import refuse_journal
from probewise.errors import ParameterError
from probewise.verbs import CALIBRATION, N_LIVE, ORDERS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise calibrate`."""
    about = "recording, its JSON beside it; or paper or concealed, which ship"
    common.add(parser, "recording REC.csv", about, type=common.parse_recording)
    common.add_out(parser)
    about = f"numbers of Gaussians to compare (default {' '.join(map(str, ORDERS))})"
    common.add(parser, "--orders N", about, type=common.parse_count, nargs="+", default=list(ORDERS))
    about = f"live points where a number of Gaussians is searched in full (default {N_LIVE})"
    common.add(parser, "--live N", about, type=common.parse_count, default=N_LIVE)
    common.add(
        parser,
        "--method",
        "quick (default): samples from the peaks of the likelihood, until the evidence has clearly fallen, one "
        "search of the prior that vouches; full: the whole prior of every number of Gaussians is searched by nested "
        "sampling, and each evidence refined by importance sampling; paper: uniform priors, evidence by nested "
        "sampling alone",
        choices=("quick", "full", "paper"),
        default=CALIBRATION,
    )
    common.add_nested_stop(parser)
    common.add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate a sensor model; write sensor.json, report.html and the figures; return the exit status."""
    import numpy as np

    from probewise import verbs
    from probewise._progress import progress_shown
    from probewise.calibration import predict, write_sensor
    from probewise.recordings import read_recording
    from probewise.report import calibration as report

    common.refuse_nested_stop(arguments)
    refuse_journal(arguments.recording)
    drawings = Drawings(checked_output_directory(arguments.out, main="sensor.json"))
    orders = tuple(sorted(set(arguments.orders)))
    with progress_shown(quiet=arguments.quiet) as progress:
        recording = read_recording(arguments.recording, progress=progress)
        _require_enough_live_points(arguments.live, orders)
        result = verbs.calibrate(
            recording,
            orders=orders,
            n_live=arguments.live,
            method=arguments.method,
            nested_stop=arguments.nested_stop,
            rng=np.random.default_rng(arguments.seed),
            progress=progress,
        )
        prediction = predict(result.sensor, recording, progress=progress)
        notes = drawings.write_results(
            lambda stage: write_sensor(result.sensor, stage / "sensor.json"),
            report.figure_drawers(result, recording, prediction),
            lambda drawn: report.page_html(result, recording, prediction, drawn, seed=arguments.seed),
            inputs=common.tables_and_descriptions([arguments.recording]),
            progress=progress,
        )
    return common.finish(
        drawings,
        *(f"note: {note}" for note in recording.notes),
        *notes,
        f"{result.sensor.summary()}\nseed {arguments.seed}; written to {drawings.out}",
        quiet=arguments.quiet,
    )


def _require_enough_live_points(n_live: int, orders: Sequence[int]) -> None:
    """Raise ParameterError if these are too few live points for the largest number of Gaussians."""
    from probewise.nested import LIVE_PER_PARAM, least_live

    n_params = 6 * max(orders) + 2
    least, most = least_live(n_params), (n_live // LIVE_PER_PARAM - 2) // 6
    if n_live >= least:
        return
    if max(orders) <= max(ORDERS):
        allowed = f"{least} or more for the {n_params} parameters of --orders {max(orders)}"
        raise ParameterError("--live", n_live, allowed)
    takes = f"{max(orders)} Gaussians have {n_params} parameters, which take --live {least}"
    raise ParameterError("--orders", max(orders), f"up to {most} with --live {n_live}; {takes}")
