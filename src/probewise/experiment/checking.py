"""Checks before a run ends: further readings that would show a fault of the sensor, or an unread side of the shape.

A dozen readings that fit the sensor without faults cannot exclude most faults, and one further reading would show some.
And if a shape was read from one side only, its far side follows from the sensor model alone: with an unknown fault, the
result may be wrong by any amount. A run with `trust` below 1 checks both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.arm.instrument import Reading
from probewise.inquiry import Readout, UtilityInput, entropy_bits
from probewise.inquiry.given_reading import WeightsGivenReading
from probewise.scene import outlines
from probewise.scene.albedo import Region
from probewise.scene.regions import EllipseRegion, PolygonRegion

ENOUGH_BITS = 0.05
"""Expected information about the name of what is left out for which a reading is taken after the shape is known."""

NAMES = "expected information about what the sensor leaves out (bits)"
FAR_SIDE = "expected information (bits) on the side of the shape that no reading has seen"
_NODES = 12  # of the reading expected under a name
_CELL = 0.5  # noise sds: cells of the reading; twice as wide, they lose four times as much
_FAR = 0.75  # of the shape's diameter: two opposite readings at the edge of a circle leave 0.71
_AT_EDGE = 1.0  # spacings of the grid within which a reading is at the edge


def expected_bits_about_left_out_effect(
    weight: FloatArray, answers: FloatArray, names: NDArray[np.str_], readout: Readout, *, repeats: int = 1
) -> FloatArray:
    """Return the expected information of a reading about the name of the effect left out: the smaller of two estimates.

    The parameters of shape and effect do not count. Both estimates err upwards: one Gaussian per name, where a few
    predictions lie far from the others; a histogram of the readings, where a name has few hypotheses.

    Parameters
    ----------
    weight, names
        Weight, sum 1, and name of each hypothesis, (n,).
    answers
        Predicted readings, (n, n_designs).
    readout
        Cells and noise of a reading.
    repeats
        Number of readings at each design, of which the mean counts.

    Returns
    -------
    Bits, (n_designs,).
    """
    each = [names == name for name in np.unique(names)]
    by_gaussians = _expected_bits_by_gaussians(weight, answers, each, readout.noise_sd / math.sqrt(repeats))
    by_cells = _expected_bits_by_cells(weight, answers, each, readout, repeats)
    return np.asarray(np.maximum(np.minimum(by_gaussians, by_cells), 0.0))


def _expected_bits_by_gaussians(
    weight: FloatArray, answers: FloatArray, each: Sequence[BoolArray], noise_sd: float
) -> FloatArray:
    """Return bits about the name, (n_designs,), if the predictions of each name are Gaussian.

    `each` holds the mask of each name's hypotheses, (n,).
    """
    share, mean, sd = [], [], []
    for own in each:
        part = float(weight[own].sum())
        average = weight[own] @ answers[own] / part
        share.append(part)
        mean.append(average)
        sd.append(np.sqrt(weight[own] @ (answers[own] - average) ** 2 / part + noise_sd**2))
    p, middle, width = np.array(share)[:, None], np.array(mean), np.array(sd)
    # The entropy of the mixture, by Gauss-Hermite nodes about each name's Gaussian.
    nodes, node_weight = np.polynomial.hermite_e.hermegauss(_NODES)
    node_weight = node_weight / node_weight.sum()
    told = np.zeros(answers.shape[1])
    for k, part in enumerate(share):
        at = middle[k] + width[k] * nodes[:, None]
        log_density = -0.5 * ((at[:, None] - middle) / width) ** 2 - np.log(width)
        most = log_density.max(axis=1)
        of_all = most + np.log((p * np.exp(log_density - most[:, None])).sum(axis=1))
        told += part * (node_weight @ (log_density[:, k] - of_all))
    return np.asarray(told / math.log(2.0))


def _expected_bits_by_cells(
    weight: FloatArray, answers: FloatArray, each: Sequence[BoolArray], readout: Readout, repeats: int
) -> FloatArray:
    """Return bits about the name, (n_designs,): entropy of the histogram of readings minus its mean given the name."""
    given = WeightsGivenReading(answers, weight, readout, fine=_CELL, repeats=repeats)
    told = entropy_bits(given.weight_by_cell)
    for own in each:
        part = float(weight[own].sum())
        told -= part * entropy_bits(given.weighted_sum_by_cell(own / part))
    return np.asarray(told)


@dataclass(frozen=True, eq=False)
class OutlineReadingDistances:
    """The part of a probable shape's outline within reach, and distances from the readings taken near this outline.

    Attributes
    ----------
    edge_mm
        Places on the outline, (n, 2).
    nearest
        Index of the available design nearest to each place, (n,).
    apart_mm
        Distance of each place from the nearest reading at the outline, (n,); infinite if there is none.
    spacing_mm, diameter_mm
        Spacing of the grid, and diameter of the outline within reach.
    """

    edge_mm: FloatArray
    nearest: IntArray
    apart_mm: FloatArray
    spacing_mm: float
    diameter_mm: float

    @classmethod
    def from_region(cls, utility_input: UtilityInput, region: Region, readings: Sequence[Reading]) -> Self | None:
        """Build from one region and the readings so far; None if that is no ellipse or polygon, or out of reach."""
        if not isinstance(region, EllipseRegion | PolygonRegion):
            return None
        edge = outlines(region)[0]
        grid = utility_input.designs.grid
        spacing = max(grid.width_mm / (grid.n_x - 1), grid.height_mm / (grid.n_y - 1))
        away = np.linalg.norm(edge[:, None] - available_places_mm(utility_input), axis=2)
        within = away.min(axis=1) <= spacing
        if not within.any():
            return None
        edge, nearest = edge[within], away.argmin(axis=1)[within]
        diameter = float(np.linalg.norm(edge[:, None] - edge, axis=2).max())
        unread = cls(edge, nearest, np.full(len(edge), np.inf), spacing, diameter)
        # A missing reading has seen nothing.
        taken = np.array([[r.pose.x_mm, r.pose.y_mm] for r in readings if not math.isnan(r.value)]).reshape(-1, 2)
        apart = unread.nearest_reading_distances_if_read_at(taken).min(axis=1, initial=np.inf)
        return cls(edge, nearest, apart, spacing, diameter)

    def nearest_reading_distances_if_read_at(self, places_mm: FloatArray) -> FloatArray:
        """Return `apart_mm` with one more reading at each of these places, (n_places, 2) -> (n, n_places).

        A place farther than one spacing of the grid from the outline changes nothing.
        """
        apart = np.linalg.norm(self.edge_mm[:, None] - places_mm, axis=2)
        at_edge = apart.min(axis=0) <= _AT_EDGE * self.spacing_mm
        return np.asarray(np.minimum(np.where(at_edge, apart, np.inf), self.apart_mm[:, None]))

    @property
    def far_side_design(self) -> int | None:
        """Index of the available design at the place on the outline farthest from the readings at the outline.

        None if a reading at the outline is nearer to that place than 0.75 of the diameter.
        """
        farthest = int(self.apart_mm.argmax())
        return int(self.nearest[farthest]) if self.apart_mm[farthest] > _FAR * self.diameter_mm else None

    def leaves_no_far_side_mask(self, places_mm: FloatArray) -> BoolArray:
        """Mark places at which one more reading would leave `far_side_design` None, (n_places, 2) -> (n_places,)."""
        return np.asarray(self.nearest_reading_distances_if_read_at(places_mm).max(axis=0) <= _FAR * self.diameter_mm)


def available_places_mm(utility_input: UtilityInput) -> FloatArray:
    """Return x and y of the available designs, (n, 2)."""
    return np.stack([utility_input.plan.x_mm[utility_input.rows], utility_input.plan.y_mm[utility_input.rows]], axis=1)
