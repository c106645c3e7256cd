"""Alternatives to the declared noise model, as rivals that predict the same noise-free readings.

A law of the noise is a function of readings, (n_points,), and predictions, (n_samples, n_points), that returns log
likelihoods, (n_samples,), marginalised over equally weighted nodes of its prior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray, logsumexp
from probewise.effects import HeavyTailedPrior
from probewise.effects.noise import SD_FACTORS, correlated_noise, lattice_step, outliers, signal_dependent_noise
from probewise.effects.noise_distribution import log_gaussian_density, log_rounding_cell_density
from probewise.inference import GaussianKnown, Rounded
from probewise.inference.problem import Likelihood
from probewise.inference.rounded import ScaleEnds
from probewise.priors import LogUniform

_REACH = 5.0  # noise sds beyond its range that a sensor may read
_SHARES = LogUniform(2e-3, 0.2).from_unit((np.arange(8) + 0.5) / 8)
_NODES = (np.arange(6)[:, None] + 0.5) / 6  # of a prior of one parameter
_EXACT = 1e-3  # of the noise sd: within which a value counts as the same, lost to black or rounded
_PHASES = 7
_PER_PHASE = 0.16  # of the amplitude: width of each phase's component, about the spacing of neighbouring phases
_COARSE = 0.3  # noise sds from which rounding of the readings matters
_STEPS = (1.0, 2.0, 4.0, 8.0)  # noise sds: possible steps of a lattice of which one value has been seen
_SMOOTH = 4.0  # steps: of wider noise, the density in a cell is that at its middle, to .1 nats at 25 sds
_LEAST = -1e300  # log of a probability of zero, for differences
_FREE = 2  # readings that determine the lattice


@dataclass(frozen=True)
class DeclaredNoise:
    """Gaussian noise of sd `sd`, clipped to a scale and rounded to `step` within it (0: not rounded).

    If not `whole_steps`, readings are not rounded, and `step` is only the width of a reading's cell.

    Methods return the log density of each reading, (n_samples, n_points); for rounded readings, the log probability of
    the rounding cell, and for a reading at an end of the scale, the log probability of all values beyond.
    """

    sd: float
    step: float = 0.0
    ends: ScaleEnds | None = None
    whole_steps: bool = True

    @classmethod
    def from_likelihood(cls, likelihood: Likelihood) -> Self | None:
        """Return the noise of a likelihood with one known sd; None for any other."""
        if isinstance(likelihood, Rounded):
            return cls(likelihood.sd, likelihood.step, likelihood.ends, likelihood.whole_steps)
        if isinstance(likelihood, GaussianKnown) and np.ndim(likelihood.sd) == 0:
            return cls(float(np.asarray(likelihood.sd)))
        return None

    def inside_scale_mask(self, readings: FloatArray) -> BoolArray:
        """Return which readings, (n_points,), lie between the ends of the scale."""
        return np.ones(len(readings), dtype=np.bool_) if self.ends is None else ~self.ends.end_mask(readings)

    def log_density(
        self,
        readings: FloatArray,
        predicted: FloatArray,
        *,
        sd: float | FloatArray | None = None,
        step: float | None = None,
    ) -> FloatArray:
        """Return the log density of readings, (n_points,), given predictions, (n_samples, n_points).

        Another `sd` or `step` than the declared one may be given; `sd` broadcasts to the predictions.
        """
        sd, step = self.sd if sd is None else sd, self.step if step is None else step
        if step == 0:
            within = log_gaussian_density(readings, predicted, sd)
        elif np.min(sd) >= _SMOOTH * step:  # the density at the cell's middle, of the noise and a uniform cell
            within = log_gaussian_density(readings, predicted, np.hypot(sd, step / math.sqrt(12.0))) + math.log(step)
        elif np.ndim(sd) == 0:
            within = _rounded(float(sd), step).log_cell_probability(np.abs(readings - predicted) / sd)
        else:
            within = log_rounding_cell_density(readings, predicted, np.asarray(sd), step) + math.log(step)
        inside = self.inside_scale_mask(readings)
        if self.ends is None or inside.all():
            return within
        return np.where(inside, within, self.ends.log_prob_at_ends(readings, predicted, sd))

    def log_uniform_density(self, readings: FloatArray, low: float, high: float) -> FloatArray:
        """Return the log density, (n_points,), of readings that are uniform from `low` to `high`; -inf outside."""
        width, ends = np.full(len(readings), self.step or 1.0), self.ends
        if ends is not None:
            width = np.where(ends.lowest_reading_mask(readings), ends.lowest_cell + 0.5 * self.step - low, width)
            width = np.where(ends.highest_reading_mask(readings), high - ends.highest_cell + 0.5 * self.step, width)
        possible = (readings >= low) & (readings <= high) & (width > 0)
        return np.log(np.where(possible, width, 1.0) / (high - low)) + np.where(possible, 0.0, -np.inf)


@lru_cache(maxsize=64)  # a sensor has some thirty
def _rounded(sd: float, step: float) -> Rounded:
    return Rounded(sd, step)  # keeps its table


@dataclass(frozen=True, eq=False)
class NoiseLikelihood:
    """A law of the noise as a likelihood."""

    law: Callable[[FloatArray, FloatArray], FloatArray]

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return log likelihoods of readings, (n_points,), given predictions, (n_samples, n_points) -> (n_samples,)."""
        return self.law(readings, predicted)


