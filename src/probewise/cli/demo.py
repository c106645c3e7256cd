"""`probewise demo`: the main job, the paper end to end on the recordings that ship with the package."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from probewise.cli._common import Verb, add_common, add_out_directory, say
from probewise.cli._output import check_out_directory, staged

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from probewise.calibration import Calibration, FittedSensor
    from probewise.diagnosis import Diagnosis
    from probewise.experiment import Exploration, Model
    from probewise.scene import Circle

__all__ = ["VERB"]

MODELS: tuple[Model, ...] = ("naive", "ssf")
N_LIVE = 100  # of the calibration; --full takes the paper's 300
N_LIVE_ROBOT = 100
MAX_READINGS = 80


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fill the verb's parser."""
    add_out_directory(parser)
    parser.add_argument(
        "--full", action="store_true", help="weigh one to four Gaussians with 300 live points, as the paper does"
    )
    add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, search twice, diagnose, report."""
    import time

    import numpy as np
    from tqdm import tqdm

    from probewise.calibration import predict, write_sensor
    from probewise.cli import diagnose as diagnose_verb
    from probewise.cli._workers import workers
    from probewise.recordings import read_recording, shipped
    from probewise.report import demo as report
    from probewise.report import diagnosis as diagnosis_report
    from probewise.scene import outlines
    from probewise.world.shipped import truth as world_behind

    started = time.monotonic()
    seed = arguments.seed
    out = check_out_directory(arguments.out)
    truth = hidden_circle(seed)
    with (
        workers(2) as pool,
        tqdm(total=4, desc="demo", unit=" part", disable=True if arguments.quiet else None) as bar,
    ):
        diagnosing = pool.submit(_diagnose, seed)
        calibration = _calibrate(seed, arguments.full, pool)
        bar.update()
        searching = [pool.submit(_search, calibration.sensor, model, truth, seed) for model in MODELS]
        diagnosis = diagnosing.result()
        bar.update()
        runs = []
        for future in searching:
            runs.append(future.result())
            bar.update()
    recording = read_recording(shipped("paper"))
    sensor = calibration.sensor
    prediction = predict(sensor, recording.plan, recording.readings)
    means = sensor.mean()
    circle = hypothesis()
    searches = [
        report.Search(
            {"naive": "naive", "ssf": "SSF"}[model],
            run,
            dict(zip(circle.prior.names, truth, strict=True)),
            outlines(circle.region(np.array([truth])))[0],
            (means["I_min"], means["I_max"]),
        )
        for model, run in zip(MODELS, runs, strict=True)
    ]
    drawn = report.figures(calibration, recording, prediction, searches)
    diagnosis_drawn = diagnosis_report.figures(diagnosis)
    concealed = ", ".join(effect.name for effect in world_behind("concealed").concealed)
    seconds = time.monotonic() - started
    with staged(out) as stage:
        write_sensor(sensor, stage / "sensor.json")
        for name, png in drawn.items():
            (stage / name).write_bytes(png)
        (stage / "diagnosis").mkdir()
        rng = np.random.default_rng([seed, 3])
        diagnose_verb.write_results(diagnosis, diagnosis_drawn, stage / "diagnosis", rng=rng)
        page = report.write_page(
            calibration,
            recording,
            prediction,
            searches,
            drawn,
            report.diagnosis_sections(diagnosis, diagnosis_drawn, concealed),
            seed=seed,
            seconds=seconds,
        )
        (stage / "report.html").write_text(page, encoding="utf-8")
    for line in (
        *report.comparison_lines(searches),
        f"diagnosis of the second recording: {diagnosis.verdict}, "
        f"{' + '.join(diagnosis.combination) or 'nothing'}; concealed was: {concealed}",
        f"seed {seed}; {seconds:.0f} s; written to {out / 'report.html'}",
    ):
        say(line, quiet=arguments.quiet)
    return 0


def hypothesis() -> Circle:
    """Say what the robot is told and the hidden circle drawn from: wholly on the field, radius 50 to 150 mm."""
    from probewise.scene import Circle

    return Circle(radius_mm=(50.0, 150.0), inside=True)


def hidden_circle(seed: int) -> tuple[float, ...]:
    """Draw the circle to be found: x, y, radius in mm."""
    import numpy as np

    drawn = hypothesis().prior.from_unit_cube(np.random.default_rng([seed, 0]).random((1, 3)))[0]
    return tuple(float(v) for v in drawn)


def _calibrate(seed: int, full: bool, pool: Executor) -> Calibration:
    import numpy as np

    from probewise.calibration import calibrate
    from probewise.recordings import read_recording, shipped

    return calibrate(
        read_recording(shipped("paper")),
        orders=(1, 2, 3, 4) if full else (1, 2),
        n_live=300 if full else N_LIVE,
        rng=np.random.default_rng([seed, 1]),
        executor=pool,
    )


def _search(sensor: FittedSensor, model: Model, truth: tuple[float, ...], seed: int) -> Exploration:
    import numpy as np

    from probewise.experiment import arm_over, experiment_for, run, surface_of
    from probewise.scene import Field
    from probewise.world.shipped import truth as world_behind

    field = Field()
    experiment = experiment_for(sensor, hypothesis(), field, model=model, n_live=N_LIVE_ROBOT)
    surface = surface_of("circle", np.array(truth), field)
    with arm_over(world_behind("paper"), surface, field, seed=seed) as arm:
        return run(arm, experiment, rng=np.random.default_rng([seed, 2]), max_readings=MAX_READINGS)


def _diagnose(seed: int) -> Diagnosis:
    import numpy as np

    from probewise.diagnosis import diagnose
    from probewise.recordings import read_recording, shipped

    return diagnose(read_recording(shipped("concealed")), rng=np.random.default_rng([seed, 4]))


VERB = Verb("demo", "Do all of it: calibrate, find a hidden circle with two models, diagnose.", add_arguments, run)
