"""Likelihood of readings that the sensor rounds to steps and clips to its scale."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr

from probewise._arrays import FloatArray, floats
from probewise._kinds import checked_number
from probewise.effects.density import log_mass_between
from probewise.errors import ParameterError
from probewise.inference._residuals import residuals

_FAR = 200.0  # sds from the prediction that the table covers
_PER_SD = 50.0  # table entries per sd: linear interpolation errs by less than 1e-4


@dataclass(frozen=True)
class Rounded:
    """Likelihood of rounded readings: Gaussian noise of known sd, then clipping to the scale and rounding within it.

    It is the probability of a reading's rounding cell. Where the noise is not much wider than a step, a density at the
    rounded reading would overstate its information.

    Parameters
    ----------
    sd
        Sd of the noise before rounding, in units of the reading.
    step
        Rounding step: readings are whole multiples of it, or an end of the scale that rounds to one beyond.
    low, high
        Ends of the scale. The outermost reading that each allows covers everything beyond.
    whole_steps
        Whether readings are rounded; if not, `step` is only the width of a reading's cell.
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
            if not 0 < getattr(self, name) < math.inf:
                raise ParameterError(name, getattr(self, name), "greater than 0, finite")
        if not self.low < self.high:
            raise ParameterError("(low, high)", (self.low, self.high), "low < high")

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log probability of the readings, (n_points,), (n_samples, n_points) -> (n_samples,)."""
        readings, predicted = floats(readings, "readings"), floats(predicted, "predicted")
        away = np.abs(residuals(readings, predicted)) / self.sd
        lowest, highest = self._end_cells
        slack = 1e-9 * self.step  # a multiple of a step such as 0.1 is not exact
        at_low, at_high = readings <= max(lowest, self.low) + slack, readings >= min(highest, self.high) - slack
        at_end = at_low | at_high
        if at_end.any():
            within = self._log_cell_probability(away[:, ~at_end]).sum(axis=1)
            inward = np.where(at_high, predicted - highest, lowest - predicted)[:, at_end]
            # Everything beyond the inner edge of the end cell.
            return np.asarray(within + log_ndtr((inward + 0.5 * self.step) / self.sd).sum(axis=1))
        return np.asarray(self._log_cell_probability(away).sum(axis=1))

    @cached_property
    def _end_cells(self) -> tuple[float, float]:
        """Centres of the outermost cells: the multiples of the step to which the ends of the scale are rounded."""
        low, high = (
            round(end / self.step) * self.step if self.whole_steps and math.isfinite(end) else end
            for end in (self.low, self.high)
        )
        return low, high

    def _log_cell_probability(self, away: FloatArray) -> FloatArray:
        """Interpolate the log probability of readings' cells from a table, by distance from the prediction in sds."""
        position = np.minimum(away, _FAR - 1.0) * _PER_SD
        entry = position.astype(np.int64)
        below = self._log_probability_table[entry]
        out = below + (position - entry) * (self._log_probability_table[entry + 1] - below)
        far = away > _FAR - 1.0
        if far.any():
            out[far] = self._exact_log_cell_probability(away[far])
        return np.asarray(out)

    @cached_property
    def _log_probability_table(self) -> FloatArray:
        return self._exact_log_cell_probability(np.arange(0.0, _FAR + 1.0 / _PER_SD, 1.0 / _PER_SD))

    def _exact_log_cell_probability(self, away: FloatArray) -> FloatArray:
        half = 0.5 * self.step / self.sd
        return log_mass_between(-half - away, half - away)
