"""Alternatives to the declared noise model, as rivals that predict the same noise-free readings.

Each likelihood is marginalised over equally weighted nodes of its prior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.effects import (
    CorrelatedNoise,
    HeavyTailedPrior,
    Outliers,
    SignalDependentNoise,
    lattice_step,
    log_density,
)
from probewise.effects.density import log_gaussian_density
from probewise.priors import LogUniform
from probewise.sensor import NoiseParameters

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
    """Return the log of the mean over equally weighted nodes of equal shape; called too often for scipy's version."""
    stacked = np.stack(nodes)
    most = np.maximum(stacked.max(axis=0), _LEAST)
    stacked -= most
    np.exp(stacked, out=stacked)
    with np.errstate(divide="ignore"):  # impossible at every node
        return np.asarray(most + np.log(stacked.mean(axis=0)))


@dataclass(frozen=True, eq=False)
class OutlierLikelihood:
    """Likelihood with outliers, marginalised over their share and width.

    `sd` and `step` are those of the declared noise (step 0: not rounded); `shares` and `sizes`, (n_nodes,), are equally
    weighted nodes.
    """

    sd: float
    step: float
    shares: FloatArray
    sizes: FloatArray

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        narrow = _log_density_per_reading(readings, predicted, self.sd, self.step)
        nodes = []
        for share, size in zip(self.shares, self.sizes, strict=True):
            wide = _quick_log_density_per_reading(readings, predicted, self.sd * size, self.step)
            nodes.append(np.logaddexp(narrow + math.log1p(-share), wide + math.log(share)).sum(axis=1))
        return _log_mean_over_nodes(nodes)


@dataclass(frozen=True, eq=False)
class LostReadingLikelihood:
    """Likelihood with lost readings, independent of the target.

    Lost readings are `black`, exactly or within the noise, or anything between `low` and `high`. `sd` and `step` are
    those of the declared noise, here and in the likelihoods below.
    """

    sd: float
    step: float
    black: float
    low: float
    high: float

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        kept = _log_density_per_reading(readings, predicted, self.sd, self.step)
        to_black = _log_density_per_reading(readings, np.array([[self.black]]), self.sd, self.step)
        exactly = _log_density_per_reading(readings, np.array([[self.black]]), self.sd * _EXACT, self.step)
        low, high = min(self.low - _REACH * self.sd, 0.0), self.high + _REACH * self.sd
        within = (readings >= low) & (readings <= high)
        anywhere = np.where(within, math.log((self.step or 1.0) / (high - low)), -np.inf)
        lost = logsumexp(np.broadcast_arrays(exactly, to_black, anywhere), axis=0) - math.log(3.0)
        return _log_mean_over_nodes(
            [np.logaddexp(kept + math.log1p(-share), lost + math.log(share)).sum(axis=1) for share in _SHARES.tolist()]
        )


@dataclass(frozen=True, eq=False)
class CorrelatedLikelihood:
    """Likelihood with AR(1) noise, marginalised over the correlation."""

    sd: float
    step: float

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        before = np.zeros_like(predicted)
        before[:, 1:] = (readings - predicted)[:, :-1]
        first = _log_density_per_reading(readings[:1], predicted[:, :1], self.sd, self.step)[:, 0]
        nodes = []
        for rho in CorrelatedNoise().prior.from_unit_cube(_NODES)[:, 0].tolist():
            sd = self.sd * math.sqrt(1.0 - rho**2)
            later = _log_density_per_reading(readings[1:], predicted[:, 1:] + rho * before[:, 1:], sd, self.step)
            nodes.append(first + later.sum(axis=1))
        return _log_mean_over_nodes(nodes)


@dataclass(frozen=True, eq=False)
class SignalDependentLikelihood:
    """Likelihood with noise that grows with the signal, marginalised over the growth of its variance.

    The signal runs from 0 at `dark` to 1 at `bright`.
    """

    sd: float
    step: float
    dark: float
    bright: float

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        seen = np.clip((predicted - self.dark) / (self.bright - self.dark), 0.0, 1.0)
        return _log_mean_over_nodes(
            [
                _log_density_per_reading(readings, predicted, self.sd * np.sqrt(1.0 + ratio * seen), self.step).sum(
                    axis=1
                )
                for ratio in SignalDependentNoise().prior.from_unit_cube(_NODES)[:, 0].tolist()
            ]
        )


