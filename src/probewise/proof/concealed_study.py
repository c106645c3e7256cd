"""Studies of the robot with a concealed fault: success rates, named faults, and runs that are sure and wrong.

The sensor model is exact except for one concealed effect, at three sizes each. The readings are simulated by
`probewise.world`, which sums pixels and shares no code with the models. Every row has the same circles and noise, at
two prior probabilities that the sensor model is complete (`trust`): `TRUST` and 1.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise._kinds import checked_whole
from probewise._version import __version__
from probewise.arm import Pose, Reach, Reading, SimulatedArm, Speed
from probewise.experiment import CLEAN, TRUST, left_out_after_step, recording_of
from probewise.progress import Progress, silent
from probewise.proof.campaign import run_campaign
from probewise.proof.configurations import FIELD, MOST_CIRCLES, POPULATIONS, REFERENCE
from probewise.proof.estimates import Estimate, estimated_share
from probewise.proof.results import CONCEALED_TRIAL, misfit
from probewise.proof.trial import (
    BRIGHT,
    DARK,
    SEED,
    WRONG_MM,
    accuracy_measures,
    experiment_of,
    footprint_pixels,
    has_reached_target,
    timed_steps,
)
from probewise.recordings import Disc
from probewise.world import AmbientGradient, Backlash, Concealed, GainDrift, Nonlinearity, Saturation, World
from probewise.world.concealed import (
    AlbedoGradient,
    AlbedoPatch,
    AmbientStep,
    CorrelatedNoise,
    Dropouts,
    EdgeBlur,
    EdgeShadow,
    Flicker,
    Glint,
    Halo,
    HeightGradient,
    Hysteresis,
    Lag,
    OffsetDrift,
    Outliers,
    PeriodicPositionError,
    PositionScale,
    Quantisation,
    SensorTilt,
    SignalDependentNoise,
)
from probewise.world.stages import Rows, Stage

_EACH_S = 8.0  # seconds between readings, about
_MIDDLE_MM = (FIELD.width_mm / 2, FIELD.height_mm / 2)
_SPEED = Speed(move_mm_s=500.0, read_s=_EACH_S - 0.8)


@dataclass(frozen=True)
class FadingLamp:
    """A lamp that fades linearly: every eight seconds it loses a `share` of its first signal, down to zero."""

    share: float

    name: ClassVar[str] = "gain_loss"
    stage: ClassVar[Stage] = "gain"

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Multiply the signal by the fraction of light that the lamp still gives at each row's time."""
        return np.asarray(values * np.maximum(1.0 - self.share * rows.time_s / _EACH_S, 0.0))


