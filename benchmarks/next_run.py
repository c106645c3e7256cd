"""The run after a run that found out what its sensor leaves out: does it start from a sensor that can be relied on?

For seven of the effects that a sensor file can hold, a robot with doubt looks for a circle in a world in which the
effect is concealed (as `probewise study --concealed` does, clear size). A second one starts from the sensor that the
first one wrote, looks for another circle in the same world, and is compared with a robot whose sensor is right: the
same circle with nothing concealed.

    python benchmarks/next_run.py --circles 8 --seed 733 --out docs/results/next_run.json
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from probewise.calibration import FittedSensor, posterior_mean_ssf_field
from probewise.experiment import TRUST, Exploration, experiment_for, explore, left_out_after_step, repaired_sensor
from probewise.proof.concealed_study import ConcealedTrial, _arm_in_concealed_world
from probewise.proof.study import (
    BRIGHT,
    DARK,
    FIELD,
    POPULATIONS,
    REFERENCE,
    accuracy_measures,
    experiment_of,
)
from probewise.recordings import Instrumentation
from probewise.scene import Field
from probewise.sensor import mixture_parameter_names

EFFECTS = ("backlash", "saturation", "nonlinearity", "albedo_gradient", "ambient_gradient", "edge_blur", "halo")
CLEAR, MOST_READINGS = 1, 100


def calibrated() -> FittedSensor:
    """Return the study's sensor as a calibration would leave it: right, and known to about a percent."""
    mixture = experiment_of(REFERENCE).model.ssf
    (a, c), (_, b) = 0.5 * np.linalg.inv(mixture.covs_mm2[0])  # paper, eq. Ssf
    truth = np.array([1.0, *mixture.means_mm[0], a, b, c, DARK, BRIGHT])
    sd = np.array([0.0, 0.02, 0.02, *(0.01 * np.abs(truth[3:6])), 0.05, 0.05])
    samples = truth + sd * np.random.default_rng(11).standard_normal((500, len(truth)))
    return FittedSensor(
        names=(*mixture_parameter_names(1), "I_min", "I_max"),
        samples=samples,
        n_gaussians=1,
        noise_sd=np.full(500, REFERENCE.noise_sd),
        field=posterior_mean_ssf_field(samples, 1, pixel_mm=0.5),
        instrumentation=Instrumentation(),
    )


def run(sensor: FittedSensor, trial: ConcealedTrial) -> tuple[FittedSensor, dict[str, Any]]:
    """Look for the circle of a trial from a sensor; return the sensor that the run leaves, and its figures."""
    shape = POPULATIONS[REFERENCE.population]
    experiment = replace(
        experiment_for(sensor, shape, Field(FIELD.width_mm, FIELD.height_mm), trust=TRUST),
        grid=experiment_of(REFERENCE).grid,
    )
    with _arm_in_concealed_world(trial) as arm:
        *_, last = explore(
            arm, experiment, rng=np.random.default_rng([trial.seed, trial.circle]), max_readings=MOST_READINGS
        )
    found = left_out_after_step(last, TRUST)
    figures = {
        "known": Exploration(experiment, (last,)).target_reached,
        "readings": last.number,
        **accuracy_measures(last, experiment, trial.true_circle_in_arm_frame),
        "credible": list(found.credible_set),
    }
    return repaired_sensor(sensor, last, rng=np.random.default_rng(trial.seed)), figures


def main() -> None:
    """Run both robots of every effect and circle, and write their figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--circles", type=int, default=8)
    parser.add_argument("--seed", type=int, default=733)
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS))
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    sensor, rows = calibrated(), []
    for circle in range(asked.circles):
        other = circle + asked.circles
        _, right = run(sensor, ConcealedTrial("", 0, other, TRUST, seed=asked.seed))
        rows.append({"effect": "", "circle": other, "run": right})
        for effect in asked.effects:
            left, first = run(sensor, ConcealedTrial(effect, CLEAR, circle, TRUST, seed=asked.seed))
            _, second = run(left, ConcealedTrial(effect, CLEAR, other, TRUST, seed=asked.seed))
            holds = effect in left.effects
            rows.append({"effect": effect, "circle": circle, "first": first, "holds": holds, "second": second})
            print(effect, circle, "holds it" if holds else "does not hold it", first, second, flush=True)
            asked.out.write_text(json.dumps({"circles": asked.circles, "seed": asked.seed, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
