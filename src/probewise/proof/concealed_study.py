"""Studies of the robot with a concealed fault: success rates, named faults, and runs that are sure and wrong.

The sensor model is exact except for what is concealed, at three sizes each: effects in the form that the robot's rivals
have, in another, and effects that are in no list of theirs. The readings are simulated by `probewise.world`, which sums
pixels and shares no code with the models. Every row has the same circles and noise, at two prior probabilities that the
sensor model is complete (`trust`): `TRUST` and 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Self, TypeAlias, cast

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise._kinds import checked_whole
from probewise._version import __version__
from probewise.arm import Pose, SimulatedArm, Speed
from probewise.experiment import CLEAN, TRUST, Experiment, Exploration, left_out_after_step
from probewise.experiment.result import WRONG_MM
from probewise.inference import Rounded
from probewise.proof import study
from probewise.proof.campaign import CONCEALED_TRIAL, Campaign, Estimate, Result, estimated_share, grouped, misfit
from probewise.recordings.table import csv_text_of_rows
from probewise.sensor import Chain
from probewise.world import Blob, Concealed, Reader, World
from probewise.world import concealed as conceal

_MIDDLE_MM = (study.FIELD.width_mm / 2, study.FIELD.height_mm / 2)
_MOVE_S = 0.8  # of a reading: what a move takes, about
_SECOND = Blob(0.4, (7.0, -1.0), (2.5, 4.0))  # of the sensor of two Gaussians


@dataclass(frozen=True)
class Conditions:
    """Noise sd, seconds between readings, about, rounding step and footprint; those of the study's table by default."""

    noise_sd: float = study.REFERENCE.noise_sd
    each_s: float = 8.0
    step: float | None = None
    blobs: tuple[Blob, ...] = (study.BLOB,)

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """Draw noise and pace log-uniformly, and whether readings are rounded and the sensor has two Gaussians."""
        noise_sd, each_s = (math.exp(rng.uniform(*np.log(ends))) for ends in ((0.3, 2.0), (2.0, 20.0)))
        rounded, two = rng.random(2) < 0.5
        return cls(noise_sd, each_s, 1.0 if rounded else None, (study.BLOB, _SECOND) if two else (study.BLOB,))

    def experiment(self) -> Experiment:
        """Return the reference experiment of a robot that knows these conditions."""
        posed = study.experiment_of(replace(study.REFERENCE, noise_sd=self.noise_sd))
        if len(self.blobs) > 1:
            posed = replace(posed, model=replace(cast(Chain, posed.model), ssf=study.mixture_of(self.blobs)))
        if self.step is not None:
            rounded = Rounded(self.noise_sd, self.step, -math.inf, math.inf)
            posed = replace(posed, likelihood=rounded, step=self.step)
        return posed


Make: TypeAlias = Callable[[float, Conditions, np.random.Generator], Concealed | tuple[Concealed, ...]]
Row: TypeAlias = tuple[Make, tuple[float, float, float]] | tuple[Make, tuple[float, float, float], str]
"""What is concealed, as a function of its size; three sizes: barely detectable, clear, gross; and the right answers,
if not the row's name: an effect equivalent to another circle cannot be detected."""


def _of(kind: Callable[..., Concealed], *more: float) -> Make:
    return lambda size, now, rng: kind(size, *more)


def _and_tenfold(least: float) -> tuple[float, float, float]:
    return least, 4 * least, 10 * least


def _step_at_any_moment(a: float, now: Conditions, rng: np.random.Generator) -> Concealed:
    return conceal.ambient_step(a, float(now.each_s * rng.uniform(1, 20)))


_W = study.FIELD.width_mm
_UNITS, _PLACES, _SHARES, _STEPS = (1.5, 4.0, 8.0), (1.5, 6.0, 12.0), (0.05, 0.2, 0.4), (2.0, 8.0, 16.0)
_LEVELS, _LOST, _SCALES = (55.0, 40.0, 25.0), (0.03, 0.1, 0.2), _and_tenfold(0.005)

