"""Albedo regions, one per hypothesis: small frozen values of batched geometry, one kind per file.

A new kind is a frozen dataclass with `n_regions`, `albedo` and `coverage`. In the same file it may register the
distance to its edge (`edge_distance`) and, where that is closed, its outline (`outlines`); a closed form registered
with `sensor.gaussian.mean_albedo_under_one_gaussian` makes a footprint over it cost microseconds, not milliseconds.
"""

from probewise.scene.regions.ellipse import EllipseRegion, disc_region
from probewise.scene.regions.geometry import edge_distance, outlines
from probewise.scene.regions.half_plane import HalfPlaneRegion
from probewise.scene.regions.image import ImageRegion
from probewise.scene.regions.mixed_kinds import RegionsOfMixedKinds
from probewise.scene.regions.polygon import PolygonRegion
from probewise.scene.regions.quadrant import QuadrantRegion
from probewise.scene.regions.ramp import RampRegion
from probewise.scene.regions.stripes import StripesRegion
from probewise.scene.regions.uniform import UniformRegion

__all__ = [
    "EllipseRegion",
    "HalfPlaneRegion",
    "ImageRegion",
    "PolygonRegion",
    "QuadrantRegion",
    "RampRegion",
    "RegionsOfMixedKinds",
    "StripesRegion",
    "UniformRegion",
    "disc_region",
    "edge_distance",
    "outlines",
]
