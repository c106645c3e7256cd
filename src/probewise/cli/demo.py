"""`probewise demo`: the paper end to end, on the recordings that ship, in two processes; then all files."""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from probewise import diagnosis as engine
from probewise._writing import Drawings, Output, StagedFiles, checked_output_directory
from probewise.arm import Pose, read_geometry, shipped_geometry_path
from probewise.calibration import FittedSensor, calibrate, predict, write_sensor
from probewise.cli._common import progress_of, say
from probewise.cli._executor import worker_pool
from probewise.cli._options import parse_finite_numbers
from probewise.diagnosis import Diagnosis, generators_of_diagnosis
from probewise.experiment import Exploration, HiddenShape, ModelName, arm_over, experiment_for, run_from_place
from probewise.inquiry import ReadingEntropy
from probewise.progress import Progress
from probewise.recordings import read_recording, shipped
from probewise.scene import Circle, Field
from probewise.world import saturation
from probewise.world.shipped import true_world as world_behind

DIAGNOSIS = "diagnosis"  # folder of the second recording's diagnosis
_MODELS: dict[ModelName, str] = {"naive": "naive", "ssf": "SSF"}
N_LIVE = 100  # live points of the calibration; --full uses the paper's 300
N_LIVE_ROBOT = 100
MAX_READINGS = 80
MAX_READINGS_DOUBT = 20  # bounds the time of the demo
_CIRCLE = Circle(radius_mm=(50.0, 150.0), inside=True)
"""The hypothesised shape: a circle entirely on the field."""


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, search and diagnose, write all files, and print the summary; return the exit status."""
    out = checked_output_directory(arguments.out, DIAGNOSIS, main="answers.json")
    checked_output_directory(out / DIAGNOSIS, main="diagnosis.json")
    hidden = HiddenShape.drawn_from_prior({"circle": _CIRCLE}, rng=np.random.default_rng([arguments.seed, 0]))
    if arguments.truth is not None:
        values = parse_finite_numbers("--truth", arguments.truth, 3, "X,Y,R in mm, such as 600,260,90")
        hidden = HiddenShape.from_parameters("circle", _CIRCLE, np.array(values), called=f"--truth {arguments.truth}")
    with progress_of(arguments) as progress:
        drawings, lines = _run_demo(out, hidden, seed=arguments.seed, full=arguments.full, progress=progress)
    say(arguments, *lines)
    for each in drawings:
        each.raise_if_any_failed()
    return 0


def _run_demo(
    out: Path, hidden: HiddenShape, *, seed: int, full: bool, progress: Progress
) -> tuple[list[Drawings], list[str]]:
    from probewise.report import demo as report  # here, as the processes that search import this file and draw nothing
    from probewise.report.diagnosis import output_of

    started = time.monotonic()
    doing = "calibrating, searching and diagnosing"
    with worker_pool(2) as pool:
        progress(doing, 0, 6)
        diagnosing = pool.submit(diagnose_shipped_recording, seed)
        orders, n_live = ((1, 2, 3, 4), 300) if full else ((1, 2), N_LIVE)
        recording, rng = read_recording(shipped("paper")), np.random.default_rng([seed, 1])
        calibration = calibrate(recording, orders=orders, n_live=n_live, rng=rng, executor=pool)
        sensor = calibration.sensor

        def seek(stream: int, max_readings: int = MAX_READINGS, **options: Any) -> Any:
            return pool.submit(_search, sensor, hidden, seed, stream, max_readings=max_readings, **options)

        doubts: dict[str, Any] = {"saturates_at": report.SATURATION, "max_readings": MAX_READINGS_DOUBT}
        doubting = {name: seek(7, trust=trust, **doubts) for name, trust in {"trusting": 1.0, "doubting": 0.9}.items()}
        searching = {name: seek(6, model=model, utility=ReadingEntropy()) for model, name in _MODELS.items()}
        parts: list[Any] = [diagnosing, *doubting.values(), *searching.values()]
        progress(doing, 1, 6)
        for done, future in enumerate(as_completed(parts), start=2):
            future.result()
            progress(doing, done, 6)
    diagnosis, prediction = diagnosing.result(), predict(sensor, recording.plan, recording.readings)
    searches, doubted = ({name: run.result() for name, run in runs.items()} for runs in (searching, doubting))
    concealed = ", ".join(effect.name for effect in world_behind("concealed").concealed)
    geometry = read_geometry(shipped_geometry_path())
    found = report.DemoRun(calibration, recording, prediction, searches, doubted, diagnosis, geometry, concealed, seed)
    figures, made = report.figure_drawers(found), output_of(diagnosis, seed=seed, source="concealed.csv")
    seconds = time.monotonic() - started

    def write_files(stage: StagedFiles) -> None:
        write_sensor(sensor, stage / "sensor.json")
        answers = report.main_findings_by_key(found)
        stage.write("answers.json", json.dumps(answers, indent=1, ensure_ascii=False) + "\n")

    page = partial(report.page_html, found, seconds=seconds)
    drawings = [Drawings(out / DIAGNOSIS), Drawings(out)]
    for each, output in zip(drawings, (made, Output(write_files, figures, page, "answers.json")), strict=True):
        each.write_results(output, progress=progress)
    return drawings, [
        *dict.fromkeys(note for each in drawings for note in each.notes),
        *(
            f"{k} robot: {len(v.steps)} readings, off by {report.largest_error_mm(v):.1f} mm"
            for k, v in searches.items()
        ),
        report.summary_sentence(searches),
        f"diagnosis of the second recording: {diagnosis.verdict}, "
        f"{' + '.join(diagnosis.combination) or 'nothing'}; concealed was: {found.concealed}",
        f"a concealed saturation: {report.doubt_sentence(doubted)}",
        f"seed {seed}; {seconds:.0f} s; written to {out / 'report.html'}",
    ]


def _search(
    sensor: FittedSensor,
    hidden: HiddenShape,
    seed: int,
    stream: int,
    *,
    max_readings: int,
    saturates_at: float | None = None,
    **options: Any,
) -> Exploration:
    """Search for the circle with a simulated arm and a model by the `options` of `experiment_for`.

    The first reading is on the circle, the same for all robots compared. The sensor saturates at the reading
    `saturates_at`, which its model leaves out; None: nowhere.
    """
    field, world = Field(), world_behind("paper")
    if saturates_at is not None:
        world = replace(world, concealed=(saturation(saturates_at),))
    experiment = experiment_for(sensor, _CIRCLE, field, n_live=N_LIVE_ROBOT, **{"trust": 1.0, **options})
    rng = np.random.default_rng([seed, stream])
    with arm_over(world, hidden.surface, field, seed=seed) as arm:
        x_mm, y_mm, radius_mm = hidden.theta.tolist()
        away, turn = np.random.default_rng([seed, 5]).random(2)
        away_mm, turn_rad = radius_mm * np.sqrt(away), 2 * np.pi * turn
        first = Pose(float(x_mm + away_mm * np.cos(turn_rad)), float(y_mm + away_mm * np.sin(turn_rad)))
        return replace(run_from_place(first, arm, experiment, rng=rng, max_readings=max_readings), hidden=hidden)


def diagnose_shipped_recording(seed: int) -> Diagnosis:
    """Diagnose the second recording, with the same result as `probewise diagnose`."""
    return engine.diagnose(read_recording(shipped("concealed")), rng=generators_of_diagnosis(seed)[0])
