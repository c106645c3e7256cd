"""Geometry of a region besides its albedo: generic functions that each kind registers in its own file."""

from __future__ import annotations

from functools import singledispatch

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.scene.albedo import Region


@singledispatch
def outlines(region: Region, *, n_vertices: int = 96) -> list[FloatArray]:
    """Trace the closed edge of each hypothesis, for drawing, rasterising and culling.

    Parameters
    ----------
    region
        Ellipses, polygons, a mixture of these, or any kind that registers its outline (`outlines.register`).
    n_vertices
        Number of vertices of a curved edge.

    Returns
    -------
    One array (n, 2) per hypothesis, mm, the first vertex repeated at the end; pieces of a
    polygon that crosses itself are separated by NaN.

    Raises
    ------
    ParameterError
        If the region has no closed edge.
    """
    raise ParameterError("region", type(region).__name__, "EllipseRegion, PolygonRegion or a mixture of them")


@singledispatch
def edge_distance(region: Region, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return the distance of places from the nearest edge of a region, mm.

    Parameters
    ----------
    region
        A region of n_regions hypotheses; the distance is infinite for kinds without edges (uniform, ramp, image).
    x_mm, y_mm
        Places, (n_samples or 1, n_points).

    Returns
    -------
    Distances, (n_samples or n_regions or 1, n_points): exact, but to first order in the distance for an ellipse
    that is no disc.
    """
    return np.full(np.broadcast_shapes(x_mm.shape, y_mm.shape, (region.n_regions, 1)), np.inf)
