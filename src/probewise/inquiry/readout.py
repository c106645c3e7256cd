"""Noise, rounding and range of a reading; entropies; the capacity of a sensor in bits per reading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray
from probewise._kinds import checked_number
from probewise.errors import require
from probewise.priors import Prior

MOST_LEVELS = 1000
"""Largest number of levels and of cells of a reading, more than the hypotheses can fill."""

_REACH = 5.0  # noise sds beyond the levels that the cells cover
_FINE = 0.25  # width of a cell in noise sds, for unrounded readings: loses 0.3 % of a nat
_WIDE = 2.0  # steps: of wider noise, a mean hardly depends on the rounding of each reading
_MOST_SUMS = 3000  # values of a sum of readings
_PER_SD = 4.0  # levels per noise sd, for the capacity
_MOST_ROUNDS = 2000
_CLOSE_BITS = 1e-4
_N_OF_PRIOR = 20_000


def evenly_spaced_levels(low: float, high: float, spacing: float, *, most: int | None = None) -> FloatArray:
    """Return evenly spaced levels between two readings, two or more, at most `spacing` apart.

    `most`: largest number of levels, even if they are then further apart.
    """
    low, high = min(low, high), max(low, high)
    n = max(2, int(np.ceil((high - low) / spacing)) + 1)
    return np.linspace(low, max(high, low + spacing), n if most is None else min(n, most))


def nearest_level_index(predicted: FloatArray, levels: FloatArray) -> IntArray:
    """Return the index of the nearest of evenly spaced levels to each prediction, of the same shape."""
    return np.asarray(np.rint((predicted - levels[0]) / (levels[1] - levels[0])).astype(np.int64))


def weight_by_level(index: IntArray, weight: FloatArray, n_levels: int) -> FloatArray:
    """Sum the weights, (n,), of hypotheses that predict each level, index (n, n_designs) -> (n_designs, n_levels)."""
    n_designs = index.shape[1]
    key = index + np.arange(n_designs) * n_levels
    counted = np.bincount(key.ravel(), np.repeat(weight, n_designs), minlength=n_designs * n_levels)
    return np.asarray(counted.reshape(n_designs, n_levels), dtype=np.float64)


@dataclass(frozen=True)
class Readout:
    """Gaussian noise of known sd, then clipping to the range, then rounding to whole steps within it.

    Parameters
    ----------
    noise_sd
        Sd of the Gaussian noise of one reading, in the sensor's unit.
    step
        Rounding step of the readings; None: not rounded.
    low, high
        Smallest and largest possible reading.

    Raises
    ------
    ParameterError
        If `noise_sd` or `step` is not above 0, or `low` not below `high`.
    """

    noise_sd: float
    step: float | None = None
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        for name in ("noise_sd", "low", "high", *["step"] * (self.step is not None)):
            checked_number(name, getattr(self, name))
        require(0 < self.noise_sd < math.inf, "noise_sd", self.noise_sd, "finite, greater than 0")
        require(self.step is None or 0 < self.step < math.inf, "step", self.step, "finite, greater than 0, or None")
        require(self.low < self.high, "(low, high)", (self.low, self.high), "low < high")

    def require_in_range(self, value: float) -> None:
        """Raise ParameterError for a reading out of range; NaN, a missing reading, passes."""
        allowed = f"{self.low:g} to {self.high:g}, the range of the sensor; is it the sensor that was calibrated?"
        require(math.isnan(value) or self.low <= value <= self.high, "reading", value, allowed)

    def cell_edges(self, levels: FloatArray, *, fine: float = _FINE, most: int | None = None) -> FloatArray:
        """Return the edges of the cells for readings of these levels, (n_cells - 1,); the end cells are open.

        A cell is a range of readings recorded as one: a step, or `fine` noise sds for unrounded readings. Above `most`
        cells, neighbours are merged.
        """
        width = fine * self.noise_sd if self.step is None else self.step
        least = max(float(np.min(levels)) - _REACH * self.noise_sd, self.low)
        greatest = min(float(np.max(levels)) + _REACH * self.noise_sd, self.high)
        if most is not None:
            width *= max(1, math.ceil((greatest - least) / (most * width))) | 1  # odd, so that no edge is on a step
        first, last = math.floor(least / width + 0.5), math.ceil(greatest / width - 0.5)
        return np.asarray((np.arange(first, max(last, first + 1)) + 0.5) * width, dtype=np.float64)

    def cell_probability(
        self, levels: FloatArray, *, repeats: int = 1, fine: float = _FINE, most: int | None = None
    ) -> FloatArray:
        """Return the probability of each cell given each level, (n_levels,) -> (n_levels, n_cells); see `cell_edges`.

        For `repeats` readings it is that of their sum, each rounded by itself. If the noise is wider than two steps,
        where rounding hardly matters, or a sum has too many values, it is that of their mean, with cells scaled to the
        mean's smaller noise.
        """
        if repeats > 1 and self.step is not None and self.noise_sd < _WIDE * self.step:
            n_sums = repeats * len(self.cell_edges(levels)) + 1
            if n_sums <= _MOST_SUMS:
                from scipy.fft import irfft, next_fast_len, rfft  # slow to import, and few need it

                size = next_fast_len(n_sums, real=True)
                spectrum = rfft(self.cell_probability(levels), size, axis=1)
                of_sum = np.maximum(irfft(spectrum**repeats, size, axis=1)[:, :n_sums], 0.0)
                if most is None or n_sums <= most:
                    return of_sum
                return np.asarray(np.add.reduceat(of_sum, np.arange(0, n_sums, math.ceil(n_sums / most)), axis=1))
        sd = self.noise_sd / math.sqrt(repeats)
        each = self if repeats == 1 else Readout(sd, self.step and self.step / repeats, self.low, self.high)
        below = ndtr((each.cell_edges(levels, fine=fine, most=most) - levels[:, None]) / sd)
        ends = np.zeros((len(levels), 1)), np.ones((len(levels), 1))
        return np.diff(np.concatenate([ends[0], below, ends[1]], axis=1), axis=1)


def entropy_bits(probability: FloatArray) -> FloatArray:
    """Return the Shannon entropy in bits along the last axis; zero probabilities contribute 0."""
    log = np.log2(np.maximum(probability, np.float32(1e-30)))
    log *= probability
    return np.asarray(-log.sum(axis=-1))


def bits_gained(information: float, log_prior: FloatArray, weight: FloatArray, prior_entropy_bits: float) -> float:
    """Convert nested sampling's information to prior minus posterior differential entropy.

    With p the prior and P the posterior, h(P) = -H - E_P[ln p], so h(p) - h(P) = H + E_P[ln p] + h(p). For a uniform
    prior the last two cancel and the bits are H / ln 2. `information` is H, the relative entropy of posterior to prior,
    nats; `log_prior` the natural log of the prior density of posterior samples, and `weight` their weights, summing to
    one, (n_samples,) each.
    """
    return (information + float(weight @ log_prior)) / math.log(2) + prior_entropy_bits


def prior_entropy(prior: Prior, *, rng: np.random.Generator) -> float:
    """Return the differential entropy of a prior in bits: minus the mean log2 density of 20,000 draws."""
    theta = prior.from_unit_cube(rng.random((_N_OF_PRIOR, len(prior.names))))
    return -float(np.mean(prior.log_prob(theta))) / math.log(2)


def capacity_bits(low: float, high: float, readout: Readout) -> float:
    """Return the capacity of the sensor in bits per reading, for levels from `low` to `high`, in this order.

    The capacity-achieving distribution of levels is found by the Blahut-Arimoto iteration (1972), until the bounds are
    within 1e-4 bits. ParameterError unless `low` is below `high`.
    """
    require(low < high, "(low, high)", (low, high), "low < high")
    levels = evenly_spaced_levels(low, high, readout.noise_sd / _PER_SD)
    chance = readout.cell_probability(levels)
    given = -entropy_bits(chance)
    share: FloatArray = np.full(len(levels), 1.0 / len(levels))
    lower = 0.0
    for _ in range(_MOST_ROUNDS):
        surprise = -np.log2(np.maximum(share @ chance, 1e-300))
        divergence = given + chance @ surprise
        lower, upper = float(share @ divergence), float(divergence.max())
        if upper - lower < _CLOSE_BITS:
            break
        share = share * np.exp2(divergence - divergence.max())
        share /= share.sum()
    return lower