CONCEALED: Mapping[str, tuple[Callable[[float], Concealed], tuple[float, float, float]]] = {
    "backlash": (Backlash, (1.5, 6.0, 12.0)),
    "saturation": (Saturation, (55.0, 40.0, 25.0)),
    "nonlinearity": (Nonlinearity, (1.1, 1.5, 2.2)),
    "albedo_gradient": (lambda share: AlbedoGradient(-share / FIELD.width_mm, 0.0), (0.1, 0.3, 0.5)),
    "ambient_gradient": (lambda units: AmbientGradient(units / FIELD.width_mm, 0.0), (2.0, 10.0, 25.0)),
    "ambient_step": (lambda units: AmbientStep(units, 6 * _EACH_S), (2.0, 8.0, 16.0)),
    "offset_drift": (lambda units: OffsetDrift(units * 3600.0 / (30 * _EACH_S)), (2.0, 8.0, 16.0)),
    "gain_drift": (lambda share: GainDrift(share, 15 * _EACH_S), (0.05, 0.15, 0.3)),
    "edge_blur": (EdgeBlur, (3.0, 11.0, 20.0)),
    "halo": (lambda share: Halo(share, 25.0), (0.05, 0.2, 0.4)),
    "dropouts": (lambda share: Dropouts(share, DARK), (0.03, 0.1, 0.2)),
    "outliers": (lambda share: Outliers(share, 12.0), (0.03, 0.1, 0.2)),
    "gain_loss": (FadingLamp, (0.001, 0.005, 0.01)),
    "hysteresis": (Hysteresis, (1.0, 4.0, 10.0)),
    "lag": (Lag, (2.0, 4.0, 8.0)),
    "flicker": (lambda units: Flicker(units, 0.37, 1.0), (1.5, 4.0, 8.0)),
    "edge_shadow": (lambda share: EdgeShadow(share, 8.0), (0.05, 0.2, 0.4)),
    "correlated_noise": (CorrelatedNoise, (0.3, 0.6, 0.9)),
    "signal_dependent_noise": (SignalDependentNoise, (1.0, 8.0, 30.0)),
    "quantisation": (Quantisation, (2.0, 5.0, 10.0)),
    "periodic_position_error": (lambda mm: PeriodicPositionError(mm, 60.0, 0.0), (1.0, 4.0, 10.0)),
    "height_gradient": (lambda mm: HeightGradient(mm / FIELD.width_mm), (0.5, 2.0, 5.0)),
    "albedo_patch": (lambda share: AlbedoPatch(share, *_MIDDLE_MM, 150.0), (0.1, 0.3, 0.6)),
    "glint": (lambda units: Glint(units, *_MIDDLE_MM, 100.0), (3.0, 12.0, 30.0)),
    "sensor_tilt": (lambda mm: SensorTilt(mm, 0.0), (2.0, 6.0, 12.0)),
    "position_scale": (lambda share: PositionScale(share, share), (0.005, 0.02, 0.05)),
}
"""For each name: the concealed effect as a function of its size, and three sizes: barely detectable, clear, gross."""

NAMES: Mapping[str, str] = {"": CLEAN, "gain_loss": GainDrift.name, "sensor_tilt": CLEAN, "position_scale": CLEAN}
"""The right answer of a row, if not its name: an effect equivalent to another circle cannot be detected."""

_IN_ARM_FRAME: Mapping[str, Callable[[float, FloatArray], FloatArray]] = {
    "sensor_tilt": lambda mm, circle: circle - np.array([mm, 0.0, 0.0]),
    "position_scale": lambda share, circle: circle / (1.0 + share),
}
_REMEMBERING = frozenset({"lag", "correlated_noise"})  # effects by which a reading depends on earlier ones


@dataclass(frozen=True)
class ConcealedTrial:
    """One run: concealed effect ("": none), index of its size, number of the circle, trust, reading limit, seed."""

    effect: str
    size: int
    circle: int
    trust: float
    max_readings: int = 100
    seed: int = SEED

    @property
    def circle_mm(self) -> FloatArray:
        """The true circle: x_mm, y_mm, radius_mm, (3,)."""
        return np.asarray(POPULATIONS[REFERENCE.population].circles(self.circle + 1, seed=self.seed)[self.circle])

    @property
    def true_circle_in_arm_frame(self) -> FloatArray:
        """The circle that the robot can find, (3,): the true one, but as changed by a tilt or an error of scale."""
        frame = _IN_ARM_FRAME.get(self.effect)
        return self.circle_mm if frame is None else frame(CONCEALED[self.effect][1][self.size], self.circle_mm)

    @property
    def right_answer(self) -> str:
        """The name that a run should give: of the concealed effect, of an equivalent one, or "clean"."""
        return NAMES.get(self.effect, self.effect)

    @property
    def key(self) -> str:
        """Key of the run in the campaign's file: effect, size, circle and trust."""
        return f"{self.effect or CLEAN} / {self.size} / {self.circle} / {self.trust:g}"


