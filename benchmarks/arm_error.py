"""Are shapes that an arm finds as well known as is claimed, where its geometry was fitted to marks?

    probewise calibrate paper --method quick --out my_sensor
    python benchmarks/arm_error.py --arms 200 --seed 1 --sensor my_sensor/sensor.json --out docs/results/arm_error.json

Each arm is built otherwise than the shipped file says (home angles by 2 degrees, lengths and base by 3 mm, sds); its
sensor is brought to the marks, each met to 1 mm, and the geometry is fitted. With it the robot finds a hidden circle,
while the readings come from where the sensor truly is, at its true height above it, by `probewise.world`. The sensor
was calibrated with the same arm in the middle of the field. Counted is how often the claimed 95 % intervals hold the
truth, with the arm's error in them and without, over the runs that some hypothesis explains: the others say of
themselves that they are not to be trusted.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from probewise import experiment as posing
from probewise.arm import Geometry, Pose, SimulatedArm, read_geometry, shipped_geometry
from probewise.arm.fitting import fit_geometry
from probewise.arm.marks import marks_of
from probewise.arm.uncertainty import places_of, values_of
from probewise.calibration import FittedSensor, read_sensor
from probewise.scene import Circle, Field

BUILT_SDS = np.array([*np.radians([2.0, 2.0, 2.0]), 3.0, 3.0, 3.0, 3.0, 3.0, 3.0])
TOUCH_MM, BLOCK_MM = 1.0, 32.0


def fitted_arm(file: Geometry, *, rng: np.random.Generator) -> tuple[Geometry, np.ndarray]:
    """Build an arm and fit its geometry; return the fit and the numbers that are true of it."""
    true = values_of(file) + BUILT_SDS * rng.standard_normal(9)
    marks = marks_of(file)
    # The joints are turned until the sensor of the true arm meets the mark: the file's angles, then Newton steps.
    turned = file.angles_rad(marks, BLOCK_MM) - values_of(file)[:3]
    goal = np.column_stack([marks, np.full(len(marks), BLOCK_MM)])
    for _ in range(8):
        off = goal - places_of(file, true, turned)
        slopes = np.stack(
            [
                (places_of(file, true, turned + 1e-6 * axis) - places_of(file, true, turned)) / 1e-6
                for axis in np.eye(3)
            ],
            axis=-1,
        )
        turned = turned + np.linalg.solve(slopes, off[..., None])[..., 0]
    met = goal + TOUCH_MM * rng.standard_normal(goal.shape)
    return fit_geometry(file, turned, met, touch_mm=TOUCH_MM).geometry, true


def trial(sensor: FittedSensor, file: Geometry, *, seed: int) -> dict[str, list[float]]:
    """Let one arm find a circle; return errors, sds by the readings alone, sds of the arm, by parameter."""
    rng = np.random.default_rng([seed, 0])
    geometry, true = fitted_arm(file, rng=rng)
    field = Field(*file.field_mm)
    shape = Circle(field)
    hidden = posing.Hidden.drawn({"circle": shape}, rng=rng)
    world, surface = posing.world_like(sensor), hidden.surface
    home = values_of(geometry)[:3]
    middle = np.array(file.field_mm) / 2

    def stands(x_mm: float, y_mm: float) -> np.ndarray:
        turned = geometry.angles_rad(np.array([[x_mm, y_mm]]), geometry.read_height_mm) - home
        return places_of(geometry, true, turned)[0]

    calibrated_mm = stands(*middle)[2]
    n_read = iter(range(10**6))

    def light(pose: Pose, time_s: float, height_mm: float) -> float:
        x_mm, y_mm, up_mm = stands(pose.x_mm, pose.y_mm)
        noise = np.random.default_rng([seed, 1, next(n_read)])
        ratio = max(up_mm, 1.0) / max(calibrated_mm, 1.0)
        turned = pose.orientation_rad + true[0] - home[0]
        return world.read(surface, x_mm, y_mm, turned, time_s=time_s, rng=noise, height_mm=world.height_mm * ratio)

    arm = SimulatedArm(light, reach=geometry, scale=posing.scale_of(sensor.instrumentation))
    asked = posing.pose_experiment(sensor, shape, field, trust=1.0)
    found = posing.run(arm, asked, rng=np.random.default_rng([seed, 2]), max_readings=30)
    dark = sensor.mean()["I_min"]
    claimed = posing.with_arm_error(found, geometry, dark=dark, rng=np.random.default_rng([seed, 3]))
    truth = np.array([hidden.parameters[name] for name in shape.prior.names])
    return {
        "error": (found.last.mean - truth).tolist(),
        "sd_readings": found.last.sd.tolist(),
        "sd_arm": claimed.arm.sd.tolist(),
        "readings": [len(found.steps)],
        "explained": [found.last.p_value >= asked.doubt_p],
    }


def main() -> None:
    """Run the arms and write what they come to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sensor", type=Path, required=True, help="a sensor.json, of `probewise calibrate paper`")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    sensor, file = read_sensor(given.sensor), read_geometry(shipped_geometry())
    trials = []
    for number in range(given.arms):
        trials.append(trial(sensor, file, seed=given.seed * 100_000 + number))
        if number % 5 == 4:
            print(number + 1, flush=True)
    counted = [t for t in trials if t["explained"][0]]
    error, readings, arm = (np.array([t[name] for t in counted]) for name in ("error", "sd_readings", "sd_arm"))
    names = ("x_mm", "y_mm", "radius_mm")
    both = np.hypot(readings, arm)
    of = {}
    for k, name in enumerate(names):
        held = {"with the arm's error": both[:, k], "without": readings[:, k]}
        of[name] = {
            "rms_error_mm": float(np.sqrt((error[:, k] ** 2).mean())),
            "median_sd_readings_mm": float(np.median(readings[:, k])),
            "median_sd_arm_mm": float(np.median(arm[:, k])),
            **{
                f"held by 95 % {label}": interval(int((np.abs(error[:, k]) < 1.96 * sd).sum()), len(counted))
                for label, sd in held.items()
            },
        }
    document = {
        "arms": given.arms,
        "seed": given.seed,
        "explained": len(counted),
        "median_readings": float(np.median([t["readings"] for t in trials])),
    }
    given.out.write_text(json.dumps({**document, **of}, indent=1) + "\n", encoding="utf-8")
    print(given.out.read_text(encoding="utf-8"))


def interval(held: int, of: int) -> list[float]:
    """Give a share with its 95 % Wilson interval."""
    found = binomtest(held, of).proportion_ci(method="wilson")
    return [held / of, round(found.low, 4), round(found.high, 4)]


if __name__ == "__main__":
    main()
