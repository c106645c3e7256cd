"""A lower bound on the number of readings: the bits needed over the capacity of one reading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.inquiry.forecast import evenly_spaced_levels
from probewise.inquiry.readout import Readout, entropy_bits

_PER_SD = 4.0
_MOST_ROUNDS = 2000
_CLOSE_BITS = 1e-4


@dataclass(frozen=True)
class Bound:
    """Lower bound on the mean number of readings, for search and refinement separately.

    Attributes
    ----------
    search_bits, refinement_bits
        Bits needed until the first reading on the shape, and from there to the target.
    search_capacity_bits, capacity_bits
        Capacity of one reading: before the shape is found, that of a yes or no with the largest possible probability of
        yes; afterwards, that of the sensor.
    """

    search_bits: float
    refinement_bits: float
    search_capacity_bits: float
    capacity_bits: float

    @property
    def readings_of_search(self) -> float:
        """Number of readings until the shape is found."""
        return self.search_bits / self.search_capacity_bits

    @property
    def readings_of_refinement(self) -> float:
        """Number of readings from there until the target precision."""
        return self.refinement_bits / self.capacity_bits

    @property
    def readings(self) -> float:
        """Total number of readings."""
        return self.readings_of_search + self.readings_of_refinement


def fewest_readings(
    prior_bits: float, met_bits: float, target_bits: float, *, most_covered: float, capacity: float
) -> Bound:
    """Bound the mean number of readings of any strategy.

    Parameters
    ----------
    prior_bits, met_bits, target_bits
        Differential entropy of the parameters: under the prior, at the first reading on the shape (on average), and at
        the target (`target_entropy`), in descending order; else ParameterError.
    most_covered
        Probability that the best first place lies on the shape, above 0 and below 1, else ParameterError. A search
        reading answers yes or no, with at most this probability of yes as long as no better place arises.
    capacity
        Capacity of the sensor, bits per reading (`capacity_bits`).
    """
    if not 0 < most_covered < 1:
        raise ParameterError("most_covered", most_covered, "greater than 0, less than 1")
    if not prior_bits >= met_bits >= target_bits:
        raise ParameterError(
            "(prior_bits, met_bits, target_bits)", (prior_bits, met_bits, target_bits), "in descending order"
        )
    yes = min(most_covered, 0.5)
    chance = np.array([yes, 1.0 - yes])
    return Bound(prior_bits - met_bits, met_bits - target_bits, float(entropy_bits(chance)), capacity)


def target_entropy(n_params: int, sd: float) -> float:
    """Return the largest differential entropy in bits of parameters with a given sd: that of independent Gaussians."""
    return n_params * 0.5 * math.log2(2 * math.pi * math.e * sd**2)


def capacity_bits(low: float, high: float, readout: Readout) -> float:
    """Return the capacity of the sensor in bits per reading, for levels from `low` to `high`, in this order.

    The capacity-achieving distribution of levels is found by the Blahut-Arimoto iteration (1972), until the bounds are
    within 1e-4 bits. ParameterError unless `low` is below `high`.
    """
    if not low < high:
        raise ParameterError("(low, high)", (low, high), "low < high")
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