CONCEALED_BY_FORM: Mapping[str, Mapping[str, Row]] = {
    "in the list": {
        "backlash": (_of(conceal.backlash), _PLACES),
        "saturation": (_of(conceal.saturation), _LEVELS),
        "nonlinearity": (_of(conceal.nonlinearity), (1.1, 1.5, 2.2)),
        "albedo_gradient": (lambda a, now, rng: conceal.albedo_gradient(-a / _W, 0.0), (0.1, 0.3, 0.5)),
        "ambient_gradient": (lambda a, now, rng: conceal.ambient_gradient(a / _W, 0.0), (2.0, 10.0, 25.0)),
        "ambient_step": (lambda a, now, rng: conceal.ambient_step(a, 6 * now.each_s), _STEPS),
        "offset_drift": (lambda a, now, rng: conceal.offset_drift(a * 3600 / (30 * now.each_s)), _STEPS),
        "gain_drift": (lambda a, now, rng: conceal.gain_drift(a, 15 * now.each_s), (0.05, 0.15, 0.3)),
        "edge_blur": (_of(conceal.edge_blur), (3.0, 11.0, 20.0)),
        "halo": (_of(conceal.halo, 25.0), _SHARES),
        "dropouts": (_of(conceal.dropouts, study.DARK), _LOST),
        "outliers": (_of(conceal.outliers, 12.0), _LOST),
        "gain_loss": (lambda a, now, rng: conceal.gain_loss(a, now.each_s), (0.001, 0.005, 0.01), "gain_drift"),
        "hysteresis": (_of(conceal.hysteresis), _and_tenfold(1.0)),
        "lag": (_of(conceal.lag), (2.0, 4.0, 8.0)),
        "flicker": (_of(conceal.flicker, 0.37, 1.0), _UNITS),
        "edge_shadow": (_of(conceal.edge_shadow, 8.0), _SHARES),
        "correlated_noise": (_of(conceal.correlated_noise), (0.3, 0.6, 0.9)),
        "signal_dependent_noise": (_of(conceal.signal_dependent_noise), (1.0, 8.0, 30.0)),
        "quantisation": (_of(conceal.quantisation), (2.0, 5.0, 10.0)),
        "periodic_position_error": (_of(conceal.periodic_position_error, 60.0, 0.0), _and_tenfold(1.0)),
        "height_gradient": (lambda a, now, rng: conceal.height_gradient(a / _W), _and_tenfold(0.5)),
        "albedo_patch": (_of(conceal.albedo_patch, *_MIDDLE_MM, 150.0), (0.1, 0.3, 0.6)),
        "glint": (_of(conceal.glint, *_MIDDLE_MM, 100.0), _and_tenfold(3.0)),
        "sensor_tilt": (_of(conceal.sensor_tilt, 0.0), (2.0, 6.0, 12.0), CLEAN),
        "position_scale": (lambda a, now, rng: conceal.position_scale(a, a), _SCALES, CLEAN),
        "dark_level": (_of(conceal.ambient_step, -math.inf), _and_tenfold(2.0)),
        "gain": (_of(conceal.gain_drift, math.inf), _and_tenfold(0.05)),
        "noise_sd": (lambda a, now, rng: conceal.drifting_noise(1 + a, 1e-9), _and_tenfold(0.5)),
        "play_of_axes": (lambda a, now, rng: conceal.play_of_axes(a, a / 2), _PLACES, "backlash"),
        "scale_of_x": (_of(conceal.position_scale, 0.0), _SCALES, "position_scale"),
        "step_at_any_moment": (_step_at_any_moment, _STEPS, "ambient_step"),
    },
    "another form": {
        "thermal_gain": (
            lambda a, now, rng: conceal.thermal_gain(a, 50 * now.each_s, tuple(rng.uniform(0, 2 * math.pi, 10))),
            *(_and_tenfold(0.02), "gain_drift"),
        ),
        "soft_saturation": (_of(conceal.saturation, 10.0), _LEVELS, "saturation"),
        "dead_zone": (_of(conceal.floor), _and_tenfold(0.05), "nonlinearity"),
        "ghost": (_of(conceal.ghost, 25.0, 0.0), _SHARES, "halo"),
        "stick_slip": (_of(conceal.stick_slip, 60.0, 0.0), _and_tenfold(1.0), "periodic_position_error"),
        "chirp": (
            lambda a, now, rng: conceal.chirp(a, 0.05 / now.each_s, 0.005 / now.each_s**2, 0.0),
            *(_UNITS, "flicker"),
        ),
    },
    "in no list": {
        "bent_rail": (lambda a, now, rng: conceal.bent_rail(a * (10 / _W) ** 2), _and_tenfold(2.0)),
        "place_step": (_of(conceal.place_step, _MIDDLE_MM[0]), _and_tenfold(1.0)),
        "after_glow": (
            lambda a, now, rng: conceal.after_glow(a, 3 * now.each_s, 0.5 * (study.DARK + study.BRIGHT)),
            _UNITS,
        ),
        "peak_memory": (_of(conceal.peak_memory), _SHARES),
    },
    "two at once": {
        "backlash_and_step": (
            lambda a, now, rng: (conceal.backlash(a), _step_at_any_moment(a, now, rng)),
            *(_PLACES, "backlash ambient_step"),
        ),
        "gain_and_dark_level": (
            lambda a, now, rng: (conceal.gain_drift(a / 50, math.inf), conceal.ambient_step(a, -math.inf)),
            *(_and_tenfold(2.0), "dark_level+gain gain dark_level"),
        ),
    },
}
"""What is concealed in each row: as a rival of the robot has it, in another form than its, or in no list of rivals."""

