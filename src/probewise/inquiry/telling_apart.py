"""Expected information of readings on which of several models is true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, frozen
from probewise.errors import ParameterError, ShapeError
from probewise.inquiry.forecast import (
    MOST_LEVELS,
    evenly_spaced_levels,
    nearest_level_index,
    predict_where_visible,
    weight_by_level,
)
from probewise.inquiry.readout import Readout, entropy_bits
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SensorModel

_PER_SD = 8.0  # levels per noise sd
_BLOCK = 512


@dataclass(frozen=True, eq=False)
class Rival:
    """One of several competing models: posterior samples and probability.

    `theta` has shape (n_samples, n_params), equally weighted; `probability` need not be normalised.
    """

    model: SensorModel
    theta: FloatArray
    probability: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", frozen(self.theta))
        if self.theta.ndim != 2 or len(self.theta) == 0:
            raise ShapeError(f"theta has shape {self.theta.shape}; allowed: (n_samples, n_params), one sample or more")
        if not 0 <= self.probability < np.inf:
            raise ParameterError("probability", self.probability, "finite, 0 or more")


def information_about_rivals(rivals: Sequence[Rival], plan: Plan, readout: Readout) -> FloatArray:
    """Return the expected information in bits of each reading of a plan on which rival is true.

    It is the Jensen-Shannon divergence of the rivals' predictive distributions, marginalised over their parameters: the
    entropy of the reading minus its mean entropy given the rival. It is at most the entropy of the rivals'
    probabilities.

    Parameters
    ----------
    rivals
        Two models or more, of any parameters.
    plan
        Possible readings, n_points rows, each by itself.
    readout
        Noise, rounding and range of a reading.

    Returns
    -------
    Bits, (n_points,).
    """
    total = sum(rival.probability for rival in rivals)
    if len(rivals) < 2 or not total > 0:
        raise ParameterError(
            "rivals", [rival.probability for rival in rivals], "two models or more, one of them above 0"
        )
    answers = [predict_where_visible(rival.model, rival.theta, plan) for rival in rivals]
    low, high = min(a.min() for a in answers), max(a.max() for a in answers)
    levels = evenly_spaced_levels(float(low), float(high), readout.noise_sd / _PER_SD, most=MOST_LEVELS)
    chance = readout.probability(levels, most=MOST_LEVELS)
    bits = np.zeros(len(plan))
    for start in range(0, len(plan), _BLOCK):
        block = slice(start, start + _BLOCK)
        mixed = np.zeros((len(bits[block]), chance.shape[1]))
        for rival, answer in zip(rivals, answers, strict=True):
            even = np.full(len(answer), 1.0 / len(answer))
            own = weight_by_level(nearest_level_index(answer[:, block], levels), even, len(levels)) @ chance
            share = rival.probability / total
            mixed += share * own
            bits[block] -= share * entropy_bits(own)
        bits[block] += entropy_bits(mixed)
    return np.maximum(bits, 0.0)
