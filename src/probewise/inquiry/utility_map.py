"""The map: what a reading at each design would be worth, and the choice of the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.errors import ReachError, ShapeError
from probewise.inquiry.choice import best_places, choose
from probewise.inquiry.designs import Designs
from probewise.inquiry.finishing import Finishing
from probewise.inquiry.forecast import AskedForecast
from probewise.inquiry.grid import Grid
from probewise.inquiry.prospect import Prospect
from probewise.inquiry.readout import Readout
from probewise.inquiry.utility import ReadingEntropy, Utility
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SensorModel

__all__ = ["UtilityMap", "entropy_map", "utility_map"]

FLAT = 1e-5
"""Utilities that differ by less are equal for every purpose: single precision computes them."""


@dataclass(frozen=True, eq=False)
class UtilityMap:
    """Hold the worth of each design.

    `values` has shape (n_designs,), bits where the utility is an entropy or an information, 0 where
    `reachable` is False: nothing can be learned where the arm cannot go. `label` says what the values are, with
    their unit.
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
        """The map as rows and columns, shape (n_y, n_x), lower row first; NaN, for drawing, out of reach.

        Where a place allows several designs, the best of them.
        """
        every = np.where(self.reachable, self.values, -np.inf).reshape(-1, self.grid.n_places)
        best = every.max(axis=0)
        return self.grid.image(np.where(np.isfinite(best), best, np.nan))

    @property
    def highest(self) -> float:
        """The best that a reading can promise."""
        return float(self.values[self.reachable].max())

    @property
    def flat(self) -> bool:
        """Whether there is nothing to choose: all that can be taken promise the same, or the only one nothing."""
        values = self.values[self.reachable]
        return bool(np.ptp(values) <= FLAT and (len(values) > 1 or values[0] <= FLAT))

    @property
    def best(self) -> BoolArray:
        """The designs that tie for the best, shape (n_designs,)."""
        return best_places(self.values, self.reachable)

    def choose(self, *, rng: np.random.Generator) -> tuple[float, float]:
        """Draw the next place (x_mm, y_mm) at random among the best."""
        design = self.designs[choose(self.values, self.reachable, rng=rng)]
        return design.x_mm, design.y_mm


def utility_map(prospect: Prospect, utility: Utility) -> UtilityMap:
    """Value every design that can be taken (paper, the machine learning system).

    Raises
    ------
    ShapeError
        If the utility gives another number of values than designs.
    ParameterError
        If one of its values is not finite.
    """
    # The one utility with two measures says which of them these values are.
    worth, label = utility.measure(prospect) if isinstance(utility, Finishing) else (utility(prospect), utility.label)
    found = np.asarray(worth, dtype=np.float64)
    if found.shape != prospect.rows.shape:
        raise ShapeError(f"the utility gives {found.shape} values; allowed: {prospect.rows.shape}, one a design")
    values = np.zeros(len(prospect.designs))
    reachable = np.zeros(len(prospect.designs), dtype=np.bool_)
    values[prospect.rows], reachable[prospect.rows] = found, True
    best_places(values, reachable)  # raises where a value is not finite
    values.flags.writeable = False
    return UtilityMap(prospect.designs, values, reachable, label)


def entropy_map(
    model: SensorModel,
    theta: FloatArray,
    grid: Grid,
    plan: Plan,
    *,
    reachable: BoolArray,
    noise_sd: float,
    utility: Utility | None = None,
) -> UtilityMap:
    """Ask every hypothesis what it would read at every reachable place: the paper's map, by hand.

    Parameters
    ----------
    model
        The sensor over the hypothesised scene.
    theta
        Equally weighted hypotheses drawn from the posterior, (n_samples, n_params); the paper has 50.
    grid, plan
        The places, and the same places as rows of a plan (see `Grid.plan`).
    reachable
        Places the arm can take, shape (n_places,).
    noise_sd
        Sd of the noise of one reading, for utilities that weigh it.
    utility
        What a reading is worth; by default the entropy of the predicted ones.

    Raises
    ------
    ReachError
        If no place is reachable.
    """
    rows = reachable_rows(reachable, grid.n_places)
    even = np.full(len(theta), 1.0 / len(theta))
    prospect = Prospect(
        AskedForecast(model), Readout(noise_sd), theta, even, theta, Designs(grid), plan, rows, np.ones(rows.size)
    )
    return utility_map(prospect, ReadingEntropy() if utility is None else utility)


def reachable_rows(reachable: BoolArray, n_places: int, n_combinations: int = 1) -> IntArray:
    """Rows of the designs at places that can be reached, (n_places,) -> (n,)."""
    if reachable.shape != (n_places,):
        raise ShapeError(f"reachable has shape {reachable.shape}; allowed: ({n_places},), one a place")
    if not reachable.any():
        raise ReachError(
            "reachable places",
            0,
            f"at least one of the {reachable.size} places of the field; "
            "is the field where the arm stands, and is its reach in millimetres?",
        )
    return np.flatnonzero(np.tile(reachable, n_combinations))
