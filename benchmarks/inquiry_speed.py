"""Processor time and memory of the map and of the inference after each reading, against plain ways to the same.

    python benchmarks/inquiry_speed.py --circles 5 --out docs/results/inquiry_speed.json

Medians over the readings of whole runs, the study's first row, on circles that the study does not look for; and
of as many runs for each other shape, drawn from its prior, under the same sensor (seed: the number of the run).
The plain ways, in the same process and about the same posterior:

- the map's predictions by the sensor's closed form for every hypothesis at every one of the 131 x 65 places,
  vectorised (timed for twenty hypotheses, scaled to all);
- the inference by nested sampling of all readings so far.

Ratios are medians over the readings that are done both ways. Times are processor seconds of a machine that does
other things too: compare them within one file only.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from probewise.arm import Pose, Reach, SimulatedArm
from probewise.experiment import ArmReachAndTravel, Experiment, Step, explore
from probewise.experiment.inquire import predict_readings_and_utilities
from probewise.inquiry import Grid
from probewise.inquiry.smc import Particles, nested_sampling_from_scratch, update
from probewise.proof.configurations import REFERENCE
from probewise.proof.trial import Trial, arm_of, experiment_of
from probewise.scene import SHAPES, HypothesisScene
from probewise.scene import Field as PlayingField

FIRST_CIRCLE = 2000  # the study looks for the first thousand at most
SOME_HYPOTHESES = 20
N_LIVE = 200  # live points of nested sampling, the robot's default
EVERY = 4  # steps between those that are also done the plain way


def seconds(work: Callable[[], object]) -> float:
    """Processor time of one call."""
    began = time.process_time()
    work()
    return time.process_time() - began


def plain_map_s(experiment: Experiment, step: Step) -> float:
    """Time the closed form everywhere for some hypotheses of a step's posterior; scale to all."""
    theta, plan = step.posterior.theta, experiment.designs.plan("field")
    blocks = [plan.take(rows) for rows in np.array_split(np.arange(len(plan)), 8)]
    took = seconds(lambda: [experiment.model.predict(theta[:SOME_HYPOTHESES], block) for block in blocks])
    return took * len(theta) / SOME_HYPOTHESES


def follow(arm: SimulatedArm, experiment: Experiment, run: int) -> list[dict[str, float]]:
    """Run once, and time every step again by itself."""
    rows = []
    with arm:
        field = ArmReachAndTravel.from_instrument(arm, experiment.grid)
        steps = list(explore(arm, experiment, rng=np.random.default_rng(run)))
    for number, (before, after) in enumerate(pairwise(steps)):
        problem = experiment.problem([step.reading for step in steps[: number + 2]])
        rng = np.random.default_rng([run, number])
        scratch = partial(nested_sampling_from_scratch, problem, N_LIVE, rng)
        drawn = after.posterior.samples(experiment.n_samples, rng=rng)
        ask = partial(predict_readings_and_utilities, experiment, after.posterior, drawn, field, at=after.reading)
        before_it = Particles(before.posterior, np.arange(len(before.posterior.theta)), 0.0)
        infer = partial(update, before_it, problem, rng=rng, fall_back=scratch)
        row = {"map_s": seconds(ask), "inference_s": seconds(infer)}
        if number % EVERY == 0:
            row |= {"plain_map_s": plain_map_s(experiment, after), "nested_sampling_s": seconds(scratch)}
        rows.append(row)
    return rows


def circle(run: int) -> list[dict[str, float]]:
    """Look for a circle of the study."""
    trial = Trial(REFERENCE, FIRST_CIRCLE + run)
    return follow(arm_of(trial), experiment_of(REFERENCE), FIRST_CIRCLE + run)


def other_shape(name: str, run: int) -> list[dict[str, float]]:
    """Look for another shape, read in closed form: what the robot does with a reading is the same."""
    shape = SHAPES[name](PlayingField())
    known = experiment_of(REFERENCE)
    chain = replace(known.model, scene=HypothesisScene(shape))
    experiment = replace(known, shape=shape, model=chain)
    rng = np.random.default_rng(run)
    truth = shape.prior.from_unit_cube(rng.random((1, len(shape.prior.names))))

    def light(pose: Pose, time_s: float, height_mm: float) -> float:
        place = Grid(2.0, 2.0, 2, 2).plan("field").take(np.array([0]))
        place = replace(place, x_mm=np.array([pose.x_mm]), y_mm=np.array([pose.y_mm]))
        return float(chain.predict(truth, place)[0, 0] + rng.standard_normal())

    return follow(SimulatedArm(light, reach=Reach.over_whole_field(), scale=None), experiment, run)


def medians(rows: list[dict[str, float]]) -> dict[str, float]:
    """Take the median of every time, to three digits."""
    return {name: float(f"{np.median([row[name] for row in rows if name in row]):.3g}") for name in rows[0]}


def ratio(rows: list[dict[str, float]], plain: str, ours: str) -> float:
    """Take the median ratio of two times over the readings that are done both ways."""
    return round(float(np.median([row[plain] / row[ours] for row in rows if plain in row])), 1)


def main() -> None:
    """Write the medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--circles", type=int, default=5, metavar="N", help="and as many of each other shape")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    looks = {"circle": circle} | {name: partial(other_shape, name) for name in SHAPES if name != "circle"}
    found = {}
    for name, look in looks.items():
        rows = [row for run in range(arguments.circles) for row in look(run)]
        found[name] = {
            "decisions": len(rows),
            "median": medians(rows),
            "ratio": {
                "map, closed form over ours": ratio(rows, "plain_map_s", "map_s"),
                "inference, nested sampling over ours": ratio(rows, "nested_sampling_s", "inference_s"),
            },
            "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        }
    command = f"python benchmarks/inquiry_speed.py --circles {arguments.circles}"
    arguments.out.write_text(json.dumps({"command": command, **found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
