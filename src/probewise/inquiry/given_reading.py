"""Posterior weights given each possible value of a reading, for many designs at once."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray
from probewise.inquiry.forecast import MOST_LEVELS, evenly_spaced_levels, nearest_level_index, weight_by_level
from probewise.inquiry.readout import Readout, entropy_bits

_PER_SD = 2.0  # levels of the predicted reading per noise sd
_LEAST = 1e-12


class WeightsGivenReading:
    """Weights of hypotheses times the probability of each cell of a reading, and sums over hypotheses.

    A cell is a range of readings recorded as one. Hypotheses with nearly equal predictions are summed first, so that
    the noise is applied to some hundred levels instead of every hypothesis.

    Parameters
    ----------
    answers
        Predicted readings, (n, n_designs).
    weight
        Weights of the hypotheses, (n,).
    readout
        The cells of a reading and its noise.
    fine
        Width of a cell in noise sds, if readings are not rounded.
    repeats
        Number of readings at each design, of which the mean counts.
    """

    def __init__(
        self, answers: FloatArray, weight: FloatArray, readout: Readout, *, fine: float = 1.0, repeats: int = 1
    ) -> None:
        sd = readout.noise_sd / math.sqrt(repeats)
        levels = evenly_spaced_levels(float(answers.min()), float(answers.max()), sd / _PER_SD, most=MOST_LEVELS)
        self._index = nearest_level_index(answers, levels)
        self._weight = weight
        self._chance = readout.cell_probability(levels, repeats=repeats, fine=fine, most=MOST_LEVELS)

    @cached_property
    def weight_by_cell(self) -> FloatArray:
        """Total weight in each cell, (n_designs, n_cells); never 0."""
        return np.maximum(self._weight_by_level @ self._chance, _LEAST)

    @cached_property
    def information_bits(self) -> FloatArray:
        """Expected information about the hypotheses, whose weights sum to one, in bits, (n_designs,)."""
        of_noise = self._weight_by_level @ entropy_bits(self._chance)
        return np.asarray(np.maximum(entropy_bits(self.weight_by_cell) - of_noise, 0.0))

    @cached_property
    def _weight_by_level(self) -> FloatArray:
        """Total weight of the hypotheses at each level, (n_designs, n_levels)."""
        return weight_by_level(self._index, self._weight, len(self._chance))

    def weighted_sum_by_cell(self, values: FloatArray) -> FloatArray:
        """Sum over hypotheses of weight times value times cell probability: values (n,) -> (n_designs, n_cells)."""
        return np.asarray(weight_by_level(self._index, self._weight * values, len(self._chance)) @ self._chance)

    def weight_by_hypothesis_and_cell(self, design: int) -> FloatArray:
        """Return weight times probability of each cell for each hypothesis at one design, (n, n_cells)."""
        return np.asarray(self._weight[:, None] * self._chance[self._index[:, design]])
