"""Effects on the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed_prior import LogHeavyTailedPrior
from probewise.effects.noise_distribution import FittedReadings
from probewise.effects.vocabulary import NoiseEffect
from probewise.priors import LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import NoiseParameters, Stage


@dataclass(frozen=True)
class CorrelatedNoise(NoiseEffect):
    """Correlated noise, AR(1) within a scan: e_k = rho e_(k-1) + new noise."""

    lowest: float = -0.5
    highest: float = 0.95

    name = "correlated_noise"
    words = "noise that neighbouring readings share"
    stage = Stage.NOISE
    units = ("1",)
    covariates = ("scan",)
    n_nodes = 28  # dense enough to integrate the posterior of a thousand readings

    @cached_property
    def prior(self) -> Product:
        return Product({"rho": Uniform(self.lowest, self.highest)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        """Return the noise with this correlation; the sd of a single reading does not change."""
        return replace(value, rho=theta[:, :1])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the noise of successive readings has correlation {value_with_sd(mean[0], sd[0])}: "
            "part of each error returns in the next reading"
        )


@dataclass(frozen=True)
class SignalDependentNoise(NoiseEffect):
    """Noise that grows with the light: variance x (1 + ratio u), u the seen white fraction."""

    least: float = 0.05
    most: float = 50.0

    name = "signal_dependent_noise"
    words = "noise that grows with the signal"
    stage = Stage.NOISE
    units = ("1",)
    covariates = ("level",)

    @cached_property
    def prior(self) -> Product:
        return Product({"ratio": LogUniform(self.least, self.most)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, sd=value.sd * np.sqrt(1 + theta[:, :1] * np.clip(value.seen, 0.0, 1.0)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the noise grows with the reading: its variance at the highest level is "
            f"{value_with_sd(1 + mean[0], sd[0])} times that at the lowest"
        )


@dataclass(frozen=True)
class DriftingNoise(NoiseEffect):
    """Noise whose sd grows or shrinks exponentially in time: sd x growth^(time / duration - 1/2).

    The effect is outside the vocabulary: a nuisance that keeps the tests of the mean valid. Time counts from the first
    reading to the last of the plan; no repaired model holds it, so that it never acts on another plan than the
    recording's.
    """

    least: float = 0.2
    most: float = 5.0

    name = "drifting_noise"
    words = "noise that changes in time"
    stage = Stage.NOISE
    units = ("1",)
    covariates = ("time",)

    @cached_property
    def prior(self) -> Product:
        return Product({"growth": LogUniform(self.least, self.most)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        elapsed = (plan.time_s - plan.time_s.min()) / (float(np.ptp(plan.time_s)) or 1.0)
        return replace(value, sd=value.sd * theta[:, :1] ** (elapsed - 0.5))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"the sd of the noise at the end is {value_with_sd(mean[0], sd[0])} times that at the start"


@dataclass(frozen=True)
class RandomWalk(NoiseEffect):
    """A random walk of the offset: a normal step from each row to the next, across runs too.

    `n_before` is the number of steps taken before the first row of the plan: the rows of the training data.
    """

    n_before: int = 0
    least: float = 5e-3
    most: float = 3.0

    name = "random_walk"
    words = "a zero that wanders"
    stage = Stage.NOISE
    units = ("noise sd",)
    covariates = ("time", "row", "run")
    n_nodes = 16

    @cached_property
    def prior(self) -> Product:
        """Prior of the sd of a step in noise sds, log-uniform."""
        return Product({"sd_per_row": LogUniform(self.least, self.most)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        """Return the noise parameters with a random walk of the offset added; its steps have the sd in theta."""
        return replace(
            value, walk=theta[:, :1], walked=np.asarray(self.n_before + 1.0 + np.arange(len(plan)), dtype=np.float64)
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"the offset is a random walk with steps of sd {value_with_sd(mean[0], sd[0])} noise sds from row to row"


_SPREADS = (0.1, 0.2, 0.4, 0.8, 1.6)  # hyperprior, equal weights: sds between runs of the logarithm of a run's sd
_NEWTON_STEPS = 40


@dataclass(frozen=True)
class NoisePerRun(NoiseEffect):
    """Noise that differs between runs: sd x the run's value, whose logarithm has a heavy-tailed prior.

    Parameters
    ----------
    runs
        Names of the runs.
    n_rows
        Number of readings from which each run's value was estimated; () where it is not needed.
    """

    runs: tuple[str, ...] = ()
    n_rows: tuple[int, ...] = ()

    name = "noise_per_run"
    words = "noise that differs from run to run"
    stage = Stage.NOISE
    covariates = ("run",)
    nodes_per_parameter = ()  # they are most probable values about a fit

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect for the runs of a recording; None if there is only one."""
        plan = extent.plan
        names = tuple(plan.scan_names)
        return cls(names, tuple(np.bincount(plan.scan, minlength=len(names)).tolist())) if len(names) > 1 else None

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the values: pure numbers."""
        return ("1",) * len(self.runs)

    @property
    def amplitudes(self) -> tuple[int, ...]:
        """No amplitudes: the values are factors, which do nothing at 1."""
        return ()

    @property
    def nothing(self) -> dict[int, float]:
        """Factor 1 in every run."""
        return dict.fromkeys(range(len(self.runs)), 1.0)

    @cached_property
    def prior(self) -> Product:
        """Independent priors of the runs' values."""
        return Product({f"values[{run}]": LogHeavyTailedPrior(0.3) for run in self.runs})

    def bank(self) -> FloatArray:
        """Return one entry, 1 in every run: `weighed_nodes` finds the values from a fit's residuals."""
        return np.ones((1, 1, len(self.runs)))

    def weighed_nodes(self, residuals: FloatArray, rows: FittedReadings) -> tuple[FloatArray, FloatArray]:
        """Return the runs' most probable values, (n_nodes, n_runs), and log Laplace weights, (n_nodes,).

        There is one node for each of five assumed sds, between runs, of the values' logs; none for a single run.
        """
        n_runs = len(self.runs)
        counts = np.bincount(rows.run, minlength=n_runs).astype(np.float64)
        squares: FloatArray = np.bincount(rows.run, residuals**2, minlength=n_runs).astype(np.float64)
        if n_runs < 2 or not (squares > 0).any():
            return np.zeros((0, n_runs)), np.zeros(0)
        values, log_weights = [], []
        for spread in _SPREADS:
            logs = _most_probable_log_sd_ratios(counts, squares, spread)
            curvature = 2 * counts + spread**-2
            # The overall sd is integrated elsewhere, at fixed values: `beside` corrects for its coupling to them.
            beside = float(np.sum(2 * counts * spread**-2 / curvature)) / float(2 * counts.sum())
            log_prior = -0.5 * float(np.sum((logs / spread) ** 2)) - n_runs * np.log(spread)
            log_weights.append(log_prior - 0.5 * float(np.log(curvature).sum() + np.log(beside)))
            values.append(np.exp(logs))
        return np.array(values), np.array(log_weights) - np.log(len(_SPREADS))

    def draws_about(self, nodes: FloatArray, *, rng: np.random.Generator) -> FloatArray | None:
        """Draw each run's value about its node, with relative sd 1 / sqrt(2 n_rows)."""
        widths = 1 / np.sqrt(2 * np.maximum(np.array(self.n_rows or (1,) * len(self.runs)), 1))
        return np.asarray(nodes * np.exp(widths * rng.standard_normal(nodes.shape)))

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        """Return the noise, its sd times the value of each reading's run; 1 for a run that is not listed."""
        known = {name: k for k, name in enumerate(self.runs)}
        at = np.array([known.get(name, len(self.runs)) for name in plan.scan_names])
        values = np.concatenate([theta, np.ones((len(theta), 1))], axis=1)
        return replace(value, sd=value.sd * values[:, at[plan.scan]])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say which runs have the least and the most noise."""
        low, high = int(np.argmin(mean)), int(np.argmax(mean))
        return (
            f"the noise differs from run to run: its sd is {value_with_sd(mean[high], sd[high])} times the typical one "
            f"in run {self.runs[high]} and {value_with_sd(mean[low], sd[low])} times in run {self.runs[low]}"
        )


def _most_probable_log_sd_ratios(counts: FloatArray, squares: FloatArray, spread: float) -> FloatArray:
    """Return the most probable logs of each run's noise sd over the overall sd, (n_runs,); the latter is profiled out.

    `counts` and `squares` are the number of readings and the sum of squared residuals of each run, (n_runs,); `spread`
    is the prior sd of the logs.
    """
    logs = np.zeros(len(counts))
    for _ in range(_NEWTON_STEPS):
        weighed = squares * np.exp(-2 * logs)
        share = weighed * counts.sum() / weighed.sum()  # sums of squares in units of the best overall variance
        slope = share - counts - logs / spread**2
        curvature = 2 * share + spread**-2
        # Profiling out the overall sd takes a rank-one term from the Hessian: Sherman-Morrison inverts it.
        along, turned = 2 * share / curvature, slope / curvature
        step = turned - along * float(np.sum(2 * share * turned)) / (-float(2 * share.sum()) + float(2 * share @ along))
        logs = logs + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-9:
            break
    return np.asarray(logs)
