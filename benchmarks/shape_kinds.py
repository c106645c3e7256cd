"""Hold the probabilities of a set of shapes, as runs carry them from reading to reading, against nested sampling.

    python benchmarks/shape_kinds.py --runs 200 --out docs/results/shape_kinds.json

Each run looks for a circle or a rectangle, drawn from the seed, with the sensor of the study. At every reading from
the first that changes the odds by a tenth on, and at most at every EVERYth, the evidence of both shapes is taken by
nested sampling of 1,000 live points, sharpened by importance sampling. Written: how far the carried probability of
the true shape is from that, at every reading looked at, and whether a kind of more than .01 was lost. Runs that the
file holds already are not done again.
"""

import argparse
import json
import math
import time
import warnings
from pathlib import Path

import numpy as np

from probewise.arm import Pose, Reach, SimulatedArm
from probewise.errors import DoubtfulResultWarning
from probewise.experiment import Experiment, HiddenShape, RandomStreams, as_shape, explore
from probewise.inference import GaussianKnown
from probewise.inquiry import Grid
from probewise.nested import refine
from probewise.nested import run as run_nested
from probewise.recordings import write_text_atomically
from probewise.scene import Field, HypothesisScene
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot

N_LIVE = 1000
EVERY = 3


def experiment_of(field: Field) -> Experiment:
    """Pose the question: circle or rectangle, under a sensor of one Gaussian."""
    shape = as_shape(("circle", "rectangle"), field)
    mixture = FixedMixture(np.ones(1), np.array([[0.0, 1.5]]), np.array([[[16.0, 2.0], [2.0, 6.25]]]))
    model = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(shape), n_nodes=FAST_NODES)
    grid = Grid(field.width_mm, field.height_mm)
    return Experiment(shape, model, GaussianKnown(1.0), noise_sd=1.0, grid=grid)


def nested_odds(experiment: Experiment, readings: list, seed: int) -> np.ndarray:
    """Probability of each kind by nested sampling of that kind alone."""
    odds = []
    for kind in experiment.kinds:
        problem = kind.problem(experiment.problem(readings).recording)
        rng = np.random.default_rng([seed, len(readings)])
        run = run_nested(problem, rng=rng, n_live=N_LIVE)
        sharp = refine(run, problem, rng=rng)
        odds.append(kind.log_prior + (sharp if sharp.sound else run).log_z)
    share = np.exp(np.array(odds) - max(odds))
    return share / share.sum()


def follow(number: int) -> dict:
    """Run once, and weigh the kinds again at some readings."""
    field = Field()
    experiment = experiment_of(field)
    streams = RandomStreams.spawned_from(np.random.default_rng(number))
    hidden = HiddenShape.given_or_drawn(None, experiment.shape, field, rng=streams.truth)
    spot = gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5), 0.2)])
    world = World(spot, black=10.0, white=60.0, noise_sd=1.0)
    noise = np.random.default_rng(streams.noise)

    def light(pose: Pose, time_s: float, height_mm: float) -> float:
        place = (pose.x_mm, pose.y_mm, pose.orientation_rad)
        return world.read(hidden.surface, *place, time_s=time_s, rng=noise)

    arm = SimulatedArm(light, reach=Reach((field.width_mm, field.height_mm)), scale=None)
    index = list(experiment.shape.shape_names).index(hidden.name)
    compared, cpu, last, began = [], [], 0, time.process_time()
    with arm, warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        readings = []
        for step in explore(arm, experiment, rng=streams.run):
            cpu.append(time.process_time() - began)
            readings.append(step.reading)
            carried = step.shapes[hidden.name]
            moved = abs(math.log(carried / max(1 - carried, 1e-300))) > 0.1
            if (moved and step.number - last >= EVERY) or step.stop_reason:
                last = step.number
                by_nested = float(nested_odds(experiment, readings, number)[index])
                compared.append([step.number, round(carried, 5), round(by_nested, 5)])
            began = time.process_time()
    return {
        "run": number,
        "truth": hidden.name,
        "said": step.likely_shape,
        "p": max(step.shapes.values()),
        "readings": step.number,
        "compared": compared,
        "cpu_s": [round(float(np.quantile(cpu, q)), 3) for q in (0.5, 0.95)],
    }


def summary(runs: list[dict]) -> dict:
    """Count what the contract counts."""
    pairs = np.array([(p, q) for run in runs for _, p, q in run["compared"]]).reshape(-1, 2)
    off = np.abs(pairs[:, 0] - pairs[:, 1])
    lost = (np.minimum(pairs[:, 0], 1 - pairs[:, 0]) < 1e-4) & (np.minimum(pairs[:, 1], 1 - pairs[:, 1]) > 0.01)
    return {
        "runs": len(runs),
        "compared": len(pairs),
        "within_.05": float((off <= 0.05).mean()),
        "largest": float(off.max()),
        "lost": int(lost.sum()),
        "sure_of_the_wrong_shape": sum(run["said"] != run["truth"] for run in runs),
        "expected_wrong": round(sum(1 - run["p"] for run in runs), 3),
    }


def main() -> None:
    """Do the runs that are missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    runs = json.loads(arguments.out.read_text())["each"] if arguments.out.exists() else []
    done = {run["run"] for run in runs}
    for number in range(arguments.first, arguments.first + arguments.runs):
        if number in done:
            continue
        runs.append(follow(number))
        text = json.dumps({**summary(runs), "each": runs}, indent=1)
        write_text_atomically(arguments.out, text + "\n")
        print(json.dumps({k: v for k, v in runs[-1].items()}), flush=True)
    print(json.dumps(summary(runs), indent=1))


if __name__ == "__main__":
    main()
