"""Alternatives to the declared noise model, as rivals that predict the same noise-free readings.

Each likelihood is marginalised over equally weighted nodes of its prior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.effects import HeavyTailedPrior
from probewise.effects.noise import CorrelatedNoise, Outliers, SignalDependentNoise, lattice_step
from probewise.experiment.declared_noise import DeclaredNoise
from probewise.priors import LogUniform

_REACH = 5.0  # noise sds beyond its range that a sensor may read
_SHARES = LogUniform(2e-3, 0.2).from_unit((np.arange(8) + 0.5) / 8)
_NODES = (np.arange(6)[:, None] + 0.5) / 6  # of a prior of one parameter
_EXACT = 1e-3  # of the noise sd: within which a value counts as the same, lost to black or rounded
_PHASES = 7
_PER_PHASE = 0.16  # of the amplitude: width of each phase's component, about the spacing of neighbouring phases
_COARSE = 0.3  # noise sds from which rounding of the readings matters
_STEPS = (1.0, 2.0, 4.0, 8.0)  # noise sds: possible steps of a lattice of which one value has been seen
_LEAST = -1e300  # log of a probability of zero, for differences
_FREE = 2  # readings that determine the lattice


def _log_mean_over_nodes(nodes: list[FloatArray]) -> FloatArray:
    """Return the log of the mean of exp over a list of arrays, elementwise; faster than scipy's `logsumexp`."""
    stacked = np.stack(nodes)
    most = np.maximum(stacked.max(axis=0), _LEAST)
    stacked -= most
    np.exp(stacked, out=stacked)
    with np.errstate(divide="ignore"):  # impossible at every node
        return np.asarray(most + np.log(stacked.mean(axis=0)))


@dataclass(frozen=True, eq=False)
class OutlierLikelihood:
    """Likelihood with outliers, marginalised over their share and width.

    `shares` of outliers and their `sizes` (sds over the noise's sd), (n_nodes,) each, are equally weighted pairs.
    """

    noise: DeclaredNoise
    shares: FloatArray
    sizes: FloatArray

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        narrow = self.noise.log_density(readings, predicted)
        nodes = []
        for share, size in zip(self.shares, self.sizes, strict=True):
            wide = self.noise.quick_log_density(readings, predicted, sd=self.noise.sd * size)
            nodes.append(np.logaddexp(narrow + math.log1p(-share), wide + math.log(share)).sum(axis=1))
        return _log_mean_over_nodes(nodes)


@dataclass(frozen=True, eq=False)
class LostReadingLikelihood:
    """Likelihood with lost readings, independent of the target, marginalised over their share.

    A lost reading is, with equal probability, exactly `black`, `black` with noise, or uniform over the sensor's range,
    from `low` to `high` and some sds beyond.
    """

    noise: DeclaredNoise
    black: float
    low: float
    high: float

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        sd, black = self.noise.sd, np.array([[self.black]])
        kept = self.noise.log_density(readings, predicted)
        to_black = self.noise.log_density(readings, black)
        exactly = self.noise.log_density(readings, black, sd=sd * _EXACT)
        low, high = min(self.low - _REACH * sd, 0.0), self.high + _REACH * sd
        anywhere = self.noise.log_uniform_density(readings, low, high)
        lost = logsumexp(np.broadcast_arrays(exactly, to_black, anywhere), axis=0) - math.log(3.0)
        return _log_mean_over_nodes(
            [np.logaddexp(kept + math.log1p(-share), lost + math.log(share)).sum(axis=1) for share in _SHARES.tolist()]
        )


@dataclass(frozen=True, eq=False)
class CorrelatedLikelihood:
    """Likelihood with AR(1) noise from reading to reading, marginalised over the correlation."""

    noise: DeclaredNoise

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        before = np.zeros_like(predicted)
        before[:, 1:] = (readings - predicted)[:, :-1]
        first = self.noise.log_density(readings[:1], predicted[:, :1])[:, 0]
        nodes = []
        for rho in CorrelatedNoise().prior.from_unit_cube(_NODES)[:, 0].tolist():
            sd = self.noise.sd * math.sqrt(1.0 - rho**2)
            later = self.noise.log_density(readings[1:], predicted[:, 1:] + rho * before[:, 1:], sd=sd)
            nodes.append(first + later.sum(axis=1))
        return _log_mean_over_nodes(nodes)


@dataclass(frozen=True, eq=False)
class SignalDependentLikelihood:
    """Likelihood with noise that grows with the signal, marginalised over the growth of its variance.

    The signal runs from 0 at `dark` to 1 at `bright`.
    """

    noise: DeclaredNoise
    dark: float
    bright: float

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        seen = np.clip((predicted - self.dark) / (self.bright - self.dark), 0.0, 1.0)
        return _log_mean_over_nodes(
            [
                self.noise.log_density(readings, predicted, sd=self.noise.sd * np.sqrt(1.0 + ratio * seen)).sum(axis=1)
                for ratio in SignalDependentNoise().prior.from_unit_cube(_NODES)[:, 0].tolist()
            ]
        )


