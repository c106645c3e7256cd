"""The whole autonomous run on the emulator: as on the simulated arm, and whatever happens to the line."""

from __future__ import annotations

import math
from pathlib import Path

import arm_faults
import numpy as np
import pytest
from arm_faults import FAULTS, GEOMETRY, TRUTH, WORLD, Run, experiment, explored, violations

from probewise.emulator import Faults, Stand
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
    assert (len(run.endings) == run.mishaps["disconnect"]) or name != "disconnect"


def test_a_battery_that_sags_is_in_the_journal(asked: Experiment, tmp_path: Path) -> None:
    run = explored(asked, FAULTS["sag"], seed=SEED, journal=tmp_path / "journal.jsonl")
    millivolt = [reading.covariates["battery_mv"] for reading in run.journal]
    assert (np.diff(millivolt) < 0).all()


@pytest.fixture(scope="module")
def undisturbed(asked: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return explored(asked, Faults(), seed=SEED, journal=tmp_path_factory.mktemp("run") / "journal.jsonl")


def test_the_same_seed_gives_the_same_measurements_as_on_the_simulated_arm(
    asked: Experiment, undisturbed: Run
) -> None:
    """Places are the same as long as readings are; a reading may differ by what the motors miss.

    That is: one step, 5 % for the height (the LED's light falls by 1.5 % a mm), and what the world itself
    shows of the way from the place asked for to the one that the motors came to.
    """
    field = Field(*GEOMETRY.field_mm)
    with arm_over(WORLD, Disc(TRUTH[:2], TRUTH[2]), field, seed=SEED, workspace=GEOMETRY) as arm:
        simulated = run_experiment(arm, asked, rng=np.random.default_rng(SEED), max_readings=arm_faults.MAX_READINGS)
    n_compared = 0
    for step, (reading, stand) in zip(simulated.steps, undisturbed.taken, strict=False):
        pose = step.reading.pose
        away_mm = math.dist((pose.x_mm, pose.y_mm), (reading.pose.x_mm, reading.pose.y_mm))
        if away_mm > arm_faults.PLACE_MM:
            break
        there = Stand(pose.x_mm, pose.y_mm, stand.height_mm, pose.orientation_rad)
        missed = abs(arm_faults.expected_at(there) - arm_faults.expected_at(stand))
        assert abs(reading.value - step.reading.value) <= 1 + 0.05 * step.reading.value + missed
        n_compared += 1
    print(n_compared, len(simulated.steps), len(undisturbed.taken))
    assert n_compared >= 3
