"""Processor time and memory of the map and of the inference after each reading, against plain ways to the same.

    python benchmarks/inquiry_speed.py --circles 5 --out docs/results/inquiry_speed.json

Medians over the readings of whole runs, the study's first row, on circles that the study does not look for.
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
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from probewise.experiment import Experiment, Field, Step, explore
from probewise.experiment.asking import inquire
from probewise.experiment.loop import from_scratch
from probewise.experiment.particles import update
from probewise.study import REFERENCE, Trial, arm_of, experiment_of

FIRST_CIRCLE = 2000  # the study looks for the first thousand at most
SOME_HYPOTHESES = 20
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


def follow(circle: int) -> list[dict[str, float]]:
    """Run once, and time every step again by itself."""
    experiment = experiment_of(REFERENCE)
    rows = []
    with arm_of(Trial(REFERENCE, circle)) as arm:
        field = Field.under(arm, experiment.grid)
        steps = list(explore(arm, experiment, rng=np.random.default_rng(circle)))
    for number, (before, after) in enumerate(pairwise(steps)):
        problem = experiment.problem([step.reading for step in steps[: number + 2]])
        rng = np.random.default_rng([circle, number])
        scratch = partial(from_scratch, problem, experiment, rng)
        ask = partial(inquire, experiment, after.posterior, field, at=after.reading, rng=rng)
        infer = partial(update, before.posterior, problem, rng=rng, fall_back=scratch, blocks=experiment.blocks)
        row = {"map_s": seconds(ask), "inference_s": seconds(infer)}
        if number % EVERY == 0:
            row |= {"plain_map_s": plain_map_s(experiment, after), "nested_sampling_s": seconds(scratch)}
        rows.append(row)
    return rows


def main() -> None:
    """Write the medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--circles", type=int, default=5, metavar="N")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    rows = [row for k in range(arguments.circles) for row in follow(FIRST_CIRCLE + k)]
    medians = {name: float(np.median([row[name] for row in rows if name in row])) for name in rows[0]}
    both = [row for row in rows if "plain_map_s" in row]

    def ratio(plain: str, ours: str) -> float:
        return round(float(np.median([row[plain] / row[ours] for row in both])), 1)

    found = {
        "command": f"python benchmarks/inquiry_speed.py --circles {arguments.circles}",
        "decisions": len(rows),
        "median": {name: float(f"{value:.3g}") for name, value in medians.items()},
        "ratio": {
            "map, closed form over ours": ratio("plain_map_s", "map_s"),
            "inference, nested sampling over ours": ratio("nested_sampling_s", "inference_s"),
        },
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }
    arguments.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
