"""The whole autonomous run on the emulator: as on the simulated arm, and whatever happens to the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arm_faults import (
    FAULTS,
    GEOMETRY,
    MAX_READINGS,
    TRUTH,
    WORLD,
    bench_with,
    connected,
    expected_at,
    experiment,
    explored,
    violations,
)

from probewise.emulator import Faults, Stand, VirtualClock
from probewise.experiment import Experiment, arm_over
from probewise.experiment import run as run_experiment
from probewise.recordings import Disc
from probewise.scene import Field

SEED = 1


@pytest.fixture(scope="module")
def asked() -> Experiment:
    return experiment()


@pytest.mark.parametrize("name", FAULTS)
def test_the_robot_finds_the_circle_under_every_fault_and_loses_nothing(
    asked: Experiment, tmp_path: Path, name: str
) -> None:
    """What a run may not do is listed in `violations`: lose, double or misplace a reading, hang, leave a motor on."""
    run = explored(asked, FAULTS[name], seed=SEED, journal=tmp_path / "journal.jsonl")
    assert not violations(run)
    assert len(run.taken) == len(run.journal) >= 5
    assert name == "sag" or run.mishaps[name] >= 3
    if name == "disconnect":
        assert len(run.endings) == run.mishaps[name]
    if name == "sag":
        assert (np.diff([reading.covariates["battery_mv"] for reading in run.journal]) < 0).all()


def test_the_same_seed_gives_the_same_measurements_as_on_the_simulated_arm(asked: Experiment, tmp_path: Path) -> None:
    """Both begin at the same place, read the same there, and end at the same circle.

    At the places of the simulated arm's whole run, each reading of the emulator differs by no more than what the
    motors miss: one step, 5 % for the height (the LED's light falls by 1.5 % a mm), and what the world itself
    shows of the way from the place asked for to the one that the motors came to.
    """
    circle, field = Disc(TRUTH[:2], TRUTH[2]), Field(*GEOMETRY.field_mm)
    with arm_over(WORLD, circle, field, seed=SEED, workspace=GEOMETRY) as simulated:
        there = run_experiment(simulated, asked, rng=np.random.default_rng(SEED), max_readings=MAX_READINGS)
    here = explored(asked, Faults(), seed=SEED, journal=tmp_path / "journal.jsonl")
    assert here.taken[0].asked == there.steps[0].reading.pose
    assert here.taken[0].reading.value == there.steps[0].reading.value
    apart_mm = abs(here.steps[-1].mean - there.last.mean)
    assert (apart_mm <= 4 * np.hypot(here.steps[-1].sd, there.last.sd)).all()

    clock, again = VirtualClock(), []
    with connected(bench_with(Faults(), clock, seed=SEED), clock, again) as arm:
        for step in there.steps:
            arm.measure(step.reading.pose)
    assert len(again) >= 5
    for step, taken in zip(there.steps, again, strict=True):
        pose = step.reading.pose
        meant = Stand(pose.x_mm, pose.y_mm, taken.stand.height_mm, pose.orientation_rad)
        missed = abs(expected_at(meant) - expected_at(taken.stand))
        assert abs(taken.reading.value - step.reading.value) <= 1 + 0.05 * step.reading.value + missed