CONCEALED: Mapping[str, Row] = {name: row for rows in CONCEALED_BY_FORM.values() for name, row in rows.items()}

_IN_ARM_FRAME: Mapping[str, Callable[[float, FloatArray], FloatArray]] = {
    "sensor_tilt": lambda mm, circle: circle - np.array([mm, 0.0, 0.0]),
    "position_scale": lambda share, circle: circle / (1.0 + share),
    "scale_of_x": lambda share, circle: circle / np.array([1.0 + share, 1.0, 1.0]),
}


@dataclass(frozen=True)
class ConcealedTrial:
    """One run: concealed effect ("": none), index of its size, number of the circle, trust, reading limit, seed.

    If `varied`, the circle has conditions of its own, otherwise those of the study's table.
    """

    effect: str
    size: int
    circle: int
    trust: float
    max_readings: int = 100
    seed: int = study.SEED
    varied: bool = False

    @property
    def circle_mm(self) -> FloatArray:
        """The true circle: x_mm, y_mm, radius_mm, (3,)."""
        return study.true_circle(study.REFERENCE.population, self.circle, seed=self.seed)

    @property
    def true_circle_in_arm_frame(self) -> FloatArray:
        """The circle that the robot can find, (3,): the true one, but as changed by a tilt or an error of scale."""
        frame = _IN_ARM_FRAME.get(self.effect)
        return self.circle_mm if frame is None else frame(CONCEALED[self.effect][1][self.size], self.circle_mm)

    def circle_found_as(self, name: str, mean: FloatArray) -> FloatArray:
        """Return the circle, (3,), to compare a posterior mean with, in a run that names the effect so.

        A scale of X that is named is put right along X, or as much the other way along Y: the nearer of both counts.
        """
        if (self.effect, name) != ("scale_of_x", "position_scale"):
            return self.true_circle_in_arm_frame
        put_right = self.circle_mm, self.circle_mm / (1.0 + CONCEALED[self.effect][1][self.size])
        return min(put_right, key=lambda circle: float(np.abs(mean - circle).max()))

    @property
    def conditions(self) -> Conditions:
        """Noise, pace, rounding and footprint."""
        return Conditions.draw(np.random.default_rng([self.seed, self.circle, 1])) if self.varied else Conditions()

    @property
    def right_answers(self) -> tuple[str, ...]:
        """The names that a run may give: of the concealed effect or an equivalent one, or "clean"; none in no list."""
        if self.effect in CONCEALED_BY_FORM["in no list"]:
            return ()
        names = (CONCEALED[self.effect][2:] or (self.effect,)) if self.effect else (CLEAN,)
        return tuple(" ".join(names).split())

    @property
    def key(self) -> str:
        """Key of the run in the campaign's file: effect, size, circle and trust."""
        return f"{self.effect or CLEAN} / {self.size} / {self.circle} / {self.trust:g}"


