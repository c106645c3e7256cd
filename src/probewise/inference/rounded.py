"""Likelihood of readings that the sensor rounds to steps and clips to its scale."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.special import log_ndtr

from probewise._arrays import BoolArray, FloatArray, floats
from probewise._kinds import checked_number
from probewise.effects.noise_distribution import log_gaussian_mass_between
from probewise.errors import require
from probewise.inference.likelihoods import residuals

_FAR = 200.0  # sds from the prediction that the table covers
_PER_SD = 50.0  # table entries per sd: linear interpolation errs by less than 1e-4


@dataclass(frozen=True)
class ScaleEnds:
    """Outermost readings of a scale: each covers everything beyond the inner edge of its rounding cell.

    `low` and `high` are the readings, `lowest_cell` and `highest_cell` the centres of their cells, `step` the cells'
    width.
    """

    low: float
    high: float
    lowest_cell: float
    highest_cell: float
    step: float

    @classmethod
    def from_range(cls, low: float, high: float, step: float, *, whole_steps: bool = True) -> Self:
        """Return the ends of a scale from `low` to `high`, rounded to multiples of `step` if `whole_steps`."""
        lowest, highest = (
            round(end / step) * step if whole_steps and math.isfinite(end) else end for end in (low, high)
        )
        return cls(max(lowest, low), min(highest, high), lowest, highest, step)

    def lowest_reading_mask(self, readings: FloatArray) -> BoolArray:
        """Return a mask of the readings that are the lowest possible one."""
        return np.asarray(readings <= self.low + self._tolerance)

    def highest_reading_mask(self, readings: FloatArray) -> BoolArray:
        """Return a mask of the readings that are the highest possible one."""
        return np.asarray(readings >= self.high - self._tolerance)

    def end_mask(self, readings: FloatArray) -> BoolArray:
        """Return a mask of the readings that are the lowest or the highest possible one."""
        return self.lowest_reading_mask(readings) | self.highest_reading_mask(readings)

    def log_prob_at_ends(self, readings: FloatArray, predicted: FloatArray, sd: float | FloatArray) -> FloatArray:
        """Return the log probability of readings, all at an end, (n_points,), given predictions, (n_samples, n_points).

        `sd`: of the noise, a number or one per reading.
        """
        inward = np.where(
            self.highest_reading_mask(readings), predicted - self.highest_cell, self.lowest_cell - predicted
        )
        return np.asarray(log_ndtr((inward + 0.5 * self.step) / sd))

    @property
    def _tolerance(self) -> float:
        return 1e-9 * self.step  # a multiple of a step such as 0.1 is not exact


@dataclass(frozen=True)
class Rounded:
    """Likelihood of rounded readings: Gaussian noise of known sd, then clipping to the scale and rounding within it.

    It is the probability of a reading's rounding cell. Where the noise is not much wider than a step, a density at the
    rounded reading would overstate its information.

    Parameters
    ----------
    sd
        Sd of the noise before rounding, in units of the reading; above 0, else ParameterError.
    step
        Width of a reading's cell, above 0; readings are whole multiples of it, or an end of the scale that rounds to
        one beyond.
    low, high
        Ends of the scale, low < high. The outermost reading that each allows covers everything beyond.
    whole_steps
        Whether readings lie on multiples of `step`; if not, the ends of the scale are not rounded to such multiples.
    """

    sd: float
    step: float = 1.0
    low: float = -math.inf
    high: float = math.inf
    whole_steps: bool = True

    def __post_init__(self) -> None:
        for name in ("sd", "step", "low", "high"):
            checked_number(name, getattr(self, name))
        for name in ("sd", "step"):
            require(0 < getattr(self, name) < math.inf, name, getattr(self, name), "greater than 0, finite")
        require(self.low < self.high, "(low, high)", (self.low, self.high), "low < high")

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log probability of readings, (n_points,), by predictions (n_samples, n_points): (n_samples,)."""
        readings, predicted = floats(readings, "readings"), floats(predicted, "predicted")
        away = np.abs(residuals(readings, predicted)) / self.sd
        at_end = self.ends.end_mask(readings)
        if at_end.any():
            within = self.log_cell_probability(away[:, ~at_end]).sum(axis=1)
            beyond = self.ends.log_prob_at_ends(readings[at_end], predicted[:, at_end], self.sd)
            return np.asarray(within + beyond.sum(axis=1))
        return np.asarray(self.log_cell_probability(away).sum(axis=1))

    @cached_property
    def ends(self) -> ScaleEnds:
        """The outermost readings of the scale."""
        return ScaleEnds.from_range(self.low, self.high, self.step, whole_steps=self.whole_steps)

    def log_cell_probability(self, away: FloatArray) -> FloatArray:
        """Return the log probability of readings' cells from their distances to the prediction in sds, by a table."""
        position = np.minimum(away, _FAR - 1.0) * _PER_SD
        entry = position.astype(np.int64)
        below = self._log_cell_probability_table[entry]
        out = below + (position - entry) * (self._log_cell_probability_table[entry + 1] - below)
        far = away > _FAR - 1.0
        if far.any():
            out[far] = self._exact_log_cell_probability(away[far])
        return np.asarray(out)

    @cached_property
    def _log_cell_probability_table(self) -> FloatArray:
        return self._exact_log_cell_probability(np.arange(0.0, _FAR + 1.0 / _PER_SD, 1.0 / _PER_SD))

    def _exact_log_cell_probability(self, away: FloatArray) -> FloatArray:
        half = 0.5 * self.step / self.sd
        return log_gaussian_mass_between(-half - away, half - away)
