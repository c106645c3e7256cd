"""Areas of albedo, one for each hypothesis: small frozen values of batched geometry, one kind a file.

A new kind is a frozen dataclass with `n_regions`, `albedo` and `coverage`. In the same file it may register how far
its edge is (`edge_distance`) and, where that is closed, its trace (`outlines`); with a closed form registered at
`sensor.gaussian.seen_by_one` a footprint over it costs microseconds in place of milliseconds.
"""

from probewise.scene.regions.ellipse import EllipseRegion, disc_region
from probewise.scene.regions.geometry import edge_distance, outlines
from probewise.scene.regions.half_plane import HalfPlaneRegion
from probewise.scene.regions.image import ImageRegion
from probewise.scene.regions.mixture import MixtureOfRegions
from probewise.scene.regions.polygon import PolygonRegion
from probewise.scene.regions.quadrant import QuadrantRegion
from probewise.scene.regions.ramp import RampRegion
from probewise.scene.regions.stripes import StripesRegion
from probewise.scene.regions.uniform import UniformRegion

__all__ = [
    "EllipseRegion",
    "HalfPlaneRegion",
    "ImageRegion",
    "MixtureOfRegions",
    "PolygonRegion",
    "QuadrantRegion",
    "RampRegion",
    "StripesRegion",
    "UniformRegion",
    "disc_region",
    "edge_distance",
    "outlines",
]