def noise_likelihoods(noise: DeclaredNoise, levels: tuple[float, float]) -> dict[str, NoiseLikelihood]:
    """Return the noise models, {name of the effect in the vocabulary: likelihood}; `levels` are black and white."""
    amplitude = HeavyTailedPrior(0.01 * abs(levels[1] - levels[0]), positive=True)
    laws: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
        "noise_sd": partial(_changed_sd, noise),
        "outliers": partial(_outliers, noise, outliers().entries[:, 0]),
        "dropouts": partial(_lost_readings, noise, levels),
        "correlated_noise": partial(_correlated, noise),
        "signal_dependent_noise": partial(_signal_dependent, noise, levels),
        "flicker": partial(_flicker, noise, amplitude.from_unit(_NODES[:, 0]).tolist()),
        "quantisation": partial(_coarser_rounding, noise),
    }
    return {name: NoiseLikelihood(law) for name, law in laws.items()}


def _changed_sd(noise: DeclaredNoise, readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Another sd of the noise than at the calibration; a node is the factor."""
    sds = (noise.sd * SD_FACTORS.from_unit((np.arange(12) + 0.5) / 12)).tolist()
    return _log_mean_over_nodes([noise.log_density(readings, predicted, sd=sd).sum(axis=1) for sd in sds])


def _outliers(
    noise: DeclaredNoise, shares_and_sizes: FloatArray, readings: FloatArray, predicted: FloatArray
) -> FloatArray:
    """Outliers; a node is their share and their size, sds over the noise's sd, (n_nodes, 2)."""
    narrow, nodes = noise.log_density(readings, predicted), []
    for size in np.unique(shares_and_sizes[:, 1]):
        wide = noise.log_density(readings, predicted, sd=noise.sd * size)
        nodes += _log_mixtures(narrow, wide, shares_and_sizes[shares_and_sizes[:, 1] == size, 0])
    return _log_mean_over_nodes(nodes)


def _log_mixtures(usual: FloatArray, rare: FloatArray, shares: FloatArray) -> list[FloatArray]:
    """Return log likelihoods, (n_samples,), for each share of rare readings, from log densities of both kinds."""
    most = np.maximum(np.maximum(usual, rare), _LEAST)
    usual, rare, whole = np.exp(usual - most), np.exp(rare - most), most.sum(axis=1)
    return [whole + np.log((1.0 - share) * usual + share * rare).sum(axis=1) for share in shares.tolist()]


def _lost_readings(
    noise: DeclaredNoise, levels: tuple[float, float], readings: FloatArray, predicted: FloatArray
) -> FloatArray:
    """Lost readings, independent of the target; a node is their share.

    A lost reading is, with equal probability, exactly black, black with noise, or uniform over the sensor's range and
    some sds beyond.
    """
    black = np.array([[levels[0]]])
    kept = noise.log_density(readings, predicted)
    to_black = noise.log_density(readings, black)
    exactly = noise.log_density(readings, black, sd=noise.sd * _EXACT)
    low, high = min(min(levels) - _REACH * noise.sd, 0.0), max(levels) + _REACH * noise.sd
    anywhere = noise.log_uniform_density(readings, low, high)
    lost = logsumexp(np.broadcast_arrays(exactly, to_black, anywhere), axis=0) - math.log(3.0)
    return _log_mean_over_nodes(_log_mixtures(kept, lost, _SHARES))


def _correlated(noise: DeclaredNoise, readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """AR(1) noise from reading to reading; a node is the correlation."""
    before = np.zeros_like(predicted)
    before[:, 1:] = (readings - predicted)[:, :-1]
    first = noise.log_density(readings[:1], predicted[:, :1])[:, 0]
    nodes = []
    for rho in correlated_noise().prior.from_unit_cube(_NODES)[:, 0].tolist():
        sd = noise.sd * math.sqrt(1.0 - rho**2)
        later = noise.log_density(readings[1:], predicted[:, 1:] + rho * before[:, 1:], sd=sd)
        nodes.append(first + later.sum(axis=1))
    return _log_mean_over_nodes(nodes)


def _signal_dependent(
    noise: DeclaredNoise, levels: tuple[float, float], readings: FloatArray, predicted: FloatArray
) -> FloatArray:
    """Noise that grows with the signal, 0 over black and 1 over white; a node is the growth of its variance."""
    seen = np.clip((predicted - levels[0]) / (levels[1] - levels[0]), 0.0, 1.0)
    sds = (noise.sd * np.sqrt(1.0 + k * seen) for k in signal_dependent_noise().prior.from_unit_cube(_NODES)[:, 0])
    return _log_mean_over_nodes([noise.log_density(readings, predicted, sd=sd).sum(axis=1) for sd in sds])


def _flicker(
    noise: DeclaredNoise, amplitudes: Sequence[float], readings: FloatArray, predicted: FloatArray
) -> FloatArray:
    """Flicker of the lamp, faster than the readings, of which each has a random phase; a node is the amplitude.

    A mixture over a few phases stands for the sine.
    """
    sines = np.cos((np.arange(_PHASES) + 0.5) / _PHASES * np.pi).tolist()
    nodes = []
    for amplitude in amplitudes:
        sd = math.hypot(noise.sd, _PER_PHASE * amplitude)
        phases = [noise.log_density(readings, predicted + amplitude * sine, sd=sd) for sine in sines]
        nodes.append(_log_mean_over_nodes(phases).sum(axis=1))
    return _log_mean_over_nodes(nodes)


def _coarser_rounding(noise: DeclaredNoise, readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Coarser rounding than declared; if the readings show none, the declared noise.

    The coarser step is the largest whose lattice holds all readings within the scale, from three different values on.
    If the declared noise is not rounded and values recur, two different values determine the step by their difference;
    with a single value, the step is a node.
    """
    inside = noise.inside_scale_mask(readings)
    if not inside.all():
        at_end = noise.log_density(readings[~inside], predicted[:, ~inside]).sum(axis=1)
        return np.asarray(at_end + _coarser_rounding(noise, readings[inside], predicted[:, inside]))
    values, n_free = np.unique(readings), _FREE  # readings that determine the step are no test of it
    recur = not (noise.whole_steps and noise.step > 0) and len(values) < len(readings)
    if recur and len(values) == 1:
        steps, n_free = [times * noise.sd for times in _STEPS], 1
    else:
        steps = [float(values[1] - values[0]) if recur and len(values) == 2 else lattice_step(readings)]
    nodes = []
    for coarse in steps:
        if coarse > max(_COARSE * noise.sd, 1.5 * noise.step):
            surprise = (len(readings) - n_free) * math.log(coarse / (noise.step or _EXACT * noise.sd))
            density = noise.log_density(readings, predicted, step=coarse) - math.log(coarse)
            of_cells = len(readings) * math.log(noise.step) if noise.step else 0.0
            nodes.append(density.sum(axis=1) + surprise + of_cells)
    return _log_mean_over_nodes(nodes) if nodes else noise.log_density(readings, predicted).sum(axis=1)


def _log_mean_over_nodes(nodes: list[FloatArray]) -> FloatArray:
    """Return the log of the mean of exp over a list of arrays, elementwise; faster than scipy's `logsumexp`."""
    stacked = np.stack(nodes)
    most = np.maximum(stacked.max(axis=0), _LEAST)
    stacked -= most
    np.exp(stacked, out=stacked)
    with np.errstate(divide="ignore"):  # impossible at every node
        return np.asarray(most + np.log(stacked.mean(axis=0)))