@own_arithmetic
def run_concealed_trial(trial: ConcealedTrial) -> dict[str, Any]:
    """Search for a circle with a sensor that has a concealed effect; return a `results.CONCEALED_TRIAL`."""
    experiment = replace(experiment_of(REFERENCE), trust=trial.trust)
    cpu = []
    steps = timed_steps(
        _arm_in_concealed_world(trial),
        experiment,
        seed=trial.seed,
        circle=trial.circle,
        max_readings=trial.max_readings,
    )
    for step, cpu_s in steps:
        last = step
        cpu.append(cpu_s)
    left_out = left_out_after_step(last, trial.trust)
    return {
        "known": has_reached_target(last, experiment),
        "readings": last.number,
        **accuracy_measures(last, experiment, trial.true_circle_in_arm_frame),
        "p_truth": round(left_out.probability.get(trial.right_answer, 0.0), 4),
        "credible": list(left_out.credible_set),
        "noticed": experiment.fit_is_doubtful(last.p_value) or left_out.leading != CLEAN,
        "cpu_s": [round(float(np.quantile(cpu, q)), 3) for q in (0.5, 0.95)],
    }


def _arm_in_concealed_world(trial: ConcealedTrial) -> SimulatedArm:
    """Return an arm in the world with the concealed effect; seed, circle and reading number determine its noise."""
    concealed: tuple[Concealed, ...] = ()
    if trial.effect:
        make, sizes = CONCEALED[trial.effect]
        concealed = (make(sizes[trial.size]),)
    world = World(footprint_pixels(), black=DARK, white=BRIGHT, noise_sd=REFERENCE.noise_sd, concealed=concealed)
    x_mm, y_mm, radius_mm = trial.circle_mm.tolist()
    disc = Disc((x_mm, y_mm), radius_mm)
    came: list[tuple[Pose, float, tuple[float, float]]] = []

    def light_reading(pose: Pose, time_s: float, height_mm: float) -> float:
        direction = came[-1][2] if came else (0.0, 0.0)
        if came and (away := math.hypot(pose.x_mm - came[-1][0].x_mm, pose.y_mm - came[-1][0].y_mm)) > 0:
            direction = ((pose.x_mm - came[-1][0].x_mm) / away, (pose.y_mm - came[-1][0].y_mm) / away)
        came.append((pose, time_s, direction))
        if trial.effect in _REMEMBERING:
            so_far = recording_of([Reading(0.0, was, at_s) for was, at_s, _ in came], patterns={"field": disc}).plan
            return float(world.simulate(so_far, rng=np.random.default_rng([trial.seed, trial.circle])).readings[-1])
        rng = np.random.default_rng([trial.seed, trial.circle, len(came) - 1])
        return world.read(disc, pose.x_mm, pose.y_mm, pose.orientation_rad, time_s=time_s, rng=rng, direction=direction)

    everywhere = Reach((FIELD.width_mm, FIELD.height_mm), nearest_mm=0.0, farthest_mm=2 * FIELD.width_mm)
    return SimulatedArm(light_reading, reach=everywhere, speed=_SPEED, scale=None)


