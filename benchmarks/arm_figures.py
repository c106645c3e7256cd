"""Seconds, telegrams and positioning error of a measurement with the LEGO arm, on the emulator.

    python benchmarks/arm_figures.py --readings 200 --seed 1 --out docs/results/arm.json

The driver of `probewise.arm` moves the arm of `probewise.emulator` on a clock that nobody waits for; the
place of the sensor is taken from the emulator when the light sensor is read.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from probewise.arm import LegoArm, Pose, read_geometry, shipped_geometry_path
from probewise.arm.geometry import JOINTS
from probewise.arm.nxt import Brick, BrickMachine, Link
from probewise.emulator import VirtualClock, VirtualLine, set_up_bench
from probewise.emulator import read_geometry as read_numbers
from probewise.recordings import Disc
from probewise.world.shipped import true_world

LEAST = 12
"""Telegrams that a measurement takes at least: a command and a look for base, shoulder, elbow and the way up,
LED on and off, a reading, the battery."""


class AnySide(BrickMachine):
    """Comes to each count from the side it happens to be on, as one who knows nothing of the play would."""

    def move_to(self, joint, goal, side):
        super().move_to(joint, goal, 1 if goal >= self.limits.last_counts[joint] else -1)


def run(machine_type: type[BrickMachine], places_mm: np.ndarray, *, seed: int) -> dict[str, float]:
    """Measure at every place; return means over the measurements, errors as root mean squares."""
    clock = VirtualClock()
    bench = set_up_bench(
        read_numbers(shipped_geometry_path()), true_world("paper"), Disc((524.0, 260.0), 80.0), clock, seed=seed
    )
    geometry = read_geometry(shipped_geometry_path())
    if machine_type is AnySide:
        rigid = {name: replace(joint, play_rad=0.0) for name, joint in zip(JOINTS, geometry.joints, strict=True)}
        geometry = replace(geometry, lowest_mm=1.0, **rigid)  # from below it comes lower
    link = Link(VirtualLine(bench.radio, clock), clock=clock)
    machine = machine_type(Brick(link, clock=clock), geometry)
    stands = []
    read = machine.read_percent
    machine.read_percent = lambda: (stands.append(bench.arm.sensor_pose()), read())[1]
    arm = LegoArm(machine, geometry, clock=clock)
    seconds, telegrams, told = [], [], []
    with arm:
        for place in places_mm:
            began_s, began = clock.monotonic(), link.n_sent
            (standing,) = arm.orientation_rad(place[None, :])
            reading = arm.measure(Pose(float(place[0]), float(place[1]), float(standing)))
            seconds.append(clock.monotonic() - began_s)
            telegrams.append(link.n_sent - began)
            told.append((reading.pose.x_mm, reading.pose.y_mm, reading.pose.orientation_rad))
    stood = np.array([(s.x_mm, s.y_mm, s.height_mm) for s in stands])
    off_mm = np.hypot(*(stood[:, :2] - places_mm).T)
    known_mm = np.hypot(*(stood[:, :2] - np.array(told)[:, :2]).T)
    yaw = np.array([s.orientation_rad for s in stands]) - np.array(told)[:, 2]
    yaw_deg = np.degrees(np.angle(np.exp(1j * yaw)))
    height_mm = stood[:, 2] - geometry.read_height_mm
    return {
        "readings": len(places_mm),
        "seconds_a_measurement": float(np.mean(seconds)),
        "telegrams_a_measurement": float(np.mean(telegrams)),
        "least_telegrams": LEAST,
        "place_rms_mm": float(np.sqrt(np.mean(off_mm**2))),
        "place_largest_mm": float(off_mm.max()),
        "place_rms_mm_against_the_pose_told": float(np.sqrt(np.mean(known_mm**2))),
        "height_rms_mm": float(np.sqrt(np.mean(height_mm**2))),
        "orientation_rms_deg": float(np.sqrt(np.mean(yaw_deg**2))),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--readings", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    geometry = read_geometry(shipped_geometry_path())
    anywhere = rng.uniform((0.0, 0.0), geometry.field_mm, (20 * arguments.readings, 2))
    places = anywhere[geometry.contains(anywhere)][: arguments.readings]
    line = np.column_stack([np.linspace(474.0, 574.0, arguments.readings), np.full(arguments.readings, 260.0)])
    figures = {
        "seed": arguments.seed,
        "anywhere, from the same side": run(BrickMachine, places, seed=arguments.seed),
        "anywhere, from any side": run(AnySide, places, seed=arguments.seed),
        "along a line of 100 mm": run(BrickMachine, line, seed=arguments.seed),
    }
    text = json.dumps(figures, indent=1)
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
