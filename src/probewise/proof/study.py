"""A study: every row over its circles, run as a campaign and summarised as a table (paper, section 4, "Results").

The rows, and the circles and the noise that all of them share; one autonomous run, the search for one circle in one
configuration; and the table.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, get_args

import numpy as np
from scipy.stats import poisson

from probewise._arrays import FloatArray, own_arithmetic
from probewise._kinds import checked_whole
from probewise._version import __version__
from probewise.arm import Pose, Reach, ReadingScale, SimulatedArm, Speed
from probewise.errors import ParameterError, require
from probewise.experiment import (
    Experiment,
    Exploration,
    MethodName,
    NestedSampling,
    Step,
    explore,
    naive_levels_from_world,
    probability_of_length_off,
)
from probewise.experiment.from_sensor import AdjustedMixture, sensor_change_prior
from probewise.experiment.paper import student_t_likelihood
from probewise.experiment.result import WRONG_MM
from probewise.inference import GaussianKnown, Naive
from probewise.inquiry import Grid, utility_named
from probewise.nested import NESTED_STOP, NestedStop
from probewise.proof.campaign import (
    TRIAL,
    Campaign,
    Estimate,
    Result,
    estimated_share,
    grouped,
    mean_with_error,
    median_with_interval,
    misfit,
)
from probewise.recordings import Disc
from probewise.scene import Circle, Field, HypothesisScene
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture, FreeLevels, NaiveSensor
from probewise.world import Blob, Spot, World, gaussian_spot

__all__ = ["Summary", "study", "summaries", "summarise"]

FIELD = Field()
MOST_CIRCLES = 10_000
"""Largest number of circles of a row: a month of processor time, whose tasks are listed in memory."""
SEED = 2013

POPULATIONS: Mapping[str, Circle] = {
    "anywhere": Circle(FIELD, (20.0, 150.0)),
    "inside": Circle(FIELD, (50.0, 150.0), inside=True),
}
"""Named distributions of circles, which are also the robot's priors."""


def true_circle(population: str, number: int, *, seed: int = SEED) -> FloatArray:
    """Return a circle of a population, by its number from 0: x_mm, y_mm, radius_mm, (3,)."""
    cube = np.random.default_rng(seed).random((number + 1, 3))
    return np.asarray(POPULATIONS[population].prior.from_unit_cube(cube)[number])


_IN_BATCHES = ("finishing", "information")


@dataclass(frozen=True)
class SearchConfiguration:
    """One configuration of the search."""

    population: str = "inside"  # of the circles, which is also the prior: "anywhere" or "inside"
    model: str = "ssf"  # the robot's, or "naive", a point without SSF; the true sensor always has the SSF
    utility: str = "finishing"  # by name, see `inquiry.utility_named`
    noise_sd: float = 1.0  # simulated and known to the robot, LEGO units
    width: float = 1.0  # of the robot's SSF over the true one
    learn_sensor: bool = False  # along with the shape
    batch: int = 1  # readings chosen together
    method: str = "particles"  # or "paper" with the utility "entropy" (`experiment.paper`)
    nested_stop: NestedStop = "change"  # when the paper's nested sampling stops

    def __post_init__(self) -> None:
        choices = {"population": POPULATIONS, "model": ("ssf", "naive"), "method": get_args(MethodName)}
        for name, allowed in {**choices, "nested_stop": NESTED_STOP}.items():
            require(getattr(self, name) in allowed, name, getattr(self, name), " or ".join(allowed))
        utility_named(self.utility)
        for name in ("noise_sd", "width"):
            require(1e-3 <= getattr(self, name) <= 1e3, name, getattr(self, name), "from 0.001 to 1000")
        if self.model == "naive":
            for name, plain in (("width", 1.0), ("learn_sensor", False)):
                if getattr(self, name) != plain:
                    raise ParameterError(name, getattr(self, name), f'{plain} with the model "naive", which has no SSF')
        if self.batch > 1 and self.utility not in _IN_BATCHES:
            raise ParameterError("batch", self.batch, f"1, or more with the utility {' or '.join(_IN_BATCHES)}")
        ways = (self.utility, self.learn_sensor, self.batch)
        if self.method == "paper" and ways != ("entropy", False, 1):
            raise ParameterError("utility, learn_sensor, batch", ways, '("entropy", False, 1) with the method "paper"')
        if self.method != "paper" and self.nested_stop != "change":
            raise ParameterError("nested_stop", self.nested_stop, '"change", but with the method "paper"')

    @property
    def name(self) -> str:
        """Distribution of the circles, sensor model, and other differences from the reference, in words.

        Two rows that differ have different names, by which a study's file keeps their runs.
        """
        words = [self.population, "SSF" if self.model == "ssf" else "naive"]
        if self.method == "paper":
            words.append("the paper's method" + (" to remaining evidence" if self.nested_stop == "remaining" else ""))
        elif self.utility != REFERENCE.utility:
            words.append(self.utility)
        if self.noise_sd != REFERENCE.noise_sd:
            short = f"{self.noise_sd:g}"
            words.append(f"noise {short if float(short) == self.noise_sd else repr(float(self.noise_sd))}")
        if self.width != round(self.width, 2):
            words.append(f"believed {float(self.width)!r} times as wide")
        elif self.width != REFERENCE.width:
            words.append(f"believed {abs(self.width - 1):.0%} too {'wide' if self.width > 1 else 'narrow'}")
        if self.learn_sensor:
            words.append("learning it")
        if self.batch != REFERENCE.batch:
            words.append(f"{self.batch} at once")
        return ", ".join(words)


