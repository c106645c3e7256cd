"""Readings of a run that knows its shape: what the sensor leaves out, and the side of the shape that nobody has seen.

A dozen readings that fit the plain sensor leave most faults open, and some of these a single further reading would
show. And a shape that is known from one side alone is known by the sensor model alone: a fault of no known name may
have put its far side anywhere. Both are asked before a run with doubt ends.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray
from probewise.arm.instrument import Reading
from probewise.inquiry import Prospect
from probewise.scene import outlines
from probewise.scene.albedo import Region
from probewise.scene.regions import EllipseRegion, PolygonRegion

__all__ = ["ENOUGH_BITS", "FAR_SIDE", "NAMES", "bits_of_names", "far_side"]

ENOUGH_BITS = 0.08
"""Expected information about the name of what is left out for which a reading is taken after the shape is known."""

NAMES = "expected information about what the sensor leaves out (bits)"
FAR_SIDE = "the side of the shape that no reading has seen (1 there)"
_NODES = 12  # of the reading expected under a name
_FAR = 0.75  # of the shape's diameter: two opposite readings at the edge of a circle leave 0.71
_AT_EDGE = 1.0  # spacings of the grid within which a reading is at the edge


def bits_of_names(weight: FloatArray, answers: FloatArray, names: NDArray[np.str_], noise_sd: float) -> FloatArray:
    """Return the expected information of a reading about the name alone, by a Gaussian for each name.

    Histograms of the few hypotheses that a name has would tell names apart that agree.

    Parameters
    ----------
    weight, names
        Weight and name of each hypothesis, (n,).
    answers
        Predicted readings, (n, n_designs).
    noise_sd
        Sd of a reading's noise.

    Returns
    -------
    Bits, (n_designs,).
    """
    share, mean, sd = [], [], []
    for name in np.unique(names):
        own = names == name
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
    return np.asarray(np.maximum(told / math.log(2.0), 0.0))


def far_side(prospect: Prospect, region: Region, readings: tuple[Reading, ...]) -> int | None:
    """Return the available design on the part of an outline that is farthest from every reading at the edge.

    Parameters
    ----------
    prospect
        The available designs.
    region
        The probable shape, one region.
    readings
        The readings so far.

    Returns
    -------
    Its index among the available designs; None where every part is nearer than three quarters of the diameter, or is
    out of reach, or where the shape is neither an ellipse nor a polygon.
    """
    if not isinstance(region, EllipseRegion | PolygonRegion):
        return None
    edge = outlines(region)[0]
    grid = prospect.designs.grid
    spacing = max(grid.width_mm / (grid.n_x - 1), grid.height_mm / (grid.n_y - 1))
    there = np.stack([prospect.plan.x_mm[prospect.rows], prospect.plan.y_mm[prospect.rows]], axis=1)
    away = np.linalg.norm(edge[:, None] - there, axis=2)
    edge, nearest = edge[away.min(axis=1) <= spacing], away.argmin(axis=1)[away.min(axis=1) <= spacing]
    if not len(edge):
        return None
    taken = np.array([[r.pose.x_mm, r.pose.y_mm] for r in readings])
    apart = np.linalg.norm(edge[:, None] - taken, axis=2)
    at_edge = apart.min(axis=0) <= _AT_EDGE * spacing
    if not at_edge.any():
        return int(nearest[0])
    distance = apart[:, at_edge].min(axis=1)
    diameter = np.linalg.norm(edge[:, None] - edge, axis=2).max()
    farthest = int(distance.argmax())
    return int(nearest[farthest]) if distance[farthest] > _FAR * diameter else None