@own_arithmetic
def run_concealed_trial(trial: ConcealedTrial) -> dict[str, Any]:
    """Search for a circle with a sensor that has a concealed effect; return a `results.CONCEALED_TRIAL`."""
    experiment = replace(trial.conditions.experiment(), trust=trial.trust)
    run: Any = {"seed": trial.seed, "circle": trial.circle, "max_readings": trial.max_readings}
    steps, cpu = zip(*study.timed_steps(_arm_in_concealed_world(trial), experiment, **run), strict=True)
    last = steps[-1]
    left_out = left_out_after_step(last, trial.trust)
    return {
        "known": Exploration(experiment, (last,)).target_reached,
        "readings": last.number,
        **study.accuracy_measures(last, experiment, trial.circle_found_as(left_out.leading, last.mean)),
        "p_truth": round(sum(left_out.probability.get(name, 0.0) for name in trial.right_answers), 4),
        "credible": list(left_out.credible_set),
        "noticed": experiment.fit_is_doubtful(last.p_value) or left_out.leading != CLEAN,
        "cpu_s": [round(float(np.quantile(cpu, q)), 3) for q in (0.5, 0.95)],
    }


def _arm_in_concealed_world(trial: ConcealedTrial) -> SimulatedArm:
    """Return an arm in the world with the concealed effect; seed, circle and reading number determine its noise."""
    now = trial.conditions
    made: Any = ()
    if trial.effect:
        make, sizes, *_ = CONCEALED[trial.effect]
        made = make(sizes[trial.size], now, np.random.default_rng([trial.seed, trial.circle, trial.size, 2]))
    noisy: Any = {"noise_sd": now.noise_sd, "step": now.step, "concealed": made if isinstance(made, tuple) else (made,)}
    world = World(study.footprint_pixels(now.blobs), black=study.DARK, white=study.BRIGHT, **noisy)
    disc = study.disc_of(trial.circle_mm)
    reader = Reader(world, seed=(trial.seed, trial.circle))

    def light_reading(pose: Pose, time_s: float, height_mm: float) -> float:
        return reader.read(disc, pose.x_mm, pose.y_mm, pose.orientation_rad, time_s=time_s)

    return study.arm_that_reads(light_reading, speed=Speed(500.0, now.each_s - _MOVE_S))


