"""The recordings that ship with the package: their truth, and how to regenerate them from their seeds.

`python -m probewise.world.shipped FOLDER` writes both recordings into a folder, bit for bit as they ship.
No diagnosis may import this module, since the module holds the truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from probewise.errors import require
from probewise.recordings.files import write_recording
from probewise.recordings.io import SHIPPED
from probewise.recordings.plan import Recording
from probewise.recordings.plans import paper_plan, two_way_plan, with_jittered_times
from probewise.world.concealed import ambient_gradient, backlash, correlated_noise, gain_drift, nonlinearity, saturation
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.stages import Concealed
from probewise.world.world import World

BLOB = Blob(share=1.0, center_mm=(0.0, 1.5), sd_mm=(4.0, 2.5), correlation=0.15)
"""The true SSF of both recordings: one Gaussian, shifted towards the photodiode and wider along x'."""

BLACK, WHITE, NOISE_SD = 10.0, 60.0, 0.6

SEEDS = {"paper": 408, "concealed": 9844}

_DESCRIPTIONS = {
    "paper": "Simulated readings over the black-and-white boundary and four quadrants, as in the paper",
    "concealed": "Simulated readings, scans out and back; something is not as a plain sensor has it",
}

CANDIDATES: tuple[Concealed, ...] = (
    ambient_gradient(0.02, -0.02),
    backlash(0.53),
    correlated_noise(0.5),
    gain_drift(0.044, 400.0),
    nonlinearity(1.1),
    saturation(57.5),
)
"""Effects that the recording `concealed` may contain, each at a size lambda of about 20."""


def true_world(name: str) -> World:
    """Return the world of a shipped recording: "paper" has no concealed effect, "concealed" has one.

    Raises ParameterError if there is no recording of that name.
    """
    choice, _, _ = _random_streams(name)
    world = World(gaussian_spot([BLOB]), black=BLACK, white=WHITE, noise_sd=NOISE_SD)
    if name == "paper":
        return world
    return replace(world, concealed=(CANDIDATES[int(choice.integers(len(CANDIDATES)))],))


def regenerate_recording(name: str) -> Recording:
    """Regenerate the shipped recording `name`, "paper" or "concealed".

    Those of "paper" are what the LEGO arm records: whole LEGO units from 1 to 100. Those of "concealed" are rounded to
    0.001, far below the noise, so that floating-point differences between machines vanish.

    Raises ParameterError if there is no recording of that name.
    """
    _, times, noise = _random_streams(name)
    plan = paper_plan() if name == "paper" else two_way_plan()
    plan = replace(plan, instrumentation=replace(plan.instrumentation, description=_DESCRIPTIONS[name]))
    recording = true_world(name).simulate(with_jittered_times(plan, rng=times), rng=noise)
    if name == "paper":
        plan = replace(recording.plan, instrumentation=replace(recording.plan.instrumentation, min=1.0, step=1.0))
        return replace(recording, plan=plan, readings=np.clip(np.round(recording.readings), 1.0, 100.0))
    return replace(recording, readings=np.round(recording.readings, 3))


def _random_streams(name: str) -> list[np.random.Generator]:
    """Return three independent generators: for the concealed effect, the times and the noise."""
    require(name in SHIPPED, "name", name, " or ".join(repr(known) for known in SHIPPED))
    return np.random.default_rng(SEEDS[name]).spawn(3)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the shipped recordings into the folder named on the command line."""
    parser = argparse.ArgumentParser(description="Make the shipped recordings again.")
    parser.add_argument("folder", type=Path, help="an existing folder")
    folder: Path = parser.parse_args(arguments).folder
    for name in SHIPPED:
        write_recording(regenerate_recording(name), folder / f"{name}.csv")


if __name__ == "__main__":
    main()