def run_concealed(
    n_circles: int,
    *,
    path: str | os.PathLike[str],
    max_readings: int = 100,
    effects: Sequence[str] = tuple(CONCEALED),
    sizes: Sequence[int] = (0, 1, 2),
    n_clean: int | None = None,
    seed: int = SEED,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> dict[ConcealedTrial, dict[str, Any]]:
    """Run every row over the first circles, with trust `TRUST` and 1, or resume an interrupted study.

    Parameters
    ----------
    n_circles
        Circles per row.
    path
        The campaign's file; runs in it are not repeated.
    max_readings
        A run that has not reached the target precision after this many readings is a miss.
    effects, sizes
        Names in CONCEALED and indices of sizes to run besides the clean row.
    n_clean
        Circles of the clean row; by default as many as for the others.
    seed
        Of circles, noise and robot.
    executor, progress
        As for `run_study`.
    """
    for n in (n_circles, n_clean or n_circles):
        checked_whole("n_circles", n, most=MOST_CIRCLES)
    rows = {("", 0): n_clean or n_circles, **{(name, size): n_circles for name in effects for size in sizes}}
    trials = [
        ConcealedTrial(name, size, circle, trust, max_readings, seed)
        for circle in range(max(rows.values()))
        for (name, size), n in rows.items()
        if circle < n
        for trust in (TRUST, 1.0)
    ]
    results = run_campaign(
        run_concealed_trial,
        {trial.key: trial for trial in trials},
        path=path,
        settings={"concealed": __version__, "max_readings": max_readings, "seed": seed},
        executor=executor,
        progress=progress,
        noun="runs",
        misfit=partial(misfit, schema=CONCEALED_TRIAL),
    )
    return {trial: dict(results[trial.key]) for trial in trials}


@dataclass(frozen=True)
class ConcealedRow:
    """Summary of a row: shares with Wilson's 95 % intervals, `readings` (median), `mean_readings`, processor time.

    `size` is None where nothing is concealed. `reached`: runs that reached the target precision. `intervals_hold`: 95 %
    intervals that hold the truth, over all parameters and runs. `sure_and_wrong`: ended by the robot's own rule with a
    length off by more than 12 mm. `noticed`: an effect leads, or the fit is doubted. `in_credible_set`: the right
    answer is in the credible set, which has `names` names on average. `cpu_s_median`, `cpu_s_95`: medians over runs of
    each run's median and 95 % quantile of the processor time per decision, s.
    """

    concealed: str
    size: float | None
    trust: float
    runs: int
    readings: float
    mean_readings: float
    reached: Estimate
    intervals_hold: Estimate
    sure_and_wrong: Estimate
    noticed: Estimate
    in_credible_set: Estimate
    names: float
    cpu_s_median: float
    cpu_s_95: float


_COLUMNS = tuple(column.name for column in fields(ConcealedRow))


def concealed_rows(results: Mapping[ConcealedTrial, Mapping[str, Any]]) -> list[ConcealedRow]:
    """Summarise the runs of each row (effect, size and trust), in the order of `results`."""
    rows: dict[tuple[str, int, float], list[tuple[str, Mapping[str, Any]]]] = {}
    for trial, result in results.items():
        rows.setdefault((trial.effect, trial.size, trial.trust), []).append((trial.right_answer, result))
    return [_summary_row(key, runs) for key, runs in rows.items()]


def concealed_csv_rows(results: Mapping[ConcealedTrial, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Summarise each row as a dict for a CSV file: shares with their intervals as text."""
    return [{name: _csv_value(getattr(row, name)) for name in _COLUMNS} for row in concealed_rows(results)]


def _summary_row(key: tuple[str, int, float], runs: list[tuple[str, Mapping[str, Any]]]) -> ConcealedRow:
    effect, size, trust = key
    found = [run for _, run in runs]
    held = [hit for run in found for hit in run["held"]]
    n = len(found)
    return ConcealedRow(
        concealed=effect or "nothing",
        size=CONCEALED[effect][1][size] if effect else None,
        trust=trust,
        runs=n,
        readings=float(np.median([run["readings"] for run in found])),
        mean_readings=round(float(np.mean([run["readings"] for run in found])), 1),
        reached=estimated_share([run["known"] for run in found]),
        intervals_hold=estimated_share(held),
        sure_and_wrong=estimated_share([run["known"] and run["error_mm"] > WRONG_MM for run in found]),
        noticed=estimated_share([run["noticed"] for run in found]),
        in_credible_set=estimated_share([name in run["credible"] for name, run in runs]),
        names=round(float(np.mean([len(run["credible"]) for run in found])), 1),
        cpu_s_median=round(float(np.median([run["cpu_s"][0] for run in found])), 2),
        cpu_s_95=round(float(np.median([run["cpu_s"][1] for run in found])), 2),
    )


def _csv_value(value: object) -> object:
    if isinstance(value, Estimate):
        return f"{value.value:.2f} ({value.low:.2f} to {value.high:.2f})"
    return "" if value is None else value
