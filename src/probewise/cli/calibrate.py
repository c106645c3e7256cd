"""`probewise calibrate`: fit a sensor model to a recording, with the number of Gaussians chosen by evidence."""

import argparse
from collections.abc import Sequence

import numpy as np

from probewise import verbs
from probewise._writing import Drawings, checked_output_directory
from probewise.cli._common import finish, progress_of
from probewise.cli._inputs import refuse_journal, tables_and_descriptions
from probewise.errors import ParameterError
from probewise.nested import LIVE_PER_PARAM, least_live
from probewise.recordings import read_recording
from probewise.report.calibration import output_of


def run(arguments: argparse.Namespace) -> int:
    """Calibrate a sensor model; write sensor.json, report.html and the figures; return the exit status."""
    if arguments.nested_stop is not None and arguments.method != "paper":
        raise ParameterError("--nested-stop", arguments.nested_stop, "only with --method paper")
    refuse_journal(arguments.recording)
    drawings = Drawings(checked_output_directory(arguments.out, main="sensor.json"))
    orders = tuple(sorted(set(arguments.orders)))
    with progress_of(arguments) as progress:
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
        inputs = tables_and_descriptions([arguments.recording])
        drawings.write_results(output_of(result, seed=arguments.seed), inputs=inputs, progress=progress)
    notes = (f"note: {note}" for note in recording.notes)
    summary = f"{result.sensor.summary()}\nseed {arguments.seed}; written to {drawings.out}"
    return finish(arguments, drawings, *notes, summary)


def _require_enough_live_points(n_live: int, orders: Sequence[int]) -> None:
    """Raise ParameterError if these are too few live points for the largest number of Gaussians."""
    most_gaussians = max(orders)
    n_params = 6 * most_gaussians + 2
    least = least_live(n_params)
    if n_live >= least:
        return
    if most_gaussians <= max(verbs.ORDERS):
        allowed = f"{least} or more for the {n_params} parameters of --orders {most_gaussians}"
        raise ParameterError("--live", n_live, allowed)
    most = (n_live // LIVE_PER_PARAM - 2) // 6
    takes = f"{most_gaussians} Gaussians have {n_params} parameters, which take --live {least}"
    raise ParameterError("--orders", most_gaussians, f"up to {most} with --live {n_live}; {takes}")