def concealed_study(
    n_circles: int,
    *,
    max_readings: int = 100,
    effects: Sequence[str] = tuple(CONCEALED),
    sizes: Sequence[int] = (0, 1, 2),
    n_clean: int | None = None,
    seed: int = study.SEED,
    varied: bool = False,
) -> Campaign[ConcealedTrial]:
    """Return the campaign of every row over the first circles, with trust `TRUST` and 1.

    `n_circles`: circles per row; `max_readings`: a run that has not reached the target precision after so many is a
    miss; `effects`, `sizes`: names in CONCEALED and indices of sizes to run besides the clean row, which has `n_clean`
    circles, by default as many as the others; `seed`: of circles, noise and robot; `varied`: whether each circle has
    conditions of its own.
    """
    for n in (n_circles, n_clean or n_circles):
        checked_whole("n_circles", n, most=study.MOST_CIRCLES)
    rows = {("", 0): n_clean or n_circles, **{(name, size): n_circles for name in effects for size in sizes}}
    trials = [
        ConcealedTrial(name, size, circle, trust, max_readings, seed, varied)
        for circle in range(max(rows.values()))
        for (name, size), n in rows.items()
        if circle < n
        for trust in (TRUST, 1.0)
    ]
    settings = {"concealed": __version__, "max_readings": max_readings, "seed": seed}
    settings |= {"varied": True} if varied else {}
    tasks = {trial.key: trial for trial in trials}
    return Campaign(run_concealed_trial, tasks, settings, partial(misfit, schema=CONCEALED_TRIAL))


@dataclass(frozen=True)
class ConcealedRow:
    """Summary of a row: shares with Wilson's 95 % intervals, medians and means over its runs."""

    concealed: str
    size: float | None  # None where nothing is concealed
    trust: float
    runs: int
    readings: float  # median
    mean_readings: float
    reached: Estimate  # runs that reached the target precision
    intervals_hold: Estimate  # 95 % intervals that hold the truth, over all parameters and runs
    sure_and_wrong: Estimate  # ended by the robot's own rule with a length off by more than 12 mm
    noticed: Estimate  # an effect leads, or the fit is doubted
    in_credible_set: Estimate  # the right answer is
    names: float  # in the credible set, mean
    cpu_s_median: float  # medians over runs of each run's median and 95 % quantile per decision
    cpu_s_95: float


def concealed_rows(results: Mapping[ConcealedTrial, Result], *, by_form: bool = False) -> list[ConcealedRow]:
    """Summarise the runs of each row (effect, size and trust), in the order of `results`.

    `by_form`: instead those with effects of each form, at each trust.
    """
    form = {name: form for form, rows in CONCEALED_BY_FORM.items() for name in rows}

    def row_of(t: ConcealedTrial) -> tuple[str, float | None, float]:
        if by_form:
            return form[t.effect], None, t.trust
        return t.effect or "nothing", CONCEALED[t.effect][1][t.size] if t.effect else None, t.trust

    counted = [(t, run) for t, run in results.items() if t.effect or not by_form]
    rows = []
    for key, runs in grouped((row_of(t), (t.right_answers, run)) for t, run in counted).items():
        found = [run for _, run in runs]
        readings, cpu_s = [run["readings"] for run in found], np.median([run["cpu_s"] for run in found], axis=0)
        row = ConcealedRow(
            *key,
            runs=len(found),
            readings=float(np.median(readings)),
            mean_readings=round(float(np.mean(readings)), 1),
            reached=estimated_share(run["known"] for run in found),
            intervals_hold=estimated_share(hit for run in found for hit in run["held"]),
            sure_and_wrong=estimated_share(run["known"] and run["error_mm"] > WRONG_MM for run in found),
            noticed=estimated_share(run["noticed"] for run in found),
            in_credible_set=estimated_share(not {*names}.isdisjoint(run["credible"]) for names, run in runs if names),
            names=round(float(np.mean([len(run["credible"]) for run in found])), 1),
            cpu_s_median=round(float(cpu_s[0]), 2),
            cpu_s_95=round(float(cpu_s[1]), 2),
        )
        rows.append(row)
    return rows


def concealed_csv(rows: Sequence[ConcealedRow]) -> str:
    """Return rows as CSV text: shares with their intervals as text."""

    def cell(value: object) -> object:
        if isinstance(value, Estimate):
            return f"{value.value:.2f} ({value.low:.2f} to {value.high:.2f})" if value.n else ""
        return "" if value is None else value

    names = [column.name for column in fields(ConcealedRow)]
    return csv_text_of_rows(names, (map(cell, vars(row).values()) for row in rows))
