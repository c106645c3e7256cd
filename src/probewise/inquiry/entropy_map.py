"""The entropy map: what a reading at each reachable place of the grid would be worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import ShapeError
from probewise.inquiry.choice import best_places, choose
from probewise.inquiry.grid import Grid
from probewise.inquiry.utility import Prospect, ReadingEntropy, Utility
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SensorModel

__all__ = ["EntropyMap", "entropy_map"]

BLOCK = 2048  # places predicted at a time: a closed form with 20 nodes stays within 20 MB for 50 hypotheses


@dataclass(frozen=True, eq=False)
class EntropyMap:
    """Hold the worth of a reading at each place of a grid.

    `values` has shape (n_places,), bits where the utility is the entropy, 0 where
    `reachable` is False: nothing can be learned where the arm cannot go.
    """

    grid: Grid
    values: FloatArray
    reachable: BoolArray

    @property
    def image(self) -> FloatArray:
        """The map as rows and columns, shape (n_y, n_x), lower row first; NaN, for drawing, out of reach."""
        return self.grid.image(np.where(self.reachable, self.values, np.nan))

    @property
    def highest(self) -> float:
        """The best that a reading can promise."""
        return float(self.values[self.reachable].max())

    @property
    def best(self) -> BoolArray:
        """The places that tie for the best, shape (n_places,)."""
        return best_places(self.values, self.reachable)

    def choose(self, *, rng: np.random.Generator) -> tuple[float, float]:
        """Draw the next place (x_mm, y_mm) at random among the best."""
        x, y = self.grid.places_mm[choose(self.values, self.reachable, rng=rng)]
        return float(x), float(y)


def entropy_map(
    model: SensorModel,
    theta: FloatArray,
    grid: Grid,
    plan: Plan,
    *,
    reachable: BoolArray,
    noise_sd: float,
    utility: Utility | None = None,
) -> EntropyMap:
    """Ask every hypothesis what it would read at every reachable place (paper, the machine learning system).

    Parameters
    ----------
    model
        The sensor over the hypothesised scene.
    theta
        Hypotheses drawn from the posterior, shape (n_samples, n_params); the paper has 50.
    grid, plan
        The places, and the same places as rows of a plan (see `Grid.plan`).
    reachable
        Places the arm can take, shape (n_places,).
    noise_sd
        Sd of the noise of one reading, for utilities that weigh it.
    utility
        What a set of predicted readings is worth; by default their entropy in bits of one LEGO unit.

    Raises
    ------
    ReachError
        If no place is reachable.
    """
    if len(plan) != grid.n_places or reachable.shape != (grid.n_places,):
        raise ShapeError(f"plan has {len(plan)} rows, reachable {reachable.shape}; allowed: {grid.n_places} places")
    worth = ReadingEntropy() if utility is None else utility
    values = np.zeros(grid.n_places)
    rows = np.flatnonzero(reachable)
    for start in range(0, rows.size, BLOCK):
        block = rows[start : start + BLOCK]
        predicted = model.predict(theta, plan.take(block))
        predicted = np.broadcast_to(predicted, (len(theta), block.size))
        values[block] = worth(Prospect(predicted, np.asarray(noise_sd)))
    best_places(values, reachable)  # raises where no place is reachable
    values.flags.writeable = False
    return EntropyMap(grid, values, reachable)
