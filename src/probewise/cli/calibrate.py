"""`probewise calibrate`: fit a sensor model to a recording, with the number of Gaussians chosen by evidence."""

import argparse

import numpy as np

from probewise import verbs
from probewise._writing import Drawings, checked_output_directory
from probewise.cli._common import finish, progress_of
from probewise.cli._inputs import refuse_journal, tables_and_descriptions
from probewise.recordings import read_recording
from probewise.report.calibration import output_of


def run(arguments: argparse.Namespace) -> int:
    """Calibrate a sensor model; write sensor.json, report.html and the figures; return the exit status."""
    refuse_journal(arguments.recording)
    drawings = Drawings(checked_output_directory(arguments.out, main="sensor.json"))
    with progress_of(arguments) as progress:
        recording = read_recording(arguments.recording, progress=progress)
        result = verbs.calibrate(
            recording,
            orders=sorted(set(arguments.orders)),
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
