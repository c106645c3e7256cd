"""One autonomous run of a study: the search for one circle in one configuration."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise.arm import Pose, Reach, ReadingScale, SimulatedArm, Speed
from probewise.experiment import (
    Experiment,
    NestedSampling,
    Step,
    explore,
    naive_levels_from_world,
    probability_of_length_off,
)
from probewise.experiment.from_sensor import AdjustedMixture, sensor_change_prior
from probewise.experiment.paper import student_t_likelihood
from probewise.inference import GaussianKnown, Naive
from probewise.inquiry import Grid, utility_named
from probewise.nested import NESTED_STOP
from probewise.proof.configurations import FIELD, POPULATIONS, SEED, SearchConfiguration, true_circle
from probewise.recordings import Disc
from probewise.scene import HypothesisScene
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture, FreeLevels, NaiveSensor
from probewise.world import Blob, Spot, World, gaussian_spot

WRONG_MM = 12.0
"""Three times the 4 mm of the stopping rule: a run that ends with a larger error is sure and wrong."""
# The study's sensor: one Gaussian, in mm and LEGO units; the world uses the same numbers, rasterised to pixels.
DARK, BRIGHT = 10.0, 60.0
BLOB = Blob(1.0, (0.0, 1.5), (4.0, 2.5), 0.2)
_ON_WHITE = DARK + 0.1 * (BRIGHT - DARK)
_PIXEL_MM = 0.5
_UNROUNDED = ReadingScale(-math.inf, math.inf, None)
_EVERYWHERE = Reach((FIELD.width_mm, FIELD.height_mm), nearest_mm=0.0, farthest_mm=2 * FIELD.width_mm)


@dataclass(frozen=True)
class Trial:
    """A task of a study: the row, the number of the circle, from 0, and the limit of readings."""

    row: SearchConfiguration
    circle: int
    max_readings: int = 100

    @property
    def key(self) -> str:
        """Key of the run in the campaign's file."""
        return f"{self.row.name} / {self.circle}"

    @property
    def truth(self) -> FloatArray:
        """The true circle: x_mm, y_mm, radius_mm, (3,)."""
        return true_circle(self.row.population, self.circle)


@lru_cache(maxsize=16)
def experiment_of(row: SearchConfiguration) -> Experiment:
    """Build the experiment of a row; cached per process."""
    shape = POPULATIONS[row.population]
    scene = HypothesisScene(shape)
    common: dict[str, Any] = {
        "noise_sd": row.noise_sd,
        "grid": Grid(FIELD.width_mm, FIELD.height_mm),
        "utility": utility_named(row.utility),
        "batch": row.batch,
        "method": NestedSampling(stop=NESTED_STOP[row.nested_stop]) if row.method == "paper" else None,
    }
    levels, known = FixedLevels(DARK, BRIGHT), GaussianKnown(row.noise_sd)
    if row.model == "naive":
        likelihood = Naive(DARK, row.noise_sd, BRIGHT, row.noise_sd)
        # A reading on the edge fits neither level, and the naive model has no partial coverage.
        return Experiment(shape, NaiveSensor(levels, scene), likelihood, **common, doubt_p=0.0)
    mixture = mixture_of((BLOB,), row.width)
    if row.learn_sensor:
        free = Chain(AdjustedMixture(mixture), FreeLevels(), scene, n_nodes=FAST_NODES)
        return Experiment(shape, free, known, **common, sensor_prior=sensor_change_prior((DARK, BRIGHT)))
    chain = Chain(mixture, levels, scene, n_nodes=FAST_NODES)
    return Experiment(shape, chain, student_t_likelihood(levels, None) if row.method == "paper" else known, **common)


def mixture_of(blobs: Sequence[Blob], width: float = 1.0) -> FixedMixture:
    """Return the robot's model of a footprint of these Gaussians, or of one that is so many times as wide."""
    share = np.array([blob.share for blob in blobs])
    sd = np.array([[width * sd for sd in blob.sd_mm] for blob in blobs])
    across = np.array([blob.correlation for blob in blobs]) * sd[:, 0] * sd[:, 1]
    covariance = np.stack([sd[:, 0] ** 2, across, across, sd[:, 1] ** 2], axis=1).reshape(-1, 2, 2)
    return FixedMixture(share / share.sum(), np.array([blob.center_mm for blob in blobs]), covariance)