REFERENCE = SearchConfiguration()


def paper_comparison_rows(
    *, population: str = REFERENCE.population, nested_stop: NestedStop = "change"
) -> tuple[SearchConfiguration, ...]:
    """Return four rows: sensor model "ssf", then "naive", each with the reference's method, then the paper's."""
    paper = {"method": "paper", "utility": "entropy", "nested_stop": nested_stop}
    ways: tuple[dict[str, Any], ...] = ({}, paper)
    return tuple(
        replace(REFERENCE, population=population, model=model, **way) for model in ("ssf", "naive") for way in ways
    )


def standard_rows() -> tuple[SearchConfiguration, ...]:
    """Return the rows of the published table, the reference first."""
    changes: tuple[dict[str, Any], ...] = (
        *({}, {"model": "naive"}, {"population": "anywhere"}, {"population": "anywhere", "model": "naive"}),
        *({"utility": name} for name in ("information", "entropy", "per-second", "about:radius_mm")),
        *({"batch": 3}, {"noise_sd": 0.5}, {"noise_sd": 2.0}),
        *({"width": width, **learns} for learns in ({}, {"learn_sensor": True}) for width in (1.3, 0.7)),
    )
    return tuple(replace(REFERENCE, **change) for change in changes)


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
        "reached": Exploration(experiment, (last,)).target_reached,
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


_CHANCE = 0.01


@dataclass(frozen=True)
class Summary:
    """One row of the table, of the runs over one circle each; a run that misses the target counts as the limit.

    Means have standard errors, the median a 95 % interval; what comes from `error_mm` to `held` is of the runs that
    reached the target precision.
    """

    n_runs: int
    reached: Estimate  # share of the runs, within the limit of readings
    mean: Estimate  # readings needed
    median: Estimate
    to_white: Estimate  # readings up to the first one on white
    after_white: Estimate
    bits_each: Estimate  # per reading: prior minus posterior differential entropy
    error_mm: float  # largest error of a length, median; NaN if none reached
    wrong: int  # runs off by more than `WRONG_MM`
    wrong_expected: float  # by their own posteriors
    wrong_limit: int  # the 99 % quantile of a Poisson distribution with that mean
    held: Estimate  # share of the 95 % intervals that hold the truth
    arm_s: Estimate
    cpu_s: float  # per decision, median over runs of each run's median


def summarise(trials: Sequence[Result], *, max_readings: int) -> Summary:
    """Summarise the runs of one row, each a result of `run_trial`.

    Raises ParameterError if there are fewer than two runs, which have no standard error.
    """
    require(len(trials) >= 2, "number of trials", len(trials), "2 or more, so that there is a standard error")
    sure = [t for t in trials if t["reached"]]
    needed = np.array([t["readings"] if t["reached"] else max_readings for t in trials], dtype=np.float64)
    after = [t["readings"] - t["first_white"] for t in sure if t["first_white"] is not None]
    met = [max_readings if t["first_white"] is None else t["first_white"] for t in trials]
    errors = np.array([t["error_mm"] for t in sure])
    expected = float(sum(t["chance_wrong"] for t in sure))
    return Summary(
        n_runs=len(trials),
        reached=estimated_share(t["reached"] for t in trials),
        mean=mean_with_error(needed),
        median=median_with_interval(needed),
        to_white=mean_with_error(met),
        after_white=mean_with_error(after),
        bits_each=mean_with_error(t["bits"] / t["readings"] for t in trials),
        error_mm=float(np.median(errors)) if len(errors) else math.nan,
        wrong=int((errors > WRONG_MM).sum()),
        wrong_expected=expected,
        wrong_limit=int(poisson.isf(_CHANCE, expected)) if expected > 0 else 0,
        held=mean_with_error(float(np.mean(t["held"])) for t in sure),
        arm_s=mean_with_error(t["arm_s"] for t in trials),
        cpu_s=float(np.median([t["cpu_s"] for t in trials])),
    )


def summaries(results: Mapping[Trial, Result]) -> dict[SearchConfiguration, Summary]:
    """Return the summary of every row with two or more runs, by row."""
    most = {trial.row: trial.max_readings for trial in results}
    return {row: summarise(t, max_readings=most[row]) for row, t in trials_by_row(results).items() if len(t) > 1}


def trials_by_row(results: Mapping[Trial, Result]) -> dict[SearchConfiguration, list[Result]]:
    """Return the results of each row, in the order of the circles."""
    return grouped((trial.row, result) for trial, result in results.items())


def study(rows: Mapping[SearchConfiguration, int], *, max_readings: int = 100) -> Campaign[Trial]:
    """Return the campaign of every row over so many of the first circles of its population.

    Rows and circles may be added later to a file. `max_readings`: a run that has not reached the target precision after
    so many is a miss. Raises ParameterError if there is no row, or a row has no circle.
    """
    require(rows, "rows", rows, "one row or more, such as those of standard_rows(), each with its number of circles")
    for row, n in rows.items():
        checked_whole(f"circles of the row {row.name!r}", n, most=MOST_CIRCLES)
    # Circle by circle, so that an interrupted study has equally many runs in each row.
    trials = [Trial(row, k, max_readings) for k in range(max(rows.values())) for row, n in rows.items() if k < n]
    settings = {"study": __version__, "max_readings": max_readings}
    return Campaign(run_trial, {trial.key: trial for trial in trials}, settings, partial(misfit, schema=TRIAL))
