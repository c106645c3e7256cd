"""The inquiry engine (paper, section 2.3, "The Machine Learning System", figures 2 and 8).

Fifty hypotheses, drawn from the posterior, predict a noise-free reading at every place of a fine grid (the paper: "a
sample of what measurement could be expected"). The predictions at a place fall into bins as wide as the sensor's step;
with p_j the share of hypotheses in bin j, H = - sum_j p_j log2 p_j is the entropy of the reading. The next place is
drawn at random among the reachable ones where H is largest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray, require_finite
from probewise.errors import ReachError, ShapeError
from probewise.inquiry.forecast import predict_where_visible
from probewise.inquiry.grid import Designs, Grid
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SensorModel

TIE = 1e-9
"""Utilities closer than this count as equal, since they differ by rounding only."""

FLAT = 1e-5
"""Utilities of a map that differ by less count as equal, since they are computed in single precision."""


@dataclass(frozen=True, eq=False)
class UtilityMap:
    """The utility of each design.

    `values` has shape (n_designs,), bits where the utility is an entropy or an information, and 0 where `reachable` is
    False. `label` names the values with their unit.
    """

    designs: Designs
    values: FloatArray
    reachable: BoolArray
    label: str = ""

    @property
    def grid(self) -> Grid:
        """The places."""
        return self.designs.grid

    @property
    def image(self) -> FloatArray:
        """The map as an image, shape (n_y, n_x), lower row first; NaN out of reach.

        With several designs per place, the best of them.
        """
        best = np.where(self.reachable, self.values, -np.inf).reshape(-1, self.grid.n_places).max(axis=0)
        return self.grid.image(np.where(np.isfinite(best), best, np.nan))

    @property
    def highest_utility(self) -> float:
        """The largest utility."""
        return float(self.values[self.reachable].max())

    @property
    def is_flat(self) -> bool:
        """Whether all available designs have equal utility (to 1e-5), or the only one has none."""
        values = self.values[self.reachable]
        return bool(np.ptp(values) <= FLAT and (len(values) > 1 or values[0] <= FLAT))


def entropy_map(
    model: SensorModel, theta: FloatArray, grid: Grid, plan: Plan, *, reachable: BoolArray, bin_width: float = 1.0
) -> UtilityMap:
    """Compute the entropy of the predicted reading at every reachable place (paper, figures 2 and 8).

    `theta` are equally weighted hypotheses drawn from the posterior, (n_samples, n_params), 50 in the paper; `plan` has
    the places of the grid as rows (see `Grid.plan`), `reachable` marks them, (n_places,). Bins are `bin_width` wide, in
    the unit of readings: one LEGO unit rounds as the sensor does. For the naive model there are two readings, so the
    map is the paper's partition: at most one bit, where half of the circles contain the place. ReachError if no place
    is reachable, ParameterError if a prediction is not finite.
    """
    rows = reachable_rows(reachable, grid.n_places)
    predicted = predict_where_visible(model, theta, plan.take(rows))
    require_finite("predicted", predicted)
    return map_of_rows(Designs(grid), rows, label_entropy(np.rint(predicted / bin_width)), "entropy (bits)")


def label_entropy(labels: FloatArray) -> FloatArray:
    """Return the entropy, in bits, of the labels in each column, (n_samples, n_places) -> (n_places,).

    H = log2(n) - sum_j c_j log2(c_j) / n over the distinct labels j of a column, with counts c_j, which are the lengths
    of runs in the sorted column.
    """
    n_samples, n_places = labels.shape
    rows = np.sort(labels.T, axis=1)
    starts_run = np.ones((n_places, n_samples), dtype=np.bool_)
    starts_run[:, 1:] = rows[:, 1:] != rows[:, :-1]
    starts = np.flatnonzero(starts_run.ravel())
    counts = np.diff(starts, append=rows.size)
    spent = np.bincount(starts // n_samples, weights=counts * np.log2(counts), minlength=n_places)
    return np.asarray(np.maximum(np.log2(n_samples) - spent / n_samples, 0.0))


def map_of_rows(designs: Designs, rows: IntArray, utility: FloatArray, label: str) -> UtilityMap:
    """Return the map of the utilities, (n,), of the available designs `rows`, (n,).

    ShapeError for another number of utilities; ParameterError if one is not finite.
    """
    if utility.shape != rows.shape:
        raise ShapeError(f"the utility gives {utility.shape} values; allowed: {rows.shape}, one per design")
    values, reachable = np.zeros(len(designs)), np.zeros(len(designs), dtype=np.bool_)
    values[rows], reachable[rows] = utility, True
    best_designs_mask(values, reachable)  # raises if a value is not finite
    values.flags.writeable = False
    return UtilityMap(designs, values, reachable, label)


def reachable_rows(reachable: BoolArray, n_places: int, n_combinations: int = 1) -> IntArray:
    """Return the indices of the designs at reachable places, (n_places,) -> (n,), for `n_combinations` of settings.

    ReachError if there are none; ShapeError for a mask of another shape.
    """
    if reachable.shape != (n_places,):
        raise ShapeError(f"reachable has shape {reachable.shape}; allowed: ({n_places},), one per place")
    if not reachable.any():
        allowed = f"at least one of the {reachable.size} places of the field; "
        allowed += "is the field where the arm stands, and is its reach in millimetres?"
        raise ReachError("reachable places", 0, allowed)
    return np.flatnonzero(np.tile(reachable, n_combinations))


def best_designs_mask(utility: FloatArray, reachable: BoolArray) -> BoolArray:
    """Mark the reachable designs within `TIE` (1e-9) of the highest reachable utility; all arrays (n_designs,).

    ReachError if none is reachable, ShapeError if the arrays differ in shape, ParameterError if the utility of a
    reachable design is not finite.
    """
    if utility.shape != reachable.shape or utility.ndim != 1:
        raise ShapeError(f"utility has shape {utility.shape}, reachable {reachable.shape}; allowed: (n_places,) both")
    if not reachable.any():
        raise ReachError("reachable places", 0, f"1 or more of the {reachable.size}; move the arm or the places")
    require_finite("utility", utility[reachable])
    return np.asarray(reachable & (utility >= utility[reachable].max() - TIE))


def choose(utility: FloatArray, reachable: BoolArray, *, rng: np.random.Generator) -> int:
    """Draw the index of the next design at random among the best (paper, section 2.3).

    It raises as `best_designs_mask` does.
    """
    return int(rng.choice(np.flatnonzero(best_designs_mask(utility, reachable))))
