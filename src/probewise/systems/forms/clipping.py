"""Levels at which a quantity may be clipped: a ceiling in the upper part of its range, a floor in the lower."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.priors import Uniform

_LOWER_PART = 0.4  # of a range: a ceiling may cut off more of it than a floor
_LEAST = 0.003  # of a range, that is cut off at least by what is looked for
_N_LEVELS = 10  # of either


@dataclass(frozen=True, eq=False)
class ClippingLevels:
    """Clipping levels between `low` and `high`: a ceiling above `least_ceiling`, otherwise a floor."""

    low: float
    high: float

    @property
    def least_ceiling(self) -> float:
        """Level at 40 % of the range: a clipping level above it is a ceiling, otherwise a floor."""
        return self.low + _LOWER_PART * (self.high - self.low)

    @property
    def trial_levels(self) -> FloatArray:
        """Trial levels for the template bank, (n_levels,): ceilings, then floors, densest at the ends of the range."""
        range_ = self.high - self.low
        ceilings = self.high - range_ * np.geomspace(_LEAST, 0.97 * (1 - _LOWER_PART), _N_LEVELS)
        return np.append(ceilings, self.low + range_ * np.geomspace(_LEAST, 0.97 * _LOWER_PART, _N_LEVELS))

    @property
    def prior(self) -> Uniform:
        """Uniform prior of the level, from `low` to `high`."""
        return Uniform(self.low, self.high)

    @property
    def level_out_of_reach(self) -> float:
        """A level far above the range: a ceiling without effect."""
        return self.high + (self.high - self.low)


def clipping_levels(low: float, high: float) -> ClippingLevels | None:
    """Return the clipping levels within a range of values; None if it is empty."""
    return ClippingLevels(low, high) if low < high else None
