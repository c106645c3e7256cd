"""Regions of the pattern kinds of the recording format."""

from __future__ import annotations

import numpy as np

from probewise.errors import ParameterError
from probewise.recordings import patterns as kinds
from probewise.recordings.patterns import Pattern
from probewise.scene.albedo import Region
from probewise.scene.regions import (
    HalfPlaneRegion,
    ImageRegion,
    PolygonRegion,
    QuadrantRegion,
    RampRegion,
    StripesRegion,
    UniformRegion,
    disc_region,
)


def region_of(pattern: Pattern) -> Region:
    """Build the region that a pattern of a recording describes (n_regions is 1).

    Raises
    ------
    ParameterError
        If the pattern is of no known kind, or its numbers describe no area.
    """
    match pattern:
        case kinds.Uniform(level):
            return UniformRegion(np.array([level]))
        case kinds.HalfPlane(normal, offset, inside, outside):
            return HalfPlaneRegion(np.array([normal]), np.array([offset]), inside, outside)
        case kinds.Quadrant(corner, direction, inside, outside):
            return QuadrantRegion(np.array([corner]), np.array([direction]), inside, outside)
        case kinds.Disc(center, radius, inside, outside):
            return disc_region(np.array([center]), np.array([radius]), inside=inside, outside=outside)
        case kinds.Polygon(vertices, inside, outside):
            return PolygonRegion.from_even_odd_vertices(np.array(vertices), inside=inside, outside=outside)
        case kinds.Stripes(normal, period, duty, phase, inside, outside):
            return StripesRegion(
                np.array([normal]), np.array([period]), np.array([duty]), np.array([phase]), inside, outside
            )
        case kinds.Ramp(normal, per_mm):
            return RampRegion(np.array([normal]), np.array([per_mm]))
        case kinds.Image(albedo, pixel, origin, _):
            return ImageRegion(albedo, pixel, origin)
        case _:
            raise ParameterError("pattern", pattern, "a pattern of probewise.recordings.patterns")