@dataclass(frozen=True, eq=False)
class FlickerLikelihood:
    """Likelihood under a lamp that flickers faster than the readings: each reading has a random phase.

    `amplitudes` are equally weighted nodes. A sine of uniform phase is approximated by a mixture over a few phases.
    """

    sd: float
    step: float
    amplitudes: tuple[float, ...]

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        sines = np.cos((np.arange(_PHASES) + 0.5) / _PHASES * np.pi)
        nodes = []
        for amplitude in self.amplitudes:
            sd = math.hypot(self.sd, _PER_PHASE * amplitude)
            phases = [
                _quick_log_density_per_reading(readings, predicted + amplitude * sine, sd, self.step)
                for sine in sines.tolist()
            ]
            nodes.append(_log_mean_over_nodes(phases).sum(axis=1))
        return _log_mean_over_nodes(nodes)


@dataclass(frozen=True, eq=False)
class LatticeLikelihood:
    """Likelihood with coarser rounding than declared; if the readings show none, that of the declared noise.

    A lattice is the set of multiples of the coarser step. Three different values or more determine it. If the declared
    noise is not rounded, two values that recur determine it too. One value that recurs shows that there is a lattice;
    its step is then marginalised over.
    """

    sd: float
    step: float

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        least = max(_COARSE * self.sd, 1.5 * self.step)
        steps, n_free = self._lattice_steps_and_n_free(readings)
        nodes = [
            self._log_prob_if_rounded_to(coarse, n_free, readings, predicted) for coarse in steps if coarse > least
        ]
        if not nodes:
            return np.asarray(_log_density_per_reading(readings, predicted, self.sd, self.step).sum(axis=1))
        return _log_mean_over_nodes(nodes)

    def _lattice_steps_and_n_free(self, readings: FloatArray) -> tuple[list[float], int]:
        """Return possible steps of a lattice, equally weighted, and how many readings determine it."""
        values = np.unique(readings)
        recur = not self.step and len(values) < len(readings)
        if recur and len(values) == 1:
            return [times * self.sd for times in _STEPS], 1
        if recur and len(values) == 2:
            return [float(values[1] - values[0])], _FREE
        return [lattice_step(readings)], _FREE

    def _log_prob_if_rounded_to(
        self, coarse: float, n_free: int, readings: FloatArray, predicted: FloatArray
    ) -> FloatArray:
        """Return the log likelihood under rounding to `coarse`, (n_samples,)."""
        fine = self.step or _EXACT * self.sd
        surprise = (len(readings) - n_free) * math.log(coarse / fine)
        density = _log_density_per_reading(readings, predicted, self.sd, coarse) - math.log(coarse)
        return np.asarray(density.sum(axis=1) + surprise + (len(readings) * math.log(self.step) if self.step else 0.0))


NoiseLikelihood = (
    OutlierLikelihood
    | LostReadingLikelihood
    | CorrelatedLikelihood
    | SignalDependentLikelihood
    | FlickerLikelihood
    | LatticeLikelihood
)


def noise_likelihoods(sd: float, step: float, ends: tuple[float, float]) -> dict[str, NoiseLikelihood]:
    """Return the noise models by their names in the vocabulary.

    Parameters
    ----------
    sd, step
        Sd and rounding step of the declared noise; step 0: not rounded.
    ends
        Readings over black and over white.
    """
    dark, bright = ends
    low, high = sorted(ends)
    shares, sizes = Outliers().bank()[:, 0].T
    amplitudes = HeavyTailedPrior(0.01 * (high - low), positive=True).from_unit((np.arange(6) + 0.5) / 6)
    return {
        "outliers": OutlierLikelihood(sd, step, shares, sizes),
        "dropouts": LostReadingLikelihood(sd, step, dark, low, high),
        "correlated_noise": CorrelatedLikelihood(sd, step),
        "signal_dependent_noise": SignalDependentLikelihood(sd, step, dark, bright),
        "flicker": FlickerLikelihood(sd, step, tuple(amplitudes.tolist())),
        "quantisation": LatticeLikelihood(sd, step),
    }


def _log_density_per_reading(
    readings: FloatArray, predicted: FloatArray, sd: float | FloatArray, step: float
) -> FloatArray:
    """Return the log density of each reading, or log probability of its cell, (n_samples, n_points)."""
    if not step:
        return log_gaussian_density(readings, predicted, sd)
    noise = NoiseParameters(np.atleast_2d(np.asarray(sd)), np.zeros((1, 1)), step=np.array([[step]]))
    return np.asarray(log_density(noise, readings, predicted) + math.log(step))


def _quick_log_density_per_reading(readings: FloatArray, predicted: FloatArray, sd: float, step: float) -> FloatArray:
    """Return the same as `_log_density_per_reading`, faster if the noise is wider than the cell.

    Then the density at the middle of the cell is used, with the variance of a uniform cell added.
    """
    if sd < step:
        return _log_density_per_reading(readings, predicted, sd, step)
    wide = math.hypot(sd, step / math.sqrt(12.0))
    return log_gaussian_density(readings, predicted, wide) + (math.log(step) if step else 0.0)