@dataclass(frozen=True, eq=False)
class FlickerLikelihood:
    """Likelihood under a lamp that flickers faster than the readings: each reading has a random phase.

    `amplitudes` are equally weighted nodes, in the reading's unit. A mixture over a few phases stands for the sine.
    """

    noise: DeclaredNoise
    amplitudes: tuple[float, ...]

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        sines = np.cos((np.arange(_PHASES) + 0.5) / _PHASES * np.pi)
        nodes = []
        for amplitude in self.amplitudes:
            sd = math.hypot(self.noise.sd, _PER_PHASE * amplitude)
            phases = [
                self.noise.quick_log_density(readings, predicted + amplitude * sine, sd=sd) for sine in sines.tolist()
            ]
            nodes.append(_log_mean_over_nodes(phases).sum(axis=1))
        return _log_mean_over_nodes(nodes)


@dataclass(frozen=True, eq=False)
class CoarserRoundingLikelihood:
    """Likelihood with coarser rounding than declared; if the readings show none, that of the declared noise.

    The coarser step is the largest whose lattice holds all readings, from three different values on. If the declared
    noise is not rounded and values recur, two different values determine the step by their difference; with a single
    value, the step is marginalised over.
    """

    noise: DeclaredNoise

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        inside = self.noise.inside_scale_mask(readings)
        if inside.all():
            return self._log_prob_inside_scale(readings, predicted)
        at_end = self.noise.log_density(readings[~inside], predicted[:, ~inside]).sum(axis=1)
        return np.asarray(at_end + self._log_prob_inside_scale(readings[inside], predicted[:, inside]))

    def _log_prob_inside_scale(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings that lie inside the scale, (n_samples,)."""
        least = max(_COARSE * self.noise.sd, 1.5 * self.noise.step)
        steps, n_free = self._rounding_steps_and_n_determining(readings)
        nodes = [
            self._log_prob_if_rounded_to(coarse, n_free, readings, predicted) for coarse in steps if coarse > least
        ]
        if not nodes:
            return np.asarray(self.noise.log_density(readings, predicted).sum(axis=1))
        return _log_mean_over_nodes(nodes)

    def _rounding_steps_and_n_determining(self, readings: FloatArray) -> tuple[list[float], int]:
        """Return possible rounding steps, equally weighted, and how many readings determine the step (are no test)."""
        values = np.unique(readings)
        recur = not self.noise.is_rounded and len(values) < len(readings)
        if recur and len(values) == 1:
            return [times * self.noise.sd for times in _STEPS], 1
        if recur and len(values) == 2:
            return [float(values[1] - values[0])], _FREE
        return [lattice_step(readings)], _FREE

    def _log_prob_if_rounded_to(
        self, coarse: float, n_free: int, readings: FloatArray, predicted: FloatArray
    ) -> FloatArray:
        """Return the log likelihood under rounding to `coarse`, which `n_free` readings determine, (n_samples,)."""
        step = self.noise.step
        surprise = (len(readings) - n_free) * math.log(coarse / (step or _EXACT * self.noise.sd))
        density = self.noise.log_density(readings, predicted, step=coarse) - math.log(coarse)
        return np.asarray(density.sum(axis=1) + surprise + (len(readings) * math.log(step) if step else 0.0))


NoiseLikelihood = (
    OutlierLikelihood
    | LostReadingLikelihood
    | CorrelatedLikelihood
    | SignalDependentLikelihood
    | FlickerLikelihood
    | CoarserRoundingLikelihood
)


def noise_likelihoods(noise: DeclaredNoise, ends: tuple[float, float]) -> dict[str, NoiseLikelihood]:
    """Return the noise models, {name of the effect in the vocabulary: likelihood}.

    Parameters
    ----------
    noise
        The declared noise.
    ends
        Readings over black and over white.
    """
    dark, bright = ends
    low, high = sorted(ends)
    shares, sizes = Outliers().bank()[:, 0].T
    amplitudes = HeavyTailedPrior(0.01 * (high - low), positive=True).from_unit((np.arange(6) + 0.5) / 6)
    return {
        "outliers": OutlierLikelihood(noise, shares, sizes),
        "dropouts": LostReadingLikelihood(noise, dark, low, high),
        "correlated_noise": CorrelatedLikelihood(noise),
        "signal_dependent_noise": SignalDependentLikelihood(noise, dark, bright),
        "flicker": FlickerLikelihood(noise, tuple(amplitudes.tolist())),
        "quantisation": CoarserRoundingLikelihood(noise),
    }
