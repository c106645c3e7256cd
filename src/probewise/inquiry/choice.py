"""The choice of the next place, at random among the best reachable ones."""

from __future__ import annotations

import numpy as np

from probewise._arrays import BoolArray, FloatArray, require_finite
from probewise.errors import ReachError, ShapeError

TIE = 1e-9
"""Utilities closer than this count as equal, since they differ by rounding only."""


def best_places_mask(utility: FloatArray, reachable: BoolArray) -> BoolArray:
    """Mark the reachable places within `TIE` (1e-9) of the highest reachable utility; a mask, all arrays (n_places,).

    Raises
    ------
    ReachError
        If no place is reachable.
    ShapeError
        If the arrays differ in shape.
    ParameterError
        If the utility of a reachable place is not finite.
    """
    if utility.shape != reachable.shape or utility.ndim != 1:
        raise ShapeError(f"utility has shape {utility.shape}, reachable {reachable.shape}; allowed: (n_places,) both")
    if not reachable.any():
        raise ReachError("reachable places", 0, f"1 or more of the {reachable.size}; move the arm or the places")
    require_finite("utility", utility[reachable])
    best = reachable & (utility >= utility[reachable].max() - TIE)
    return np.asarray(best)


def choose(utility: FloatArray, reachable: BoolArray, *, rng: np.random.Generator) -> int:
    """Draw the index of the next place at random among the best (paper, the machine learning system).

    It raises as `best_places_mask` does.
    """
    return int(rng.choice(np.flatnonzero(best_places_mask(utility, reachable))))
