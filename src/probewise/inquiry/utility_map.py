"""The map of a utility over designs, and the choice of the next reading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.errors import ReachError, ShapeError
from probewise.inquiry.choice import best_places_mask
from probewise.inquiry.designs import Designs
from probewise.inquiry.finishing import Finishing
from probewise.inquiry.forecast import DirectForecast
from probewise.inquiry.grid import Grid
from probewise.inquiry.readout import Readout
from probewise.inquiry.utility import ReadingEntropy, Utility
from probewise.inquiry.utility_input import UtilityInput
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SensorModel

FLAT = 1e-5
"""Utilities that differ by less count as equal, since they are computed in single precision."""


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
        every = np.where(self.reachable, self.values, -np.inf).reshape(-1, self.grid.n_places)
        best = every.max(axis=0)
        return self.grid.image(np.where(np.isfinite(best), best, np.nan))

    @property
    def highest_utility(self) -> float:
        """The largest utility."""
        return float(self.values[self.reachable].max())

    @property
    def is_flat(self) -> bool:
        """Whether there is no choice: all available designs have equal utility (to 1e-5), or the only one has none."""
        values = self.values[self.reachable]
        return bool(np.ptp(values) <= FLAT and (len(values) > 1 or values[0] <= FLAT))

    @property
    def best_mask(self) -> BoolArray:
        """Mask of the reachable designs with the largest utility, ties included, shape (n_designs,)."""
        return best_places_mask(self.values, self.reachable)


def utility_map(utility_input: UtilityInput, utility: Utility) -> UtilityMap:
    """Compute the utility of every available design (paper, the machine learning system).

    Raises
    ------
    ShapeError
        If the utility returns a wrong number of values.
    ParameterError
        If one of its values is not finite.
    ReachError
        If no design is available.
    """
    # The utility with two measures reports which one these values are.
    value, label = (
        utility.utility_and_label(utility_input)
        if isinstance(utility, Finishing)
        else (utility(utility_input), utility.label)
    )
    found = np.asarray(value, dtype=np.float64)
    if found.shape != utility_input.rows.shape:
        raise ShapeError(f"the utility gives {found.shape} values; allowed: {utility_input.rows.shape}, one per design")
    values = np.zeros(len(utility_input.designs))
    reachable = np.zeros(len(utility_input.designs), dtype=np.bool_)
    values[utility_input.rows], reachable[utility_input.rows] = found, True
    best_places_mask(values, reachable)  # raises if a value is not finite
    values.flags.writeable = False
    return UtilityMap(utility_input.designs, values, reachable, label)


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
    """Compute the paper's entropy map from the predictions of every hypothesis at every reachable place.

    Parameters
    ----------
    model
        The sensor over the hypothesised scene.
    theta
        Equally weighted hypotheses drawn from the posterior, (n_samples, n_params); the paper has 50.
    grid, plan
        The places, and the same places as rows of a plan (see `Grid.plan`).
    reachable
        Mask of reachable places, shape (n_places,).
    noise_sd
        Sd of the noise of one reading, for utilities that use it.
    utility
        The utility; by default the entropy of the predicted readings.

    Raises
    ------
    ReachError
        If no place is reachable.
    """
    rows = reachable_rows(reachable, grid.n_places)
    even = np.full(len(theta), 1.0 / len(theta))
    utility_input = UtilityInput(
        DirectForecast(model),
        Readout(noise_sd),
        theta=theta,
        weight=even,
        drawn=theta,
        designs=Designs(grid),
        plan=plan,
        rows=rows,
        cost_s=np.ones(rows.size),
    )
    return utility_map(utility_input, ReadingEntropy() if utility is None else utility)


def reachable_rows(reachable: BoolArray, n_places: int, n_combinations: int = 1) -> IntArray:
    """Return the indices of the designs at reachable places, (n_places,) -> (n,), for `n_combinations` of settings.

    ReachError if there are none; ShapeError for a mask of another shape.
    """
    if reachable.shape != (n_places,):
        raise ShapeError(f"reachable has shape {reachable.shape}; allowed: ({n_places},), one per place")
    if not reachable.any():
        raise ReachError(
            "reachable places",
            0,
            f"at least one of the {reachable.size} places of the field; "
            "is the field where the arm stands, and is its reach in millimetres?",
        )
    return np.flatnonzero(np.tile(reachable, n_combinations))
