"""Levels at which a quantity may be clipped: a ceiling in the upper part of its range, a floor in the lower."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.priors import Uniform

_LOWER_PART = 0.4  # of a range: a ceiling may cut off more of it than a floor
_LEAST = 0.003  # of a range, that is cut off at least by what is looked for
_N_LEVELS = 10  # of either
_WILD_SHARE = 0.001  # of the values, at either end, beside one that may be wild
_WILD = 4.0  # times the range of the other values, from which some are wild


@dataclass(frozen=True, eq=False)
class ClippingLevels:
    """Clipping levels between `low` and `high`: a ceiling above `least_ceiling`, otherwise a floor.

    `top` is the largest value, which may be wild, far above `high`.
    """

    low: float
    high: float
    top: float

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
        """A level far above all values: a ceiling without effect."""
        return self.top + (self.high - self.low)


def clipping_levels(values: FloatArray) -> ClippingLevels | None:
    """Return the clipping levels within the range of some values, NaN aside; None if it is empty.

    A wild value, as 9999 in one cell, is left out: it would move the level that tells a ceiling from a floor.
    """
    ordered = np.sort(values[np.isfinite(values)])
    if not ordered.size or ordered[0] == ordered[-1]:
        return None
    n_wild = 1 + int(_WILD_SHARE * len(ordered))
    inner, others = ordered, ordered[n_wild:-n_wild]
    range_ = np.ptp(others) if others.size else 0.0
    if 0 < _WILD * range_ < np.ptp(ordered):
        inner = ordered[(ordered >= others[0] - range_) & (ordered <= others[-1] + range_)]
    return ClippingLevels(float(inner[0]), float(inner[-1]), float(ordered[-1]))