def experiment_of_trial(trial: Trial) -> Experiment:
    """Build the experiment of a row over one circle; the paper's naive robot first reads black and white sheets."""
    posed = experiment_of(trial.row)
    if (trial.row.method, trial.row.model) != ("paper", "naive"):
        return posed
    world = World(footprint_pixels(), black=DARK, white=BRIGHT, noise_sd=trial.row.noise_sd)
    naive = naive_levels_from_world(world, _UNROUNDED, rng=np.random.default_rng([SEED, trial.circle, 1]))
    model = NaiveSensor(FixedLevels(naive.mu_black, naive.mu_white), HypothesisScene(posed.shape))
    return replace(posed, model=model, likelihood=naive)


@own_arithmetic
def run_trial(trial: Trial) -> dict[str, Any]:
    """Search for a circle; return a `results.TRIAL`."""
    experiment = experiment_of_trial(trial)
    widest, cpu, first_white, bits_at_white = [], [], None, None
    for last, cpu_s in timed_steps(arm_of(trial), experiment, circle=trial.circle, max_readings=trial.max_readings):
        cpu.append(cpu_s)
        widest.append(round(last.largest_sd_mm, 3))
        if first_white is None and last.reading.value > _ON_WHITE:
            first_white, bits_at_white = last.number, round(last.bits, 3)
    return {
        "reached": has_reached_target(last, experiment),
        "readings": last.number,
        "first_white": first_white,
        "bits": round(last.bits, 3),
        "bits_at_white": bits_at_white,
        **accuracy_measures(last, experiment, trial.truth),
        "arm_s": round(last.reading.time_s, 2),
        "cpu_s": round(float(np.median(cpu)), 4),
        "widest_mm": widest,
        "p_value": last.p_value,
    }


def timed_steps(
    arm: SimulatedArm, experiment: Experiment, *, circle: int, max_readings: int, seed: int = SEED
) -> Iterator[tuple[Step, float]]:
    """Yield each step of a run with its processor time in s; randomness depends on seed and circle only."""
    with arm:
        steps = explore(arm, experiment, rng=np.random.default_rng([seed, circle]), max_readings=max_readings)
        before = time.process_time()
        for step in steps:
            yield step, time.process_time() - before
            before = time.process_time()


def has_reached_target(last: Step, experiment: Experiment) -> bool:
    """Return whether a run reached the target precision with a posterior that fits its readings."""
    known = experiment.may_stop(last.sd, last.shapes, last.chance_off)
    return known and not experiment.fit_is_doubtful(last.p_value) and not last.unexplained


def accuracy_measures(last: Step, experiment: Experiment, truth: FloatArray) -> dict[str, Any]:
    """Return `error_mm`, `chance_wrong` and `held` of `run_trial`, from the last posterior and the true shape, (3,)."""
    theta, weight = last.posterior.theta[:, experiment.shape_columns], last.posterior.weight
    held = []
    for values, true in zip(theta.T, truth, strict=True):
        below = float(weight[values < true].sum() + 0.5 * weight[values == true].sum())
        held.append(bool(0.025 <= below <= 0.975))
    return {
        "error_mm": round(float(np.abs(last.mean - truth).max()), 3),
        "chance_wrong": probability_of_length_off(experiment, last.posterior, WRONG_MM),
        "held": held,
    }


def disc_of(circle_mm: FloatArray) -> Disc:
    """Return a circle, (3,), as a pattern."""
    x_mm, y_mm, radius_mm = circle_mm.tolist()
    return Disc((x_mm, y_mm), radius_mm)


def arm_that_reads(light_reading: Callable[[Pose, float, float], float], *, speed: Speed | None = None) -> SimulatedArm:
    """Return a simulated arm that reaches the whole grid, with the readings of this function."""
    return SimulatedArm(light_reading, reach=_EVERYWHERE, speed=speed, scale=None)


def arm_of(trial: Trial) -> SimulatedArm:
    """Return a simulated arm over the circle, with noise that depends on the circle and is the same in all rows."""
    world = World(footprint_pixels(), black=DARK, white=BRIGHT, noise_sd=0.0)
    noise = iter(np.random.default_rng([trial.circle, 99]).standard_normal(trial.max_readings))
    disc = disc_of(trial.truth)

    def light_reading(pose: Pose, time_s: float, height_mm: float) -> float:
        clean = world.read(disc, pose.x_mm, pose.y_mm, pose.orientation_rad, time_s=time_s, rng=None)
        return clean + trial.row.noise_sd * float(next(noise))

    return arm_that_reads(light_reading)


@lru_cache(maxsize=2)
def footprint_pixels(blobs: tuple[Blob, ...] = (BLOB,)) -> Spot:
    """Return the footprint of the study's simulated sensor, or another of Gaussians, as pixels."""
    return gaussian_spot(blobs, pixel_mm=_PIXEL_MM)
